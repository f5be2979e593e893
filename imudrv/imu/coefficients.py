"""A calibration in SI units, as the compensation takes it."""

from dataclasses import dataclass, field

import numpy as np

from imudrv.arrays import Array


def _zeros() -> Array:
    return np.zeros(3)


@dataclass(frozen=True)
class TemperatureTerms:
    """Linear change of biases and scale factors with temperature.

    Parameters
    ----------
    reference_degc : float
        Temperature at which the terms are zero.
    low_degc, high_degc : float
        Range in which they were determined.
    gyro_bias, gyro_scale, accelerometer_bias, accelerometer_scale : ndarray, shape (3,)
        Per kelvin: rad/s, relative, m/s^2, relative.
    """

    reference_degc: float
    low_degc: float
    high_degc: float
    gyro_bias: Array = field(default_factory=_zeros)
    gyro_scale: Array = field(default_factory=_zeros)
    accelerometer_bias: Array = field(default_factory=_zeros)
    accelerometer_scale: Array = field(default_factory=_zeros)


@dataclass(frozen=True)
class Coefficients:
    """Calibration coefficients of one unit.

    Parameters
    ----------
    gyro_scale : ndarray, shape (3,)
        rad per pulse, or per rad of the unit.
    gyro_bias : ndarray, shape (3,)
        rad/s, body axes.
    C_bg : ndarray, shape (3, 3)
        Gyro axes to body.
    accelerometer_scale : ndarray, shape (3,)
        Pulses per m/s, or m/s of the unit per m/s.
    accelerometer_bias : ndarray, shape (3,)
        m/s^2, on the sensing axes.
    C_ba : ndarray, shape (3, 3)
        Accelerometer axes to body.
    r_b : ndarray, shape (3, 3), optional
        Row i: sensing point of accelerometer i, m, body axes. None: no size-effect compensation.
    temperature : TemperatureTerms, optional
        None: no temperature compensation.
    quadratic : ndarray, shape (3,)
        Quadratic term of the accelerometers, s^2/m, on the sensing axes.
    asymmetry : ndarray, shape (3,)
        Relative difference of the accelerometers' scales of positive and negative input.
    skew_s : float
        Time by which the interval of the accelerometers ends later than that of the gyros.
    gyro_in_pulses, accelerometer_in_pulses : bool
        Whether the scales are of pulses; otherwise of increments in rad and m/s, about 1.
    """

    gyro_scale: Array
    gyro_bias: Array
    C_bg: Array
    accelerometer_scale: Array
    accelerometer_bias: Array
    C_ba: Array
    r_b: Array | None = None
    temperature: TemperatureTerms | None = None
    quadratic: Array = field(default_factory=_zeros)
    asymmetry: Array = field(default_factory=_zeros)
    skew_s: float = 0.0
    gyro_in_pulses: bool = True
    accelerometer_in_pulses: bool = True
