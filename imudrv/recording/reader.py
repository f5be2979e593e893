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
from imudrv.files.atomic import MAX_BYTES
from imudrv.files.inputs import open_file
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
from imudrv.recording.reads import Gatherer, Recorded
from imudrv.records import MESSAGE, Arrival, Reads, Records, Timebase
from imudrv.wire.datagram import DatagramDecoder
from imudrv.wire.layout import Layout

MAX_RECORD_BYTES: Final = 16 << 20
"""Largest record, and largest unpacked chunk, bytes: a chunk is held packed and unpacked at once."""
MAX_MESSAGE_BYTES: Final = 4 << 20
"""Largest message, bytes: a read of a port, or what was published for it; simulated ones are large."""
MAX_DEFINITION_BYTES: Final = 1 << 20
"""Largest total of the schemas and channels, which are kept, bytes."""

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
_IN_CHUNKS: Final = frozenset({int(Opcode.SCHEMA), int(Opcode.CHANNEL), int(Opcode.MESSAGE)})
_SMALL: Final = _IN_CHUNKS | {int(Opcode.METADATA)}
_NONE: Final = frozenset[int]()
_LARGE: Final = frozenset({int(Opcode.MESSAGE), int(Opcode.CHUNK)})
_BUFFER_BYTES: Final = 1 << 18  # thousands of reads, and with all that is made of them within the cache


_UNPACKER: Final = zstandard.ZstdDecompressor(max_window_size=MAX_RECORD_BYTES)


class RecordAt(NamedTuple):
    """A record of the data section and its offset in the file."""

    offset: int
    record: _Record


