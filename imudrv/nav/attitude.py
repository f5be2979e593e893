"""Rotations. `R = rotation(u, angle)` rotates vectors by `angle` about `u`, right-handed.

Post-multiplied to an attitude it rotates the body about its own axis: `C_nb2 = C_nb1 @ R`.

Quaternions are Hamilton's, scalar first, and multiply as matrices do: `q_nb = product(q_na, q_ab)`.
"""

from math import cos, sin, sqrt
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from imudrv.arrays import Array
from imudrv.kernels import kernel
from imudrv.vectors import Matrix, Vector, add, cross, dot, scale

Quaternion: TypeAlias = tuple[float, float, float, float]


@kernel
def quaternion_at(a: Array) -> Quaternion:
    """Return the four elements of an array."""
    return a[0], a[1], a[2], a[3]


@kernel
def put_quaternion(a: Array, q: Quaternion) -> None:
    """Set the four elements of an array."""
    a[0], a[1], a[2], a[3] = q


@kernel
def rotate_about(v: Vector, u: Vector, cosine: float, sine: float) -> Vector:
    """Rotate the vector `v` about the unit vector `u` by the angle of that cosine and sine (Rodrigues).

    Parameters
    ----------
    v, u : tuple of 3 float
        In the same axes.
    cosine, sine : float
        Those of the angle; `-sine` rotates back.

    Returns
    -------
    tuple of 3 float
    """
    along = scale(dot(u, v) * (1.0 - cosine), u)
    return add(add(scale(cosine, v), along), scale(sine, cross(u, v)))


def rotation(axis: ArrayLike, angle_rad: float) -> Array:
    """Return the matrix of the rotation by `angle_rad` about `axis`.

    Parameters
    ----------
    axis : array_like, shape (3,)
        Any length but zero.
    angle_rad : float
        Right-handed.

    Returns
    -------
    ndarray, shape (3, 3)
        The same in the axes before and after, because the axis has the same components in both.

    Examples
    --------
    >>> R = rotation([0, 0, 1], np.pi / 2)
    >>> print((R @ [1, 0, 0]).round(12))
    [0. 1. 0.]
    """
    u = np.asarray(axis, np.float64)
    u = u / np.linalg.norm(u)
    unit = tuple(u.tolist())
    columns = [
        rotate_about(e, unit, cos(angle_rad), sin(angle_rad))
        for e in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    ]
    return np.array(columns).T


@kernel
def product(p: Quaternion, q: Quaternion) -> Quaternion:
    """Return `p q`: the rotation q first, then p, both rotating vectors."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


@kernel
def conjugate(q: Quaternion) -> Quaternion:
    """Return the inverse rotation of the unit quaternion `q`."""
    return q[0], -q[1], -q[2], -q[3]


@kernel
def unit(q: Quaternion) -> Quaternion:
    """Renormalise a nearly unit quaternion by one Newton step."""
    s = 1.5 - 0.5 * (q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return s * q[0], s * q[1], s * q[2], s * q[3]


@kernel
def quaternion_of_vector(phi: Vector) -> Quaternion:
    """Quaternion of a rotation vector.

    Parameters
    ----------
    phi : tuple of 3 float
        Axis times angle, rad.

    Returns
    -------
    tuple of 4 float
        `cos(|phi| / 2), sin(|phi| / 2) phi / |phi|`; below 0.1 rad as series, truncated at 1e-15.
    """
    x = dot(phi, phi)
    if x < 0.01:
        c = 1.0 + x * (-1 / 8 + x * (1 / 384 + x * (-1 / 46080)))
        s = 1 / 2 + x * (-1 / 48 + x * (1 / 3840 + x * (-1 / 645120)))
    else:
        angle = sqrt(x)
        c, s = cos(0.5 * angle), sin(0.5 * angle) / angle
    return c, s * phi[0], s * phi[1], s * phi[2]


@kernel
def turn(q: Quaternion, v: Vector) -> Vector:
    """Rotate the vector `v` by the unit quaternion `q`: `v_n = turn(q_nb, v_b)`."""
    u = (q[1], q[2], q[3])
    t = scale(2.0, cross(u, v))
    return add(v, add(scale(q[0], t), cross(u, t)))


@kernel
def rows_of(q: Quaternion) -> Matrix:
    """Return the rotation matrix of a quaternion of any length but zero, by rows."""
    w, x, y, z = q
    s = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        (1.0 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)),
        (s * (x * y + w * z), 1.0 - s * (x * x + z * z), s * (y * z - w * x)),
        (s * (x * z - w * y), s * (y * z + w * x), 1.0 - s * (x * x + y * y)),
    )


def quaternion_of_matrix(R: ArrayLike) -> Array:
    """Quaternion of a rotation matrix.

    Parameters
    ----------
    R : array_like, shape (3, 3)
        Orthogonal, determinant 1.

    Returns
    -------
    ndarray, shape (4,)
        Scalar first and not negative. The largest component is computed first, so that nothing cancels
        (Shepperd, Journal of Guidance and Control 1 (1978) 223).

    Examples
    --------
    >>> print(quaternion_of_matrix(rotation([0, 0, 1], np.pi / 2)).round(4))
    [0.7071 0.     0.     0.7071]
    """
    m = np.asarray(R, np.float64)
    four_products = np.array(  # q[i] q[j], four times
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[2, 0] + m[0, 2]],
            [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1]],
            [m[1, 0] - m[0, 1], m[2, 0] + m[0, 2], m[1, 2] + m[2, 1], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    row = four_products[np.argmax(np.diag(four_products))]
    q: Array = row / np.copysign(np.linalg.norm(row), row[0])
    return q
