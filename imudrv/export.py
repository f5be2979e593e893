"""Recordings into the formats of other tools.

==========  =========================================================================================
``csv``     increments, one row a sample, the columns of `imudrv compensate`
``npz``     the same as numpy arrays
``raw``     the bytes of a serial line as they came
``candump`` CAN messages as a log
``imr``     increments for Waypoint / Inertial Explorer
``ros2``    increments as rates, an MCAP of ``sensor_msgs/msg/Imu`` on ``/imu/data_raw`` (REP 145)
==========  =========================================================================================

``imr`` follows NovAtel's description of the format
(https://docs.novatel.com/Waypoint/Content/Data_Formats/IMR_File.htm): a header of 512 bytes, then 32 bytes a
sample: seconds of the week as a double and six scaled i32, gyro X Y Z in degrees and accelerometer X Y Z in
m/s, here increments. Time is UTC, which the header says, and begins anew with the week. What rounding takes
from one increment the next one gets, so that sums are right to one unit.

``imr`` and ``ros2`` have no flags: samples that are not valid go in like the others and are counted.
"""

from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.errors import InputError
from imudrv.outputs import require_other
from imudrv.recording import ORIGIN, Recording
from imudrv.records import INCREMENTS, Flag, Records
from imudrv.sinks.files import increment_columns, replacing, table, writing
from imudrv.units import DEG, NS, NS_PER_S
from imudrv.wire.candump import format_candump

TOPIC: Final = "/imu/data_raw"

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
_WEEK_NS: Final = 7 * 86_400 * NS_PER_S
_SUNDAY_NS: Final = 4 * 86_400 * NS_PER_S  # the epoch was a Thursday, weeks begin on Sunday

