"""How well the inner lever arms are found: simulated units drawn from a budget, identified, compared.

tools/run python tools/montecarlo.py --cases 200
tools/run python tools/montecarlo.py --budget slow --signs both --json

A case is a unit with arms of some 30 mm and residual errors that its calibration does not know, turned half a
circle with each axis up: 60 s of rest, 2.5 s, 12 s of rest. From motion to pulses, compensation, segments,
navigation and estimate all is the product's own; only the wire is left out, for it changes no bit of a pulse.
A longer alignment would cost time and change little: the rests beside the rotation tell the tilt again.
"""

import argparse
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table
from scipy.stats import chi2

from calib.estimation.joint import estimate_joint
from calib.estimation.plain import estimate_plain
from calib.estimation.result import TO_DIFFERENCES, LeverArmEstimate
from calib.estimation.runs import Priors, Run, navigate_rotations
from imudrv import profiles
from imudrv.calibration import Calibration, coefficients
from imudrv.files.settings_file import parse
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import rate_filter
from imudrv.records import Flag, Records
from imudrv.sim.scenario import NOMINAL, Residuals, Scenario, Unit
from imudrv.sim.unit import draw_true_unit, simulate
from imudrv.units import ARCSEC, DEG, DEG_PER_H, MM, UG, URAD

Array = NDArray[np.float64]

LAYOUT = profiles.load("imu50-rs422").layout()
REST_S, AFTER_S = 60.0, 12.0
POSES = ("z_up", "x_up", "y_up")
TILT_MRAD = 5.0
"""Largest lean of the plate, each way."""


@dataclass(frozen=True)
class Budget:
    """What a unit and a procedure are drawn from; 1-sigma, where it is not said otherwise."""

    bias_ug: float = 50.0
    misalignment_urad: float = 30.0
    arw_deg_per_sqrt_h: float = 0.002
    turn_s: float = 2.5
    axis_tilt_mrad: float = 3.0  # of the rotation's axis from the vertical, in a random direction
    pivot_mm: float = 60.0  # of the origin of b from the axis' fixed point, each component up to this
    priors: Priors = field(default_factory=Priors)  # the unit's skew is drawn from its prior


BUDGETS = {
    "standard": Budget(),
    "bias": Budget(bias_ug=100.0, priors=Priors(accelerometer_bias=100.0 * UG)),
    "misalignment": Budget(
        misalignment_urad=100.0,
        priors=Priors(accelerometer_misalignment=100.0 * URAD, gyro_misalignment=100.0 * URAD),
    ),
    "slow": Budget(turn_s=4.0),
    "tilted": Budget(axis_tilt_mrad=1e3 * DEG),
    "offset": Budget(pivot_mm=100.0),
    "arw": Budget(arw_deg_per_sqrt_h=0.005),
}


@dataclass(frozen=True)
class Statistics:
    """What many cases say of a method; mm."""

    method: str
    cases: int
    mean_rms_mm: float
    worst_rms_mm: float
    scatter_mm: float
    predicted_mm: float
    ratio: float
    nees: float
    nees_band: tuple[float, float]
    chi_square_per_degree: float


def unit(seed: int, budget: Budget) -> Calibration:
    """The unit that the seed draws, as it really is: arms, and residual errors on the nominal calibration."""
    arms = np.random.default_rng([seed, 0]).uniform(-35.0, 35.0, (3, 3))
    arms = np.round(arms - arms.mean(axis=0), 6)
    arms[2] = -arms[0] - arms[1]
    residuals = Residuals(
        gyro_bias_deg_per_h=0.01,
        gyro_scale_ppm=5.0,
        gyro_misalignment_urad=budget.misalignment_urad,
        accelerometer_bias_ug=budget.bias_ug,
        accelerometer_scale_ppm=20.0,
        accelerometer_misalignment_urad=budget.misalignment_urad,
    )
    nominal = scenario(seed, NOMINAL, "z_up", 1, budget)
    real = draw_true_unit(nominal.model_copy(update={"unit": Unit(residuals=residuals)}))
    document = json.loads(NOMINAL.model_dump_json(exclude_none=True))
    document["gyro"] = {
        "scale_arcsec_per_pulse": (real.gyro_scale / ARCSEC).tolist(),
        "bias_deg_per_h": (real.gyro_bias / DEG_PER_H).tolist(),
        "C_bg": real.C_bg.tolist(),
    }
    document["accelerometer"] = {
        "scale_pulse_per_m_s": real.accelerometer_scale.tolist(),
        "bias_ug": (real.accelerometer_bias / UG).tolist(),
        "C_ba": real.C_ba.tolist(),
    }
    document["size_effect"] = {"r_mm": dict(zip("xyz", arms.tolist(), strict=True)), "gauge": "centroid"}
    return parse(document, Calibration, "unit")


