"""Velocity of a quantised accelerometer in motion, free of its pulses."""

import numpy as np
import scipy  # its parts are loaded when they are used

from calib.estimation.channel import passages
from calib.estimation.rigid_motion import RigidMotion
from imudrv.arrays import Array


def without_quantisation(t_s: Array, increments: Array, pulse: float, motion: RigidMotion) -> Array:
    """Return increments whose sum passes through the edges of the pulses as the motion does in between.

    In a turn the sum of a level accelerometer lies between two pulses for up to a second while its
    acceleration changes sign. What it is off by meanwhile is turned into other axes, and stays there. The
    motion of a rigid body is fitted to the passages; the small deviation from it is interpolated. The sum is
    nowhere off the counted one by more than half a pulse.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        End of each sample.
    increments : ndarray, shape (n,)
        m/s.
    pulse : float
        Size of one pulse, m/s; 0: not quantised.
    motion : RigidMotion
        Motion along the sensing axis.

    Returns
    -------
    ndarray, shape (n,)
        m/s.
    """
    if not pulse:
        return increments
    at = passages(increments, pulse).at
    if len(at) < 2:
        return increments
    total = np.cumsum(increments)
    edges = 0.5 * (total[at] + total[at - 1])
    fitted = motion.fitted(at, edges)
    middle = 0.5 * (fitted[at] + fitted[at - 1])
    inside = np.clip(np.arange(len(total)), at[0] - 0.5, at[-1] - 0.5)
    deviation = scipy.interpolate.PchipInterpolator(at - 0.5, edges - middle)(inside)
    smooth = np.clip(fitted + deviation, total - 0.5 * pulse, total + 0.5 * pulse)
    return np.asarray(np.diff(smooth, prepend=0.0), np.float64)
