"""Monte Carlo of the identification: simulated units, identified and compared with the truth.

A case is a unit with arms of some 30 mm and residual errors that its calibration does not contain, turned by
half a circle with each axis up: 60 s of rest, 2.5 s, 12 s of rest. Motion to pulses, compensation, segments,
navigation and estimate are those of the product; only the wire is left out, as it changes no bit of a pulse.
A longer alignment would take time and change little: the rests next to the rotation determine the tilt again.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final

import numpy as np
from scipy.stats import chi2

from calib.certificate import lever_arms_of, sensing_points
from calib.estimation.joint import estimate_joint
from calib.estimation.plain import estimate_plain
from calib.estimation.result import TO_DIFFERENCES, LeverArmEstimate
from calib.estimation.runs import NavigationOptions, Priors, Run, navigate_capture
from calib.validation.simulate import LAYOUT, simulated_pulses, true_calibration
from imudrv.arrays import Array
from imudrv.calibration import Calibration, SizeEffect
from imudrv.files.settings_file import parse
from imudrv.sim.scenario import NOMINAL, Residuals, Scenario, Unit
from imudrv.units import DEG, MM, UG, URAD

REST_S: Final = 60.0
"""Rest before a rotation, s."""


AFTER_S: Final = 12.0
"""Rest after a rotation, s."""


POSES: Final = ("z_up", "x_up", "y_up")


TILT_MRAD: Final = 5.0
"""Largest tilt of the plate about each level axis, mrad."""


@dataclass(frozen=True)
class Budget:
    """Distribution of units and procedures; 1-sigma unless stated otherwise."""

    bias_ug: float = 50.0
    misalignment_urad: float = 30.0
    arw_deg_per_sqrt_h: float = 0.002
    turn_s: float = 2.5
    axis_tilt_mrad: float = 3.0  # rotation axis from the vertical, in a random direction
    pivot_mm: float = 60.0  # maximum of each component: origin of b from the fixed point of the axis
    priors: Priors = field(default_factory=Priors)  # the unit's skew is drawn from its prior


BUDGETS: Final = {
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
    """Statistics of a method over many cases; mm."""

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


def true_unit(seed: int, budget: Budget) -> Calibration:
    """Return the true unit of a seed: lever arms, and residual errors on the nominal calibration."""
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
    drawn_from = scenario(seed, NOMINAL, "z_up", 1, budget)
    real = true_calibration(Unit(residuals=residuals), drawn_from.seed)
    effect = SizeEffect(r_mm=sensing_points(arms), gauge="centroid")
    return real.model_copy(update={"size_effect": effect})


def scenario(seed: int, calibration: Calibration, pose: str, sign: int, budget: Budget) -> Scenario:
    """Return one rotation on the bench; seed, pose and sign determine its noise and the pose of the unit."""
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


def case(seed: int, signs: tuple[int, ...], budget: Budget) -> tuple[list[Run], Array]:
    """Return the runs of a unit and its true arms, (3, 3) m, with the centroid as origin."""
    real = true_unit(seed, budget)
    runs: list[Run] = []
    for sign in signs:
        for pose in POSES:
            turn = scenario(seed, real, pose, sign, budget)
            found = navigate_capture(
                partial(iter, [np.concatenate(list(simulated_pulses(turn)))]),
                LAYOUT,
                NOMINAL.without_size_effect(),
                turn.site,
                f"{pose}{sign:+d}",
                NavigationOptions(priors=budget.priors),
            )
            if len(found.runs) != 1:
                raise RuntimeError(
                    f"case {seed}, {pose}: expected one good rotation, rejected {found.rejected}"
                )
            runs += found.runs
    return runs, lever_arms_of(real, f"case {seed}").r_b


def statistics(method: str, found: Sequence[tuple[LeverArmEstimate, Array]]) -> Statistics:
    """Return the statistics of a method from its estimates, each with the true arms."""
    errors = np.array([(estimate.R_b - truth).ravel() / MM for estimate, truth in found])
    covariances = np.array([estimate.covariance / MM**2 for estimate, _ in found])
    n = len(errors)
    rms = np.sqrt((errors**2).mean(axis=1))
    six = errors @ TO_DIFFERENCES.T
    inverse = np.linalg.inv(TO_DIFFERENCES @ covariances @ TO_DIFFERENCES.T)
    scatter = float(np.sqrt((errors**2).mean()))
    predicted = float(np.sqrt(np.trace(covariances, axis1=1, axis2=2).mean() / 9.0))
    low, high = (float(chi2.ppf(p, 6 * n)) / n for p in (0.025, 0.975))
    return Statistics(
        method,
        cases=n,
        mean_rms_mm=float(rms.mean()),
        worst_rms_mm=float(rms.max()),
        scatter_mm=scatter,
        predicted_mm=predicted,
        ratio=predicted / scatter,
        nees=float(np.einsum("ni,nij,nj->n", six, inverse, six).mean()),
        nees_band=(low, high),
        chi_square_per_degree=float(np.mean([e.chi_square / max(1, e.degrees_of_freedom) for e, _ in found])),
    )


def run_cases(seeds: Iterable[int], signs: tuple[int, ...], budget: Budget) -> list[Statistics]:
    """Identify many units with both methods.

    Parameters
    ----------
    seeds : iterable of int
        One for each case.
    signs : tuple of int
        Signs of the rotations: (1,) gives three rotations, (1, -1) six.
    budget : Budget
        Distribution of the units.

    Returns
    -------
    list of Statistics
        Of `estimate_joint` and `estimate_plain`.
    """
    joint, plain = [], []
    for seed in seeds:
        runs, truth = case(seed, signs, budget)
        joint.append((estimate_joint(runs, budget.priors), truth))
        plain.append((estimate_plain(runs, budget.priors), truth))
    return [statistics("joint", joint), statistics("plain", plain)]
