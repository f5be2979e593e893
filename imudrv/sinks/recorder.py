"""Recorder of all input and output into an MCAP file that stays readable after a kill.

The loop only appends to queues; a thread writes them every 50 ms, wire bytes first. The file is neither
chunked nor compressed, as a chunk would delay data; `imudrv.recording.pack.pack` does both later.
"""

import json
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from hashlib import sha256
from importlib.metadata import version
from io import BytesIO
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Final, Generic, TypeVar

import numpy as np
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding

from imudrv.files.spool import AppendThread, Piece
from imudrv.hostclock import now_ns
from imudrv.recording import format
from imudrv.recording.format import pack_messages
from imudrv.recording.writer import McapWriter
from imudrv.records import Reads, Source, Timebase
from imudrv.sinks.base import Batch, SinkState
from imudrv.sinks.history import Moment
from imudrv.wire.datagram import SIZE
from imudrv.wire.layout import Layout

QUEUE_BYTES: Final = 32 << 20
"""Maximum size of each queue: 15 s of single reads at 20 kHz, minutes at 1 kHz."""
_OVERHEAD: Final = 64
_PIECE: Final = 256
"""Most blocks of reads, and batches, written at a time."""
_PIECE_BYTES: Final = 1 << 20
"""About as many bytes at a time, so that no message is larger than readers take (4 MiB)."""

T = TypeVar("T")


