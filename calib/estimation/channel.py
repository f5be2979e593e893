"""Readings of one sensor at rest, with a known and small error.

A level accelerometer sends few pulses a second, so that its sum is a sawtooth of one pulse. In the sample in
which a pulse arrives it is known much better: the true sum passed the edge of a pulse somewhere in that
sample. The mean of the sum before and after the sample is off by a constant, whatever the sign of the
passage, and by the time of the passage, uniform over the sample:

    variance = (s tau)^2 / 12,      s tau: mean increment less the most frequent one

**Vibration** of the bench, or of the dithering gyros, makes pulses come and go. The mean of the counted sum
over `SMOOTH_S` is then off by a function of the fraction of a pulse that is odd about each edge, whatever the
amplitude: it is right where it passes an edge. Such a channel is read there. The mean costs a tenth of a
second next to a turn, and is used only where the vibration costs more.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.arrays import Array

SMOOTH_S: Final = 0.1
"""Length of the means, s, weighted as half a wave; they pass 3 % of what is above 20 Hz."""

WALK_SHARE: Final = 0.045
"""Variance of a mean about its middle for a random walk q, over q^2 `SMOOTH_S`."""


class Channel(NamedTuple):
    """Readings of a channel."""

    t_s: Array  # (n,)
    v: Array  # (n,)
    variance: Array  # (n,), of each on its own

    def nearest(self, after: Array, before: Array) -> NDArray[np.int64]:
        """Return the first readings at or after some times, and the last ones at or before others."""
        first = np.searchsorted(self.t_s, after)
        last = np.searchsorted(self.t_s, before, side="right") - 1
        at = np.unique(np.concatenate([first, last]))
        return at[(at >= 0) & (at < len(self.t_s))]

    def take(self, at: NDArray[np.int64]) -> "Channel":
        """Return some of the readings."""
        return Channel(self.t_s[at], self.v[at], self.variance[at])

    def joined(self, other: "Channel") -> "Channel":
        """Return the readings of both."""
        return Channel(*map(np.concatenate, zip(self, other, strict=True)))


class Passages(NamedTuple):
    """Samples in which a channel passes from one pulse to the next."""

    at: NDArray[np.int64]  # (n,), their indices, from 1
    variance: float  # of the sum in the middle of such a sample
    one_way: bool  # whether all are in the same direction


def passages(increments: Array, pulse: float) -> Passages:
    """Find the passages of a channel.

    Parameters
    ----------
    increments : ndarray, shape (n,)
        rad or m/s.
    pulse : float
        Size of one pulse; 0: not quantised, so that every sample is one.

    Returns
    -------
    Passages
    """
    if not pulse:
        return Passages(np.arange(1, len(increments)), 0.0, True)
    usual = float(np.median(increments))
    at = np.flatnonzero(np.abs(increments[1:] - usual) >= 0.5 * pulse) + 1
    upward = increments[at] > usual
    return Passages(
        at, (float(increments.mean()) - usual) ** 2 / 12.0, bool(upward.all() or not upward.any())
    )


def channel(t_s: Array, v: Array, increments: Array, pulse: float, walk: float) -> Channel:
    """Return the readings of one channel at rest.

    Parameters
    ----------
    t_s, v : ndarray, shape (n,)
        End of each sample, and the sum there: m/s, or rad.
    increments : ndarray, shape (n,)
        Increments of the sensor.
    pulse : float
        Size of one pulse; 0: not quantised.
    walk : float
        Random walk of the sum, per square root of a second.

    Returns
    -------
    Channel
        Less than two readings if the channel sends no pulses.
    """
    at, variance, one_way = passages(increments, pulse)
    sharp = _between(t_s, v, at, variance)
    kernel = _kernel(t_s)
    if len(at) < 2 or len(t_s) < 3 * len(kernel):
        return sharp
    own = _roughness(np.interp(t_s, sharp.t_s, sharp.v), kernel, walk)
    if one_way and own < 0.5 * SMOOTH_S * walk**2:
        return sharp._replace(variance=np.maximum(sharp.variance, own))
    half = len(kernel) // 2
    smooth_t, smooth_v = t_s[half:-half], np.convolve(v, kernel, "valid")
    at, share = np.arange(1, len(smooth_t)), 0.5
    if pulse:
        count = np.convolve(np.cumsum(np.rint((increments - np.median(increments)) / pulse)), kernel, "valid")
        level = np.floor(count + 0.5)
        at = np.flatnonzero(np.diff(level)) + 1
        share = (np.maximum(level[at], level[at - 1]) - 0.5 - count[at - 1]) / (count[at] - count[at - 1])
    smooth = _between(smooth_t, smooth_v, at, 0.0, share)
    return smooth._replace(variance=np.full(len(at), _own_variance(smooth, walk)))


def vibration(t_s: Array, increments: Array) -> float:
    """Return the mean square of a counted sum about its mean over `SMOOTH_S`."""
    kernel = _kernel(t_s)
    return _roughness(np.cumsum(increments), kernel, 0.0) if len(t_s) > len(kernel) else 0.0


def _kernel(t_s: Array) -> Array:
    """Return the weights of the means."""
    kernel = np.hanning(2 * max(1, round(0.5 * SMOOTH_S / float(np.median(np.diff(t_s))))) + 1)
    return np.asarray(kernel / kernel.sum(), np.float64)


def _between(
    t_s: Array, v: Array, at: NDArray[np.int64], variance: float, share: Array | float = 0.5
) -> Channel:
    """Return readings after a share of some samples."""
    t, v = (x[at - 1] + share * (x[at] - x[at - 1]) for x in (t_s, v))
    return Channel(t, v, np.full(len(at), variance))


def _roughness(v: Array, kernel: Array, walk: float) -> float:
    """Return the mean square of what smoothing removes, beyond that of a random walk."""
    half = len(kernel) // 2
    removed = v[half:-half] - np.convolve(v, kernel, "valid")
    return max(0.0, float((removed**2).mean()) - WALK_SHARE * SMOOTH_S * walk**2)


def _own_variance(smooth: Channel, walk: float) -> float:
    """Return the variance of smoothed readings beyond that of a random walk, from their differences."""
    chosen = spaced(smooth.t_s, SMOOTH_S)
    if len(chosen) < 3:
        return 0.0
    dt, dv = np.diff(smooth.t_s[chosen]), np.diff(smooth.v[chosen])
    residual = dv - dv.sum() / dt.sum() * dt
    return max(0.0, 0.5 * float((residual**2).mean() - walk**2 * (dt.mean() - 0.2 * SMOOTH_S)))


def spaced(t_s: Array, step_s: float) -> list[int]:
    """Return the first of some times, and each first one at least a step after the one before."""
    chosen, after = [], 0
    while after < len(t_s):
        chosen.append(after)
        after = int(np.searchsorted(t_s, t_s[after] + step_s))
    return chosen
