"""Monte Carlo of the identification: simulated units, identified and compared with the truth.

A case is a unit with arms of some 30 mm and residual errors that its calibration does not contain, turned by
half a circle with each axis up: 60 s of rest, the turns, a last rest of 12 s. Motion to pulses, compensation,
segments, navigation and estimate are those of the product; only the wire is left out, as it changes no bit of
a pulse. A longer alignment would take time and change little: the rests next to the turns determine the tilt
again. A `Budget` says how the units and the bench differ from an ideal one.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import Any, Final

import numpy as np
from scipy.stats import chi2

from calib.certificate import lever_arms_of, sensing_points
from calib.estimation.joint import estimate_joint
from calib.estimation.plain import estimate_plain
from calib.estimation.priors import Priors
from calib.estimation.result import TO_DIFFERENCES, ChiSquare, LeverArmEstimate
from calib.estimation.runs import CaptureRuns, NavigationOptions, Run, navigate_capture
from calib.validation.simulate import simulated_pulses, true_calibration
from imudrv import profiles
from imudrv.arrays import Array
from imudrv.calibration import Calibration, SizeEffect, Temperature
from imudrv.files.settings_file import parse
from imudrv.sim.scenario import NOMINAL, Residuals, Scenario, Unit
from imudrv.site import Site
from imudrv.units import DEG, DEG_PER_H, MM, PPM, UG, URAD

REST_S: Final = 60.0
"""Rest before a rotation, s."""


AFTER_S: Final = 12.0
"""Rest after a rotation, s."""


SITE: Final = Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0)


POSES: Final = ("z_up", "x_up", "y_up")


POSE_MIN: Final = 2.0
"""Time from pose to pose, min, while the unit warms up."""


START_DEGC: Final = 35.0


PRIORS: Final = Priors(
    accelerometer_bias=50.0 * UG,
    accelerometer_scale=20.0 * PPM,
    accelerometer_misalignment=30.0 * URAD,
    gyro_bias=0.01 * DEG_PER_H,
    gyro_scale=5.0 * PPM,
    gyro_misalignment=30.0 * URAD,
)
"""Those of a unit that was calibrated on a turntable, from which the units are drawn."""


TILT_MRAD: Final = 5.0
"""Largest tilt of the plate about each level axis, mrad."""


@dataclass(frozen=True)
class Budget:
    """Distribution of units and procedures; 1-sigma unless stated otherwise."""

    bias_ug: float = 50.0
    misalignment_urad: float = 30.0
    arw_deg_per_sqrt_h: float = 0.002
    turn_s: float = 2.5
    turns: int = 1  # after one alignment, to and fro
    arrest_s: float = AFTER_S  # after each turn
    angle_deg: float = 180.0
    axis_tilt_mrad: float = 3.0  # rotation axis from the vertical, in a random direction
    pivot_mm: float = 60.0  # maximum of each component: origin of b from the fixed point of the axis
    arms_mm: float = 35.0  # maximum of each component before the centroid is subtracted
    skew_ms: float | None = None  # of every unit; None: drawn from its prior
    pulse_factor: float = 1.0  # accelerometer pulses that many times coarser
    dither_arcsec: float = 0.0  # amplitude of the dither, 400, 392 and 412 Hz
    pose_bias_ug: float = 0.0  # change of the accelerometer biases from pose to pose
    warming_k_per_min: float = 0.0  # with 30 ug, 30 ppm, 0.003 deg/h and 2 ppm per kelvin
    wobble_deg: float = 0.0
    motor_mg: float = 0.0  # vibration of the bench
    motor_hz: float = 25.0
    lean_urad: float = 0.0  # tilt of the bench a second after each turn
    dither_share: float = 1.0  # of the dither that is left in the increments
    case_reaction: float = 0.0  # of the dither, as a rotation of the case
    vrw_m_s_per_sqrt_h: float = 0.003
    signs: tuple[int, ...] = (1,)  # of the sets of three rotations
    profile: str = "imu50-rs422"
    interval_ms: float = 1.0
    one_file: bool = False  # the unit restarts between the poses
    priors: Priors = PRIORS  # the unit's skew is drawn from its prior


BUDGETS: Final = {
    "standard": Budget(),
    "bias": Budget(bias_ug=100.0, priors=replace(PRIORS, accelerometer_bias=100.0 * UG)),
    "misalignment": Budget(
        misalignment_urad=100.0,
        priors=replace(PRIORS, accelerometer_misalignment=100.0 * URAD, gyro_misalignment=100.0 * URAD),
    ),
    "slow": Budget(turn_s=4.0),
    "tilted": Budget(axis_tilt_mrad=1e3 * DEG),
    "offset": Budget(pivot_mm=100.0),
    "arw": Budget(arw_deg_per_sqrt_h=0.005),
    "ten-turns": Budget(turn_s=1.5, turns=10, arrest_s=4.0),
    "coarse-pulses": Budget(pulse_factor=10.0),
    "pose-bias": Budget(pose_bias_ug=20.0),
    "warming": Budget(warming_k_per_min=0.12),
    "wobble": Budget(wobble_deg=2.0),
    "176-deg": Budget(angle_deg=176.0),
    "long-arms": Budget(arms_mm=150.0),
    "motor": Budget(motor_mg=1.0),
    "six": Budget(signs=(1, -1)),
    "case-reaction": Budget(dither_arcsec=150.0, dither_share=0.0, case_reaction=0.01),
    "restart": Budget(signs=(1, -1), one_file=True),
    "turns-1-s": Budget(turn_s=1.0),
    "turns-5-s": Budget(turn_s=5.0),
    "lean": Budget(lean_urad=20.0),
    "200-hz": Budget(interval_ms=5.0),
    "400-hz": Budget(interval_ms=2.5),
    "can": Budget(profile="imu50-can"),
    **{f"dither-{amplitude}": Budget(dither_arcsec=amplitude) for amplitude in (3, 10, 100)},
    **{f"skew-{skew}": Budget(skew_ms=skew) for skew in (0.3, 1.0)},
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
    worst_sigma: float  # largest error of a difference, in its uncertainty
    band_held: float  # share of cases whose scatter at rest is in its 95 % band
    chi_square_per_degree: float


def nominal(budget: Budget) -> Calibration:
    """Return the calibration that is known of the units."""
    scale = np.array(NOMINAL.accelerometer.scale_pulse_per_m_s) / budget.pulse_factor
    accelerometer = NOMINAL.accelerometer.model_copy(update={"scale_pulse_per_m_s": tuple(scale.tolist())})
    return NOMINAL.model_copy(update={"accelerometer": accelerometer})


def true_unit(seed: int, budget: Budget) -> Calibration:
    """Return the true unit of a seed: lever arms, and residual errors on the nominal calibration."""
    arms = np.random.default_rng([seed, 0]).uniform(-budget.arms_mm, budget.arms_mm, (3, 3))
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
    known = nominal(budget)
    drawn_from = scenario(seed, known, "z_up", 1, budget)
    real = true_calibration(Unit(calibration=known, residuals=residuals), drawn_from.seed)
    terms = None
    if budget.warming_k_per_min:
        slopes = np.random.default_rng([seed, 8]).standard_normal((4, 3)) * [[0.003], [2.0], [30.0], [30.0]]
        names = (
            "gyro_bias_deg_per_h_per_k",
            "gyro_scale_ppm_per_k",
            "accelerometer_bias_ug_per_k",
            "accelerometer_scale_ppm_per_k",
        )
        terms = Temperature(
            reference_degc=START_DEGC,
            range_degc=(0.0, 70.0),
            **{name: tuple(row) for name, row in zip(names, slopes.tolist(), strict=True)},
        )
    effect = SizeEffect(r_mm=sensing_points(arms), gauge="centroid")
    return real.model_copy(update={"size_effect": effect, "temperature": terms})


def scenario(seed: int, calibration: Calibration, pose: str, sign: int, budget: Budget) -> Scenario:
    """Return one run on the bench; seed, pose and sign determine its noise and the pose of the unit."""
    number = 2 * POSES.index(pose) + int(sign < 0)
    bench = np.random.default_rng([seed, 1 + POSES.index(pose), int(sign > 0)])
    tilt, pivot = bench.uniform(-TILT_MRAD, TILT_MRAD, 2), bench.uniform(-1.0, 1.0, 3) * budget.pivot_mm
    lean = bench.uniform(0.0, 2.0 * np.pi)
    axis_tilt = [budget.axis_tilt_mrad * np.cos(lean), budget.axis_tilt_mrad * np.sin(lean)]
    skew_s = budget.priors.skew * float(np.random.default_rng([seed, 7]).standard_normal())
    if budget.skew_ms is not None:
        skew_s = budget.skew_ms * 1e-3
    moved_ug = budget.pose_bias_ug * np.random.default_rng([seed, 9, number]).standard_normal(3)
    rotate = {
        "angle_deg": budget.angle_deg * sign,
        "duration_s": budget.turn_s,
        "axis_tilt_mrad": axis_tilt,
        "wobble_deg": budget.wobble_deg,
    }
    unit: dict[str, Any] = {
        "calibration": json.loads(calibration.model_dump_json(exclude_none=True)),
        "accelerometer_skew_s": skew_s,
        "noise": {
            "arw_deg_per_sqrt_h": budget.arw_deg_per_sqrt_h,
            "vrw_m_s_per_sqrt_h": budget.vrw_m_s_per_sqrt_h,
        },
        "bias_steps": [{"at_s": 0.0, "accelerometer_ug": moved_ug.tolist()}],
    }
    if budget.dither_arcsec:
        amplitude = 3 * [budget.dither_arcsec]
        unit["dither"] = {
            "amplitude_arcsec": amplitude,
            "frequency_hz": [400.0, 392.0, 412.0],
            "in_increments": budget.dither_share,
            "case_reaction": budget.case_reaction,
        }
    if budget.warming_k_per_min:
        unit["temperature"] = {
            "start_degc": START_DEGC + number * POSE_MIN * budget.warming_k_per_min,
            "slope_k_per_h": 60.0 * budget.warming_k_per_min,
        }
    document: dict[str, Any] = {
        "format": "imu50-scenario",
        "version": 1,
        "seed": int(bench.integers(2**63)),
        "site": SITE.model_dump(exclude_none=True, exclude={"format", "version"}),
        "start": {"pose": pose, "tilt_mrad": tilt.tolist(), "pivot_offset_mm": pivot.tolist()},
        "motion": [
            {"rest": {"duration_s": REST_S}},
            {"turns": {"count": budget.turns, "rotate": rotate, "arrest_s": budget.arrest_s}},
        ],
        "unit": unit,
    }
    if budget.lean_urad:
        lean_deg = budget.lean_urad * URAD / DEG
        document["motion"][1]["turns"]["arrest_s"] = 1.0
        document["motion"] += [
            {"rotate": {"angle_deg": lean_deg, "duration_s": 0.5, "axis_n": [0.6, 0.8, 0.0]}},
            {"rest": {"duration_s": budget.arrest_s - 1.5}},
        ]
    if budget.turns > 1:
        document["motion"].append({"rest": {"duration_s": AFTER_S - budget.arrest_s}})
    if budget.motor_mg:
        document["motor"] = {"frequency_hz": budget.motor_hz, "mg": [budget.motor_mg, 0.0, budget.motor_mg]}
    return parse(document, Scenario, "montecarlo")


def drawn(seed: int) -> Budget:
    """Return conditions drawn at random; the priors are the defaults of the product."""
    rng = np.random.default_rng([seed, 99])

    def some(low: float, high: float, share: float = 0.3) -> float:
        """Draw a number in a share of the cases, 0 in the others."""
        return float(rng.uniform(low, high)) if rng.random() < share else 0.0

    turns = int(rng.choice([1, 1, 1, 5]))
    dither = some(-1.0, 5.0)  # natural logarithm of arcsec
    return Budget(
        bias_ug=float(rng.uniform(0.0, 70.0)),
        misalignment_urad=float(rng.uniform(0.0, 150.0)),
        arw_deg_per_sqrt_h=float(rng.uniform(0.0005, 0.005)),
        vrw_m_s_per_sqrt_h=float(rng.uniform(0.001, 0.01)),
        turn_s=float(rng.uniform(1.0, 5.0)),
        turns=turns,
        arrest_s=4.0 if turns > 1 else 12.0,
        angle_deg=float(rng.uniform(176.0, 184.0)),
        axis_tilt_mrad=float(rng.uniform(0.0, 15.0)),
        pivot_mm=float(rng.uniform(0.0, 150.0)),
        arms_mm=float(rng.uniform(10.0, 150.0)),
        skew_ms=float(rng.normal(0.0, 0.5)),
        pulse_factor=float(rng.choice([0.1, 1.0, 1.0, 3.0, 10.0])),
        dither_arcsec=float(np.exp(dither)) if dither else 0.0,
        case_reaction=some(0.0, 0.02),
        pose_bias_ug=some(0.0, 40.0),
        warming_k_per_min=some(0.0, 0.15),
        wobble_deg=some(0.0, 3.0),
        motor_mg=some(0.0, 3.0),
        motor_hz=float(rng.uniform(10.0, 60.0)),
        lean_urad=some(0.0, 20.0, 0.2) if turns == 1 else 0.0,
        signs=(1, -1) if rng.random() < 0.7 else (1,),
        interval_ms=float(rng.choice([1.0, 1.0, 2.5, 5.0])),
        one_file=bool(rng.random() < 0.2),
        priors=Priors(),
    )


def captures(seed: int, budget: Budget) -> list[CaptureRuns]:
    """Return the captures of a unit, navigated: one of each pose and sign, or one of all."""
    layout = profiles.load(budget.profile).layout()
    layout = replace(layout, interval=Fraction(round(budget.interval_ms * 1e6)))
    real = true_unit(seed, budget)
    turns = {
        f"{pose}{sign:+d}": scenario(seed, real, pose, sign, budget)
        for sign in budget.signs
        for pose in POSES
    }
    data = {label: list(simulated_pulses(turn, layout)) for label, turn in turns.items()}
    if budget.one_file:
        data = {"all": [piece for pieces in data.values() for piece in pieces]}
    return [
        navigate_capture(
            partial(iter, pieces),
            layout,
            nominal(budget).without_size_effect(),
            SITE,
            label,
            NavigationOptions(priors=budget.priors),
        )
        for label, pieces in data.items()
    ]


def case(seed: int, budget: Budget) -> tuple[list[Run], Array]:
    """Return the runs of a unit and its true arms, (3, 3) m, with the centroid as origin."""
    runs = [run for capture in captures(seed, budget) for run in capture.runs]
    if len(runs) != len(POSES) * len(budget.signs):
        raise RuntimeError(f"case {seed}: expected {len(POSES) * len(budget.signs)} runs, got {len(runs)}")
    return runs, true_arms(seed, budget)


def true_arms(seed: int, budget: Budget) -> Array:
    """Return the true arms of a seed, (3, 3) m, with the centroid as origin."""
    return lever_arms_of(true_unit(seed, budget), f"case {seed}").r_b


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
        worst_sigma=max(worst_sigma(*one) for one in found),
        band_held=float(
            np.mean([_in_band(estimate.scatter or estimate.redundancy) for estimate, _ in found])
        ),
        chi_square_per_degree=float(
            np.mean(
                [
                    t.value / max(1, t.degrees_of_freedom)
                    for e, _ in found
                    for t in [e.scatter or e.redundancy]
                ]
            )
        ),
    )


def run_cases(seeds: Iterable[int], budget: Budget) -> list[Statistics]:
    """Identify many units with both methods.

    Parameters
    ----------
    seeds : iterable of int
        One for each case.
    budget : Budget
        Distribution of the units.

    Returns
    -------
    list of Statistics
        Of `estimate_joint` and `estimate_plain`.
    """
    joint, plain = [], []
    for seed in seeds:
        runs, truth = case(seed, budget)
        joint.append((estimate_joint(runs, budget.priors), truth))
        plain.append((estimate_plain(runs, budget.priors), truth))
    return [statistics("joint", joint), statistics("plain", plain)]


def worst_sigma(estimate: LeverArmEstimate, truth: Array) -> float:
    """Return the largest error of a difference, in its standard uncertainty."""
    error = TO_DIFFERENCES @ (estimate.R_b - truth).ravel()
    return float(np.abs(error / estimate.differences_sigma.ravel()).max())


def _in_band(test: ChiSquare) -> bool:
    """Whether the value of a test is in its 95 % band."""
    low, high = test.band
    return low <= test.value <= high
