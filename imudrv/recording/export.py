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
from typing import Final, NamedTuple, TypeVar

import numpy as np

from imudrv.errors import InputError
from imudrv.files.outputs import require_other
from imudrv.files.tables import increment_columns, table, writing
from imudrv.recording.reader import Recording
from imudrv.recording.ros2 import export_ros2
from imudrv.recording.waypoint import export_imr
from imudrv.records import INCREMENTS, Flag, Records
from imudrv.wire.candump import format_candump
from imudrv.wire.datagram import DatagramDecoder

T = TypeVar("T")

KINDS: Final = ("csv", "npz", "raw", "candump", "imr", "ros2")
"""Names of the formats."""
_TABLES: Final = ("csv", "npz")
_CHUNK_BYTES: Final = 76 << 12


class Exported(NamedTuple):
    """Counts of an export.

    Parameters
    ----------
    written : int
        Number of samples; for ``raw`` of bytes, for ``candump`` of messages.
    invalid : int
        Number of samples among them that are not valid.
    """

    written: int
    invalid: int


def export(recording: Recording, kind: str, target: Path) -> Exported:
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
    if kind == "raw":
        return Exported(_export_raw(recording, target), 0)
    if kind == "candump":
        return Exported(_export_candump(recording, target), 0)
    samples = invalid = 0

    def counted() -> Iterator[Records]:
        nonlocal samples, invalid
        for increments in recording.increments():
            yield increments
            samples += increments.size
            invalid += int(np.count_nonzero(increments["flags"] & Flag.VALID == 0))

    if kind == "imr":
        export_imr(recording, counted(), target)
    elif kind == "ros2":
        export_ros2(recording, counted(), target)
    else:
        _export_table(f".{kind}", counted(), target)
    return Exported(samples, invalid)


def export_datagrams(path: Path, kind: str, target: Path) -> Exported:
    """Write the increments of a file of datagrams (``.i50n``) as a table; counters are modulo 2^32.

    Parameters
    ----------
    path : Path
        Datagrams back to back; the last one may be cut.
    kind : {'csv', 'npz'}
        The format.
    target : Path
        See `export`.

    Returns
    -------
    Exported

    Raises
    ------
    InputError
        Another kind, a file that holds other bytes or cannot be read, or a target that cannot be written.
    """
    if kind not in _TABLES:
        raise InputError(f"--to: expected {' or '.join(_TABLES)} for increments ({path}), got {kind!r}")
    require_other(target, path)
    decoder = DatagramDecoder()
    samples = invalid = 0

    def pieces() -> Iterator[Records]:
        nonlocal samples, invalid
        try:
            with path.open("rb") as file:
                while data := file.read(_CHUNK_BYTES):
                    increments, _, rejects = decoder.feed(data)
                    if rejects.size:
                        place = rejects["offset"][0]
                        raise InputError(f"{path}: byte {place}: expected I50N datagrams, got other bytes")
                    yield increments
                    samples += increments.size
                    invalid += int(np.count_nonzero(increments["flags"] & Flag.VALID == 0))
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror}") from error

    _export_table(f".{kind}", pieces(), target)
    return Exported(samples, invalid)


def _export_raw(recording: Recording, target: Path) -> int:
    _require_transport(recording, "serial", "--to candump")
    with writing(target) as file:
        return sum(file.write(data) for data in _wire(recording, bytes))


def _export_candump(recording: Recording, target: Path) -> int:
    _require_transport(recording, "can", "--to raw")
    count = 0
    with writing(target) as file:
        for messages in _wire(recording, np.ndarray):
            file.write(format_candump(messages))
            count += messages.size
    return count


def _require_transport(recording: Recording, transport: str, instead: str) -> None:
    came = recording.profile.transport
    if came != transport:
        raise InputError(
            f"{recording.path}: expected a recording of a {transport} unit, got {came}: {instead}"
        )


def _wire(recording: Recording, kind: type[T]) -> Iterator[T]:
    """Yield what was received, all of one kind."""
    for arrival in recording.arrivals():
        if not isinstance(arrival.data, kind):
            raise InputError(
                f"{recording.path}: expected wire data of its profile's transport, got those of another; "
                "the file is damaged"
            )
        yield arrival.data


def _export_table(suffix: str, pieces: Iterator[Records], target: Path) -> None:
    with table(target, (suffix,), {}) as rows:
        rows.write(increment_columns(np.zeros(0, INCREMENTS)))  # columns even without a sample
        for increments in pieces:
            rows.write(increment_columns(increments))
