"""Export to the IMR format of Waypoint and Inertial Explorer.

Format: https://docs.novatel.com/Waypoint/Content/Data_Formats/IMR_File.htm, a header of 512 bytes, then 32
bytes a sample: seconds of the week as a double and six scaled i32, gyro X Y Z in degrees and accelerometer
X Y Z in m/s, here increments. Time is UTC, which the header says, and restarts with the week. The rounding
error of one increment is added to the next, so that sums are right to one unit. Readers take each increment
as that of one sample, so an interval that bridges a gap is split evenly into its samples.
"""

from importlib.metadata import version
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.recording.samples import Samples
from imudrv.records import Records
from imudrv.units import DEG, NS, NS_PER_S

_HEADER: Final = np.dtype(
    [
        ("szHeader", "S8"),
        ("bIsIntelOrMotorola", "<i1"),  # 0: little-endian
        ("dVersionNumber", "<f8"),
        ("bDeltaTheta", "<i4"),  # 1: increments
        ("bDeltaVelocity", "<i4"),
        ("dDataRateHz", "<f8"),
        ("dGyroScaleFactor", "<f8"),  # deg a unit
        ("dAccelScaleFactor", "<f8"),  # m/s a unit
        ("iUtcOrGpsTime", "<i4"),  # 1: UTC seconds of the week
        ("iRcvTimeOrCorrTime", "<i4"),  # 0: not known
        ("dTimeTagBias", "<f8"),
        ("szImuName", "S32"),
        ("reserved1", "V4"),
        ("szProgramName", "S32"),
        ("tCreate", "V12"),
        ("bLeverArmValid", "<i1"),
        ("lXoffset", "<i4"),
        ("lYoffset", "<i4"),
        ("lZoffset", "<i4"),
        ("Reserved", "V354"),
    ]
)
_SAMPLE: Final = np.dtype([("time", "<f8"), ("gyro", "<i4", 3), ("accelerometer", "<i4", 3)])
_GYRO_DEG: Final = 2.0**-25  # 5.2e-10 rad; an increment may be up to 64 deg
_ACCELEROMETER_M_S: Final = 2.0**-24  # 6.0e-8 m/s; up to 128 m/s
_MOST_PARTS: Final = 1 << 17  # of the intervals of one message: 86 000 samples are one of 4.3 s at 20 kHz
_WEEK_NS: Final = 7 * 86_400 * NS_PER_S
_SUNDAY_NS: Final = 4 * 86_400 * NS_PER_S  # the epoch was a Thursday, weeks begin on Sunday


def export_imr(samples: Samples, target: Path) -> None:
    """Write increments as IMR.

    Parameters
    ----------
    samples : Samples
        The increments.
    target : Path
        The file.

    Raises
    ------
    InputError
        An increment that the format cannot hold, or the file cannot be written.
    """
    header = np.zeros(1, _HEADER)
    header["szHeader"] = b"$IMURAW"
    header["dVersionNumber"] = 8.80
    header["bDeltaTheta"] = header["bDeltaVelocity"] = 1
    header["dDataRateHz"] = NS_PER_S / samples.interval_ns
    header["dGyroScaleFactor"] = _GYRO_DEG
    header["dAccelScaleFactor"] = _ACCELEROMETER_M_S
    header["iUtcOrGpsTime"] = 1
    header["szImuName"] = f"IMU50 {samples.unit}".strip().encode("ascii", "replace")[:31]
    header["szProgramName"] = f"imudrv {version('imu50')}".encode()[:31]
    gyro = _Rounding("angle", "deg", _GYRO_DEG)
    accelerometer = _Rounding("velocity", "m/s", _ACCELEROMETER_M_S)
    with (
        atomic_write(target) as file,
        np.errstate(over="ignore", invalid="ignore"),
    ):  # is checked as inf or NaN
        file.write(header.tobytes())
        for increments in (_split(piece, samples.covered(piece), samples.path) for piece in samples):
            rows = np.zeros(increments.size, _SAMPLE)
            rows["time"] = ((increments["t_ns"] + _SUNDAY_NS) % _WEEK_NS) * NS
            rows["gyro"] = gyro.feed(increments["dtheta_b"] / DEG, increments)
            rows["accelerometer"] = accelerometer.feed(increments["dv_b"], increments)
            file.write(rows.tobytes())


def _split(increments: Records, covered: NDArray[np.int64], path: Path) -> Records:
    """Split each interval evenly into the samples that it covers; the last one ends where it ended."""
    if covered.sum() > _MOST_PARTS:
        raise InputError(f"{path}: expected intervals of some samples, got one of {covered.max()} samples")
    parts = np.repeat(increments, covered)
    share = np.repeat(covered, covered)
    after = np.repeat(np.cumsum(covered), covered) - 1 - np.arange(parts.size)  # parts of it that follow
    parts["t_ns"] -= after * parts["interval_ns"] // share
    parts["counter"] -= after
    for name in ("dtheta_b", "dv_b"):
        parts[name] /= share[:, np.newaxis]
    return parts


class _Rounding:
    """Rounding of increments to whole units; the remainder is added to the next increment."""

    def __init__(self, name: str, unit: str, scale: float) -> None:
        self._name = name
        self._unit = unit
        self._scale = scale
        self._remainder = np.zeros(3)

    def feed(self, values: NDArray[np.float64], increments: Records) -> NDArray[np.float64]:
        if np.isnan(values).any():
            raise InputError(
                f"expected {self._name} increments of all three axes, as the format has no place for an "
                "absent one, got those of a unit that lacks some; export to csv or npz"
            )
        sums = self._remainder + np.cumsum(values / self._scale, axis=0)
        whole = np.rint(sums)
        self._remainder = sums[-1] - whole[-1]
        units = np.diff(whole, axis=0, prepend=0)
        outside = ~(np.abs(units) < 2**31).all(axis=1)
        if outside.any():
            first = int(outside.argmax())
            raise InputError(
                f"sample {increments['counter'][first]}: expected {self._name} increments "
                f"below {2**31 * self._scale:g} {self._unit}, as many as the format holds, "
                f"got {values[first].tolist()}"
            )
        return units
