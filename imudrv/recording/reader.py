"""Reader of recordings, also of those that were cut; see `imudrv.recording.format` for their contents."""

import json
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BufferedReader, BytesIO
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, TypeAlias

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Message, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from imudrv.calibration import Calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.profiles.schema import Profile
from imudrv.recording.format import (
    CALIBRATION,
    CAN_MESSAGES,
    CLOCK,
    EVENTS,
    INCREMENTS,
    MAX_TIME_NS,
    ORIGIN,
    PROFILE,
    STATUS,
    WIRE,
    unpack_messages,
)
from imudrv.recording.reads import Gatherer, Reads, Recorded
from imudrv.records import MESSAGE, Arrival, Records, Timebase
from imudrv.wire.datagram import DatagramDecoder

MAX_RECORD_BYTES: Final = 64 << 20
"""Largest record, and largest unpacked chunk, bytes."""

_RECORD: Final = struct.Struct("<BQ")
_MESSAGE: Final = struct.Struct("<HIQQ")
_FOOTER_BYTES: Final = _RECORD.size + 20

_Record: TypeAlias = Schema | Channel | Message | Attachment | Metadata | Chunk
_READ: Final[dict[int, Callable[[ReadDataStream], _Record]]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
    Opcode.CHUNK: Chunk.read,
}
_NONE: Final = frozenset[int]()
_LARGE: Final = frozenset({int(Opcode.MESSAGE), int(Opcode.CHUNK)})
_BUFFER_BYTES: Final = 1 << 18  # thousands of reads, and with all that is made of them within the cache


class RecordAt(NamedTuple):
    """A record of the data section and its offset in the file."""

    offset: int
    record: _Record


