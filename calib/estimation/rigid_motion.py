"""Velocity along a sensing axis of a rigid body that turns about a fixed point, from the gyros alone.

With the attitude C_nb, the specific force along the axis a of an accelerometer at rho from the fixed point is

    f = (C_nb a) . (0, 0, g) + a . Omega rho

Its integral is known but for rho, a bias, two tilts and the constant: all linear.
"""

from typing import Final, NamedTuple

import numpy as np
import scipy  # its parts are loaded when they are used
from numpy.typing import NDArray

from imudrv.arrays import Array

RATE_S: Final = 0.02
"""Length of the means of the rates, s: shorter ones would show the pulses of the gyros."""

BIAS_SIGMA: Final = 0.01
"""Prior of the bias of an accelerometer, m/s^2."""

TILT_SIGMA: Final = 0.01
"""Prior of gravity times a tilt, m/s^2."""

ARM_SIGMA: Final = 0.3
"""Prior of a component of rho, m."""

CONSTANT_SIGMA: Final = 10.0
"""Prior of the constant, m/s."""

READING_SIGMA: Final = 1e-4
"""Standard deviation of a velocity that is fitted, m/s: the random walk of some seconds."""


class RigidMotion(NamedTuple):
    """Integrated specific force along a sensing axis."""

    gravity: Array  # (n,), of gravity, m/s
    columns: Array  # (n, 7), derivatives by the constant, bias, two tilts and rho

    def fitted(self, at: NDArray[np.int64], v: Array) -> Array:
        """Return the velocity, shape (n,), with the parameters that fit values v at some samples best."""
        sigma = np.array([CONSTANT_SIGMA, BIAS_SIGMA, *2 * [TILT_SIGMA], *3 * [ARM_SIGMA]])
        scaled = self.columns * sigma
        A = np.concatenate([scaled[at] / READING_SIGMA, np.eye(7)])
        b = np.concatenate([(v - self.gravity[at]) / READING_SIGMA, np.zeros(7)])
        x = np.linalg.lstsq(A, b, rcond=None)[0]
        return np.asarray(self.gravity + scaled @ x, np.float64)


def rigid_motion(t_s: Array, C_nb: Array, dtheta_b: Array, a_b: Array, gravity: float) -> RigidMotion:
    """Return the integrated specific force along a sensing axis.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        End of each sample.
    C_nb : ndarray, shape (n, 3, 3)
        Attitude there.
    dtheta_b : ndarray, shape (n, 3)
        Angle increments, rad.
    a_b : ndarray, shape (3,)
        Sensing axis, body axes.
    gravity : float
        m/s^2.

    Returns
    -------
    RigidMotion
    """
    dt = np.gradient(t_s)[:, None]
    size = max(1, round(RATE_S / float(np.median(dt))))
    omega = scipy.ndimage.uniform_filter1d(dtheta_b, size, axis=0, mode="nearest") / dt
    axis_n = np.cumsum(dt * (C_nb @ a_b), axis=0)
    along = (omega @ a_b)[:, None]
    centripetal = along * omega - (omega * omega).sum(axis=1)[:, None] * a_b
    size_effect = np.cross(a_b, omega) + np.cumsum(dt * centripetal, axis=0)
    columns = np.column_stack([np.ones(len(t_s)), t_s, axis_n[:, :2], size_effect])
    return RigidMotion(gravity * axis_n[:, 2], columns)
