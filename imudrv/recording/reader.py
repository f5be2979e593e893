"""Recordings: what the service saw and made of it, in an MCAP file (https://mcap.dev/spec).

=====================  ==========================================================================
channel                a message
=====================  ==========================================================================
``/imu50/wire``        one read of the port at its host time: ``bytes`` as they came, or
                       ``can-messages`` (see `pack_messages`)
``/imu50/increments``  ``i50n``: datagrams back to back
``/imu50/status``      ``json``: how the service was
``/imu50/events``      ``json``: ``{"text": ...}``, what happened
=====================  ==========================================================================

The attachments ``profile.yaml`` and ``calibration.yaml`` make a recording self-contained; a calibration that
was swapped in later is attached again at its time. The metadata record ``imu50`` says where it all came from.
"""

import json
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final, NamedTuple, TypeAlias

import lz4.frame  # type: ignore[import-untyped]
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
    EVENTS,
    INCREMENTS,
    ORIGIN,
    PROFILE,
    STATUS,
    WIRE,
    unpack_messages,
)
from imudrv.records import Arrival, Records
from imudrv.wire.datagram import DatagramDecoder

MAX_RECORD_BYTES: Final = 64 << 20
"""Longest record that is read, and most that a chunk may unpack to."""


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


_LARGE: Final = frozenset({int(Opcode.MESSAGE), int(Opcode.CHUNK)})


class _Item(NamedTuple):
    """A record of the data section and where it stands."""

    offset: int
    record: _Record


class Recording:
    """A recording, chunked or not, with its end or without; read as a stream, so that any length will do.

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
        """The profile of the unit that was recorded, as its file has it."""
        found = next(self._attachments(PROFILE), None)
        if found is None:
            why = "it was cut before it, there is nothing in it" if self.cut else "it is not one of ours"
            raise InputError(f"{self.path}: expected a recording with its {PROFILE}, got none: {why}")
        return found[1]

    @property
    def profile(self) -> Profile:
        """The profile of the unit that was recorded."""
        return settings_file.parse_text(self.profile_text.encode(), Profile, f"{self.path}: {PROFILE}")

    @property
    def calibration_text(self) -> str | None:
        """The calibration that the recording began with, as its file has it; None without one."""
        found = next(self._attachments(CALIBRATION), None)
        return None if found is None else found[1]

    @property
    def calibration(self) -> Calibration | None:
        """The calibration that the recording began with."""
        text = self.calibration_text
        if text is None:
            return None
        return settings_file.parse_text(text.encode(), Calibration, f"{self.path}: {CALIBRATION}")

    def calibrations(self) -> Iterator[tuple[int, Calibration]]:
        """All calibrations and since when they hold: for reads later than this host time, ns."""
        for t_ns, text in self._attachments(CALIBRATION):
            yield t_ns, settings_file.parse_text(text.encode(), Calibration, f"{self.path}: {CALIBRATION}")

    @property
    def origin(self) -> dict[str, str]:
        """Where it came from: version, unit, port and so on; empty if it was cut before that."""
        for item in self._items(skip_messages=True):
            if isinstance(item.record, Metadata) and item.record.name == ORIGIN:
                return item.record.metadata
        return {}

    def arrivals(self) -> Iterator[Arrival]:
        """What the port brought, read by read."""
        for offset, channel, message in self._messages(WIRE):
            if channel.message_encoding != CAN_MESSAGES:
                yield Arrival(message.log_time, message.data)
                continue
            try:
                messages = unpack_messages(message.data)
            except ValueError as error:
                raise self._corrupt(offset, str(error)) from error
            yield Arrival(message.log_time, messages)

    def increments(self) -> Iterator[Records]:
        """Increments as they were published, ndarrays of INCREMENTS; counters modulo 2^32."""
        for offset, _, message in self._messages(INCREMENTS):
            received = DatagramDecoder().feed(message.data)
            if received.rejects.size or not received.increments.size:
                raise self._corrupt(offset, "expected whole datagrams, got other bytes")
            yield received.increments

    def statuses(self) -> Iterator[tuple[int, dict[str, Any]]]:
        """Host time, ns, and status."""
        yield from self._documents(STATUS)

    def events(self) -> Iterator[tuple[int, str]]:
        """Host time, ns, and what happened."""
        for t_ns, document in self._documents(EVENTS):
            yield t_ns, str(document.get("text", ""))

    def _documents(self, topic: str) -> Iterator[tuple[int, dict[str, Any]]]:
        for offset, _, message in self._messages(topic):
            try:
                document = json.loads(message.data)
            except (ValueError, RecursionError) as error:
                raise self._corrupt(offset, f"expected JSON: {error}") from error
            if not isinstance(document, dict):
                raise self._corrupt(offset, "expected a JSON object")
            yield message.log_time, document

    def _attachments(self, name: str) -> Iterator[tuple[int, str]]:
        for offset, record in self._items(skip_messages=True):
            if isinstance(record, Attachment) and record.name == name:
                try:
                    yield record.log_time, record.data.decode()
                except UnicodeDecodeError as error:
                    raise self._corrupt(offset, "expected text") from error

    def _messages(self, topic: str) -> Iterator[tuple[int, Channel, Message]]:
        channels: dict[int, Channel] = {}
        for offset, record in self._items():
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    raise self._corrupt(offset, f"expected a known channel, got {record.channel_id}")
                if channel.topic == topic:
                    yield offset, channel, record

    def _items(self, skip_messages: bool = False) -> Iterator[_Item]:
        """Records of the data section, those in chunks instead of the chunks, up to its end or the cut."""
        skipped = _LARGE if skip_messages else frozenset[int]()
        try:
            with self.path.open("rb") as file:
                file.seek(len(MCAP0_MAGIC))
                for item in self._items_of(file, skipped):
                    if not isinstance(item.record, Chunk):
                        yield item
                        continue
                    inside = BytesIO(self._unpacked(item.record, item.offset))
                    for offset, record in self._items_of(inside, skipped):
                        if isinstance(record, Chunk):
                            raise self._corrupt(item.offset, "expected no chunk inside of a chunk")
                        # Roughly: an offset inside means something in the unpacked chunk only.
                        yield _Item(item.offset + offset, record)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read on: {error.strerror or error}") from error

    def _items_of(self, file: IO[bytes], skipped: frozenset[int]) -> Iterator[_Item]:
        while True:
            offset = file.tell()
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
            yield _Item(offset, self._parsed(opcode, body, offset))

    def _parsed(self, opcode: int, body: bytes, offset: int) -> _Record:
        try:
            if opcode == Opcode.MESSAGE:
                # By hand: there are thousands a second of them.
                channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(body)
                return Message(channel, log_time, body[_MESSAGE.size :], publish_time, sequence)
            crc = int.from_bytes(body[-4:], "little") if opcode == Opcode.ATTACHMENT else 0
            if crc and crc != zlib.crc32(body[:-4]):
                raise ValueError("its check is wrong")
            return _READ[opcode](ReadDataStream(BytesIO(body)))
        except Exception as error:  # the library raises whatever its parts do
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
        except Exception as error:  # each library has its own
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