_IMU_DEFINITION: Final = """\
std_msgs/Header header
geometry_msgs/Quaternion orientation
float64[9] orientation_covariance
geometry_msgs/Vector3 angular_velocity
float64[9] angular_velocity_covariance
geometry_msgs/Vector3 linear_acceleration
float64[9] linear_acceleration_covariance
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Quaternion
float64 x 0
float64 y 0
float64 z 0
float64 w 1
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""


class Exported(NamedTuple):
    """What an export wrote.

    Parameters
    ----------
    written : int
        Samples; for ``raw`` bytes, for ``candump`` messages.
    invalid : int
        Samples among them that are not valid.
    """

    written: int
    invalid: int


def export(recording: Recording, kind: str, target: Path) -> Exported:
    """Write a recording in another format.

    Parameters
    ----------
    recording : Recording
        Cut or whole.
    kind : str
        One of `KINDS`.
    target : Path
        The file; it appears whole or not at all. For ``csv``, ``raw`` and ``candump`` also standard output.

    Returns
    -------
    Exported

    Raises
    ------
    InputError
        An unknown kind, one that does not fit the recording, a sample that the format cannot hold, a damaged
        recording, or a file that cannot be written or is the recording.
    """
    if kind not in KINDS:
        raise InputError(f"--to: expected one of {', '.join(KINDS)}, got {kind!r}")
    require_other(target, recording.path)
    return KINDS[kind](recording, target)


def _export_table(suffix: str) -> Callable[[Recording, Path], Exported]:
    def write(recording: Recording, target: Path) -> Exported:
        tally = _Tally()
        with table(target, (suffix,), {}) as rows:
            rows.write(increment_columns(np.zeros(0, INCREMENTS)))  # columns even without a sample
            for increments in tally.of(recording.increments()):
                rows.write(increment_columns(increments))
        return tally.result

    return write


def _export_raw(recording: Recording, target: Path) -> Exported:
    _require_transport(recording, "serial", "--to candump")
    count = 0
    with writing(target) as file:
        for arrival in recording.arrivals():
            assert isinstance(arrival.data, bytes)
            count += file.write(arrival.data)
    return Exported(count, 0)


def _export_candump(recording: Recording, target: Path) -> Exported:
    _require_transport(recording, "can", "--to raw")
    count = 0
    with writing(target) as file:
        for arrival in recording.arrivals():
            assert isinstance(arrival.data, np.ndarray)
            file.write(format_candump(arrival.data))
            count += arrival.data.size
    return Exported(count, 0)


def _export_imr(recording: Recording, target: Path) -> Exported:
    tally = _Tally()
    unit = recording.origin.get("unit", "")
    header = np.zeros(1, _HEADER)
    header["szHeader"] = b"$IMURAW"
    header["dVersionNumber"] = 8.80
    header["bDeltaTheta"] = header["bDeltaVelocity"] = 1
    header["dDataRateHz"] = recording.profile.sample_rate_hz
    header["dGyroScaleFactor"] = _GYRO_DEG
    header["dAccelScaleFactor"] = _ACCELEROMETER_M_S
    header["iUtcOrGpsTime"] = 1
    header["szImuName"] = f"IMU50 {unit}".strip().encode("ascii", "replace")[:31]
    header["szProgramName"] = f"imudrv {version('imu50')}".encode()[:31]
    gyro = _Rounding("angle", "deg", _GYRO_DEG)
    accelerometer = _Rounding("velocity", "m/s", _ACCELEROMETER_M_S)
    with replacing(target) as file:
        file.write(header.tobytes())
        for increments in tally.of(recording.increments()):
            samples = np.zeros(increments.size, _SAMPLE)
            samples["time"] = ((increments["t_ns"] + _SUNDAY_NS) % _WEEK_NS) * NS
            samples["gyro"] = gyro.feed(increments["dtheta_b"] / DEG, increments)
            samples["accelerometer"] = accelerometer.feed(increments["dv_b"], increments)
            file.write(samples.tobytes())
    return tally.result


def _export_ros2(recording: Recording, target: Path) -> Exported:
    try:
        from mcap_ros2.writer import Writer
    except ImportError as error:
        raise InputError(
            "--to ros2: expected the package mcap-ros2-support: pip install imu50[ros2]"
        ) from error
    tally = _Tally()
    with replacing(target) as file:
        writer = Writer(file)
        schema = writer.register_msgdef("sensor_msgs/msg/Imu", _IMU_DEFINITION)
        writer.add_metadata(ORIGIN, recording.origin)
        for increments in tally.of(recording.increments()):
            if (increments["interval_ns"] <= 0).any() or (increments["t_ns"] < 0).any():
                raise InputError(
                    f"{recording.path}: expected samples with an interval and a time from 1970 on, got others"
                )
            interval_s = increments["interval_ns"][:, np.newaxis] * NS
            rates = (increments["dtheta_b"] / interval_s).tolist()
            forces = (increments["dv_b"] / interval_s).tolist()
            for t_ns, rate, force in zip(increments["t_ns"].tolist(), rates, forces, strict=True):
                writer.write_message(TOPIC, schema, _imu_message(t_ns, rate, force), t_ns, t_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    return tally.result


def _imu_message(t_ns: int, rate: list[float], force: list[float]) -> dict[str, Any]:
    sec, nanosec = divmod(t_ns, NS_PER_S)
    return {
        "header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "imu50"},
        "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        "orientation_covariance": [-1.0] + [0.0] * 8,  # there is no orientation
        "angular_velocity": dict(zip("xyz", rate, strict=True)),
        "angular_velocity_covariance": [0.0] * 9,  # not known
        "linear_acceleration": dict(zip("xyz", force, strict=True)),
        "linear_acceleration_covariance": [0.0] * 9,
    }


class _Rounding:
    """Increments to whole units; what is left over goes on to the next."""

    def __init__(self, name: str, unit: str, scale: float) -> None:
        self._name = name
        self._unit = unit
        self._scale = scale
        self._left = np.zeros(3)

    def feed(self, values: NDArray[np.float64], increments: Records) -> NDArray[np.float64]:
        sums = self._left + np.cumsum(values / self._scale, axis=0)
        whole = np.rint(sums)
        self._left = sums[-1] - whole[-1]
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


class _Tally:
    """Counts what goes through."""

    def __init__(self) -> None:
        self.result = Exported(0, 0)

    def of(self, pieces: Iterator[Records]) -> Iterator[Records]:
        for increments in pieces:
            yield increments
            invalid = np.count_nonzero(increments["flags"] & Flag.VALID == 0)
            self.result = Exported(self.result.written + increments.size, self.result.invalid + int(invalid))


def _require_transport(recording: Recording, transport: str, instead: str) -> None:
    came = recording.profile.transport
    if came != transport:
        raise InputError(
            f"{recording.path}: expected a recording of a {transport} unit, got {came}: {instead}"
        )


KINDS: Final[dict[str, Callable[[Recording, Path], Exported]]] = {
    "csv": _export_table(".csv"),
    "npz": _export_table(".npz"),
    "raw": _export_raw,
    "candump": _export_candump,
    "imr": _export_imr,
    "ros2": _export_ros2,
}
"""What there is, and what writes it."""
