"""The live loop as one kernel, for ports with a descriptor: no Python between the wake-up and the send.

`serve` repeats this turn:

    call            what for                       if it fails
    poll            wait for the port              EINTR: return SIGNAL
    clock_gettime   arrival; has a clock stepped?  stepped: return CLOCKS, the port still unread
    read            of a line, up to 64 KiB        EAGAIN, EINTR: next turn; 0 bytes, other error: return GONE
    recv            of a CAN bus, until EAGAIN     EINTR: again; other error: return GONE after this turn
    feed            all stages, imudrv.chain       -
    send, write     datagrams to each outlet       any error, or a part only: return OUTLET after this turn
    clock_gettime   latency                        -

It has no memory of its own: bytes or messages, reads, samples and datagrams are appended to buffers that
Python takes over after each return, for the recording, the counts and the outputs without a descriptor. What
is unusual is left to Python, which handles it as it does for a port without a descriptor, with the same
stages:

    reason        returned when                               Python then
    HOUSEKEEPING  its time is over, 0.25 or 0.13 s            does the housekeeping
    SIGNAL        a signal came                               runs its handler
    WOKEN         a signal or another thread woke it          does what is asked for
    CLOCKS        the host's clock was set, or the host slept compares the clocks, and reads the port
    GONE          the port has an error                       reports it, and opens the port again
    OUTLET        an outlet did not take everything           queues the rest, and knows the error
    FULL          a buffer has no room for another read       empties the buffers
    SAMPLES       there are samples and an impatient output   publishes them
    REJECTED      some bytes are no frame                     counts them
"""

from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from imudrv.chain import Chain, Output, Stages, feed_bytes, feed_messages
from imudrv.hostclock import OFFSET_NS
from imudrv.imu.compensation import MAX_TAPS
from imudrv.kernels import kernel
from imudrv.ports.base import OTHER_END_GONE
from imudrv.ports.socketcan import FRAME_BYTES, MESSAGES_AT_ONCE, receive
from imudrv.records import MESSAGE, Arrival, Reads, Records, Timebase, as_array
from imudrv.service.clock_watch import STEP_NS, ClockWatch
from imudrv.service.latency import Latency, count_latency
from imudrv.service.wake import WakePipe
from imudrv.sinks.base import Batch, Outlet, Written
from imudrv.system import (
    CLOCK_BOOTTIME,
    CLOCK_MONOTONIC,
    CLOCK_REALTIME,
    EAGAIN,
    EINTR,
    POLL,
    POLLIN,
    clock_ns,
    poll,
    read,
    send,
    write,
)
from imudrv.wire.can import CanArrays, CanAssembler
from imudrv.wire.datagram import SIZE
from imudrv.wire.stream import StreamArrays, StreamDecoder

AT_ONCE: Final = 1 << 16
"""Most bytes of one read of a line."""
_LARGEST_READS: Final = 4  # until the buffers are full
_GRACE_NS: Final = 5_000_000
"""How much later to return, at most, so that it is right after a read: then the next one is farthest away."""

SERVE: Final = np.dtype(
    [
        ("until_ns", np.int64),  # when to return for housekeeping, on the scale of the arrivals
        ("in_real_time", np.bool_),  # times of arrival show when samples were made
        ("offset_ns", np.int64),  # time of arrival less CLOCK_BOOTTIME
        ("real_offset_ns", np.int64),  # CLOCK_REALTIME less time of arrival, as it is known
        ("awake_offset_ns", np.int64),  # time of arrival less CLOCK_MONOTONIC, as it is known
        ("is_impatient", np.bool_),  # return as soon as there are samples
        ("error", np.int64),  # of the port
        ("reads", np.int64),  # in the buffers,
        ("size", np.int64),  # bytes, or messages
    ],
    align=True,
)
"""Settings of the kernel and its counts."""

READ: Final = np.dtype(
    [
        ("t_ns", np.int64),  # arrival
        ("stop", np.int64),  # its bytes or messages, samples and increments end here in the buffers
        ("samples", np.int64),
        ("increments", np.int64),
    ],
    align=True,
)
"""One read of the port."""

