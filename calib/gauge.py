"""Where the origin of b is put, and how other programs count the lever arms.

Turned between rests, a unit shows how its three sensing points lie to each other, not where the origin lies.
A gauge names the choice; a change of gauge is one common shift, and exact:

    r_i' = r_i - (sum of w_j r_j)        w = (1, 1, 1) / 3 in `centroid`, (1, 0, 0) in `x`, ...

`given` puts the origin where one point is stated to be, from a drawing; the statement bears no error here.
The differences of the points, and what compensated data say at rest, are the same in every gauge.

**Kalibr** (`--imu-models scale-misalignment-size-effect`) writes metres, axes of its frame i, x as origin:
`accelerometers: {rx_i: [0, 0, 0], ry_i: [...], rz_i: [...]}`. Frame i is our b. Its model has the size effect
before scale and misalignment M, ours on the sensing axes: they differ by misalignment times arm (1e-3 of it).

**PSINS** keeps metres in `clbt.rx`, `clbt.ry`, `clbt.rz`, in the gauge that the motion had. As a calibration,
`imuclbt(imu, clbt)` takes `S [rx; ry; rz]` off the specific force with the S of ours, and `sysclbt` finds it
in that sense: the sign is ours. Where `imuclbt` is used to spoil perfect data with a struct, the unit so made
has its points at minus that struct: its `clbt.rx` of (1, 2, 3) cm makes a unit with r_x = -(10, 20, 30) mm.

>>> arms = Arms(np.array([[24, -11, -9], [-23, 29, -7], [-1, -18, 16]]) * 1e-3, None, "centroid")
>>> to_kalibr(arms)["accelerometers"]["ry_i"]
[-0.047, 0.04, 0.002]
>>> to_psins(arms)["rx"]
[0.024, -0.011, -0.009]
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imudrv.errors import InputError

Array = NDArray[np.float64]
Gauge: TypeAlias = Literal["centroid", "x", "y", "z", "given"]

GAUGES: Final[tuple[Gauge, ...]] = ("centroid", "x", "y", "z", "given")
_WEIGHTS: Final = {
    "centroid": (1 / 3, 1 / 3, 1 / 3),
    "x": (1.0, 0.0, 0.0),
    "y": (0.0, 1.0, 0.0),
    "z": (0.0, 0.0, 1.0),
}
_DIGITS: Final = 12
"""Decimals of a metre that other programs' files get."""


@dataclass(frozen=True)
class Arms:
    """The sensing points in a gauge.

    Attributes
    ----------
    r_b : ndarray, shape (3, 3)
        Row i: sensing point of accelerometer i, m, body axes.
    covariance : ndarray, shape (9, 9), or None
        Of (r_x, r_y, r_z) in the gauge, m^2; None: not known.
    gauge : {'centroid', 'x', 'y', 'z', 'given'}
        Where the origin of b is.
    """

    r_b: Array
    covariance: Array | None
    gauge: Gauge


def convert(arms: Arms, to: Gauge, stated: tuple[Literal["x", "y", "z"], ArrayLike] | None = None) -> Arms:
    """Go over to another gauge.

    Parameters
    ----------
    arms : Arms
        In any gauge.
    to : {'centroid', 'x', 'y', 'z', 'given'}
        The new one.
    stated : tuple of an accelerometer and its sensing point, optional
        For `given`: one of 'x', 'y', 'z' and where that one senses, m, body axes, shape (3,).

    Returns
    -------
    Arms

    Raises
    ------
    InputError
        Not a gauge; `given` without a statement, or a statement without `given`; a point that is none.
    """
    if to not in GAUGES:
        raise InputError(f"gauge: expected one of {', '.join(GAUGES)}, got {to!r}")
    if to != "given":
        if stated is not None:
            raise InputError(
                f"gauge {to}: expected no stated point, got one of accelerometer {stated[0]}; use gauge given"
            )
        return _shifted(arms, to, _WEIGHTS[to], np.zeros(3))
    if stated is None:
        raise InputError(
            "gauge given: expected where one sensing point is, from a drawing, got none; the rotations alone "
            "cannot tell it"
        )
    accelerometer, place = stated
    point = np.asarray(place, np.float64)
    if accelerometer not in ("x", "y", "z") or point.shape != (3,) or not np.isfinite(point).all():
        raise InputError(
            f"gauge given: expected x, y or z and three finite numbers, got {accelerometer!r} and {place!r}"
        )
    return _shifted(arms, to, _WEIGHTS[accelerometer], point)


def _shifted(arms: Arms, gauge: Gauge, weights: tuple[float, float, float], origin: Array) -> Arms:
    T = np.eye(9) - np.kron(np.tile(weights, (3, 1)), np.eye(3))
    r_b = (T @ arms.r_b.ravel()).reshape(3, 3) + origin
    covariance = None if arms.covariance is None else T @ arms.covariance @ T.T
    return Arms(r_b, covariance, gauge)


def to_kalibr(arms: Arms) -> dict[str, Any]:
    """The arms as Kalibr's IMU file has them.

    Parameters
    ----------
    arms : Arms
        In any gauge.

    Returns
    -------
    dict
        `{"accelerometers": {"rx_i": ..., "ry_i": ..., "rz_i": ...}}`, lists of 3 float, m, x as origin.
    """
    r_b = convert(arms, "x").r_b
    return {"accelerometers": {f"r{axis}_i": _list(r) for axis, r in zip("xyz", r_b, strict=True)}}


def from_kalibr(document: Mapping[str, Any]) -> Arms:
    """Read the arms of Kalibr's IMU file.

    Parameters
    ----------
    document : mapping
        Of one IMU: what stands below `imu0`.

    Returns
    -------
    Arms
        In gauge x, without covariance.

    Raises
    ------
    InputError
        There are no such arms in it.
    """
    section = document.get("accelerometers")
    r_b = _points("Kalibr: accelerometers", section, [f"r{axis}_i" for axis in "xyz"])
    return convert(Arms(r_b, None, "given"), "x")


def to_psins(arms: Arms) -> dict[str, list[float]]:
    """The arms as a PSINS calibration struct has them, for `imuclbt` to compensate with.

    Parameters
    ----------
    arms : Arms
        In any gauge, which is kept.

    Returns
    -------
    dict
        `rx`, `ry`, `rz`: lists of 3 float, m.
    """
    return {f"r{axis}": _list(r) for axis, r in zip("xyz", arms.r_b, strict=True)}


def from_psins(clbt: Mapping[str, Any]) -> Arms:
    """Read the arms of a PSINS calibration struct, as `sysclbt` finds it.

    Parameters
    ----------
    clbt : mapping
        With `rx`, `ry`, `rz`, m.

    Returns
    -------
    Arms
        In gauge given, for the struct does not name its origin; without covariance.

    Raises
    ------
    InputError
        There are no such arms in it.
    """
    return Arms(_points("PSINS: clbt", clbt, ["rx", "ry", "rz"]), None, "given")


def _list(r: Array) -> list[float]:
    return [round(float(value), _DIGITS) for value in r]


def _points(where: str, section: Any, names: list[str]) -> Array:
    try:
        r_b = np.array([np.ravel(section[name]) for name in names], np.float64)
    except (KeyError, TypeError, ValueError):
        r_b = np.empty(0)
    if r_b.shape != (3, 3) or not np.isfinite(r_b).all():
        raise InputError(f"{where}: expected {', '.join(names)} as three numbers each, m, got {section!r}")
    return r_b
