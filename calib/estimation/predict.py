"""Accuracy that a plan of rotations will give."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, tan
from typing import Final, get_args

import numpy as np
from scipy.spatial.transform import Rotation as Attitude

from calib.axes import Side, vector
from calib.detection.blocks import BLOCK_NS
from calib.detection.segments import Rest
from calib.detection.turns import Turn
from calib.estimation.design import Design, Known
from calib.estimation.gains import GAIN_WINDOW_S
from calib.estimation.linear_system import (
    NormalEquations,
    extra_terms,
    prior_parameters,
    run_equations,
)
from calib.estimation.noise import SensorNoise
from calib.estimation.observability import unobservable_text
from calib.estimation.priors import Priors
from calib.estimation.readings import RestSamples, read_rests
from calib.estimation.result import CENTROID_BASIS, TO_DIFFERENCES
from calib.estimation.runs import AFTER_S, BEFORE_S, GUARD_S, Run
from calib.estimation.walk import WalkEstimate
from calib.html_table import html_table
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.nav.alignment import ALIGNMENT_S, Aligned, RestReadings
from imudrv.nav.earth import earth_rate_n, normal_gravity
from imudrv.nav.mechanisation import Navigator, Place
from imudrv.records import INCREMENTS
from imudrv.units import DEG, MM, NS

_PLAN_INTERVAL_NS: Final = 5_000_000


TYPICAL_ARMS: Final = np.array([[24.0, -11.0, -9.0], [-23.0, 29.0, -7.0], [-1.0, -18.0, 16.0]]) * MM
"""Sensing points of a unit that was not measured yet: misalignments are felt in proportion to them."""


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
    plan: Sequence[PlannedRotation], latitude_rad: float, noise: SensorNoise, priors: Priors | None = None
) -> Prediction:
    """Predict the covariance of the lever arms from an ideal motion, without data.

    Parameters
    ----------
    plan : sequence of PlannedRotation
        The rotations.
    latitude_rad : float
        Geodetic latitude.
    noise : SensorNoise
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
    runs = [
        _planned_run(planned, k, latitude_rad, priors, noise.velocity_walk) for k, planned in enumerate(plan)
    ]
    terms = extra_terms(priors, ())
    equations = [run_equations(run, noise, "free", Design(run, terms, _known(run))) for run in runs]
    system = NormalEquations(equations, prior_parameters(runs, priors, terms))
    sigma, directions = system.directions()
    if int((sigma < priors.arm).sum()) < 6:
        raise InputError(unobservable_text(sigma, directions, CENTROID_BASIS, priors.arm))
    covariance = system.solve(CENTROID_BASIS)[1][:9, :9]
    spread = np.sqrt(np.diag(TO_DIFFERENCES @ covariance @ TO_DIFFERENCES.T))
    return Prediction(covariance, spread.reshape(2, 3))


def _known(run: Run) -> Known:
    R = TYPICAL_ARMS.ravel()
    return Known(R, run.rows["H"] @ R)


def _planned_run(planned: PlannedRotation, k: int, latitude_rad: float, priors: Priors, walk: float) -> Run:
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
    navigated = Navigator(Place(latitude_rad, 0.0, 0.0), q_nb, C_ba=np.eye(3)).feed(increments)
    navigated["v_n"] += navigated["H"] @ TYPICAL_ARMS.ravel()
    rows = navigated[every - 1 :: every]
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
    counter, time = rows["counter"], (navigated["counter"] + 1) * T
    begins = np.array([0, *(turn.stop for turn in turns)])
    ends = np.array([*(turn.start for turn in turns), len(increments)])
    rests = [
        RestSamples(time[a:b], navigated["v_n"][a:b], increments["dv_b"][a:b], C_nb[b].as_matrix())
        for a, b in zip(begins, ends, strict=True)
    ]
    inside = (begins + guard * (begins > 0))[:, None], (ends - guard * (ends < len(increments)))[:, None]
    return Run(
        f"plan#{k + 1}",
        turns,
        Aligned(0, 0, q_nb, ALIGNMENT_S, level, heading, None),
        gravity,
        np.eye(3),
        rows,
        rows["v_n"],
        (counter + 1) * T,
        (inside[0] <= counter) & (counter < inside[1]),
        read_rests(rests, np.eye(3), np.zeros(3), walk),
        RestReadings(gravity, 0.0, *earth_rate_n(latitude_rad)[:0:-1], 0.0),
        WalkEstimate(0.0, 0),
        WalkEstimate(0.0, 0),
        (),
        "causal",
    )
