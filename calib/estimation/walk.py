"""Random walk of the sum of a sensor's increments at rest."""

from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from calib.estimation.pulses import passages
from imudrv.arrays import Array

STEP_S: Final = 1.0
"""Least time between two readings, s; their own error is then small beside the random walk."""


class WalkEstimate(NamedTuple):
    """Sum of squared differences that estimates a random walk, and its degrees of freedom."""

    squares: float  # rad^2/s or (m/s)^2/s, less what the readings' own errors contribute
    degrees_of_freedom: int


def random_walk(t_s: Array, increments: Array, pulse: Array, channels: Iterable[int]) -> WalkEstimate:
    """Estimate the random walk of some channels at rest.

    At rest the sum of the increments is `f t` plus the random walk. For readings at least `STEP_S` apart, at
    the first pulse after that time,

        sum of (dv - f dt)^2 / dt = (n - 1) q^2 + 2 s^2 sum of 1 / dt

    with n differences dv, f the mean slope and s^2 the variance of a reading.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        End of each sample.
    increments : ndarray, shape (n, 3)
        On the sensing axes, rad or m/s.
    pulse : ndarray, shape (3,)
        Size of one pulse of each channel; 0: not quantised.
    channels : iterable of int
        Channels to use.

    Returns
    -------
    WalkEstimate
    """
    squares, freedom = 0.0, 0
    for i in channels:
        at, variance = passages(increments[:, i], float(pulse[i]))
        total = np.cumsum(increments[:, i])
        t, v = 0.5 * (t_s[at] + t_s[at - 1]), 0.5 * (total[at] + total[at - 1])
        chosen = _spaced(t)
        if len(chosen) < 3:
            continue
        dt, dv = np.diff(t[chosen]), np.diff(v[chosen])
        residual = dv - dv.sum() / dt.sum() * dt
        squares += float((residual**2 / dt).sum() - 2.0 * variance * (1.0 / dt).sum())
        freedom += len(dt) - 1
    return WalkEstimate(squares, freedom)


def _spaced(t: Array) -> list[int]:
    """Return the first of some times, and each first one at least `STEP_S` after the one before."""
    chosen, after = [], 0
    while after < len(t):
        chosen.append(after)
        after = int(np.searchsorted(t, t[after] + STEP_S))
    return chosen
