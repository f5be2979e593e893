"""Vector algebra for numba kernels, on tuples: there a tuple costs nothing, a small array an allocation."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel

Vector: TypeAlias = tuple[float, float, float]
Matrix: TypeAlias = tuple[Vector, Vector, Vector]
"""By rows."""


@kernel
def add(a: Vector, b: Vector) -> Vector:
    """Return `a + b`."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@kernel
def subtract(a: Vector, b: Vector) -> Vector:
    """Difference `a - b`."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@kernel
def scale(s: float, a: Vector) -> Vector:
    """Return `s a`."""
    return s * a[0], s * a[1], s * a[2]


@kernel
def dot(a: Vector, b: Vector) -> float:
    """Return `a . b`."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a: Vector, b: Vector) -> Vector:
    """Return `a x b`."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@kernel
def times(a: Vector, b: Vector) -> Vector:
    """Multiply component by component."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@kernel
def rotate(C: Matrix, v: Vector) -> Vector:
    """Return `C @ v`."""
    return dot(C[0], v), dot(C[1], v), dot(C[2], v)


@kernel
def row(a: NDArray[np.float64], i: int) -> Vector:
    """Return row `i` of an array of shape (n, 3)."""
    return a[i, 0], a[i, 1], a[i, 2]


@kernel
def matrix(a: NDArray[np.float64]) -> Matrix:
    """Return the rows of an array of shape (3, 3)."""
    return row(a, 0), row(a, 1), row(a, 2)


@kernel
def vector_at(a: NDArray[np.float64], at: int) -> Vector:
    """Three elements of a flat array, from `at` on."""
    return a[at], a[at + 1], a[at + 2]


@kernel
def put(a: NDArray[np.float64], at: int, v: Vector) -> None:
    """Set three elements of a flat array, from `at` on."""
    a[at], a[at + 1], a[at + 2] = v
