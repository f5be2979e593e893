"""CAN logs of other programs, most of them by python-can, as lines of a candump log.

The log's own times and channel numbers stay as they are; a format without channels gets one. An error frame
has the identifier that candump gives it, so that it is counted as one.
"""

import logging
import sqlite3
import struct
import zlib
from collections.abc import Iterator
from importlib.util import find_spec
from typing import BinaryIO, Final, TextIO, cast

import can

from imudrv.capture_files.source import Source
from imudrv.errors import InputError

# What is wrong in a log is in our messages and counts; without a handler python-can prints it, too.
logging.getLogger("can").addHandler(logging.NullHandler())

_ERROR_FLAG, _ID_MASK = 1 << 29, (1 << 29) - 1
_NO_CHANNEL: Final = "can"
_TRC_VERSIONS: Final = ("1.0", "1.1", "1.3", "2.0", "2.1")
_LARGEST_VALUE: Final = 1 << 16


def read_asc(source: Source) -> Iterator[bytes]:
    """Yield the lines of an ASC log; its times count from the beginning of the log."""
    reader = can.ASCReader(_text(source))
    for message in reader:
        if reader.timestamps_format == "relative":
            message.timestamp = 0.0  # since the event before; python-can leaves out some events
        yield _line(message, first_channel=1)


def read_blf(source: Source) -> Iterator[bytes]:
    """Yield the lines of a BLF log."""
    content = _BlfContent(source)
    for message in can.BLFReader(cast(BinaryIO, content)):
        content.searched = 0
        yield _line(message, first_channel=1)


def read_trc(source: Source) -> Iterator[bytes]:
    """Yield the lines of a TRC log."""
    for message in can.TRCReader(cast(TextIO, _with_known_version(source))):
        yield _line(message)


def read_csv(source: Source) -> Iterator[bytes]:
    """Yield the lines of a CSV log of python-can."""
    for message in can.CSVReader(_text(source)):
        yield _line(message)


def read_database(source: Source) -> Iterator[bytes]:
    """Yield the lines of an SQLite log of python-can."""
    connection = sqlite3.connect(f"{source.path.absolute().as_uri()}?mode=ro", uri=True)
    try:
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _LARGEST_VALUE)
        tables = connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        if ("messages",) not in tables:
            raise ValueError("expected the table 'messages' of python-can, got none")
        columns = "ts, arbitration_id, extended, remote, error, data"
        for row in connection.execute(f"SELECT {columns} FROM messages"):
            timestamp, identifier, is_extended, is_remote, is_error, data = row
            yield _line(
                can.Message(
                    timestamp,
                    identifier,
                    is_extended_id=bool(is_extended),
                    is_remote_frame=bool(is_remote),
                    is_error_frame=bool(is_error),
                    is_fd=len(data or b"") > 8,
                    data=data,
                )
            )
    finally:
        connection.close()


def read_mdf(source: Source) -> Iterator[bytes]:
    """Yield the lines of an MDF 4 log; needs the package asammdf."""
    if find_spec("asammdf") is None:
        raise InputError(
            f"{source.path}: an MDF 4 log is read with the package asammdf, which is not installed; "
            "pip install 'imu50[mf4]', or convert the log to .blf or .asc"
        )
    with can.MF4Reader(source.path) as reader:
        for message in reader:
            yield _line(message)


def _text(source: Source) -> TextIO:
    # python-can only iterates over a text file and closes it, and both can be done with a generator
    return cast(TextIO, (line.decode("latin-1") for line in source))


def _with_known_version(source: Source) -> Iterator[str]:
    for line in _text(source):
        name, _, version = line.strip().partition("=")
        if name == ";$FILEVERSION" and version not in _TRC_VERSIONS:
            # python-can would read another version as 1.0
            raise ValueError(f"expected version {', '.join(_TRC_VERSIONS)}, got {version[:20]!r}")
        yield line


