"""Accuracy that a plan of rotations will give."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, tan
from typing import Final, get_args

import numpy as np
from scipy.spatial.transform import Rotation as Attitude

from calib.axes import Side, vector
from calib.detection.blocks import BLOCK_NS
from calib.detection.noise import Noise
from calib.detection.segments import Rest
from calib.detection.turns import Turn
from calib.estimation.linear_system import (
    GAIN_WINDOW_S,
    NormalEquations,
    parameter_groups,
    prior_parameters,
    run_equations,
    unobservable_text,
)
from calib.estimation.result import CENTROID_BASIS, TO_DIFFERENCES
from calib.estimation.runs import AFTER_S, BEFORE_S, GUARD_S, Priors, Run
from calib.html_table import html_table
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.nav.alignment import ALIGNMENT_S, Aligned
from imudrv.nav.earth import earth_rate_n, normal_gravity
from imudrv.nav.mechanisation import Navigator, Place
from imudrv.records import INCREMENTS
from imudrv.units import DEG, MM, NS

_PLAN_INTERVAL_NS: Final = 5_000_000


@dataclass(frozen=True)
class PlannedRotation:
    """One run of a plan: a turn, or several after one alignment.

    Attributes
    ----------
    up : {'+X', '-X', '+Y', '-Y', '+Z', '-Z'}
        Body axis that points up.
    angle_deg : float
        Right-handed about up.
    duration_s : float
        Duration from rest to rest, with minimum jerk.
    after_s : float
        Duration of the rest after each turn.
    offset_m : float
        Distance of the origin of b from the rotation axis; the effect of a skew is proportional to it.
    turns : int
        Number of turns after one alignment.
    alternate : bool
        Whether every second turn is back.
    """

    up: Side
    angle_deg: float = 180.0
    duration_s: float = 2.5
    after_s: float = 15.0
    offset_m: float = 0.05
    turns: int = 1
    alternate: bool = True


@dataclass(frozen=True, repr=False)
class Prediction:
    """Predicted accuracy of a plan.

    Attributes
    ----------
    covariance : ndarray, shape (9, 9)
        Covariance of (r_x, r_y, r_z) in gauge centroid, m^2.
    differences_sigma : ndarray, shape (2, 3)
        1-sigma of `r_x - r_y` and `r_x - r_z`, m.
    """

    covariance: Array
    differences_sigma: Array

    def __repr__(self) -> str:
        return f"<Prediction: sigma of the differences up to {self.differences_sigma.max() / MM:.3f} mm>"

    def _repr_html_(self) -> str:
        rows = [
            (name, *(f"{value:.3f}" for value in sigma))
            for name, sigma in zip(("r_x - r_y", "r_x - r_z"), self.differences_sigma / MM, strict=True)
        ]
        return html_table("Predicted sigma of the differences", ("mm", "X", "Y", "Z"), rows)


def predict(
    plan: Sequence[PlannedRotation], latitude_rad: float, noise: Noise, priors: Priors | None = None
) -> Prediction:
    """Predict the covariance of the lever arms from an ideal motion, without data.

    Parameters
    ----------
    plan : sequence of PlannedRotation
        The rotations.
    latitude_rad : float
        Geodetic latitude.
    noise : Noise
        Noise of the sensors, such as that of an earlier session.
    priors : Priors, optional
        Uncertainty of the static calibration.

    Returns
    -------
    Prediction

    Raises
    ------
    InputError
        The plan is empty, or does not determine the six differences; names the unobservable directions.
    """
    priors = priors or Priors()
    if not plan:
        raise InputError("plan: expected at least one rotation, got none")
    runs = [_planned_run(planned, k, latitude_rad, priors) for k, planned in enumerate(plan)]
    terms = parameter_groups(priors, ())
    system = NormalEquations(
        [run_equations(run, noise, "free", terms) for run in runs], prior_parameters(runs, priors, terms)
    )
    sigma, directions = system.directions()
    if int((sigma < priors.arm).sum()) < 6:
        raise InputError(unobservable_text(sigma, directions, CENTROID_BASIS, priors.arm))
    covariance = system.solve(CENTROID_BASIS)[1][:9, :9]
    spread = np.sqrt(np.diag(TO_DIFFERENCES @ covariance @ TO_DIFFERENCES.T))
    return Prediction(covariance, spread.reshape(2, 3))


def _planned_run(planned: PlannedRotation, k: int, latitude_rad: float, priors: Priors) -> Run:
    """Return the ideal run of a planned rotation: level, about the vertical, without errors."""
    T, n = _PLAN_INTERVAL_NS * NS, round(planned.duration_s / (_PLAN_INTERVAL_NS * NS))
    before, after = round(BEFORE_S / T), round(min(planned.after_s, AFTER_S) / T)
    if planned.up not in get_args(Side) or n < 1 or planned.turns < 1 or after * T < GAIN_WINDOW_S:
        raise InputError(
            f"plan: expected an axis up from +X to -Z, a duration, turns, and a rest of at "
            f"least {GAIN_WINDOW_S:g} s, got {planned}"
        )
    up_b = vector(planned.up)
    starts = before + (n + after) * np.arange(planned.turns)
    samples = np.arange(before + (n + after) * planned.turns + 1)
    angle = np.zeros(len(samples))
    for k, start in enumerate(starts):
        u = np.clip((samples - start) / n, 0.0, 1.0)
        sign = -1.0 if planned.alternate and k % 2 else 1.0
        angle += sign * planned.angle_deg * DEG * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    gravity = normal_gravity(latitude_rad, 0.0)
    C_nb0 = Attitude.align_vectors([[0.0, 0.0, 1.0]], [up_b])[0]
    turned = Attitude.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))
    C_nb = turned * C_nb0
    increments = np.zeros(len(angle) - 1, INCREMENTS)
    increments["counter"] = np.arange(len(increments))
    increments["interval_ns"] = _PLAN_INTERVAL_NS
    increments["dtheta_b"] = np.outer(np.diff(angle), up_b) + T * C_nb[1:].inv().apply(
        earth_rate_n(latitude_rad)
    )
    v_n = np.gradient(turned.apply([planned.offset_m, 0.0, 0.0]), T, axis=0)
    increments["dv_b"] = gravity * T * up_b + C_nb[1:].inv().apply(np.diff(v_n, axis=0))
    q_nb = np.roll(C_nb0.as_quat(), 1)
    every = BLOCK_NS // _PLAN_INTERVAL_NS
    rows = Navigator(Place(latitude_rad, 0.0, 0.0), q_nb, C_ba=np.eye(3), every=every).feed(increments)
    guard = round(GUARD_S / T)
    level = priors.accelerometer_bias / gravity
    heading = hypot(
        priors.gyro_bias / earth_rate_n(latitude_rad)[1],
        tan(latitude_rad) * priors.accelerometer_bias / gravity,
    )
    rest = Rest(0, before, 0.0, before * T, 0, planned.up, up_b, None)
    turns = tuple(
        Turn(
            start,
            start + n,
            start * T,
            (start + n) * T,
            missing=0,
            before=rest,
            after=rest,
            angle_deg=planned.angle_deg,
            axis=planned.up,
            about=planned.up[1],
            axis_tilt_deg=0.0,
            peak_deg_per_s=0.0,
            flags=0,
            reasons=(),
        )
        for start in starts.tolist()
    )
    counter = rows["counter"]
    begins = [0, *(turn.stop + guard for turn in turns)]
    ends = [*(turn.start - guard for turn in turns), len(increments)]
    return Run(
        f"plan#{k + 1}",
        turns,
        Aligned(0, 0, q_nb, ALIGNMENT_S, level, heading, None),
        gravity,
        rows,
        rows["v_n"],
        (rows["counter"] + 1) * T,
        np.array([(begin <= counter) & (counter < end) for begin, end in zip(begins, ends, strict=True)]),
    )
