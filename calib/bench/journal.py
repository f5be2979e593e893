"""The journal: what happened, one JSON object a line, only appended to, each line fsynced before it counts.

A line ends with its own hash, which the next line repeats, so that no line can be changed, taken out or put
in unseen::

    {"event": ..., "at": UTC, ..., "before": hash of the line before, "sha256": hash of the text up to here}

A power cut may leave the beginning of a line at the very end. It is dropped: what follows it is a line that
is determined by what precedes it, with the length and hash of what was dropped, so that even a cut while that
one is written leaves a journal to go on with. A broken line anywhere else is damage.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

from imudrv.errors import InputError

Entry: TypeAlias = dict[str, Any]
"""A line without its hashes."""


_HASH: Final = ', "sha256": "'


_HASH_BYTES: Final = len(_HASH) + 64 + len('"}')


class PartialLine(NamedTuple):
    """The beginning of a line at a journal's very end.

    Attributes
    ----------
    number : int
        Of the line.
    text : bytes
        What there is of it.
    mend : bytes
        What has to be appended before the journal can go on.
    """

    number: int
    text: bytes
    mend: bytes

    def __str__(self) -> str:
        """What it is, for people."""
        return (
            f"line {self.number}, the last, is broken after {len(self.text)} bytes, as a power cut leaves it"
        )


class Contents(NamedTuple):
    """What a journal holds.

    Attributes
    ----------
    entries : list of dict
        Its whole lines.
    last : str
        Hash of the last one.
    torn : Torn or None
        None: it ends with a whole line.
    """

    entries: list[Entry]
    last: str
    torn: PartialLine | None


class Journal:
    """A journal that is open to be appended to.

    Parameters
    ----------
    path : Path
        Of one that is there, see `begin`. A broken last line is dropped.

    Attributes
    ----------
    dropped : str
        What was dropped when it was opened; empty if nothing was.

    Raises
    ------
    InputError
        It cannot be read or written, or a line is damaged: its number is told.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._entries, self._last, torn = read(path)
        self.dropped = ""
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
        if torn is not None:
            self.dropped = f"{path}: {torn}; it is dropped"
            self._write(torn.mend)
            _, entry, self._last = _mend(torn.text, self._last)
            self._entries.append(entry)

    @property
    def entries(self) -> Sequence[Entry]:
        """All lines so far."""
        return self._entries

    def append(self, entry: Entry) -> None:
        """Append a line; it is on the disk when this returns.

        Parameters
        ----------
        entry : dict
            Of what JSON knows; `event` says what happened.

        Raises
        ------
        InputError
            It cannot be written.
        """
        entry = _stamped(entry)
        line, digest = _line(entry, self._last)
        self._write(line)
        self._entries.append(entry)
        self._last = digest

    def close(self) -> None:
        """Let go of it."""
        os.close(self._file)

    def _write(self, data: bytes) -> None:
        rest = memoryview(data)
        try:
            while rest:
                rest = rest[os.write(self._file, rest) :]
            os.fsync(self._file)
        except OSError as error:
            raise InputError(
                f"{self._path}: cannot be written: {error.strerror or error}; make room and resume"
            ) from error


def begin(path: Path, entry: Entry) -> None:
    """Begin a journal.

    Parameters
    ----------
    path : Path
        There must be no such file.
    entry : dict
        Its first line.

    Raises
    ------
    InputError
        It cannot be made.
    """
    try:
        with path.open("xb") as file:
            file.write(_line(_stamped(entry), "")[0])
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise InputError(f"{path}: cannot be made: {error.strerror or error}") from error


def read(path: Path) -> Contents:
    """Read a journal and check its hashes.

    Parameters
    ----------
    path : Path
        The file.

    Returns
    -------
    Contents

    Raises
    ------
    InputError
        It cannot be read, or a line is damaged: its number is told.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: expected a session's journal, cannot read it: {error.strerror}") from error
    entries: list[Entry] = []
    last, torn = "", None
    at, number = 0, 1
    while at < len(data) and torn is None:
        end = data.find(b"\n", at)
        line = data[at:] if end < 0 else data[at:end]
        entry = _read_line(line) if end >= 0 else None
        if entry is not None:
            if entry.pop("before") != last:
                raise InputError(
                    f"{path}: line {number}: does not follow the line before it; "
                    "one was changed, taken out or put in"
                )
            last = entry.pop("sha256")
            entries.append(entry)
            at, number = end + 1, number + 1
            continue
        rest = data[at + len(line) :]
        mend, mended, hash_of_mended = _mend(line, last)
        if rest.startswith(mend):
            entries.append(mended)
            last = hash_of_mended
            at, number = at + len(line) + len(mend), number + 2
        elif mend.startswith(rest) and not _is_json(line):
            torn = PartialLine(number, line, mend[len(rest) :])
        else:
            raise InputError(f"{path}: line {number}: is damaged: its text does not give its sha256")
    if not entries:
        raise InputError(f"{path}: expected the plan in line 1, got {len(data)} bytes without it; begin anew")
    return Contents(entries, last, torn)


def _stamped(entry: Entry) -> Entry:
    return {"event": entry["event"], "at": datetime.now(UTC).isoformat(timespec="milliseconds"), **entry}


def _line(entry: Entry, before: str) -> tuple[bytes, str]:
    """A line and its hash."""
    text = json.dumps({**entry, "before": before}, allow_nan=False)[:-1]
    digest = _sha256(text.encode())
    return f'{text}{_HASH}{digest}"}}\n'.encode(), digest


def _read_line(line: bytes) -> Entry | None:
    """A line, if it is whole."""
    text, tail = line[:-_HASH_BYTES], line[-_HASH_BYTES:]
    if tail != f'{_HASH}{_sha256(text)}"}}'.encode():
        return None
    entry: Entry = json.loads(line)
    return entry


def _mend(torn: bytes, before: str) -> tuple[bytes, Entry, str]:
    """What follows a torn line: the bytes from its end on, the line that they hold, and its hash."""
    entry = {"event": "dropped", "bytes": len(torn), "sha256_of_dropped": _sha256(torn)}
    line, digest = _line(entry, before)
    return b"\n" + line, entry, digest


def _is_json(line: bytes) -> bool:
    try:
        json.loads(line)
    except ValueError:
        return False
    return True


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
