"""Compress a recording, index it, and add its samples as plotting programs read them."""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from numpy.typing import NDArray

from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.imu.sequence import SequenceTracker
from imudrv.recording import samples_channel
from imudrv.recording.format import (
    BYTES,
    CAN_MESSAGES,
    CLOCK,
    INCREMENTS,
    MAX_TIME_NS,
    WIRE,
    unpack_messages,
)
from imudrv.recording.reader import Recording
from imudrv.recording.samples_channel import SampleEncoder
from imudrv.recording.writer import ChunkedWriter
from imudrv.records import MAX_TEMPERATURES, Records
from imudrv.units import NS_PER_S
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.layout import NARROW_BITS, Layout, SequenceKind

_ID: Final = 0xFFFF
"""Number of the channel of samples and of its schema; the recorder numbers its own from 1."""
_MOST_PENDING: Final = 1 << 20
"""Most wire bytes that wait for the increments made of them."""
_LATE_NS: Final = NS_PER_S
"""Longest time from a sample to the read after which it is written."""
_PERIOD: Final = 1 << 32
"""Published counters are modulo this."""
_KEPT: Final = 1 << 16
"""Samples whose temperatures are kept until their increments come."""


def pack(source: Path, target: Path) -> None:
    """Write a recording again, compressed, with an index and with the channel ``/imu50/samples``.

    Parameters
    ----------
    source : Path
        The recording.
    target : Path
        Its new file, which may be the same one; it appears complete or not at all.

    Raises
    ------
    InputError
        The recording cannot be read or is damaged, or the target cannot be written.
    """
    recording = Recording(source)
    with atomic_write(target) as file:
        _Packer(recording, ChunkedWriter(file)).run()


class _Packer:
    def __init__(self, recording: Recording, writer: ChunkedWriter) -> None:
        self._recording, self._writer = recording, writer
        layout = recording.profile.layout()
        self._encoder = SampleEncoder(layout.temperature_names)
        self._temperatures = _Temperatures(layout)
        self._defined: dict[tuple[type, int], Schema | Channel] = {}
        self._clock = _ArrivalClock()

    def run(self) -> None:
        writer = self._writer
        schema = self._encoder.definition
        writer.define(Schema(id=_ID, name=samples_channel.NAME, encoding=SchemaEncoding.ROS2, data=schema))
        writer.define(
            Channel(
                id=_ID,
                topic=samples_channel.TOPIC,
                message_encoding=MessageEncoding.CDR,
                metadata={},
                schema_id=_ID,
            )
        )
        for offset, record in self._recording.records():
            if isinstance(record, Schema | Channel):
                self._define(record)
            elif isinstance(record, Attachment):
                writer.attach(record)
            elif isinstance(record, Metadata):
                writer.add_metadata(record)
            elif isinstance(record, Message):
                self._add(offset, record)
        writer.finish()

    def _define(self, record: Schema | Channel) -> None:
        """Write a schema or a channel the first time, but not those of the samples, which are made anew."""
        key = type(record), record.id
        if key in self._defined:
            return
        self._defined[key] = record
        if record.id == _ID:
            if isinstance(record, Channel) and record.topic != samples_channel.TOPIC:
                raise InputError(f"{self._recording.path}: expected channels below {_ID}, got {record.topic}")
        elif isinstance(record, Schema) or (Schema, record.schema_id) in self._defined:
            self._writer.define(record)
        else:
            self._writer.define(replace(record, schema_id=0))

    def _add(self, offset: int, message: Message) -> None:
        channel = self._defined[Channel, message.channel_id]
        if channel.id == _ID or not isinstance(channel, Channel):
            return
        self._writer.message(channel.id, message.log_time, message.data)
        if channel.topic == CLOCK:
            timebase = self._recording.timebase(offset, message.data)
            self._clock.step(message.log_time, timebase.offset_ns)
        elif channel.topic == WIRE:
            self._temperatures.add(message, channel.message_encoding)
        elif channel.topic == INCREMENTS:
            increments = self._recording.increments_of(offset, message.data)
            rows = self._encoder.encode(increments, self._temperatures.of(increments["counter"]))
            t_ns = self._clock.times_of(increments)
            ends = rows.shape[1] * np.arange(1, len(rows) + 1)
            self._writer.messages(_ID, np.clip(t_ns, 0, MAX_TIME_NS), rows.ravel(), ends)


