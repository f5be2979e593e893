"""The recorder: everything that came and went, into an MCAP file that a kill cannot spoil.

The loop only puts things into queues; a thread writes them each 50 ms, wire bytes first. The file is neither
chunked nor compressed, for a chunk would hold data back; `imudrv.recording.pack.pack` does both later.
"""

import json
import struct
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from hashlib import sha256
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Final, Generic, TypeVar

from mcap.opcode import Opcode
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer

from imudrv.files.spool import AppendThread, Piece
from imudrv.hostclock import now_ns
from imudrv.recording import format
from imudrv.recording.format import pack_messages
from imudrv.records import Arrival, Source
from imudrv.sinks.base import Batch, SinkState
from imudrv.sinks.history import Moment
from imudrv.wire.datagram import SIZE
from imudrv.wire.layout import Layout

QUEUE_BYTES: Final = 32 << 20
"""What waits in each queue at the most: 15 s of single reads at 20 kHz, minutes at 1 kHz."""
_OVERHEAD: Final = 64
_PIECE: Final = 256  # reads, and batches, of one piece

# A message, packed here in 0.2 us where the library takes 4, for the loop cannot run meanwhile. So the
# library does not know of messages, and its summary has no statistics.
_MESSAGE: Final = struct.Struct("<BQHIQQ")
_BODY: Final = _MESSAGE.size - 9

T = TypeVar("T")