class Recording:
    """A recording, chunked or not, of any length: it is read as a stream, with at most 64 MiB in memory.

    A recording that was cut, at whatever byte after its profile, is read up to the cut.

    Parameters
    ----------
    path : path-like
        The file.

    Attributes
    ----------
    path : Path
    cut : bool
        Whether the end is absent.
    profile_text : str
        Text of the profile file.

    Raises
    ------
    InputError
        The file cannot be read, is no MCAP file, or has no profile: it was cut before that, or is not from
        this driver.

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
        with open_file(path) as file:
            head = file.read(len(MCAP0_MAGIC))
            self.cut = not _has_end(file)
        if not MCAP0_MAGIC.startswith(head):
            raise InputError(f"{path}: expected a recording (MCAP), got another kind of file")
        text = next((text for _, text in self._attachments(PROFILE)), None)
        if text is None:
            why = "it was cut before it, there is nothing in it" if self.cut else "it is not from this driver"
            raise InputError(f"{path}: expected a recording with its {PROFILE}, got none: {why}")
        self.profile_text = text

    def __repr__(self) -> str:
        return f"<Recording {self.path}, {self.profile.name}, {'cut' if self.cut else 'complete'}>"

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

    def reads(self, layout: Layout | None = None) -> Iterator[Reads]:
        """Yield the reads of the port, many at once.

        Parameters
        ----------
        layout : Layout, optional
            Layout of the profile that they are decoded with; default: that of the recording.

        Yields
        ------
        Reads
            Whole reads with one timebase.

        Raises
        ------
        InputError
            The layout is for CAN messages and the recording is of a serial line, or the other way round; or
            the file is damaged or cannot be read: what is before the damage comes first.
        """
        layout = layout or self.profile.layout()
        for reads in self._all_reads():
            if (reads.data.dtype == MESSAGE) != layout.can:
                kinds = "CAN messages", "bytes of a serial line"
                expected, came = kinds if layout.can else kinds[::-1]
                raise InputError(
                    f"{self.path}: expected {expected} for {layout.name}, got a recording of {came}; "
                    "use the profile of the unit, which is in the recording"
                )
            yield reads

    def _all_reads(self) -> Iterator[Reads]:
        timebase, gatherer = Timebase(), Gatherer()
        channels: dict[int, Channel] = {}
        for offset, item in self._items(gatherer=gatherer):
            if isinstance(item, Channel):
                channels[item.id] = item
                gatherer.add(item)
            elif isinstance(item, Recorded):
                yield from self._reads(offset, item, timebase)
            elif isinstance(item, Message) and channels[item.channel_id].topic == CLOCK:
                timebase = self.timebase(offset, item.data)
            elif isinstance(item, Message) and channels[item.channel_id].topic == WIRE:
                encoding = channels[item.channel_id].message_encoding
                yield from self._reads(offset, self._one(offset, item, encoding), timebase)

    def arrivals(self, layout: Layout | None = None) -> Iterator[Arrival]:
        """Yield the reads of the port, one by one; see `reads`."""
        for reads in self.reads(layout):
            data: bytes | Records = reads.data if reads.data.dtype == MESSAGE else reads.data.tobytes()
            begin = 0
            for end, t_ns in zip(reads.ends.tolist(), reads.times.tolist(), strict=True):
                yield Arrival(t_ns, data[begin:end], reads.timebase)
                begin = end

    def increments(self) -> Iterator[Records]:
        """Yield the published increments, ndarrays of INCREMENTS; counters modulo 2^32."""
        for offset, _, message in self._messages(INCREMENTS):
            yield self.increments_of(offset, message.data)

    def increments_of(self, offset: int, data: bytes) -> Records:
        """Return the increments of one message, ndarray of INCREMENTS; `offset` is for an error."""
        received = DatagramDecoder().feed(data)
        if received.rejects.size or not received.increments.size:
            raise self._corrupt(offset, "expected whole datagrams, got other bytes")
        return received.increments

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

    def timebase(self, offset: int, data: bytes) -> Timebase:
        """Return the timebase of one message; `offset` is for an error."""
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
                if len(record.data) > MAX_BYTES:
                    raise self._corrupt(offset, f"expected a {name} of at most {MAX_BYTES} bytes")
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
        defined = _Definitions()
        try:
            with BufferedReader(self.path.open("rb", 0), _BUFFER_BYTES) as file:
                file.seek(len(MCAP0_MAGIC))
                for offset, item in self._items_of(file, skipped, defined, gatherer):
                    if not isinstance(item, Chunk):
                        yield offset, item
                        continue
                    chunk = BufferedReader(BytesIO(self._unpacked(item, offset)), _BUFFER_BYTES)
                    yield from self._items_of(chunk, skipped, defined, gatherer, chunk_at=offset)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read on: {error.strerror or error}") from error

    def _items_of(
        self,
        file: "BufferedReader[Any]",
        skipped: frozenset[int],
        defined: "_Definitions",
        gatherer: Gatherer | None,
        chunk_at: int = 0,
    ) -> Iterator[tuple[int, _Record | Recorded]]:
        while True:
            offset = chunk_at + file.tell()  # approximate inside of a chunk, which is unpacked
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
            if not opcode or length > (MAX_MESSAGE_BYTES if opcode in _SMALL else MAX_RECORD_BYTES):
                raise self._corrupt(offset, f"expected a record, got kind {opcode} of {length} bytes")
            if chunk_at and opcode in _READ and opcode not in _IN_CHUNKS:
                raise self._corrupt(offset, f"expected no {Opcode(opcode).name.lower()} inside of a chunk")
            if opcode in skipped or (opcode != Opcode.MESSAGE and opcode not in _READ):
                file.seek(length, 1)
                continue
            body = file.read(length)
            if len(body) < length:
                return
            record = self._parsed(opcode, body, offset)
            if isinstance(record, Schema | Channel):
                if fault := defined.fault(record, length):
                    raise self._corrupt(offset, fault)
            elif isinstance(record, Message) and (Channel, record.channel_id) not in defined.known:
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
            raise self._corrupt(
                offset,
                f"expected a chunk of at most {MAX_RECORD_BYTES} bytes, got one of {chunk.uncompressed_size}",
            )
        limit = chunk.uncompressed_size + 1
        try:
            if chunk.compression == "zstd":
                data = _UNPACKER.stream_reader(chunk.data).read(limit)
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


class _Definitions:
    """The schemas and channels of a recording; a writer may repeat them in each chunk."""

    def __init__(self) -> None:
        self.known: dict[tuple[type, int], Schema | Channel] = {}
        self._bytes = 0

    def fault(self, record: Schema | Channel, length: int) -> str:
        """Add a record of that many bytes; return what is wrong with it, empty if nothing is."""
        before = self.known.setdefault((type(record), record.id), record)
        if before is record:
            self._bytes += length
        if self._bytes > MAX_DEFINITION_BYTES:
            return f"expected schemas and channels of at most {MAX_DEFINITION_BYTES} bytes in all"
        return (
            "" if before == record else f"expected schema or channel {record.id} as before, got another one"
        )


def _has_end(file: IO[bytes]) -> bool:
    size = file.seek(0, 2)
    tail = _FOOTER_BYTES + len(MCAP0_MAGIC)
    if size < tail + len(MCAP0_MAGIC):
        return False
    file.seek(size - tail)
    end = file.read(tail)
    return end.startswith(_RECORD.pack(Opcode.FOOTER, 20)) and end.endswith(MCAP0_MAGIC)
