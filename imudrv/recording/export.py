"""Recordings into the formats of other tools.

==========  =========================================================================================
``csv``     increments, one row a sample, the columns of `imudrv compensate`
``npz``     the same as numpy arrays
``raw``     the bytes of a serial line as received
``candump`` CAN messages as a log
``imr``     increments for Waypoint / Inertial Explorer
``ros2``    increments as rates, an MCAP of ``sensor_msgs/msg/Imu`` on ``/imu/data_raw`` (REP 145)
==========  =========================================================================================

``imr`` and ``ros2`` have no flags: samples that are not valid are written like the others and counted.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from imudrv.errors import InputError
from imudrv.files.inputs import open_file
from imudrv.files.outputs import require_other
from imudrv.files.tables import increment_columns, table, writing
from imudrv.recording.reader import Recording
from imudrv.recording.ros2 import export_ros2
from imudrv.recording.waypoint import export_imr
from imudrv.records import INCREMENTS, Records
from imudrv.wire.candump import format_candump
from imudrv.wire.datagram import DatagramDecoder

KINDS: Final = ("csv", "npz", "raw", "candump", "imr", "ros2")
"""Names of the formats."""
_TABLES: Final = ("csv", "npz")
_CHUNK_BYTES: Final = 76 << 12


def export(recording: Recording, kind: str, target: Path) -> None:
    """Write a recording in another format.

    Parameters
    ----------
    recording : Recording
        Cut or complete.
    kind : str
        One of `KINDS`.
    target : Path
        The file; it appears complete or not at all. For ``csv``, ``raw`` and ``candump`` also standard
        output.

    Raises
    ------
    InputError
        An unknown kind, one that does not fit the recording, a sample that the format cannot hold, a damaged
        recording, or a file that cannot be written or is the recording.
    """
    if kind not in KINDS:
        raise InputError(f"--to: expected one of {', '.join(KINDS)}, got {kind!r}")
    require_other(target, recording.path)
    if kind == "raw":
        _require_transport(recording, "serial", "--to candump")
        with writing(target) as file:
            file.writelines(reads.data.tobytes() for reads in recording.reads())
    elif kind == "candump":
        _require_transport(recording, "can", "--to raw")
        with writing(target) as file:
            file.writelines(format_candump(reads.data) for reads in recording.reads())
    elif kind == "imr":
        export_imr(recording, target)
    elif kind == "ros2":
        export_ros2(recording, target)
    else:
        _write_table(f".{kind}", recording.increments(), target)


def export_datagrams(path: Path, kind: str, target: Path) -> None:
    """Write the increments of a file of datagrams (``.i50n``) as a table; counters are modulo 2^32.

    Parameters
    ----------
    path : Path
        Datagrams back to back; the last one may be cut.
    kind : {'csv', 'npz'}
        The format.
    target : Path
        See `export`.

    Raises
    ------
    InputError
        Another kind, a file that holds other bytes or cannot be read, or a target that cannot be written.
    """
    if kind not in _TABLES:
        raise InputError(f"--to: expected {' or '.join(_TABLES)} for increments ({path}), got {kind!r}")
    require_other(target, path)
    _write_table(f".{kind}", _datagrams(path), target)


def _datagrams(path: Path) -> Iterator[Records]:
    decoder = DatagramDecoder()
    with open_file(path) as file:
        while data := file.read(_CHUNK_BYTES):
            increments, _, rejects = decoder.feed(data)
            if rejects.size:
                place = rejects["offset"][0]
                raise InputError(f"{path}: byte {place}: expected I50N datagrams, got other bytes")
            yield increments


def _write_table(suffix: str, pieces: Iterator[Records], target: Path) -> None:
    with table(target, (suffix,), {}) as rows:
        rows.write(increment_columns(np.zeros(0, INCREMENTS)))  # columns even without a sample
        for increments in pieces:
            rows.write(increment_columns(increments))


def _require_transport(recording: Recording, transport: str, instead: str) -> None:
    came = recording.profile.transport
    if came != transport:
        raise InputError(
            f"{recording.path}: expected a recording of a {transport} unit, got {came}: {instead}"
        )
