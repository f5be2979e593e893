"""Channel ``/imu50/samples`` of a packed recording: what plotting programs show of each sample.

A message is CDR (little-endian) with a definition in the language of ROS 2, which Foxglove, Lichtblick and
PlotJuggler read without a program of ours. All messages of a recording have the same size. The increments are
exact; rate and specific force, the increments over their interval, are rounded to 24 bits.
"""

import re
from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.records import Flag, Records
from imudrv.units import NS, NS_PER_S

TOPIC: Final = "/imu50/samples"
NAME: Final = "imu50/msg/Sample"
"""Name of the schema."""

_CDR_LITTLE_ENDIAN: Final = b"\0\1\0\0"
_VECTORS: Final = {"float32": "imu50/Vector32", "float64": "imu50/Vector64"}
_FIELDS: Final = (
    (
        "stamp",
        "builtin_interfaces/Time",
        "end of the interval, UNIX time",
        [("sec", "<i4"), ("nanosec", "<u4")],
    ),
    ("counter", "uint32", "counts by one a sample", "<u4"),
    ("interval_ns", "uint32", "covered by the increments", "<u4"),
    ("dtheta_b", _VECTORS["float64"], "rad", ("<f8", 3)),
    ("dv_b", _VECTORS["float64"], "m/s", ("<f8", 3)),
    ("angular_rate", _VECTORS["float32"], "rad/s, mean over the interval", ("<f4", 3)),
    ("specific_force", _VECTORS["float32"], "m/s^2, mean over the interval", ("<f4", 3)),
)
"""Name, type and meaning of each field before the temperatures, and its type in numpy."""
_SEPARATOR: Final = "=" * 80


class SampleEncoder:
    """Encoder of samples as CDR.

    Parameters
    ----------
    temperature_names : sequence of str
        Names of the temperatures of the profile.

    Attributes
    ----------
    definition : bytes
        Definition of the messages, in the language of ROS 2.
    """

    def __init__(self, temperature_names: tuple[str, ...]) -> None:
        names = [re.sub(r"\W", "_", name.lower(), flags=re.ASCII) for name in temperature_names]
        self._count = len(names)
        flags = [flag.name.lower() for flag in Flag if flag.name]
        self.definition = _definition(names, flags).encode()
        fields = [(name, kind) for name, _, _, kind in _FIELDS]
        self._row = np.dtype(
            [("head", "S4"), *fields, ("temperature_degc", "<f4", len(names)), ("flags", "?", len(flags))]
        )

    def encode(self, increments: Records, temperature_degc: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Encode samples.

        Parameters
        ----------
        increments : ndarray of INCREMENTS, shape (n,)
            Samples.
        temperature_degc : ndarray of float64, shape (n, k)
            The temperatures of each, degrees Celsius, in the order of their names; more are ignored.

        Returns
        -------
        ndarray of uint8, shape (n, size)
            A message a row.
        """
        rows = np.zeros(len(increments), self._row)
        rows["head"] = _CDR_LITTLE_ENDIAN
        seconds, ns = np.divmod(increments["t_ns"], NS_PER_S)
        rows["stamp"]["sec"] = np.clip(seconds, -(2**31), 2**31 - 1)  # a time that ROS 2 cannot have
        rows["stamp"]["nanosec"] = ns
        for name in ("counter", "interval_ns", "dtheta_b", "dv_b"):
            rows[name] = increments[name]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            interval_s = increments["interval_ns"][:, np.newaxis] * NS
            rows["angular_rate"] = increments["dtheta_b"] / interval_s
            rows["specific_force"] = increments["dv_b"] / interval_s
        rows["temperature_degc"] = temperature_degc[:, : self._count]
        rows["flags"] = (increments["flags"][:, np.newaxis] & np.array(list(Flag), np.uint32)) != 0
        return rows.view(np.uint8).reshape(len(rows), self._row.itemsize)


def _definition(temperatures: list[str], flags: list[str]) -> str:
    fields = [f"{kind} {name}  # {meaning}" for name, kind, meaning, _ in _FIELDS]
    parts = {
        "builtin_interfaces/Time": ["int32 sec", "uint32 nanosec"],
        **{kind: [f"{number} {axis}" for axis in "xyz"] for number, kind in _VECTORS.items()},
        "imu50/Flags": [f"bool {name}" for name in flags],
    }
    if temperatures:
        fields.append("imu50/Temperatures temperature_degc  # NaN: not known")
        parts["imu50/Temperatures"] = [f"float32 {name}" for name in temperatures]
    fields.append("imu50/Flags flags")
    lines = [*fields]
    for name, members in parts.items():
        lines += [_SEPARATOR, f"MSG: {name}", *members]
    return "\n".join(lines) + "\n"
