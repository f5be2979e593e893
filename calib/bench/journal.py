"""Append-only journal of a session: one JSON object per line, synchronised to disk line by line.

Each line ends with its own hash and contains that of the line before, so that a line that is changed, removed
or inserted is detected::

    {"event": ..., "at": UTC, ..., "before": hash of the line before, "sha256": hash of the text up to here}

A power cut may leave a partial line at the end of the file. The repair appends a line with the length and
hash of that partial line, which is then ignored. The repair line depends only on what precedes it, so that a
second power cut while it is written can be repaired as well. A partial line anywhere else is damage.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeAlias

from calib.bench.entries import Entry, LineDropped, Plan, from_json, to_json
from imudrv.errors import InputError
from imudrv.files.atomic import sync_folder
from imudrv.posix import O_BINARY

_Line: TypeAlias = dict[str, Any]


_HASH: Final = ', "sha256": "'


_HASH_BYTES: Final = len(_HASH) + 64 + len('"}')


class PartialLine(NamedTuple):
    """A partial line at the end of a journal.

    Attributes
    ----------
    number : int
        Line number.
    text : bytes
        The partial line.
    repair : bytes
        Bytes to append before the journal can be continued.
    """

    number: int
    text: bytes
    repair: bytes

    def __str__(self) -> str:
        """Return a phrase for the user."""
        return f"line {self.number}, the last, ends after {len(self.text)} bytes, as after a power cut"


class Contents(NamedTuple):
    """Contents of a journal.

    Attributes
    ----------
    entries : list of Entry
        Its complete lines.
    last : str
        Hash of the last one.
    partial : PartialLine or None
        None if the journal ends with a complete line.
    """

    entries: list[Entry]
    last: str
    partial: PartialLine | None


class Journal:
    """A journal that is open for appending.

    Parameters
    ----------
    path : Path
        An existing journal, see `begin`. A partial last line is dropped.

    Attributes
    ----------
    dropped : str
        Message about the line dropped on opening; empty if there was none.

    Raises
    ------
    InputError
        The journal cannot be read or written, or a line is damaged; the message gives its number.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._entries, self._last, partial = read(path)
        self.dropped = ""
        try:
            self._file = os.open(path, os.O_WRONLY | os.O_APPEND | O_BINARY)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
        if partial is not None:
            self.dropped = f"{path}: {partial}; it is dropped"
            self._write(partial.repair)
            _, entry, self._last = _repair(partial.text, self._last)
            self._entries.append(entry)

    @property
    def entries(self) -> Sequence[Entry]:
        """All entries so far."""
        return self._entries

    def append(self, entry: Entry) -> None:
        """Append an entry; it is on disk when this returns.

        Raises
        ------
        InputError
            The entry cannot be written.
        """
        line, digest = _line(_stamped(entry), self._last)
        self._write(line)
        self._entries.append(entry)
        self._last = digest

    def close(self) -> None:
        """Close the file."""
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


def begin(path: Path, plan: Plan) -> None:
    """Create a journal.

    Parameters
    ----------
    path : Path
        A file that does not exist yet.
    plan : Plan
        First entry.

    Raises
    ------
    InputError
        The file cannot be created.
    """
    try:
        with path.open("xb") as file:
            file.write(_line(_stamped(plan), "")[0])
            file.flush()
            os.fsync(file.fileno())
        sync_folder(path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be created: {error.strerror or error}") from error


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
        The journal cannot be read, or a line is damaged; the message gives its number.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: expected a session's journal, cannot read it: {error.strerror}") from error
    entries: list[Entry] = []
    last, partial = "", None
    at, number = 0, 1
    while at < len(data) and partial is None:
        end = data.find(b"\n", at)
        text = data[at:] if end < 0 else data[at:end]
        line = _read_line(text) if end >= 0 else None
        if line is not None:
            if line["before"] != last:
                raise InputError(
                    f"{path}: line {number}: does not follow the line before it; "
                    "a line was changed, removed or inserted"
                )
            try:
                entries.append(from_json(line))
            except InputError as error:
                raise InputError(f"{path}: line {number}: {error}") from None
            last = line["sha256"]
            at, number = end + 1, number + 1
            continue
        rest = data[at + len(text) :]
        repair, dropped, digest = _repair(text, last)
        if rest.startswith(repair):
            entries.append(dropped)
            last = digest
            at, number = at + len(text) + len(repair), number + 2
        elif repair.startswith(rest) and not _is_json(text):
            partial = PartialLine(number, text, repair[len(rest) :])
        else:
            raise InputError(f"{path}: line {number}: is damaged: its text does not match its sha256")
    if not entries:
        raise InputError(
            f"{path}: expected the plan in line 1, got {len(data)} bytes without it; begin a new session"
        )
    return Contents(entries, last, partial)


def _stamped(entry: Entry) -> _Line:
    line = to_json(entry)
    return {"event": line["event"], "at": datetime.now(UTC).isoformat(timespec="milliseconds"), **line}


def _line(content: _Line, before: str) -> tuple[bytes, str]:
    """Return the text of a line and its hash."""
    text = json.dumps({**content, "before": before}, allow_nan=False)[:-1]
    digest = _sha256(text.encode())
    return f'{text}{_HASH}{digest}"}}\n'.encode(), digest


def _read_line(line: bytes) -> _Line | None:
    """Return the object of a line, None if its hash is wrong."""
    text, tail = line[:-_HASH_BYTES], line[-_HASH_BYTES:]
    if tail != f'{_HASH}{_sha256(text)}"}}'.encode():
        return None
    content: _Line = json.loads(line)
    return content


def _repair(partial: bytes, before: str) -> tuple[bytes, Entry, str]:
    """Return what follows a partial line: the bytes after it, their entry, and its hash."""
    entry = LineDropped(len(partial), _sha256(partial))
    line, digest = _line(to_json(entry), before)
    return b"\n" + line, entry, digest


def _is_json(line: bytes) -> bool:
    try:
        json.loads(line)
    except ValueError:
        return False
    return True


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