OUTLET: Final = np.dtype(
    [
        ("fd", np.int32),
        ("is_socket", np.bool_),
        ("piece", np.int64),  # most bytes of a packet
        ("written", np.int64),  # bytes since the kernel was entered,
        ("last", np.int64),  # of them in the last packet
        ("error", np.int32),  # 0: none
    ],
    align=True,
)
"""A descriptor that takes datagrams."""


class Why(IntEnum):
    """Why the kernel returns; see the module."""

    HOUSEKEEPING = 0
    SIGNAL = 1
    WOKEN = 2
    CLOCKS = 3
    GONE = 4
    OUTLET = 5
    FULL = 6
    SAMPLES = 7
    REJECTED = 8


class Served(NamedTuple):
    """What the kernel has done.

    Parameters
    ----------
    why : Why
        Why it has returned.
    error : int
        Error of the port, see `imudrv.ports.base.Port.fault`; 0: none, or the port will report it again.
    output : Output
        Samples, all reads together.
    data : bytes or ndarray of MESSAGE
        Of all reads.
    reads : ndarray of READ
        Where each ends.
    written : list of Written
        What each outlet has taken, in the order given.
    """

    why: Why
    error: int
    output: Output
    data: bytes | Records
    reads: Records
    written: list[Written]

    def block(self, timebase: Timebase) -> Reads:
        """Return the reads as a block.

        Parameters
        ----------
        timebase : Timebase
            That of all reads.
        """
        return Reads(as_array(self.data), self.reads["stop"], self.reads["t_ns"], timebase)

    def arrivals(self, timebase: Timebase) -> Iterator[tuple[Arrival, Batch]]:
        """Return each read, with the samples that it completed.

        Parameters
        ----------
        timebase : Timebase
            That of all reads.
        """
        (pulses, increments, datagrams), begin, p, i = self.output, 0, 0, 0
        for t_ns, stop, samples, ready in self.reads.tolist():
            batch = Batch(pulses[p:samples], increments[i:ready], datagrams[i * SIZE : ready * SIZE])
            yield Arrival(t_ns, self.data[begin:stop], timebase), batch
            begin, p, i = stop, samples, ready


class DescriptorLoop:
    """The kernel `serve` with its buffers.

    Parameters
    ----------
    chain : Chain
        Stages of the profile.
    latency : Latency
        Receives the latencies.
    in_real_time : bool
        Whether times of arrival show when samples were made.

    Attributes
    ----------
    pipe : WakePipe
        Ends its wait.
    """

    def __init__(self, chain: Chain, latency: Latency, in_real_time: bool = True) -> None:
        is_can = isinstance(chain.decoder.decoder, CanAssembler)
        most = MESSAGES_AT_ONCE if is_can else AT_ONCE
        chain.reserve(most, _LARGEST_READS)
        self.pipe = WakePipe()
        self._chain, self._latency = chain, latency
        self._data: NDArray[Any] = np.zeros(_LARGEST_READS * most, MESSAGE if is_can else np.uint8)
        self._reads = np.zeros(4096, READ)
        self._serve = np.zeros(1, SERVE)
        self._serve["in_real_time"], self._serve["offset_ns"] = in_real_time, OFFSET_NS
        self._descriptors = np.zeros(2, POLL)
        self._descriptors["events"] = POLLIN
        self._descriptors["fd"][1] = self.pipe.descriptor
        self._room: Room = (np.zeros(2, np.int64), np.zeros(FRAME_BYTES, np.uint8))

    def run(
        self, fd: int, until_ns: int, clocks: ClockWatch, outlets: Sequence[Outlet], is_impatient: bool
    ) -> Served:
        """Serve a port until there is something for Python to do.

        Parameters
        ----------
        fd : int
            Descriptor of the port.
        until_ns : int
            When to return at the latest, on the scale of the arrivals.
        clocks : ClockWatch
            What is known of the host's clocks.
        outlets : sequence of Outlet
            Where datagrams go.
        is_impatient : bool
            Whether to return as soon as there are samples.

        Returns
        -------
        Served
        """
        chain, s = self._chain, self._serve[0]
        decoder = chain.decoder.decoder
        chain.clear()
        self._descriptors["fd"][0] = fd
        s["until_ns"], s["is_impatient"] = until_ns, is_impatient
        s["real_offset_ns"], s["awake_offset_ns"] = clocks.timebase.offset_ns, clocks.awake_offset_ns
        s["reads"] = s["size"] = s["error"] = 0
        rows = np.zeros(len(outlets), OUTLET)
        for row, outlet in zip(rows, outlets, strict=True):
            row["fd"], row["is_socket"], row["piece"] = outlet.fd, outlet.is_socket, outlet.piece
        why = serve(
            self._serve,
            self._descriptors,
            self._room,
            self._data,
            self._reads,
            rows,
            self._latency.state,
            decoder.arrays if isinstance(decoder, StreamDecoder) else None,
            (decoder.arrays, chain.rejects) if isinstance(decoder, CanAssembler) else None,
            chain.stages,
        )
        if why == Why.WOKEN:
            self.pipe.clear()
        data = self._data[: s["size"]]
        written = [Written(*row) for row in rows[["written", "last", "error"]].tolist()]
        return Served(
            Why(why),
            int(s["error"]),
            chain.collect(),
            data.copy() if data.dtype == MESSAGE else data.tobytes(),
            self._reads[: s["reads"]].copy(),
            written,
        )

    def close(self) -> None:
        """Close the pipe."""
        self.pipe.close()


