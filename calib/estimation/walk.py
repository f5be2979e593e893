"""Random walk of the sum of a sensor's increments at rest."""

from collections.abc import Iterable
from math import sqrt
from typing import Final, NamedTuple

import numpy as np

from calib.estimation.channel import Channel, channel, spaced
from imudrv.arrays import Array

STEP_S: Final = 1.0
"""Least time between two readings, s; their own error is then small beside the random walk."""


class WalkEstimate(NamedTuple):
    """Sum of squared differences that estimates a random walk, and its degrees of freedom."""

    squares: float  # rad^2/s or (m/s)^2/s, less what the readings' own errors contribute
    degrees_of_freedom: float

    @property
    def root(self) -> float:
        """The random walk, rad/sqrt(s) or m/s/sqrt(s); 0: unknown."""
        return sqrt(max(self.squares, 0.0) / self.degrees_of_freedom) if self.degrees_of_freedom else 0.0


def random_walk(t_s: Array, increments: Array, pulse: Array, channels: Iterable[int]) -> WalkEstimate:
    """Estimate the random walk of some channels at rest.

    At rest the sum of the increments is `f t` plus the random walk. For readings at least `STEP_S` apart, and
    at least the time between two pulses: one that comes back to the edge of a pulse says nothing,

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
    squares, freedom = 0.0, 0.0
    for i in channels:
        total = np.cumsum(increments[:, i])
        # the walk decides how a channel is read; for that a first estimate is good enough
        a_pulse_s = float(pulse[i]) * (t_s[-1] - t_s[0]) / max(abs(float(total[-1])), 1e-12)
        walk = _of(channel(t_s, total, increments[:, i], float(pulse[i]), 0.0), a_pulse_s).root
        more, n = _of(channel(t_s, total, increments[:, i], float(pulse[i]), walk), a_pulse_s)
        squares, freedom = squares + more, freedom + n
    return WalkEstimate(squares, freedom)


def _of(read: Channel, step_s: float) -> WalkEstimate:
    """Return the estimate of one channel."""
    chosen = spaced(read.t_s, max(STEP_S, step_s))
    if len(chosen) < 3:
        return WalkEstimate(0.0, 0.0)
    dt, dv = np.diff(read.t_s[chosen]), np.diff(read.v[chosen])
    residual = dv - dv.sum() / dt.sum() * dt
    squares, own = float((residual**2 / dt).sum()), float(2.0 * read.variance[0] * (1.0 / dt).sum())
    share = max(0.0, 1.0 - own / squares) if squares else 0.0
    # readings whose own error is large say little: their weight is that of the walk in the differences
    return WalkEstimate(share**2 * (squares - own), share**2 * (len(dt) - 1))
