"""The size effect as numpy formulas, linear in the sensing points (mathematics, sections 1 and 2).

At the sensing point r_i the specific force differs from that at the origin of b by `Omega r_i`. Accelerometer
i senses along `a_i`, row i of inv(C_ba), and contributes to b by column i of C_ba:

    delta f_b = S R,   S = C_ba blockdiag(a_x^T Omega, a_y^T Omega, a_z^T Omega),   R = (r_x, r_y, r_z)

A second, plain way to what the kernels of `imudrv.imu` and `imudrv.nav` compute sample by sample.
"""

import numpy as np
from numpy.typing import ArrayLike

from imudrv.arrays import Array


def size_effect_rate(omega_ib_b: ArrayLike, omega_dot_b: ArrayLike, C_ba: ArrayLike) -> Array:
    """Return S at an instant.

    Parameters
    ----------
    omega_ib_b, omega_dot_b : array_like, shape (..., 3)
        rad/s and rad/s^2.
    C_ba : array_like, shape (3, 3)
        Accelerometer axes to body.

    Returns
    -------
    ndarray, shape (..., 3, 9)
        `S @ R` is the error of the specific force, m/s^2, body axes, for R in m.
    """
    return _through_accelerometers(_cross(omega_dot_b) + _square(omega_ib_b), C_ba)


def size_effect_increment(
    omega0_b: ArrayLike, omega1_b: ArrayLike, dtheta_b: ArrayLike, T: ArrayLike, C_ba: ArrayLike
) -> Array:
    """Return S integrated over an interval, in its own body axes.

    The tangential part telescopes, the centripetal part is Simpson's rule.

    Parameters
    ----------
    omega0_b, omega1_b : array_like, shape (..., 3)
        Rates at the beginning and the end, rad/s.
    dtheta_b : array_like, shape (..., 3)
        Angle of the interval, rad.
    T : array_like, shape (...)
        Its length, s.
    C_ba : array_like, shape (3, 3)
        Accelerometer axes to body.

    Returns
    -------
    ndarray, shape (..., 3, 9)
        `S @ R` is the error of the velocity increment, m/s, body axes, for R in m.
    """
    T = np.asarray(T, np.float64)[..., None, None]
    middle_b = np.asarray(dtheta_b, np.float64) / T[..., 0]
    tangential = _cross(np.asarray(omega1_b, np.float64) - np.asarray(omega0_b, np.float64))
    centripetal = T / 6.0 * (_square(omega0_b) + 4.0 * _square(middle_b) + _square(omega1_b))
    return _through_accelerometers(tangential + centripetal, C_ba)


def _through_accelerometers(Omega: Array, C_ba: ArrayLike) -> Array:
    C = np.asarray(C_ba, np.float64)
    felt = np.linalg.inv(C) @ Omega  # row i: a_i^T Omega
    S: Array = np.einsum("bi,...ij->...bij", C, felt)
    return S.reshape(*S.shape[:-2], 9)


def _cross(v: ArrayLike) -> Array:
    """`[v x]`."""
    matrix: Array = np.cross(np.asarray(v, np.float64)[..., None, :], np.eye(3)).swapaxes(-1, -2)
    return matrix


def _square(omega: ArrayLike) -> Array:
    """`[omega x]^2`."""
    square: Array = _cross(omega) @ _cross(omega)
    return square