Room: TypeAlias = tuple[NDArray[np.int64], NDArray[np.uint8]]
"""Room for answers of the system: a timespec and a CAN frame."""
CanBus: TypeAlias = tuple[CanArrays, Records]
"""Arguments of `imudrv.chain.feed_messages`."""


@kernel
def serve(
    settings: Records,
    descriptors: Records,
    room: Room,
    data: NDArray[Any],
    reads: Records,
    outlets: Records,
    latency: Records,
    line: StreamArrays | None,
    bus: CanBus | None,
    stages: Stages,
) -> int:
    """Serve a port; see the module.

    Parameters
    ----------
    settings : ndarray of SERVE
        One row.
    descriptors : ndarray of POLL
        Port and wake pipe.
    room : tuple of ndarray
        For answers of the system.
    data : ndarray of uint8 or MESSAGE
        Receives bytes or messages.
    reads : ndarray of READ
        Receives the reads.
    outlets : ndarray of OUTLET
        Where datagrams go.
    latency : ndarray of LATENCY
        `Latency.state`.
    line, bus
        State of the decoder of a serial line or of a CAN bus, for `feed_bytes` or `feed_messages` of
        `imudrv.chain`; the other one is None.
    stages
        `Chain.stages`.

    Returns
    -------
    int
        A `Why`.
    """
    frames, samples, increments, datagrams, _, _, _, _, _, flows = stages
    s, flow, timespec = settings[0], flows[0], room[0]
    most = len(frames) + MAX_TAPS  # rows of one read
    while True:
        if (
            s["reads"] == len(reads)
            or s["size"] + len(data) // _LARGEST_READS > len(data)
            or flow["samples"] + most > len(samples)
            or flow["increments"] + most > len(increments)
        ):
            return Why.FULL
        left_ns = s["until_ns"] - clock_ns(CLOCK_BOOTTIME, timespec) - s["offset_ns"]
        if left_ns <= (0 if s["reads"] > 0 else -_GRACE_NS):
            return Why.HOUSEKEEPING
        ready = poll(descriptors, left_ns + _GRACE_NS)
        if ready < 0:
            return Why.SIGNAL
        if ready == 0:
            return Why.HOUSEKEEPING
        if descriptors[1]["revents"]:
            return Why.WOKEN
        if _has_stepped(s, timespec):
            return Why.CLOCKS
        size, begin, fd = s["size"], flow["increments"], descriptors[0]["fd"]
        if line is not None:
            t_ns = _read_line(fd, s, room, data, line, stages)
        if bus is not None:
            t_ns = _read_bus(fd, s, room, data, bus, stages)
        if s["size"] > size:
            row = reads[s["reads"]]
            row["t_ns"], row["stop"] = t_ns if s["in_real_time"] else 0, s["size"]
            row["samples"], row["increments"] = flow["samples"], flow["increments"]
            s["reads"] += 1
        count = flow["increments"] - begin
        if count:
            is_whole = True
            for k in range(len(outlets)):
                is_whole &= _put(datagrams, begin, flow["increments"], outlets[k])
            count_latency(clock_ns(CLOCK_BOOTTIME, timespec) + s["offset_ns"] - t_ns, count, latency)
            if not is_whole:
                return Why.OUTLET
        if s["error"]:
            return Why.GONE
        if s["is_impatient"] and flow["samples"]:
            return Why.SAMPLES
        if flow["rejected"]:
            return Why.REJECTED