class Recording:
    """A recording, chunked or not, of any length: it is read as a stream.

    A recording that was cut, at whatever byte, is read up to the cut.

    Parameters
    ----------
    path : path-like
        The file.

    Attributes
    ----------
    path : Path
    cut : bool
        Whether the end is absent.

    Raises
    ------
    InputError
        The file cannot be read, or is no MCAP file.

    Examples
    --------
    >>> recording = imudrv.Recording("run.mcap")
    >>> recording
    <Recording run.mcap, imu50-rs422, complete>
    >>> np.concatenate(list(recording.increments()))["dtheta_b"].shape
    (30, 3)
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = path = Path(path)
        try:
            with path.open("rb") as file:
                head = file.read(len(MCAP0_MAGIC))
                self.cut = not _has_end(file)
        except OSError as error:
            raise InputError(f"{path}: expected a recording, cannot read it: {error.strerror}") from error
        if not MCAP0_MAGIC.startswith(head):
            raise InputError(f"{path}: expected a recording (MCAP), got another kind of file")

    def __repr__(self) -> str:
        try:
            profile = self.profile.name
        except InputError:
            profile = "no profile"
        return f"<Recording {self.path}, {profile}, {'cut' if self.cut else 'complete'}>"

    @property
    def profile_text(self) -> str:
        """Text of the profile file."""
        for _, text in self._attachments(PROFILE):
            return text
        why = "it was cut before it, there is nothing in it" if self.cut else "it is not from this driver"
        raise InputError(f"{self.path}: expected a recording with its {PROFILE}, got none: {why}")

    @property
    def profile(self) -> Profile:
        """Profile of the unit."""
        return settings_file.parse_text(self.profile_text.encode(), Profile, f"{self.path}: {PROFILE}")

    @property
    def calibration_text(self) -> str | None:
        """Text of the first calibration file; None without one."""
        return next((text for _, text in self._attachments(CALIBRATION)), None)

    @property
    def calibration(self) -> Calibration | None:
        """First calibration; None without one."""
        return next((calibration for _, calibration in self.calibrations()), None)

    def calibrations(self) -> Iterator[tuple[int, Calibration]]:
        """Yield each calibration with the host time, ns, after which it holds."""
        for t_ns, text in self._attachments(CALIBRATION):
            yield t_ns, settings_file.parse_text(text.encode(), Calibration, f"{self.path}: {CALIBRATION}")

    @property
    def origin(self) -> dict[str, str]:
        """Version of the driver, unit, port and so on; empty if the recording was cut before."""
        for item in self.records(skip_messages=True):
            if isinstance(item.record, Metadata) and item.record.name == ORIGIN:
                return item.record.metadata
        return {}

    def reads(self) -> Iterator[Reads]:
        """Yield the reads of the port, many at once.

        Yields
        ------
        Reads
            Whole reads with one timebase.

        Raises
        ------
        InputError
            The file is damaged or cannot be read; what is before the damage comes first.
        """
        timebase, gatherer = Timebase(), Gatherer()
        channels: dict[int, Channel] = {}
        for offset, item in self._items(gatherer=gatherer):
            if isinstance(item, Channel):
                channels[item.id] = item
                gatherer.add(item)
            elif isinstance(item, Recorded):
                yield from self._reads(offset, item, timebase)
            elif isinstance(item, Message) and channels[item.channel_id].topic == CLOCK:
                timebase = self._timebase(offset, item.data)
            elif isinstance(item, Message) and channels[item.channel_id].topic == WIRE:
                encoding = channels[item.channel_id].message_encoding
                yield from self._reads(offset, self._one(offset, item, encoding), timebase)

    def arrivals(self) -> Iterator[Arrival]:
        """Yield the reads of the port."""
        for reads in self.reads():
            data: bytes | Records = reads.data if reads.data.dtype == MESSAGE else reads.data.tobytes()
            begin = 0
            for end, t_ns in zip(reads.ends.tolist(), reads.times.tolist(), strict=True):
                yield Arrival(t_ns, data[begin:end], reads.timebase)
                begin = end

    def increments(self) -> Iterator[Records]:
        """Yield the published increments, ndarrays of INCREMENTS; counters modulo 2^32."""
        for offset, _, message in self._messages(INCREMENTS):
            received = DatagramDecoder().feed(message.data)
            if received.rejects.size or not received.increments.size:
                raise self._corrupt(offset, "expected whole datagrams, got other bytes")
            yield received.increments

    def statuses(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Yield host time, ns, and status of the service."""
        yield from self._documents(STATUS)

    def events(self) -> Iterator[tuple[int, str]]:
        """Yield host time, ns, and text of each event."""
        for t_ns, document in self._documents(EVENTS):
            yield t_ns, str(document.get("text", ""))

    def _one(self, offset: int, message: Message, encoding: str) -> Recorded:
        """Return the read of one message."""
        if message.log_time > MAX_TIME_NS:
            raise self._corrupt(offset, f"expected a time up to {MAX_TIME_NS} ns, got {message.log_time}")
        data = np.frombuffer(message.data, np.uint8).copy()  # the kernels are compiled for such arrays
        return Recorded(
            encoding, data, np.array([data.size]), np.array([message.log_time]), np.zeros(1, np.int64)
        )

    def _reads(self, offset: int, recorded: Recorded, timebase: Timebase) -> Iterator[Reads]:
        if recorded.encoding != CAN_MESSAGES:
            yield Reads(recorded.data, recorded.ends, recorded.times, timebase)
            return
        messages, ends, fault = unpack_messages(recorded.data, recorded.ends)
        yield Reads(messages, ends, recorded.times[: len(ends)], timebase)
        if fault:
            raise self._corrupt(offset + int(recorded.places[len(ends)]), fault)

    def _documents(self, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
        for offset, _, message in self._messages(topic):
            yield message.log_time, self._document(offset, message.data)

    def _document(self, offset: int, data: bytes) -> dict[str, Any]:
        try:
            document = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise self._corrupt(offset, f"expected JSON: {error}") from error
        if not isinstance(document, dict):
            raise self._corrupt(offset, "expected a JSON object")
        return document

    def _timebase(self, offset: int, data: bytes) -> Timebase:
        document = self._document(offset, data)
        values = map(document.get, Timebase._fields)
        times = [value for value in values if type(value) is int and abs(value) <= MAX_TIME_NS]
        if len(times) != len(Timebase._fields):
            raise self._corrupt(
                offset, f"expected {', '.join(Timebase._fields)}, each up to {MAX_TIME_NS} ns"
            )
        return Timebase(*times)

    def _attachments(self, name: str) -> Iterator[tuple[int, str]]:
        for offset, record in self.records(skip_messages=True):
            if isinstance(record, Attachment) and record.name == name:
                try:
                    yield record.log_time, record.data.decode()
                except UnicodeDecodeError as error:
                    raise self._corrupt(offset, "expected text") from error

    def _messages(self, *topics: str) -> Iterator[tuple[int, Channel, Message]]:
        channels: dict[int, Channel] = {}
        for offset, record in self.records():
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                if channel.topic in topics:
                    yield offset, channel, record

    def records(self, skip_messages: bool = False) -> Iterator[RecordAt]:
        """Yield the MCAP records up to the end or the cut; chunks are unpacked.

        Parameters
        ----------
        skip_messages : bool
            Leave messages and chunks out, which is faster.

        Yields
        ------
        RecordAt

        Raises
        ------
        InputError
            The file is damaged or cannot be read.
        """
        for offset, item in self._items(_LARGE if skip_messages else _NONE):
            if not isinstance(item, Recorded):
                yield RecordAt(offset, item)

    def _items(
        self, skipped: frozenset[int] = _NONE, gatherer: Gatherer | None = None
    ) -> Iterator[tuple[int, _Record | Recorded]]:
        """Yield the records outside and inside of chunks, and the reads that a gatherer takes."""
        channels: set[int] = set()
        try:
            with BufferedReader(self.path.open("rb", 0), _BUFFER_BYTES) as file:
                file.seek(len(MCAP0_MAGIC))
                for offset, item in self._items_of(file, skipped, channels, gatherer):
                    if not isinstance(item, Chunk):
                        yield offset, item
                        continue
                    chunk = BufferedReader(BytesIO(self._unpacked(item, offset)), _BUFFER_BYTES)
                    for inside, record in self._items_of(chunk, skipped, channels, gatherer):
                        if isinstance(record, Chunk):
                            raise self._corrupt(offset, "expected no chunk inside of a chunk")
                        # Approximate: an offset inside refers to the unpacked chunk.
                        yield offset + inside, record
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read on: {error.strerror or error}") from error

    def _items_of(
        self,
        file: "BufferedReader[Any]",
        skipped: frozenset[int],
        channels: set[int],
        gatherer: Gatherer | None,
    ) -> Iterator[tuple[int, _Record | Recorded]]:
        while True:
            offset = file.tell()
            if gatherer is not None:
                size, recorded = gatherer.gather(file.peek())
                if size:
                    file.seek(size, 1)
                    if recorded.ends.size:
                        yield offset, recorded
                    continue
            head = file.read(_RECORD.size)
            if len(head) < _RECORD.size:
                return
            opcode, length = _RECORD.unpack(head)
            if opcode in (Opcode.DATA_END, Opcode.FOOTER):
                return
            if not opcode or length > MAX_RECORD_BYTES:
                raise self._corrupt(offset, f"expected a record, got kind {opcode} of {length} bytes")
            if opcode in skipped or (opcode != Opcode.MESSAGE and opcode not in _READ):
                file.seek(length, 1)
                continue
            body = file.read(length)
            if len(body) < length:
                return
            record = self._parsed(opcode, body, offset)
            if isinstance(record, Channel):
                channels.add(record.id)
            elif isinstance(record, Message) and record.channel_id not in channels:
                raise self._corrupt(offset, f"expected a known channel, got {record.channel_id}")
            yield offset, record

    def _parsed(self, opcode: int, body: bytes, offset: int) -> _Record:
        try:
            if opcode == Opcode.MESSAGE:
                # Not by the library: there are thousands a second.
                channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(body)
                return Message(channel, log_time, body[_MESSAGE.size :], publish_time, sequence)
            crc = int.from_bytes(body[-4:], "little") if opcode == Opcode.ATTACHMENT else 0
            if crc and crc != zlib.crc32(body[:-4]):
                raise ValueError("its check is wrong")
            return _READ[opcode](ReadDataStream(BytesIO(body)))
        except Exception as error:  # the library raises many kinds
            kind = Opcode(opcode).name.lower()
            raise self._corrupt(offset, f"expected a whole {kind} record: {error}") from error

    def _unpacked(self, chunk: Chunk, offset: int) -> bytes:
        if chunk.uncompressed_size > MAX_RECORD_BYTES:
            raise self._corrupt(offset, f"expected a chunk of at most {MAX_RECORD_BYTES} bytes")
        limit = chunk.uncompressed_size + 1
        try:
            if chunk.compression == "zstd":
                data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(limit)
            elif chunk.compression == "lz4":
                data = lz4.frame.open(BytesIO(chunk.data)).read(limit)
            elif chunk.compression == "":
                data = chunk.data
            else:
                raise ValueError(f"unknown compression {chunk.compression!r}")
        except Exception as error:  # each library has its own kinds
            raise self._corrupt(offset, f"expected a chunk that unpacks: {error}") from error
        wrong = chunk.uncompressed_crc and chunk.uncompressed_crc != zlib.crc32(data)
        if len(data) != chunk.uncompressed_size or wrong:
            raise self._corrupt(offset, "expected a chunk whose length and check are right")
        return data

    def _corrupt(self, offset: int, what: str) -> InputError:
        return InputError(f"{self.path}: at byte {offset}: {what}; the file is damaged")


def _has_end(file: IO[bytes]) -> bool:
    size = file.seek(0, 2)
    tail = _FOOTER_BYTES + len(MCAP0_MAGIC)
    if size < tail + len(MCAP0_MAGIC):
        return False
    file.seek(size - tail)
    end = file.read(tail)
    return end.startswith(_RECORD.pack(Opcode.FOOTER, 20)) and end.endswith(MCAP0_MAGIC)