def _line(message: can.Message, first_channel: int = 0) -> bytes:
    """Return a message as a line of a candump log; the decoder of these judges what is in it."""
    if message.channel is None:
        channel = _NO_CHANNEL
    elif isinstance(message.channel, int):
        channel = str(message.channel + first_channel)
    else:
        channel = "_".join(str(message.channel).split()) or _NO_CHANNEL
    if message.is_error_frame:
        identifier = f"{_ERROR_FLAG | message.arbitration_id & _ID_MASK:08X}"
    else:
        identifier = f"{message.arbitration_id:0{8 if message.is_extended_id else 3}X}"
    data = "R" if message.is_remote_frame else ("#1" if message.is_fd else "") + message.data.hex()
    return f"({message.timestamp:.6f}) {channel} {identifier}#{data}\n".encode()


class _BlfContent:
    """A BLF log with its containers unpacked, for python-can to read.

    python-can unpacks a container to whatever size it has, keeps what holds no message, and does not notice
    that the log is truncated; here these are bounded, and an error.
    """

    _HEADER: Final = struct.Struct("<4sL")
    _OBJECT: Final = struct.Struct("<4sHHLL")
    _CONTAINER: Final = struct.Struct("<H6xL4x")
    _IS_CONTAINER, _IS_PACKED, _IS_NOT_PACKED = 10, 2, 0
    _LARGEST_HEADER: Final = 1 << 12
    _LARGEST_OBJECT: Final = 1 << 24
    """Usual containers unpack to 2^17 bytes."""
    _LONGEST_SEARCH: Final = 1 << 26

    def __init__(self, source: Source) -> None:
        self.searched = 0
        """Bytes read since the last message; the reader sets it to 0 at each."""
        self._source = source
        self._offset = 0
        start = self._take(self._HEADER.size)
        _, size = self._HEADER.unpack(start)
        if not self._HEADER.size <= size <= self._LARGEST_HEADER:
            raise ValueError(f"byte 4: expected the size of the header, got {size}")
        self._ready = start + self._take(size - len(start))

    def read(self, size: int) -> bytes:
        """Return so many bytes; fewer at the end only."""
        while len(self._ready) < size and (more := self._next_object()):
            self._ready += more
        size = max(0, size)
        data, self._ready = self._ready[:size], self._ready[size:]
        return data

    def close(self) -> None:
        """Do nothing: the source is closed by who opened it."""

    def _next_object(self) -> bytes:
        """Return the next object of the log; a packed container as one that is not."""
        begin = self._offset
        if self.searched > self._LONGEST_SEARCH:
            raise ValueError(f"byte {begin}: no CAN message in the {self.searched} bytes before")
        head = self._source.read(self._OBJECT.size)
        if not head:
            return b""
        self._offset += len(head)
        if len(head) < self._OBJECT.size:
            raise ValueError(f"byte {begin}: the log is truncated")
        signature, header_size, version, size, kind = self._OBJECT.unpack(head)
        if signature != b"LOBJ" or not self._OBJECT.size <= size <= self._LARGEST_OBJECT:
            raise ValueError(f"byte {begin}: expected an object, got {signature!r} of {size} bytes")
        body = self._take(size - self._OBJECT.size)
        self._offset += len(self._source.read(size % 4))
        if kind == self._IS_CONTAINER:
            method, _ = self._CONTAINER.unpack_from(body)
            content = body[self._CONTAINER.size :]
            if method == self._IS_PACKED:
                unpacker = zlib.decompressobj()
                content = unpacker.decompress(content, self._LARGEST_OBJECT)
                if not unpacker.eof:
                    raise ValueError(f"byte {begin}: a container is damaged, or too large")
                method = self._IS_NOT_PACKED
            body = self._CONTAINER.pack(method, len(content)) + content
        self.searched += len(body)
        size = self._OBJECT.size + len(body)
        return self._OBJECT.pack(signature, header_size, version, size, kind) + body + bytes(size % 4)

    def _take(self, size: int) -> bytes:
        data = self._source.read(size)
        if len(data) < size:
            raise ValueError(
                f"byte {self._offset}: the log is truncated: expected {size} bytes, got {len(data)}"
            )
        self._offset += size
        return data
