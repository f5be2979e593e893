"""Gauges of the lever arms: the choice of the origin of b.

Rotations between rests determine the positions of the three sensing points relative to each other, not their
origin. A gauge is a choice of origin; a change of gauge is one common shift, and exact:

    r_i' = r_i - (sum of w_j r_j)        w = (1, 1, 1) / 3 in `centroid`, (1, 0, 0) in `x`, ...

`given` defines the origin by the known position of one point, from a drawing, which is taken as exact. The
differences of the points, and compensated data at rest, are the same in every gauge.

**Kalibr** (`--imu-models scale-misalignment-size-effect`) writes metres, axes of its frame i, x as origin:
`accelerometers: {rx_i: [0, 0, 0], ry_i: [...], rz_i: [...]}`. Frame i is our b. Its model has the size effect
before scale and misalignment M, ours on the sensing axes: they differ by misalignment times arm (1e-3 of it).

**PSINS** keeps metres in `clbt.rx`, `clbt.ry`, `clbt.rz`, in the gauge that the motion had. As a calibration,
`imuclbt(imu, clbt)` takes `S [rx; ry; rz]` off the specific force with the S of ours, and `sysclbt` finds it
in that sense: the sign is ours. Where `imuclbt` is used to spoil perfect data with a struct, the unit so made
has its points at minus that struct: its `clbt.rx` of (1, 2, 3) cm makes a unit with r_x = -(10, 20, 30) mm.
"""

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from calib.html_table import html_table
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.units import MM

Gauge: TypeAlias = Literal["centroid", "x", "y", "z", "given"]


GAUGES: Final[tuple[Gauge, ...]] = ("centroid", "x", "y", "z", "given")


_WEIGHTS: Final = {
    "centroid": (1 / 3, 1 / 3, 1 / 3),
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
}


@dataclass(frozen=True, repr=False)
class LeverArms:
    """The sensing points of the accelerometers in a gauge.

    Attributes
    ----------
    r_b : ndarray, shape (3, 3)
        Row i: sensing point of accelerometer i, m, body axes.
    covariance : ndarray, shape (9, 9), or None
        Covariance of (r_x, r_y, r_z) in the gauge, m^2; None: unknown.
    gauge : {'centroid', 'x', 'y', 'z', 'given'}
        Position of the origin of b.
    """

    r_b: Array
    covariance: Array | None
    gauge: Gauge

    def __repr__(self) -> str:
        points = ", ".join(
            f"r_{axis} ({', '.join(f'{value:+.3f}' for value in r)})"
            for axis, r in zip("xyz", self.r_b / MM, strict=True)
        )
        return f"<LeverArms: gauge {self.gauge}, mm: {points}>"

    def _repr_html_(self) -> str:
        cells = [f"{value:+.3f}" for value in self.r_b.ravel() / MM]
        if self.covariance is not None:
            sigma = np.sqrt(np.diag(self.covariance)) / MM
            cells = [f"{cell} ± {s:.3f}" for cell, s in zip(cells, sigma, strict=True)]
        rows = [(f"r_{axis}", *cells[3 * k : 3 * k + 3]) for k, axis in enumerate("xyz")]
        return html_table(f"Lever arms, gauge {self.gauge}", ("mm", "X", "Y", "Z"), rows)


def convert(arms: LeverArms, to: Gauge, known_point: tuple[str, ArrayLike] | None = None) -> LeverArms:
    """Convert lever arms to another gauge.

    Parameters
    ----------
    arms : LeverArms
        In any gauge.
    to : {'centroid', 'x', 'y', 'z', 'given'}
        The new gauge.
    known_point : tuple of an accelerometer and its sensing point, optional
        For `given`: one of 'x', 'y', 'z' and its sensing point, m, body axes, shape (3,).

    Returns
    -------
    LeverArms

    Raises
    ------
    InputError
        Unknown gauge; `given` without a known point, or a known point with another gauge; invalid point.

    Examples
    --------
    >>> arms = LeverArms(np.array([[24, -11, -9], [-23, 29, -7], [-1, -18, 16]]) * MM, None, "centroid")
    >>> (convert(arms, "x").r_b / MM).round(9).tolist()  # x is the origin
    [[0.0, 0.0, 0.0], [-47.0, 40.0, 2.0], [-25.0, -7.0, 25.0]]
    """
    if to not in GAUGES:
        raise InputError(f"gauge: expected one of {', '.join(GAUGES)}, got {to!r}")
    if to != "given":
        if known_point is not None:
            raise InputError(
                f"gauge {to}: expected no known point, got one of accelerometer {known_point[0]}; "
                "use gauge given"
            )
        return _shifted(arms, to, _WEIGHTS[to], np.zeros(3))
    if known_point is None:
        raise InputError(
            "gauge given: expected the position of one sensing point, from a drawing, got none; rotations "
            "alone do not determine it"
        )
    accelerometer, place = known_point
    point = np.asarray(place, np.float64)
    if accelerometer not in ("x", "y", "z") or point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(
            f"gauge given: expected x, y or z and three finite numbers, got {accelerometer!r} and {place!r}"
        )
    return _shifted(arms, to, _WEIGHTS[accelerometer], point)


def _shifted(arms: LeverArms, gauge: Gauge, weights: tuple[float, float, float], origin: Array) -> LeverArms:
    T = np.eye(9) - np.kron(np.tile(weights, (3, 1)), np.eye(3))
    r_b = (T @ arms.r_b.ravel()).reshape(3, 3) + origin
    covariance = None if arms.covariance is None else T @ arms.covariance @ T.T
    return LeverArms(r_b, covariance, gauge)
