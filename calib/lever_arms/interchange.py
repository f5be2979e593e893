"""Lever arms in the formats of Kalibr and PSINS.

>>> from calib.lever_arms.gauge import LeverArms
>>> arms = LeverArms(np.array([[24, -11, -9], [-23, 29, -7], [-1, -18, 16]]) * 1e-3, None, "centroid")
>>> to_kalibr(arms)["accelerometers"]["ry_i"]
[-0.047, 0.04, 0.002]
>>> to_psins(arms)["rx"]
[0.024, -0.011, -0.009]
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from calib.lever_arms.gauge import LeverArms, convert
from imudrv.arrays import Array
from imudrv.errors import InputError

_DIGITS: Final = 12
"""Decimals of a metre in the files of other programs."""


def to_kalibr(arms: LeverArms) -> dict[str, Any]:
    """Return the lever arms in the format of Kalibr's IMU file.

    Parameters
    ----------
    arms : LeverArms
        In any gauge.

    Returns
    -------
    dict
        `{"accelerometers": {"rx_i": ..., "ry_i": ..., "rz_i": ...}}`, lists of 3 float, m, x as origin.
    """
    r_b = convert(arms, "x").r_b
    return {"accelerometers": {f"r{axis}_i": _list(r) for axis, r in zip("xyz", r_b, strict=True)}}


def from_kalibr(document: Mapping[str, Any]) -> LeverArms:
    """Return the lever arms of Kalibr's IMU file.

    Parameters
    ----------
    document : mapping
        Section of one IMU: the content of `imu0`.

    Returns
    -------
    LeverArms
        In gauge x, without covariance.

    Raises
    ------
    InputError
        It contains no such lever arms.
    """
    section = document.get("accelerometers")
    r_b = _points("Kalibr: accelerometers", section, [f"r{axis}_i" for axis in "xyz"])
    return convert(LeverArms(r_b, None, "given"), "x")


def to_psins(arms: LeverArms) -> dict[str, list[float]]:
    """Return the lever arms in the format of a PSINS calibration struct, for compensation by `imuclbt`.

    Parameters
    ----------
    arms : LeverArms
        In any gauge, which is kept.

    Returns
    -------
    dict
        `rx`, `ry`, `rz`: lists of 3 float, m.
    """
    return {f"r{axis}": _list(r) for axis, r in zip("xyz", arms.r_b, strict=True)}


def from_psins(clbt: Mapping[str, Any]) -> LeverArms:
    """Return the lever arms of a PSINS calibration struct, as `sysclbt` computes it.

    Parameters
    ----------
    clbt : mapping
        With `rx`, `ry`, `rz`, m.

    Returns
    -------
    LeverArms
        In gauge given, for the struct does not name its origin; without covariance.

    Raises
    ------
    InputError
        It contains no such lever arms.
    """
    return LeverArms(_points("PSINS: clbt", clbt, ["rx", "ry", "rz"]), None, "given")


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
