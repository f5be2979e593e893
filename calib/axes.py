"""Signed body axes, '+X' to '-Z'.

>>> print(vector("-Y"))
[ 0. -1.  0.]
>>> opposite("-Y")
'+Y'
>>> axis_name(np.array([0.1, -0.9, 0.3]))
'-Y'
"""

from typing import Literal

import numpy as np

from imudrv.arrays import Array

Side = Literal["+X", "-X", "+Y", "-Y", "+Z", "-Z"]
"""A body axis with its sign: the side of the unit that it points out of."""


def vector(axis: Side) -> Array:
    """Return the unit vector of a signed body axis, in body axes, shape (3,)."""
    v = np.zeros(3)
    v["XYZ".index(axis[1])] = -1.0 if axis[0] == "-" else 1.0
    return v


def opposite(axis: Side) -> Side:
    """Return a body axis with the other sign."""
    other: dict[Side, Side] = {"+X": "-X", "-X": "+X", "+Y": "-Y", "-Y": "+Y", "+Z": "-Z", "-Z": "+Z"}
    return other[axis]


def side(axis: str) -> str:
    """Return the name of a body axis for a sentence: ``X`` for '+X', ``-X`` for '-X'."""
    return axis.removeprefix("+")


def axis_name(v_b: Array) -> Side:
    """Return the signed body axis nearest to a vector, '+X' to '-Z'."""
    k = int(np.argmax(np.abs(v_b)))
    positive: tuple[Side, ...] = ("+X", "+Y", "+Z")
    return positive[k] if v_b[k] > 0 else opposite(positive[k])
