"""Recordings, and files of datagrams, into the formats of other tools.

===========  ========================================================================================
``csv``      increments, one row a sample, the columns of `imudrv compensate`
``npz``      the same as numpy arrays
``parquet``  the same as a table of Apache Parquet
``raw``      the bytes of a serial line as received
``candump``  CAN messages as a log
``imr``      increments for Waypoint / Inertial Explorer
``ros2``     increments as rates, an MCAP of ``sensor_msgs/msg/Imu`` on ``/imu/data_raw`` (REP 145)
===========  ========================================================================================

``imr`` has no flags: samples that are not valid are written like the others, and counted.
"""

from pathlib import Path
from typing import Final

import numpy as np

from imudrv.errors import InputError
from imudrv.files.outputs import require_other
from imudrv.files.tables import increment_columns, table, writing
from imudrv.recording.reader import Recording
from imudrv.recording.ros2 import DEFAULT_CONVENTION, Convention, export_ros2
from imudrv.recording.samples import Samples, samples_of_datagrams, samples_of_recording
from imudrv.recording.waypoint import export_imr
from imudrv.records import INCREMENTS
from imudrv.wire.candump import format_candump

KINDS: Final = ("csv", "npz", "parquet", "raw", "candump", "imr", "ros2")
"""Names of the formats."""
_OF_SAMPLES: Final = ("csv", "npz", "parquet", "imr", "ros2")


def export(recording: Recording, kind: str, target: Path, convention: Convention = DEFAULT_CONVENTION) -> str:
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
    convention : Convention
        Frame and axes of ``ros2``.

    Returns
    -------
    str
        How many samples were bridged, are not valid, or were left out.

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
        return "all bytes as received, nothing left out"
    if kind == "candump":
        _require_transport(recording, "can", "--to raw")
        with writing(target) as file:
            file.writelines(format_candump(reads.data) for reads in recording.reads())
        return "all messages as received, nothing left out"
    return _export_samples(samples_of_recording(recording), kind, target, convention)


def export_datagrams(path: Path, kind: str, target: Path, convention: Convention = DEFAULT_CONVENTION) -> str:
    """Write the increments of a file of datagrams (``.i50n``); counters are modulo 2^32.

    Parameters
    ----------
    path : Path
        Datagrams back to back; the last one may be cut.
    kind : {'csv', 'npz', 'parquet', 'imr', 'ros2'}
        The format.
    target, convention
        See `export`.

    Returns
    -------
    str
        See `export`.

    Raises
    ------
    InputError
        Another kind, a file that holds other bytes or cannot be read, or a target that cannot be written.
    """
    if kind not in _OF_SAMPLES:
        raise InputError(f"--to: expected {', '.join(_OF_SAMPLES)} for increments ({path}), got {kind!r}")
    require_other(target, path)
    return _export_samples(samples_of_datagrams(path), kind, target, convention)


def _export_samples(samples: Samples, kind: str, target: Path, convention: Convention) -> str:
    if kind == "imr":
        export_imr(samples, target)
    elif kind == "ros2":
        export_ros2(samples, target, convention)
    else:
        with table(target, (f".{kind}",), {}) as rows:
            rows.write(increment_columns(np.zeros(0, INCREMENTS)))  # columns even without a sample
            for increments in samples:
                rows.write(increment_columns(increments))
    return str(samples.counts)


def _require_transport(recording: Recording, transport: str, instead: str) -> None:
    came = recording.profile.transport
    if came != transport:
        raise InputError(
            f"{recording.path}: expected a recording of a {transport} unit, got {came}: {instead}"
        )