@kernel
def _read_line(
    fd: int, s: np.void, room: Room, data: NDArray[np.uint8], line: StreamArrays, stages: Stages
) -> int:
    """Read bytes and process them; return their time of arrival."""
    buffer, _, states, _, _ = line
    pending = states[0]["pending"]
    piece = buffer[pending : pending + AT_ONCE]
    size = read(fd, piece)
    t_ns = clock_ns(CLOCK_BOOTTIME, room[0]) + s["offset_ns"]
    if size == -EAGAIN or size == -EINTR:
        return int(t_ns)
    if size <= 0:
        s["error"] = -size if size else OTHER_END_GONE
        return int(t_ns)
    for k in range(size):
        data[s["size"] + k] = piece[k]
    s["size"] += size
    end, time = np.empty(1, np.int64), np.empty(1, np.int64)
    end[0], time[0] = size, t_ns if s["in_real_time"] else 0
    feed_bytes(end, time, line, stages)
    return int(t_ns)


@kernel
def _read_bus(fd: int, s: np.void, room: Room, data: Records, bus: CanBus, stages: Stages) -> int:
    """Read messages and process them; return the time after the last one."""
    timespec, frame = room
    messages = data[s["size"] : s["size"] + MESSAGES_AT_ONCE]
    count, s["error"] = receive(fd, frame, timespec, s["offset_ns"], messages)
    t_ns = clock_ns(CLOCK_BOOTTIME, timespec) + s["offset_ns"]
    if count:
        feed_messages(messages[:count], *bus, stages)
        s["size"] += count
    return int(t_ns)


@kernel
def _has_stepped(s: np.void, timespec: NDArray[np.int64]) -> bool:
    """Whether the host's clock was set or the host slept, as far as Python does not know it yet."""
    now_ns = clock_ns(CLOCK_BOOTTIME, timespec) + s["offset_ns"]
    real_ns = clock_ns(CLOCK_REALTIME, timespec)
    awake_ns = clock_ns(CLOCK_MONOTONIC, timespec)
    return bool(
        abs(real_ns - now_ns - s["real_offset_ns"]) >= STEP_NS
        or abs(now_ns - awake_ns - s["awake_offset_ns"]) >= STEP_NS
    )


@kernel
def _put(datagrams: NDArray[np.uint8], begin: int, end: int, outlet: np.void) -> bool:
    """Send rows `begin` to `end` to an outlet; return whether it has taken all."""
    data = datagrams.ravel()
    p, stop = begin * SIZE, end * SIZE
    while p < stop:
        piece = data[p : min(p + outlet["piece"], stop)]
        count = send(outlet["fd"], piece) if outlet["is_socket"] else write(outlet["fd"], piece)
        if count < 0:
            outlet["error"] = -count
            return False
        outlet["written"] += count
        outlet["last"] = count
        if count < len(piece):
            return False
        p += count
    return True
