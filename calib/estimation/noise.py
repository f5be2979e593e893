"""Noise of the sensors in the alignments of a session."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Final

from calib.estimation.runs import Run
from calib.estimation.walk import WalkEstimate
from imudrv.errors import InputError

LEAST_ANGLE_WALK: Final = 1e-7
"""Lower bound of the random walk of angle, rad/sqrt(s), for what linear equations neglect."""

LEAST_VELOCITY_WALK: Final = 1e-6
"""Lower bound of the random walk of velocity, m/s/sqrt(s)."""


@dataclass(frozen=True)
class SensorNoise:
    """Random walks of the sensors, each axis.

    Attributes
    ----------
    angle_walk : float
        Of angle, rad/sqrt(s).
    velocity_walk : float
        Of velocity of the level accelerometers, m/s/sqrt(s).
    degrees_of_freedom : int
        Number of independent differences that `velocity_walk` comes from; 0: it is assumed.
    """

    angle_walk: float
    velocity_walk: float
    degrees_of_freedom: int


def noise_of(runs: Sequence[Run]) -> SensorNoise:
    """Return the noise of all alignments together.

    Raises
    ------
    InputError
        No accelerometer, or no gyro, sent pulses in any of them.
    """
    angle, _ = _pooled([run.angle_walk for run in runs], "gyro")
    velocity, freedom = _pooled([run.velocity_walk for run in runs], "accelerometer")
    return SensorNoise(max(angle, LEAST_ANGLE_WALK), max(velocity, LEAST_VELOCITY_WALK), freedom)


def _pooled(walks: Sequence[WalkEstimate], sensor: str) -> tuple[float, int]:
    squares, freedom = (sum(column) for column in zip(*walks, strict=True))
    if not freedom:
        raise InputError(
            f"noise: expected pulses of a {sensor} in the rests before the turns, got none; check the "
            "calibration's scale factors, and the wiring"
        )
    return sqrt(max(squares, 0.0) / freedom), max(1, round(freedom))
