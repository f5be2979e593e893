"""What rests and motions show: a number is observable where its sigma is below half of its prior."""

from typing import Final

import numpy as np

from calib.sensors.parameters import ACCELEROMETER_SCALE_PRIOR, AXIS_PRIOR, GYRO_SCALE_PRIOR, Number
from imudrv.arrays import Array

RATIO: Final = 0.5

_PRIORS: Final = {
    "gyro.scale": ("relative", GYRO_SCALE_PRIOR),
    "gyro.bias": ("absolute", 2.0),
    "gyro.C_bg": ("absolute", AXIS_PRIOR),
    "accelerometer.scale": ("relative", ACCELEROMETER_SCALE_PRIOR),
    "accelerometer.bias": ("absolute", 2000.0),
    "accelerometer.C_ba": ("absolute", AXIS_PRIOR),
    "accelerometer.quadratic": ("absolute", 100.0),
    "accelerometer.asymmetry": ("absolute", 500.0),
    "size_effect": ("absolute", 30.0),
    "skew_ms": ("absolute", 1.0),
    "temperature.gyro_bias": ("absolute", 0.05),
    "temperature.gyro_scale": ("absolute", 5.0),
    "temperature.accelerometer_bias": ("absolute", 100.0),
    "temperature.accelerometer_scale": ("absolute", 100.0),
}
"""Prior of a number by the beginning of its path, in the unit of the file or relative."""

OPTIONAL: Final = (
    "accelerometer.quadratic",
    "accelerometer.asymmetry",
    "size_effect",
    "skew_ms",
    "temperature",
)
"""Numbers that a certificate may be without."""


def prior(number: Number) -> float:
    """Return the prior sigma of a number, in the unit of the file."""
    kind, size = next(entry for path, entry in _PRIORS.items() if number.path.startswith(path))
    return size * abs(number.value) if kind == "relative" else size


def observable(numbers: list[Number], covariance: Array) -> list[bool]:
    """Return for each number whether it is observable; one that is fixed by the gauge is."""
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return [bool(s < RATIO * prior(number)) for number, s in zip(numbers, sigma, strict=True)]


def is_optional(path: str) -> bool:
    """Return whether a certificate may be without a number."""
    return path.startswith(OPTIONAL)
