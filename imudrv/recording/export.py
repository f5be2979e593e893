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

from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from imudrv.errors import InputError
from imudrv.files.outputs import require_other
from imudrv.files.tables import increment_columns, table, writing
from imudrv.recording.reader import Recording
from imudrv.recording.ros2 import export_ros2
from imudrv.recording.tally import Exported, Tally, require_transport
from imudrv.recording.waypoint import export_imr
from imudrv.records import INCREMENTS
from imudrv.wire.candump import format_candump


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
        tally = Tally()
        with table(target, (suffix,), {}) as rows:
            rows.write(increment_columns(np.zeros(0, INCREMENTS)))  # columns even without a sample
            for increments in tally.of(recording.increments()):
                rows.write(increment_columns(increments))
        return tally.result

    return write


def _export_raw(recording: Recording, target: Path) -> Exported:
    require_transport(recording, "serial", "--to candump")
    count = 0
    with writing(target) as file:
        for arrival in recording.arrivals():
            assert isinstance(arrival.data, bytes)
            count += file.write(arrival.data)
    return Exported(count, 0)


def _export_candump(recording: Recording, target: Path) -> Exported:
    require_transport(recording, "can", "--to raw")
    count = 0
    with writing(target) as file:
        for arrival in recording.arrivals():
            assert isinstance(arrival.data, np.ndarray)
            file.write(format_candump(arrival.data))
            count += arrival.data.size
    return Exported(count, 0)


KINDS: Final[dict[str, Callable[[Recording, Path], Exported]]] = {
    "csv": _export_table(".csv"),
    "npz": _export_table(".npz"),
    "raw": _export_raw,
    "candump": _export_candump,
    "imr": export_imr,
    "ros2": export_ros2,
}
"""What there is, and what writes it."""
