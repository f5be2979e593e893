"""Size effect: velocity that an accelerometer senses because it lies off the origin (mathematics, section 1).

Accelerometer i senses along a_i at r_i. Over an interval T with the angular rates w0 and w1 at its ends it
senses, beside the velocity of the origin,

    dv_r,i = a_i . { (w1 - w0) x r_i + T/6 ([w0 x]^2 + 4 [wm x]^2 + [w1 x]^2) r_i }

where the rate in the middle is wm = dtheta_b / T, or (w0 + w1) / 2 where the rate filter is to remove dither
from it as well. The tangential part telescopes, so that the quantisation of a rate does not accumulate in
velocity.

For speed both parts are inner products with constants of a and r: a . (d x r) = d . (r x a), and
a . [w x]^2 r = q . (products of the components of w).
"""

from typing import Final, NamedTuple, TypeAlias

import numpy as np

from imudrv.arrays import Array
from imudrv.kernels import kernel
from imudrv.records import Records
from imudrv.vectors import Matrix, Vector, add, matrix, rotate, scale, subtract

Vector6: TypeAlias = tuple[float, float, float, float, float, float]

SIZE_EFFECT: Final = np.dtype(
    [
        ("tangential", np.float64, (3, 3)),  # row i: r_i x a_i, m
        ("centripetal", np.float64, (3, 6)),  # row i: q_i, m, see `_products`
        ("mean_of_ends_s", np.float64),  # an interval this long takes its middle rate from its ends
    ],
    align=True,
)
"""Constants of a unit and a rate filter."""


class SizeEffect(NamedTuple):
    """`SIZE_EFFECT` as tuples."""

    tangential: Matrix
    centripetal: tuple[Vector6, Vector6, Vector6]
    mean_of_ends_s: float


def size_effect_constants(C_ba: Array, r_b: Array, mean_of_ends_s: float) -> Records:
    """Compute the constants.

    Parameters
    ----------
    C_ba : ndarray, shape (3, 3)
        Accelerometer axes to body.
    r_b : ndarray, shape (3, 3)
        Row i: sensing point of accelerometer i, m, body axes.
    mean_of_ends_s : float
        Length of the intervals whose middle rate is the mean of those at their ends, s; 0: none.

    Returns
    -------
    ndarray of SIZE_EFFECT, shape (1,)
    """
    a_b = np.linalg.inv(C_ba)
    record = np.zeros(1, SIZE_EFFECT)
    record["tangential"] = np.cross(r_b, a_b)
    record["centripetal"] = [_centripetal(a, r) for a, r in zip(a_b, r_b, strict=True)]
    record["mean_of_ends_s"] = mean_of_ends_s
    return record


def _centripetal(a: Array, r: Array) -> Array:
    """Factors of `_products` in `a . (w (w . r) - r (w . w))`."""
    ar = a * r
    x, y, z = 0, 1, 2
    return np.array(
        [
            -ar[y] - ar[z],
            -ar[z] - ar[x],
            -ar[x] - ar[y],
            a[x] * r[y] + a[y] * r[x],
            a[y] * r[z] + a[z] * r[y],
            a[z] * r[x] + a[x] * r[z],
        ]
    )


@kernel
def unpack_size_effect(record: np.void) -> SizeEffect:
    """Read a record of `SIZE_EFFECT`."""
    q = record["centripetal"]
    return SizeEffect(
        matrix(record["tangential"]),
        (
            (q[0, 0], q[0, 1], q[0, 2], q[0, 3], q[0, 4], q[0, 5]),
            (q[1, 0], q[1, 1], q[1, 2], q[1, 3], q[1, 4], q[1, 5]),
            (q[2, 0], q[2, 1], q[2, 2], q[2, 3], q[2, 4], q[2, 5]),
        ),
        record["mean_of_ends_s"],
    )


@kernel
def dv_r(effect: SizeEffect, T: float, w0: Vector, dtheta: Vector, w1: Vector) -> Vector:
    """Velocity that the size effect adds to each accelerometer.

    Parameters
    ----------
    effect : SizeEffect
        Constants.
    T : float
        Length of the interval, s.
    w0, w1 : tuple of 3 float
        Rates at its ends, rad/s.
    dtheta : tuple of 3 float
        Angle increment over it, rad.

    Returns
    -------
    tuple of 3 float
        m/s.
    """
    # Twice the middle rate, so that its products count four times. A recovered interval uses its own angle:
    # the rate varies within it, and over many intervals dither cancels.
    wm = add(w0, w1) if effect.mean_of_ends_s == T else scale(2.0 / T, dtheta)
    s = _add(_add(_products(w0), _products(w1)), _products(wm))
    q = effect.centripetal
    centripetal = _dot(q[0], s), _dot(q[1], s), _dot(q[2], s)
    return add(rotate(effect.tangential, subtract(w1, w0)), scale(T * (1.0 / 6.0), centripetal))


@kernel
def _products(w: Vector) -> Vector6:
    """Elements xx, yy, zz, xy, yz, zx of `w w^T`."""
    return w[0] * w[0], w[1] * w[1], w[2] * w[2], w[0] * w[1], w[1] * w[2], w[2] * w[0]


@kernel
def _add(a: Vector6, b: Vector6) -> Vector6:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3], a[4] + b[4], a[5] + b[5]


@kernel
def _dot(a: Vector6, b: Vector6) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3] + a[4] * b[4] + a[5] * b[5]
