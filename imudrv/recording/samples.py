"""Increments to export, from a recording or from a file of datagrams, counted on their way."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.calibration import Calibration
from imudrv.errors import InputError
from imudrv.files.inputs import open_file
from imudrv.recording.reader import Recording
from imudrv.records import INCREMENTS, Flag, Records
from imudrv.wire.datagram import DatagramDecoder
from imudrv.wording import counted

_CHUNK_BYTES: Final = 76 << 12
_COUNTERS: Final = 1 << 32
"""Counters are modulo this; a number that seems to be further ahead than half of it is a restart."""


@dataclass
class Counts:
    """Number of samples in an export.

    Attributes
    ----------
    samples : int
        Rows of increments.
    bridged : int
        Samples without increments of their own: a longer interval covers them.
    invalid : int
        Rows that are not flagged valid.
    left_out : int
        Samples that the counter numbers and no interval covers.
    """

    samples: int = 0
    bridged: int = 0
    invalid: int = 0
    left_out: int = 0

    def __str__(self) -> str:
        """One-line summary."""
        return (
            f"{counted(self.samples, 'sample')}, {self.bridged} more bridged by long intervals; "
            f"{self.invalid} not valid, {self.left_out} lost and left out"
        )


@dataclass
class Samples:
    """Increments of a file; iterating yields ndarrays of INCREMENTS, once, and counts them.

    Attributes
    ----------
    path : Path
        The file.
    interval_ns : int
        Nominal interval of a sample.
    unit : str
        Serial number of the unit; empty if not known.
    origin : mapping of str to str
        Metadata record `imu50` of a recording; empty for other files.
    calibration : Calibration or None
        That of the increments, if it is known.
    counts : Counts
        Of what has been yielded.
    """

    path: Path
    interval_ns: int
    _pieces: Iterable[Records]
    unit: str = ""
    origin: Mapping[str, str] = field(default_factory=dict)
    calibration: Calibration | None = None
    counts: Counts = field(default_factory=Counts)

    def __iter__(self) -> Iterator[Records]:
        """Yield the increments."""
        before: int | None = None
        for increments in self._pieces:
            if not len(increments):
                continue
            covered = self.covered(increments)
            counters = increments["counter"].tolist()
            previous = counters[0] - covered[0] if before is None else before
            ahead = np.diff(increments["counter"], prepend=previous) % _COUNTERS
            lost = np.where(ahead < _COUNTERS // 2, ahead - covered, 0)
            self.counts.samples += len(increments)
            self.counts.bridged += int((covered - 1).sum())
            self.counts.invalid += int(np.count_nonzero(~increments["flags"] & np.uint32(Flag.VALID)))
            self.counts.left_out += int(lost[lost > 0].sum())
            before = counters[-1]
            yield increments

    def covered(self, increments: Records) -> NDArray[np.int64]:
        """Return the number of samples that each interval covers, at least 1."""
        return np.maximum(np.rint(increments["interval_ns"] / self.interval_ns).astype(np.int64), 1)


def samples_of_recording(recording: Recording) -> Samples:
    """Return the published increments of a recording."""
    return Samples(
        recording.path,
        recording.profile.layout().interval_ns,
        recording.increments(),
        recording.origin.get("unit", ""),
        recording.origin,
        recording.calibration,
    )


def samples_of_datagrams(path: Path) -> Samples:
    """Return the increments of a file of datagrams; the interval is the usual one at its beginning.

    Parameters
    ----------
    path : Path
        Datagrams back to back; the last one may be cut.

    Raises
    ------
    InputError
        The file cannot be read; while iterating, that it holds other bytes.
    """
    pieces = _datagrams(path)
    first = next(pieces, np.zeros(0, INCREMENTS))
    usual = int(np.median(first["interval_ns"])) if len(first) else 0
    return Samples(path, max(usual, 1), chain([first], pieces))


def _datagrams(path: Path) -> Iterator[Records]:
    decoder = DatagramDecoder()
    with open_file(path) as file:
        while data := file.read(_CHUNK_BYTES):
            increments, _, rejects = decoder.feed(data)
            if rejects.size:
                place = rejects["offset"][0]
                raise InputError(f"{path}: byte {place}: expected I50N datagrams, got other bytes")
            yield increments