class Recorder:
    """Writer of one recording.

    Nothing here blocks or raises but the constructor: what the disk cannot take waits in bounded queues whose
    oldest entries are dropped, and the state tells.

    Parameters
    ----------
    path : Path
        There must be no such file yet.
    layout : Layout
        Of the unit.
    profile : bytes
        The profile's file.
    calibration : bytes or None
        The calibration's file.
    source : Source
        What stands behind the port.
    port : str
        Its URL.
    unit : str
        The unit's serial number; empty if it is not known.

    Raises
    ------
    InputError
        There is such a file, the folder cannot be written to, or the disk is full.
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
    ) -> None:
        self._path = path
        self._can = layout.can
        self._wire: _Queue[Arrival] = _Queue(_array_size if layout.can else _bytes_size)
        self._datagrams: _Queue[bytes] = _Queue(len)
        self._notes: deque[tuple[int, int, Mapping[str, object]]] = deque(maxlen=1000)
        self._calibrations: deque[tuple[int, bytes]] = deque(maxlen=10)
        self._put = 0
        self._told = 0
        self._sequences = [0] * 5
        self._staging = _Staging()
        # The library writes to anything with write and tell.
        self._writer = Writer(self._staging, use_chunking=False, use_statistics=False)
        self._begin(profile, calibration, source, port, unit)
        self._spool = AppendThread(path, self._staging.take(), self._next_piece, self._last_piece)

    def arrived(self, arrival: Arrival) -> None:
        """Take in what the port brought; to be called before it is used.

        Parameters
        ----------
        arrival : Arrival
            Not changed any more.
        """
        if len(arrival.data):
            self._wire.put(arrival)

    def publish(self, batch: Batch) -> None:
        """Take in a batch."""
        self._put += len(batch.datagrams) // SIZE
        self._datagrams.put(batch.datagrams)

    def catch_up(self, moments: Sequence[Moment]) -> None:
        """Take in what was already past when the recording was asked for; to be called before the rest.

        Parameters
        ----------
        moments : sequence of Moment
            From a `History`.
        """
        datagrams = [moment.datagrams for moment in moments if moment.datagrams]
        self._put += sum(map(len, datagrams)) // SIZE
        self._wire.extend([moment.arrival for moment in moments])
        self._datagrams.extend(datagrams)

    def status(self, status: Mapping[str, object]) -> None:
        """Take in how the service is.

        Parameters
        ----------
        status : mapping
            Of what JSON knows; not changed any more.
        """
        self._notes.append((now_ns(), _STATUS, status))

    def event(self, t_ns: int, text: str) -> None:
        """Take in what happened.

        Parameters
        ----------
        t_ns : int
            When, host clock.
        text : str
            What, in plain words.
        """
        self._notes.append((t_ns, _EVENTS, {"text": text}))

    def calibration(self, t_ns: int, calibration: bytes) -> None:
        """Take in a calibration that was swapped in.

        Parameters
        ----------
        t_ns : int
            When, host clock: it holds for later reads.
        calibration : bytes
            Its file.
        """
        self._calibrations.append((t_ns, calibration))

    def poll(self) -> None:
        """Tell in the recording what it lacks."""
        lost = self._wire.dropped
        if lost > self._told and not self._spool.trouble:
            self.event(now_ns(), f"recording: {lost - self._told} reads of the port are missing before this")
            self._told = lost

    @property
    def state(self) -> SinkState:
        """How it is now; in samples, while the words tell of reads that are lost."""
        trouble = self._spool.trouble
        lost = self._wire.dropped
        words = trouble or "ok"
        if lost:
            words += f"; {lost} reads of the port lost"
        dropped = self._datagrams.dropped_size // SIZE
        queued = self._put - self._spool.sent - dropped
        return SinkState(str(self._path), words, not trouble, self._spool.sent, dropped, queued)

    def close(self) -> None:
        """Write what waits and the end of the file, for some seconds at the most, and let go."""
        self.poll()
        self._spool.close()

    def _begin(self, profile: bytes, calibration: bytes | None, source: Source, port: str, unit: str) -> None:
        """Stage what every recording begins with."""
        writer, t_ns = self._writer, now_ns()
        writer.start(library=f"imu50 {version('imu50')}")
        status = writer.register_schema("imu50.Status", SchemaEncoding.JSONSchema, _STATUS_SCHEMA)
        event = writer.register_schema("imu50.Event", SchemaEncoding.JSONSchema, _EVENT_SCHEMA)
        wire = format.CAN_MESSAGES if self._can else format.BYTES
        for number, topic, encoding, schema in (
            (_WIRE, format.WIRE, wire, 0),
            (_INCREMENTS, format.INCREMENTS, format.DATAGRAMS, 0),
            (_STATUS, format.STATUS, MessageEncoding.JSON, status),
            (_EVENTS, format.EVENTS, MessageEncoding.JSON, event),
        ):
            registered = writer.register_channel(topic, encoding, schema)
            assert registered == number
        origin = {
            "version": version("imu50"),
            "unit": unit,
            "port": port,
            "source": source.name.lower(),
            "calibration_sha256": sha256(calibration).hexdigest() if calibration is not None else "",
        }
        writer.add_metadata(format.ORIGIN, origin)
        self._attach(t_ns, format.PROFILE, profile)
        if calibration is not None:
            self._attach(t_ns, format.CALIBRATION, calibration)

    def _attach(self, t_ns: int, name: str, data: bytes) -> None:
        self._writer.add_attachment(t_ns, t_ns, name, "application/yaml", data)

    def _next_piece(self) -> Piece:
        with suppress(IndexError):
            while True:
                t_ns, calibration = self._calibrations.popleft()
                self._attach(t_ns, format.CALIBRATION, calibration)
        arrivals = self._wire.take(_PIECE)
        data = [arrival.data for arrival in arrivals]
        pieces = pack_messages(data) if self._can and data else data  # type: ignore[arg-type]
        for arrival, piece in zip(arrivals, pieces, strict=True):
            self._message(_WIRE, arrival.t_ns, piece)  # type: ignore[arg-type]
        batches = self._datagrams.take(_PIECE)
        datagrams = b"".join(batches)
        if datagrams:
            self._message(_INCREMENTS, now_ns(), datagrams)
        with suppress(IndexError):
            while True:
                t_ns, channel, document = self._notes.popleft()
                self._message(channel, t_ns, json.dumps(document, default=str).encode())
        more = max(len(arrivals), len(batches)) == _PIECE
        return Piece(self._staging.take(), len(datagrams) // SIZE, more)

    def _last_piece(self) -> bytes:
        self._writer.finish()  # type: ignore[no-untyped-call]
        return self._staging.take()

    def _message(self, channel: int, t_ns: int, data: bytes) -> None:
        sequence = self._sequences[channel]
        self._sequences[channel] = (sequence + 1) & 0xFFFFFFFF
        head = _MESSAGE.pack(Opcode.MESSAGE, _BODY + len(data), channel, sequence, t_ns, t_ns)
        self._staging.write(head + data)


_WIRE, _INCREMENTS, _STATUS, _EVENTS = range(1, 5)
_STATUS_SCHEMA: Final = json.dumps({"type": "object"}).encode()
_EVENT_SCHEMA: Final = json.dumps({"type": "object", "properties": {"text": {"type": "string"}}}).encode()


class _Queue(Generic[T]):
    """From the loop to the thread, bounded by bytes; each side counts for itself, so nothing is locked."""

    def __init__(self, size: Callable[[T], int]) -> None:
        self.dropped = 0
        self.dropped_size = 0
        self._size = size
        self._items: deque[T] = deque()
        self._put = self._taken = 0

    def put(self, item: T) -> None:
        """Append, by the loop; drop the oldest of what is too much."""
        self._items.append(item)
        self._put += self._size(item) + _OVERHEAD
        self._drop()

    def extend(self, items: Sequence[T]) -> None:
        """Append many at once, by the loop; drop the oldest of what is too much."""
        self._items.extend(items)
        self._put += sum(map(self._size, items)) + _OVERHEAD * len(items)
        self._drop()

    def _drop(self) -> None:
        with suppress(IndexError):
            while self._put - self._taken - self.dropped_size - self.dropped * _OVERHEAD > QUEUE_BYTES:
                self.dropped_size += self._size(self._items.popleft())
                self.dropped += 1

    def take(self, count: int) -> list[T]:
        """Take up to `count` items, by the thread."""
        items: list[T] = []
        with suppress(IndexError):
            while len(items) < count:
                items.append(self._items.popleft())
        self._taken += sum(map(self._size, items)) + _OVERHEAD * len(items)
        return items


def _bytes_size(arrival: Arrival) -> int:
    return len(arrival.data)


def _array_size(arrival: Arrival) -> int:
    return arrival.data.nbytes  # type: ignore[union-attr]


class _Staging(BytesIO):
    """Where the library writes to; it tells places in the file."""

    def __init__(self) -> None:
        super().__init__()
        self._base = 0

    def tell(self) -> int:
        return self._base + super().tell()

    def take(self) -> bytes:
        data = self.getvalue()
        self._base += len(data)
        self.seek(0)
        self.truncate()
        return data