def scenario(seed: int, calibration: Calibration, pose: str, sign: int, budget: Budget) -> Scenario:
    """One rotation on the bench; seed, pose and sign decide its noise and how the unit stands."""
    bench = np.random.default_rng([seed, 1 + POSES.index(pose), int(sign > 0)])
    tilt, pivot = bench.uniform(-TILT_MRAD, TILT_MRAD, 2), bench.uniform(-1.0, 1.0, 3) * budget.pivot_mm
    lean = bench.uniform(0.0, 2.0 * np.pi)
    axis_tilt = [budget.axis_tilt_mrad * np.cos(lean), budget.axis_tilt_mrad * np.sin(lean)]
    skew_s = budget.priors.skew * float(np.random.default_rng([seed, 7]).standard_normal())
    document: dict[str, Any] = {
        "format": "imu50-scenario",
        "version": 1,
        "seed": int(bench.integers(2**63)),
        "site": {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0},
        "start": {"pose": pose, "tilt_mrad": tilt.tolist(), "pivot_offset_mm": pivot.tolist()},
        "motion": [
            {"rest": {"duration_s": REST_S}},
            {"rotate": {"angle_deg": 180.0 * sign, "duration_s": budget.turn_s, "axis_tilt_mrad": axis_tilt}},
            {"rest": {"duration_s": AFTER_S}},
        ],
        "unit": {
            "calibration": json.loads(calibration.model_dump_json(exclude_none=True)),
            "accelerometer_skew_s": skew_s,
            "noise": {"arw_deg_per_sqrt_h": budget.arw_deg_per_sqrt_h, "vrw_m_s_per_sqrt_h": 0.003},
        },
    }
    return parse(document, Scenario, "montecarlo")


def increments(turn: Scenario) -> Records:
    """What the driver makes of the unit's pulses with the nominal calibration, without the size effect."""
    bare = coefficients(NOMINAL.model_copy(update={"size_effect": None}))
    compensator = Compensator(bare, LAYOUT, rate_filter("causal", LAYOUT.interval_ns))
    pulses = np.concatenate([chunk.pulses for chunk in simulate(turn, LAYOUT.interval_ns)])
    pulses["flags"] = Flag.VALID
    return compensator.feed(pulses)


def case(seed: int, signs: tuple[int, ...], budget: Budget) -> tuple[list[Run], Array]:
    """Runs of a unit and its true arms, (3, 3) m, centroid in the origin."""
    real = unit(seed, budget)
    assert real.size_effect is not None
    runs: list[Run] = []
    for sign in signs:
        for pose in POSES:
            turn = scenario(seed, real, pose, sign, budget)
            found = navigate_rotations(
                partial(iter, [increments(turn)]),
                np.eye(3),
                turn.site,
                label=f"{pose}{sign:+d}",
                priors=budget.priors,
            )
            if len(found.runs) != 1:
                raise RuntimeError(
                    f"case {seed}, {pose}: expected one good rotation, rejected {found.rejected}"
                )
            runs += found.runs
    return runs, real.size_effect.r_m