class _ArrivalClock:
    """From the UNIX time of samples to the scale of the arrivals, which does not step."""

    def __init__(self) -> None:
        self._offset_ns = self._before_ns = 0  # UNIX time less time of arrival; before the last step
        self._stepped_ns = 0
        self._last_ns = 0  # of the newest sample

    def step(self, arrival_ns: int, offset_ns: int) -> None:
        """The host's clock was set before the read that arrived then."""
        self._before_ns, self._offset_ns, self._stepped_ns = self._offset_ns, offset_ns, arrival_ns

    def times_of(self, increments: Records) -> NDArray[np.int64]:
        """Return the time of each sample.

        Samples from before a step may be written after it: which they are is known from the time between
        samples.
        """
        times: NDArray[np.int64] = increments["t_ns"] - self._offset_ns
        if self._last_ns - self._stepped_ns < _LATE_NS:
            others = increments["t_ns"] - self._before_ns
            expected = self._last_ns + np.cumsum(increments["interval_ns"])
            times = np.where(np.abs(others - expected) < np.abs(times - expected), others, times)
        self._last_ns = int(times[-1])
        return times


class _Temperatures:
    """Temperatures of samples, by their counter.

    Increments come after the wire data that they are made of, but for a few that the loop has queued while
    those were written: these, and those of a unit without a counter, or with one that begins anew within
    seconds, have the temperatures of the newest wire data.
    """

    def __init__(self, layout: Layout) -> None:
        sequence = layout.sequence
        self._is_counted = sequence.kind is SequenceKind.COUNTER and sequence.bits > NARROW_BITS
        self._step = layout.counter_step
        self._encoding = CAN_MESSAGES if layout.can else BYTES
        self._is_used = bool(layout.temperature_names)
        self._decoder, self._tracker = FrameDecoder(layout), SequenceTracker(layout)
        self._pending: list[Message] = []
        self._size = 0
        self._counters = np.zeros(0, np.int64)
        self._degc = np.zeros((0, MAX_TEMPERATURES))
        self._latest = np.full(MAX_TEMPERATURES, np.nan)

    def add(self, message: Message, encoding: str) -> None:
        """Add a read of the port."""
        if self._is_used and encoding == self._encoding:
            self._pending.append(message)
            self._size += len(message.data)
            if self._size > _MOST_PENDING:
                self._decode()

    def of(self, counters: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the temperatures of published samples, degrees Celsius, shape (n, MAX_TEMPERATURES)."""
        if self._pending:
            self._decode()
        degc = np.tile(self._latest, (len(counters), 1))
        if len(self._counters):
            counters = (
                counters + np.rint((self._counters[-1] - counters) / _PERIOD).astype(np.int64) * _PERIOD
            )
            places = np.minimum(np.searchsorted(self._counters, counters), len(self._counters) - 1)
            is_known = self._counters[places] == counters
            degc[is_known] = self._degc[places[is_known]]
        return degc

    def _decode(self) -> None:
        pending, self._pending, self._size = self._pending, [], 0
        data = np.frombuffer(b"".join(message.data for message in pending), np.uint8).copy()
        ends = np.cumsum([len(message.data) for message in pending])
        if self._encoding == CAN_MESSAGES:
            messages, _, _ = unpack_messages(data, ends)
            frames = self._decoder.feed(messages)
        else:
            times = np.array([min(message.log_time, MAX_TIME_NS) for message in pending])
            frames = self._decoder.feed_reads(data, ends, times)
        pulses = self._tracker.feed(frames)
        if not len(pulses):
            return
        self._latest = pulses["temperature_degc"][-1].copy()
        if self._is_counted:
            counters = np.append(self._counters, pulses["counter"] // self._step)
            backward = np.flatnonzero(np.diff(counters) <= 0)  # a restart
            begin = max(int(backward[-1]) + 1 if len(backward) else 0, len(counters) - _KEPT)
            self._counters = counters[begin:]
            self._degc = np.concatenate([self._degc, pulses["temperature_degc"]])[begin:]
