"""Append-only journal of a session: one JSON object per line, synchronised to disk line by line.

Each line ends with its own hash and contains that of the line before, so that a line that is changed, removed
or inserted by accident is detected::

    {"event": ..., "at": UTC, ..., "before": hash of the line before, "sha256": hash of the text up to here}

Whoever can write the file can make all hashes anew. A bench with a key therefore signs the last hash at the
end of the session, in a line of its own (`Signed`): then nobody without the key can change any line.

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

from calib.bench.entries import (
    AcceptedStep,
    Entry,
    FileRecorded,
    LineDropped,
    Plan,
    Signed,
    from_json,
    to_json,
)
from calib.signing.keys import BenchKey
from calib.signing.signatures import sign
from imudrv.calibration import Signature
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.files.json_text import load_json
from imudrv.posix import O_BINARY
from imudrv.wording import counted

MAX_LINE: Final = 4 << 20
"""Longest line, bytes: the plan contains three settings files."""
MAX_JOURNAL: Final = 64 << 20
"""Largest journal, bytes: 200 000 lines."""

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
        size = counted(len(self.text), "byte")
        return f"line {self.number}, the last, ends after {size}, as after a power cut"


class SignedLines(NamedTuple):
    """Signature of the first lines of a journal.

    Attributes
    ----------
    number : int
        Number of the line with the signature.
    signature : Signature
        The signature.
    data : bytes
        What it signs: the hash of the line before, and thereby all lines before.
    """

    number: int
    signature: Signature
    data: bytes


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
    signatures : list of SignedLines
        Its signatures, not checked yet. A session has one, as its last line; another one may be before the
        end if a power cut left a partial line after it.
    """

    entries: list[Entry]
    last: str
    partial: PartialLine | None
    signatures: list[SignedLines]

    @property
    def signature(self) -> Signature | None:
        """Signature of the whole journal; None if there is none, or something follows it."""
        is_whole = self.partial is None and isinstance(self.entries[-1], Signed)
        return self.signatures[-1].signature if is_whole else None


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
        self._entries, self._last, partial, _ = read(path)
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

    def append(self, entry: Entry, key: BenchKey | None = None) -> None:
        """Append an entry; it is on disk when this returns.

        Parameters
        ----------
        entry : Entry
            The entry.
        key : BenchKey, optional
            Signs the journal up to this entry. Both lines are written at once, so that a kill cannot separate
            them.

        Raises
        ------
        InputError
            The entry is invalid, or cannot be written.
        """
        data, last = _line(_stamped(entry), self._last)
        entries = [entry]
        if key is not None:
            signed = Signed(**vars(sign(_signed_data(last), key.private_key)))
            line, last = _line(_stamped(signed), last)
            data, entries = data + line, [entry, signed]
        self._write(data)
        self._entries += entries
        self._last = last

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
        The file cannot be created, or the plan is invalid.
    """
    line, _ = _line(_stamped(plan), "")
    if len(line) > MAX_LINE:
        raise InputError(
            f"{path}: expected procedure, site and profile of at most {MAX_LINE} bytes, got {len(line)}"
        )
    try:
        with path.open("xb") as file:
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        atomic.sync_folder(path.parent)
    except OSError as error:
        raise InputError(f"{path}: cannot be created: {error.strerror or error}") from error


def read(path: Path) -> Contents:
    """Read a journal and check its hashes and its entries.

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
        The journal cannot be read, or a line is damaged or invalid; the message gives its number and key.
    """
    data = atomic.content(path, MAX_JOURNAL, "a journal")
    entries: list[Entry] = []
    signatures: list[SignedLines] = []
    recorded: set[str] = set()
    last, partial = "", None
    at, number = 0, 1
    while at < len(data) and partial is None:
        end = data.find(b"\n", at)
        text = data[at:] if end < 0 else data[at:end]
        name = f"{path}: line {number}"
        if len(text) > MAX_LINE:
            raise InputError(f"{name}: expected at most {MAX_LINE} bytes, got {len(text)}")
        digest = _hash(text) if end >= 0 else None
        if digest is not None:
            line = load_json(text, name)
            entry = from_json(line, name)
            if line.get("before") != last:
                raise InputError(
                    f"{name}: does not follow the line before it; a line was changed, removed or inserted"
                )
            _check_place(entry, number, recorded, name)
            if isinstance(entry, FileRecorded):
                recorded.add(entry.name)
            elif isinstance(entry, Signed):
                signatures.append(SignedLines(number, Signature(**vars(entry)), _signed_data(last)))
            entries.append(entry)
            last = digest
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
            raise InputError(f"{name}: is damaged: its text does not match its sha256")
    if not entries:
        raise InputError(
            f"{path}: expected the plan in line 1, got {len(data)} bytes without it; begin a new session"
        )
    return Contents(entries, last, partial, signatures)


def journal_dates(path: Path) -> tuple[str, str]:
    """Return the dates, UTC, of the first and the last line of a journal."""
    lines = atomic.content(path, MAX_JOURNAL, "a journal").splitlines()
    first, last = (str(load_json(lines[k], str(path)).get("at", ""))[:10] for k in (0, -1))
    return first, last


def _check_place(entry: Entry, number: int, recorded: set[str], name: str) -> None:
    """Check that a line may be where it is."""
    if isinstance(entry, Plan) != (number == 1):
        raise InputError(f"{name}: expected the plan of an imu50-session in line 1, and only there")
    if isinstance(entry, AcceptedStep) and entry.recording not in recorded:
        raise InputError(
            f"{name}: recording: expected a file that a line before this one records, got {entry.recording!r}"
        )


def _stamped(entry: Entry) -> _Line:
    line = to_json(entry)
    return {"event": line["event"], "at": datetime.now(UTC).isoformat(timespec="milliseconds"), **line}


def _line(content: _Line, before: str) -> tuple[bytes, str]:
    """Return the text of a line and its hash; a line that could not be read is refused."""
    from_json(content)
    text = json.dumps({**content, "before": before}, allow_nan=False)[:-1]
    digest = _sha256(text.encode())
    return f'{text}{_HASH}{digest}"}}\n'.encode(), digest


def _signed_data(last: str) -> bytes:
    """Return what a signature of the journal signs: the hash of its last line, and what that is."""
    return f"imu50-session {last}".encode()


def _hash(line: bytes) -> str | None:
    """Return the hash of a line, None if it is not that of its text."""
    digest = _sha256(line[:-_HASH_BYTES])
    return digest if line[-_HASH_BYTES:] == f'{_HASH}{digest}"}}'.encode() else None


def _repair(partial: bytes, before: str) -> tuple[bytes, Entry, str]:
    """Return what follows a partial line: the bytes after it, their entry, and its hash."""
    entry = LineDropped(len(partial), _sha256(partial))
    line, digest = _line(to_json(entry), before)
    return b"\n" + line, entry, digest


def _is_json(line: bytes) -> bool:
    try:
        load_json(line, "")
    except InputError:
        return False
    return True


def _sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
