"""Noise of the sensors at rest, from second differences."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import nnls

from imudrv.arrays import Array
from imudrv.errors import InputError

BIN_S: Final = 0.5
"""Velocity at rest is used as means over so long, s: pulses of a level accelerometer are few."""


LAGS: Final = (1, 2, 4, 8, 16)
"""Lags at which noise is looked at, bins."""


LEAST_NOISE_S: Final = 10.0
"""A shorter rest does not tell its noise, s."""


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
        White noise of velocity, as pulses make it, in means over `BIN_S`, m/s.
    velocity_pulse : float
        The same of a single value, m/s.
    """

    angle_walk: float
    velocity_walk: float
    velocity_white: float
    velocity_pulse: float


@dataclass(frozen=True)
class SecondDifferences:
    """Second differences of the sums of angle and velocity, from which noise is told.

    Of means over w = `BIN_S`; white noise s and a random walk q in them have, over a lag L >= w, the variance
    `6 s^2 + q^2 (2 L - w)`. A constant rate has none.

    Attributes
    ----------
    count : ndarray, shape (lags,)
        How many, each axis, over each of `LAGS`.
    angle, velocity : ndarray, shape (lags,)
        Their mean square, of all axes and of the level ones.
    single : float
        Mean square of those of single velocities, block by block.
    """

    count: Array
    angle: Array
    velocity: Array
    single: float


def pooled_noise(rests: Iterable[SecondDifferences | None]) -> Noise:
    """Noise that explains several rests together.

    Parameters
    ----------
    rests : iterable of Differences or None
        Second differences of each rest; None for one that is too short.

    Returns
    -------
    Noise

    Raises
    ------
    InputError
        All are too short.
    """
    told = [differences for differences in rests if differences is not None]
    if not told:
        raise InputError(f"noise: expected a rest of {LEAST_NOISE_S:g} s at least, got none")
    counts = np.array([d.count for d in told])
    count = counts.sum(axis=0)
    share = counts / np.maximum(count, 1.0)
    _, angle_walk = fit_laws((share * [d.angle for d in told]).sum(axis=0), count)
    white, walk = fit_laws((share * [d.velocity for d in told]).sum(axis=0), count)
    single = np.average([d.single for d in told], weights=counts[:, 0])
    return Noise(angle_walk, walk, white, float(np.sqrt(single / 6.0)))


def mean_squares(means: Array) -> Array:
    """Mean square of the second differences over each lag; zero where there are none."""
    second = [means[2 * k :] - 2.0 * means[k:-k] + means[: -2 * k] for k in LAGS if len(means) > 2 * k]
    return np.array([(x**2).mean() for x in second] + [0.0] * (len(LAGS) - len(second)))


def fit_laws(variance: Array, count: Array) -> tuple[float, float]:
    """White noise and random walk that explain the mean squares of second differences."""
    lags = np.array(LAGS)[count > 0]
    variance, count = variance[count > 0], count[count > 0]
    laws = np.stack([np.full(len(lags), 6.0), (2 * lags - 1) * BIN_S], axis=1)
    expected = variance
    for _ in range(4):
        # over lag L there are 1 / L as many independent differences, each as unsure as it is large
        weight = np.sqrt(count / lags) / np.maximum(expected, 1e-40)
        size = np.linalg.norm(laws * weight[:, None], axis=0)
        parts, _ = nnls(laws * weight[:, None] / size, variance * weight)
        expected = laws @ (parts / size)
    white, walk = np.sqrt(parts / size).tolist()
    return white, walk
