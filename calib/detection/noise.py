"""Noise of the sensors at rest, from second differences."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # its parts are loaded when they are used

from imudrv.arrays import Array
from imudrv.errors import InputError

BIN_S: Final = 0.5
"""Averaging time of the velocity at rest, s: a level accelerometer gives few pulses."""


LAGS: Final = (1, 2, 4, 8, 16)
"""Lags of the second differences, bins."""


LEAST_NOISE_S: Final = 10.0
"""Minimum length of a rest for an estimate of its noise, s."""


@dataclass(frozen=True)
class Noise:
    """Noise of the sensors at rest, from their sums of increments.

    Attributes
    ----------
    angle_walk : float
        Random walk of angle, rad/sqrt(s), each axis.
    velocity_walk : float
        Random walk of velocity of the level accelerometers, m/s/sqrt(s), each axis.
    velocity_white : float
        White noise of velocity, caused by pulses, in means over `BIN_S`, m/s.
    velocity_pulse : float
        White noise of a single velocity, m/s.
    """

    angle_walk: float
    velocity_walk: float
    velocity_white: float
    velocity_pulse: float


@dataclass(frozen=True)
class SecondDifferences:
    """Second differences of the summed angle and velocity, for the noise.

    They are differences of means over w = `BIN_S`. With white noise s and random walk q their variance over a
    lag L >= w is `6 s^2 + q^2 (2 L - w)`. A constant rate does not contribute.

    Attributes
    ----------
    count : ndarray, shape (lags,)
        Number of differences per axis, for each of `LAGS`.
    angle, velocity : ndarray, shape (lags,)
        Mean square, over all axes and over the level ones.
    single : float
        Mean square of the second differences of single velocities, block by block.
    """

    count: Array
    angle: Array
    velocity: Array
    single: float


def pooled_noise(rests: Iterable[SecondDifferences | None]) -> Noise:
    """Return the noise of several rests together.

    Parameters
    ----------
    rests : iterable of SecondDifferences or None
        Second differences of each rest; None for one that is too short.

    Returns
    -------
    Noise

    Raises
    ------
    InputError
        All rests are too short.
    """
    usable = [differences for differences in rests if differences is not None]
    if not usable:
        raise InputError(f"noise: expected a rest of at least {LEAST_NOISE_S:g} s, got none")
    counts = np.array([d.count for d in usable])
    count = counts.sum(axis=0)
    share = counts / np.maximum(count, 1.0)
    _, angle_walk = fit_noise_model((share * [d.angle for d in usable]).sum(axis=0), count)
    white, walk = fit_noise_model((share * [d.velocity for d in usable]).sum(axis=0), count)
    single = np.average([d.single for d in usable], weights=counts[:, 0])
    return Noise(angle_walk, walk, white, float(np.sqrt(single / 6.0)))


def mean_squares(means: Array) -> Array:
    """Return the mean square of the second differences over each lag; zero where there are none."""
    second = [means[2 * k :] - 2.0 * means[k:-k] + means[: -2 * k] for k in LAGS if len(means) > 2 * k]
    return np.array([(x**2).mean() for x in second] + [0.0] * (len(LAGS) - len(second)))


def fit_noise_model(variance: Array, count: Array) -> tuple[float, float]:
    """Return white noise and random walk from the mean squares of second differences."""
    lags = np.array(LAGS)[count > 0]
    variance, count = variance[count > 0], count[count > 0]
    laws = np.stack([np.full(len(lags), 6.0), (2 * lags - 1) * BIN_S], axis=1)
    expected = variance
    for _ in range(4):
        # over lag L, 1 / L of the differences are independent; their uncertainty is as large as they are
        weight = np.sqrt(count / lags) / np.maximum(expected, 1e-40)
        size = np.linalg.norm(laws * weight[:, None], axis=0)
        parts, _ = scipy.optimize.nnls(laws * weight[:, None] / size, variance * weight)
        expected = laws @ (parts / size)
    white, walk = np.sqrt(parts / size).tolist()
    return white, walk