class Recorder:
    """Writer of one recording.

    Only the constructor blocks or raises: what the disk cannot take is kept in bounded queues whose oldest
    entries are dropped, and `state` reports it.

    Parameters
    ----------
    path : Path
        Name of a new file.
    layout : Layout
        Layout of the unit.
    profile : bytes
        Contents of the profile file.
    calibration : bytes or None
        Contents of the calibration file.
    source : Source
        Kind of data source.
    port : str
        URL of the port.
    unit : str
        Serial number of the unit; empty if not known.
    sync_s : float, optional
        See `imudrv.files.spool.AppendThread`.

    Raises
    ------
    InputError
        The file exists, the folder cannot be written to, or the disk is full.
    """

    def __init__(
        self,
        path: Path,
        *,
        layout: Layout,
        profile: bytes,
        calibration: bytes | None,
        source: Source,
        port: str,
        unit: str,
        sync_s: float | None = None,
    ) -> None:
        self._path = path
        self._can = layout.can
        self._wire: _Queue[Reads] = _Queue(lambda reads: len(reads.ends), attrgetter("size"))
        self._datagrams: _Queue[bytes] = _Queue(lambda datagrams: len(datagrams) // SIZE, len)
        self._notes: deque[tuple[int, int, Callable[[], Mapping[str, object]]]] = deque(maxlen=1000)
        self._calibrations: deque[tuple[int, bytes]] = deque(maxlen=10)
        self._put = 0
        self._reported = 0
        self._timebase = Timebase()  # of the read written last
        self._staging = _Staging()
        self._writer = McapWriter(self._staging)
        self._begin(profile, calibration, source, port, unit)
        self._spool = AppendThread(path, self._staging.take(), self._next_piece, self._last_piece, sync_s)

    @property
    def displaced(self) -> str:
        """What has happened to the file, such as ``deleted``; empty while its name leads to it."""
        return self._spool.displaced

    def arrived(self, reads: Reads) -> None:
        """Record reads of the port; call it before their samples are published.

        Parameters
        ----------
        reads : Reads
            A block of reads, at most some 100 kB; it must not change any more.
        """
        if reads.size:
            self._wire.put(reads)

    def publish(self, batch: Batch) -> None:
        """Record a batch."""
        self._put += len(batch.datagrams) // SIZE
        self._datagrams.put(batch.datagrams)

    def catch_up(self, moments: Sequence[Moment]) -> None:
        """Record reads and samples from before the request; call it before any other method.

        Parameters
        ----------
        moments : sequence of Moment
            Reads from a `History`.
        """
        datagrams = [moment.datagrams for moment in moments if moment.datagrams]
        self._put += sum(map(len, datagrams)) // SIZE
        self._wire.put(*(moment.arrival.block for moment in moments))
        self._datagrams.put(*datagrams)

    def status(self, document: Callable[[], Mapping[str, object]]) -> None:
        """Record the state of the service.

        Parameters
        ----------
        document : callable
            Returns values that JSON can represent; called in the writing thread.
        """
        self._notes.append((now_ns(), _STATUS, document))

    def event(self, t_ns: int, text: str) -> None:
        """Record an event.

        Parameters
        ----------
        t_ns : int
            Host time.
        text : str
            What happened.
        """
        self._notes.append((t_ns, _EVENTS, lambda: {"text": text}))

    def calibration(self, t_ns: int, calibration: bytes) -> None:
        """Record a new calibration.

        Parameters
        ----------
        t_ns : int
            Host time; the calibration applies to later reads.
        calibration : bytes
            Contents of its file.
        """
        self._calibrations.append((t_ns, calibration))

    def poll(self) -> None:
        """Record an event for reads that were lost since the last call."""
        lost = self._wire.dropped
        if lost > self._reported and not self._spool.trouble:
            self.event(
                now_ns(), f"recording: {lost - self._reported} reads of the port are missing before this"
            )
            self._reported = lost

    @property
    def state(self) -> SinkState:
        """Current state, in samples; the text gives the number of lost reads."""
        trouble = self._spool.trouble
        lost = self._wire.dropped
        words = trouble or "ok"
        if lost:
            words += f"; {lost} reads of the port lost"
        dropped = self._datagrams.dropped
        queued = self._put - self._spool.sent - dropped
        return SinkState(str(self._path), words, not trouble, self._spool.sent, dropped, queued)

    @property
    def finished(self) -> Path | None:
        """The file, once it is closed with its end; None if not, or if its name does not lead to it."""
        return self._path if self._spool.is_finished and not self.displaced else None

    def close(self) -> None:
        """Write what waits and the end of the file, for some seconds at most, and close the file."""
        self.poll()
        self._spool.close()

    def _begin(self, profile: bytes, calibration: bytes | None, source: Source, port: str, unit: str) -> None:
        """Write the start of the file: channels, origin, profile, calibration."""
        writer = self._writer
        encodings = {
            _WIRE: format.CAN_MESSAGES if self._can else format.BYTES,
            _INCREMENTS: format.DATAGRAMS,
        }
        for number, (topic, name, schema) in _CHANNELS.items():
            encoding = SchemaEncoding.JSONSchema if schema else ""
            writer.define(Schema(id=number, name=name, encoding=encoding, data=schema))
            encoding = encodings.get(number, MessageEncoding.JSON)
            writer.define(
                Channel(id=number, topic=topic, message_encoding=encoding, metadata={}, schema_id=number)
            )
        origin = {
            "version": version("imu50"),
            "unit": unit,
            "port": port,
            "source": source.name.lower(),
            "calibration_sha256": sha256(calibration).hexdigest() if calibration is not None else "",
        }
        writer.add_metadata(Metadata(format.ORIGIN, origin))
        t_ns = now_ns()
        self._attach(t_ns, format.PROFILE, profile)
        if calibration is not None:
            self._attach(t_ns, format.CALIBRATION, calibration)

    def _attach(self, t_ns: int, name: str, data: bytes) -> None:
        self._writer.attach(
            Attachment(create_time=t_ns, log_time=t_ns, name=name, media_type="application/yaml", data=data)
        )

    def _next_piece(self) -> Piece:
        with suppress(IndexError):
            while True:
                t_ns, calibration = self._calibrations.popleft()
                self._attach(t_ns, format.CALIBRATION, calibration)
        for _, blocks in groupby(self._wire.take(), attrgetter("timebase")):
            self._write(_joined(list(blocks)))
        datagrams = b"".join(self._datagrams.take())
        if datagrams:
            self._writer.message(_INCREMENTS, now_ns(), datagrams)
        with suppress(IndexError):
            while True:
                t_ns, channel, document = self._notes.popleft()
                self._writer.message(channel, t_ns, json.dumps(document(), default=str).encode())
        more = self._wire.left or self._datagrams.left
        return Piece(self._staging.take(), len(datagrams) // SIZE, more)

    def _write(self, reads: Reads) -> None:
        if reads.timebase != self._timebase:
            self._timebase = reads.timebase
            document = json.dumps(self._timebase._asdict()).encode()
            self._writer.message(_CLOCK, int(reads.times[0]), document)
        data, ends = pack_messages(reads.data, reads.ends) if self._can else (reads.data, reads.ends)
        self._writer.messages(_WIRE, reads.times, data, ends)

    def _last_piece(self) -> bytes:
        self._writer.finish()
        return self._staging.take()


_WIRE, _INCREMENTS, _STATUS, _EVENTS, _CLOCK = range(1, 6)
_STATUS_SCHEMA: Final = json.dumps({"type": "object"}).encode()
_TIMEBASE_SCHEMA: Final = json.dumps(
    {"type": "object", "properties": {name: {"type": "integer"} for name in Timebase._fields}}
).encode()
_EVENT_SCHEMA: Final = json.dumps({"type": "object", "properties": {"text": {"type": "string"}}}).encode()
_CHANNELS: Final = {
    _WIRE: (format.WIRE, "imu50.Wire", b""),
    _INCREMENTS: (format.INCREMENTS, "imu50.Datagrams", b""),
    _STATUS: (format.STATUS, "imu50.Status", _STATUS_SCHEMA),
    _EVENTS: (format.EVENTS, "imu50.Event", _EVENT_SCHEMA),
    _CLOCK: (format.CLOCK, "imu50.Timebase", _TIMEBASE_SCHEMA),
}
"""Topic, name of the schema and schema of each channel; empty: only documentation describes the bytes."""


def _joined(blocks: list[Reads]) -> Reads:
    """Return blocks with the same timebase as one."""
    begins = np.cumsum([0, *(len(block.data) for block in blocks[:-1])])
    return Reads(
        np.concatenate([block.data for block in blocks]),
        np.concatenate([begin + block.ends for begin, block in zip(begins, blocks, strict=True)]),
        np.concatenate([block.times for block in blocks]),
        blocks[0].timebase,
    )


class _Queue(Generic[T]):
    """Queue from the loop to the thread, bounded in bytes; each side has its own counts, without a lock.

    Parameters
    ----------
    count, size : callable
        Return the number of reads or samples of an item, and its bytes.
    """

    def __init__(self, count: Callable[[T], int], size: Callable[[T], int]) -> None:
        self.dropped = 0  # reads or samples
        self._count, self._size = count, size
        self._items: deque[T] = deque()
        self._put = self._taken = self._lost = 0  # bytes
        self.left = False  # items, perhaps, by the bounds of the last `take`

    def put(self, *items: T) -> None:
        """Append items (in the loop); drop the oldest above the limit."""
        self._items.extend(items)
        self._put += sum(map(self._room, items))
        with suppress(IndexError):
            while self._put - self._taken - self._lost > QUEUE_BYTES:
                item = self._items.popleft()
                self._lost += self._room(item)
                self.dropped += self._count(item)

    def take(self) -> list[T]:
        """Remove up to `_PIECE` items, and about `_PIECE_BYTES`, (in the thread) and return them."""
        items: list[T] = []
        size = 0
        with suppress(IndexError):
            while len(items) < _PIECE and size < _PIECE_BYTES:
                items.append(self._items.popleft())
                size += self._room(items[-1])
        self.left = len(items) == _PIECE or size >= _PIECE_BYTES
        self._taken += size
        return items

    def _room(self, item: T) -> int:
        return self._size(item) + _OVERHEAD * self._count(item)


class _Staging(BytesIO):
    """Buffer between the writer and the file."""

    def take(self) -> bytes:
        data = self.getvalue()
        self.seek(0)
        self.truncate()
        return data
