"""Passages of a sensor from one pulse to the next.

In the sample in which a pulse arrives the sum is known much better than to a pulse: the true one passed the
edge of a pulse somewhere in that sample. The mean of the sum before and after the sample is off by a
constant, whatever the sign of the passage, and by the time of the passage, uniform over the sample:

    variance = (s tau)^2 / 12,      s tau: mean increment less the most frequent one
"""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from imudrv.arrays import Array


class Passages(NamedTuple):
    """Samples in which a channel passes from one pulse to the next."""

    at: np.ndarray  # (n,), their indices, from 1
    variance: float  # of the sum in the middle of such a sample


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
    usual = float(np.median(increments))
    at = np.flatnonzero(np.abs(increments[1:] - usual) >= 0.5 * pulse) + 1
    return Passages(at, (float(increments.mean()) - usual) ** 2 / 12.0 if pulse else 0.0)


def without_quantisation(t_s: Array, increments: Array, pulse: float) -> Array:
    """Return increments whose sum is a cubic spline through the passages.

    In a turn the sum of a level accelerometer lies between two pulses for a tenth of a second while its
    acceleration changes sign. What it is off by meanwhile is turned into other axes, and stays there. It is
    nowhere off the counted sum by more than half a pulse.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        End of each sample.
    increments : ndarray, shape (n,)
        m/s.
    pulse : float
        Size of one pulse, m/s; 0: not quantised.

    Returns
    -------
    ndarray, shape (n,)
        m/s.
    """
    if not pulse:
        return increments
    at, _ = passages(increments, pulse)
    if len(at) < 2:
        return increments
    total = np.cumsum(increments)
    t = np.concatenate([[2.0 * t_s[0] - t_s[1]], 0.5 * (t_s[at] + t_s[at - 1]), t_s[-1:]])
    sums = np.concatenate([[0.0], 0.5 * (total[at] + total[at - 1]), total[-1:]])
    smooth = np.clip(CubicSpline(t, sums)(t_s), total - 0.5 * pulse, total + 0.5 * pulse)
    return np.asarray(np.diff(smooth, prepend=0.0), np.float64)