class Tally:
    """What the cases of one method say."""

    def __init__(self, method: str) -> None:
        self.method = method
        self.errors: list[Array] = []
        self.covariances: list[Array] = []
        self.chi_square: list[float] = []

    def add(self, found: LeverArmEstimate, truth: Array) -> None:
        """Compare an estimate with the truth."""
        self.errors.append((found.R_b - truth).ravel() / MM)
        self.covariances.append(found.covariance / MM**2)
        self.chi_square.append(found.chi_square / max(1, found.degrees_of_freedom))

    def statistics(self) -> Statistics:
        """Figures over all cases."""
        errors, covariances = np.array(self.errors), np.array(self.covariances)
        n = len(errors)
        rms = np.sqrt((errors**2).mean(axis=1))
        six = errors @ TO_DIFFERENCES.T
        inverse = np.linalg.inv(TO_DIFFERENCES @ covariances @ TO_DIFFERENCES.T)
        scatter = float(np.sqrt((errors**2).mean()))
        predicted = float(np.sqrt(np.trace(covariances, axis1=1, axis2=2).mean() / 9.0))
        low, high = (float(chi2.ppf(p, 6 * n)) / n for p in (0.025, 0.975))
        return Statistics(
            self.method,
            n,
            float(rms.mean()),
            float(rms.max()),
            scatter,
            predicted,
            predicted / scatter,
            float(np.einsum("ni,nij,nj->n", six, inverse, six).mean()),
            (low, high),
            float(np.mean(self.chi_square)),
        )


def montecarlo(seeds: Iterable[int], signs: tuple[int, ...], budget: Budget) -> list[Statistics]:
    """Identify many units.

    Parameters
    ----------
    seeds : iterable of int
        One a case.
    signs : tuple of int
        Of the rotations: (1,) makes three of them, (1, -1) six.
    budget : Budget
        What is drawn from.

    Returns
    -------
    list of Statistics
        Of `estimate_joint` and of `estimate_plain`.
    """
    tallies = Tally("joint"), Tally("plain")
    for seed in seeds:
        runs, truth = case(seed, signs, budget)
        for tally, method in zip(tallies, (estimate_joint, estimate_plain), strict=True):
            tally.add(method(runs, budget.priors), truth)
    return [tally.statistics() for tally in tallies]


def main() -> None:
    """Run the cases and tell."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--cases", type=int, default=200, help="how many (default: %(default)s)")
    parser.add_argument("--budget", choices=BUDGETS, default="standard", help="default: %(default)s")
    parser.add_argument("--signs", choices=("one", "both"), default="one", help="three rotations or six")
    parser.add_argument(
        "--skew-sigma-ms",
        type=float,
        default=Priors().skew * 1e3,
        help="gyro-accelerometer skew of the units, 1 sigma, and its prior; 0: none (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, help="of the first case (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="numbers for a machine instead of a table")
    options = parser.parse_args()
    if options.cases < 1:
        parser.error("--cases: expected 1 or more")
    if not 0.0 <= options.skew_sigma_ms <= 2.0:
        parser.error("--skew-sigma-ms: expected 0 to 2")
    budget = BUDGETS[options.budget]
    budget = replace(budget, priors=replace(budget.priors, skew=options.skew_sigma_ms * 1e-3))
    seeds: Iterable[int] = range(options.seed, options.seed + options.cases)
    if not options.json:
        seeds = track(seeds, description="cases", transient=True)
    signs = (1,) if options.signs == "one" else (1, -1)
    found = montecarlo(seeds, signs, budget)
    if options.json:
        rows = [asdict(row) for row in found]
        print(json.dumps({"budget": options.budget, "signs": options.signs, "methods": rows}, indent=1))
        return
    table = Table(
        "method", "mean rms", "worst", "scatter", "predicted", "ratio", "NEES (6)", "95 % band", "chi2/dof"
    )
    for s in found:
        table.add_row(
            s.method,
            *(f"{x:.4f}" for x in (s.mean_rms_mm, s.worst_rms_mm, s.scatter_mm, s.predicted_mm)),
            f"{s.ratio:.3f}",
            f"{s.nees:.2f}",
            f"{s.nees_band[0]:.2f} .. {s.nees_band[1]:.2f}",
            f"{s.chi_square_per_degree:.2f}",
        )
    console = Console()
    console.print(f"{options.cases} units, budget {options.budget}, {3 * len(signs)} rotations each; mm")
    console.print(table)


if __name__ == "__main__":
    main()
