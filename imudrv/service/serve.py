"""The live loop as one kernel, for ports with a descriptor: no Python between the wake-up and the send.

`serve` repeats this turn:

    call            what for                       if it fails
    poll            wait for bytes                 EINTR: return SIGNAL
    clock_gettime   arrival; has a clock stepped?  stepped: return CLOCKS, the bytes still unread
    read            up to 64 KiB                   EAGAIN, EINTR: next turn; 0 bytes, other error: return GONE
    feed_bytes      all stages, imudrv.chain       -
    send, write     datagrams to each outlet       any error, or a part only: return OUTLET after this turn
    clock_gettime   latency                        -

It has no memory of its own: bytes, reads, samples and datagrams are appended to buffers that Python takes
over after each return, for the recording, the counts and the outputs without a descriptor. What is unusual is
left to Python, which handles it as it does for a port without a descriptor, with the same stages:

    reason        returned when                               Python then
    HOUSEKEEPING  its time is over, 20 ms                     does the housekeeping
    SIGNAL        a signal came                               runs its handler
    CLOCKS        the host's clock was set, or the host slept compares the clocks, and reads the port
    GONE          the port has an error                       reads the port, and reports the same error
    OUTLET        an outlet did not take everything           queues the rest, and knows the error
    FULL          a buffer has no room for another read       empties the buffers
    SAMPLES       there are samples and an impatient output   publishes them
    REJECTED      some bytes are no frame                     counts them
"""

from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.chain import Chain, Output, Stages, feed_bytes
from imudrv.hostclock import OFFSET_NS
from imudrv.imu.compensation import MAX_TAPS
from imudrv.kernels import kernel
from imudrv.records import Arrival, Records, Timebase
from imudrv.service.clock_watch import STEP_NS, ClockWatch
from imudrv.service.latency import Latency, count_latency
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
from imudrv.wire.datagram import SIZE
from imudrv.wire.stream import StreamArrays, StreamDecoder

AT_ONCE: Final = 1 << 16
"""Most bytes of one read."""
_READS: Final = 4  # of that size, until the buffers are full
_GRACE_NS: Final = 5_000_000
"""How much later to return, at most, so that it is right after a read: then the next one is farthest away."""

SERVE: Final = np.dtype(
    [
        ("fd", np.int32),  # of the port
        ("until_ns", np.int64),  # when to return for housekeeping, on the scale of the arrivals
        ("offset_ns", np.int64),  # time of arrival less CLOCK_BOOTTIME
        ("real_offset_ns", np.int64),  # CLOCK_REALTIME less time of arrival, as it is known
        ("awake_offset_ns", np.int64),  # time of arrival less CLOCK_MONOTONIC, as it is known
        ("is_impatient", np.bool_),  # return as soon as there are samples
        ("reads", np.int64),  # in the buffers,
        ("bytes", np.int64),
    ],
    align=True,
)
"""Settings of the kernel and its counts."""

READ: Final = np.dtype(
    [
        ("t_ns", np.int64),  # arrival
        ("stop", np.int64),  # its bytes, samples and increments end here in the buffers
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
    CLOCKS = 2
    GONE = 3
    OUTLET = 4
    FULL = 5
    SAMPLES = 6
    REJECTED = 7


class Served(NamedTuple):
    """What the kernel has done.

    Parameters
    ----------
    why : Why
        Why it has returned.
    output : Output
        Samples, all reads together.
    data : bytes
        Bytes of all reads.
    reads : ndarray of READ
        Where each ends.
    written : list of Written
        What each outlet has taken, in the order given.
    """

    why: Why
    output: Output
    data: bytes
    reads: Records
    written: list[Written]

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
        Stages of a serial profile.
    latency : Latency
        Receives the latencies.
    """

    def __init__(self, chain: Chain, latency: Latency) -> None:
        chain.reserve(AT_ONCE, _READS)
        self._chain, self._latency = chain, latency
        self._wire = np.zeros(_READS * AT_ONCE, np.uint8)
        self._reads = np.zeros(4096, READ)
        self._serve = np.zeros(1, SERVE)
        self._serve["offset_ns"] = OFFSET_NS
        self._descriptor = np.zeros(1, POLL)
        self._timespec = np.zeros(2, np.int64)

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
        if not isinstance(decoder, StreamDecoder):
            raise TypeError("expected a chain of a serial profile")
        chain.clear()
        s["fd"], s["until_ns"], s["is_impatient"] = fd, until_ns, is_impatient
        s["real_offset_ns"], s["awake_offset_ns"] = clocks.timebase.offset_ns, clocks.awake_offset_ns
        s["reads"] = s["bytes"] = 0
        rows = np.zeros(len(outlets), OUTLET)
        for row, outlet in zip(rows, outlets, strict=True):
            row["fd"], row["is_socket"], row["piece"] = outlet.fd, outlet.is_socket, outlet.piece
        why = serve(
            self._serve,
            self._descriptor,
            self._timespec,
            self._wire,
            self._reads,
            rows,
            self._latency.state,
            decoder.arrays,
            chain.stages,
        )
        data = self._wire[: s["bytes"]].tobytes()
        written = [Written(*row) for row in rows[["written", "last", "error"]].tolist()]
        return Served(Why(why), chain.collect(), data, self._reads[: s["reads"]].copy(), written)


@kernel
def serve(
    settings: Records,
    descriptor: Records,
    timespec: NDArray[np.int64],
    wire: NDArray[np.uint8],
    reads: Records,
    outlets: Records,
    latency: Records,
    decoder: StreamArrays,
    stages: Stages,
) -> int:
    """Serve a port; see the module.

    Parameters
    ----------
    settings : ndarray of SERVE
        One row.
    descriptor : ndarray of POLL
        One row; with `timespec`, two numbers, room for the system's answers.
    wire : ndarray of uint8
        Receives the bytes.
    reads : ndarray of READ
        Receives the reads.
    outlets : ndarray of OUTLET
        Where datagrams go.
    latency : ndarray of LATENCY
        `Latency.state`.
    decoder, stages
        See `imudrv.chain.feed_bytes`.

    Returns
    -------
    int
        A `Why`.
    """
    frames, samples, increments, datagrams, _, _, _, _, _, flows = stages
    buffer, _, states, _, _ = decoder
    s, flow, state = settings[0], flows[0], states[0]
    most = len(frames) + MAX_TAPS  # rows of one read
    end, time = np.zeros(1, np.int64), np.zeros(1, np.int64)  # of the one read
    descriptor[0]["fd"], descriptor[0]["events"] = s["fd"], POLLIN
    while True:
        if (
            s["reads"] == len(reads)
            or s["bytes"] + AT_ONCE > len(wire)
            or flow["samples"] + most > len(samples)
            or flow["increments"] + most > len(increments)
        ):
            return Why.FULL
        left_ns = s["until_ns"] - clock_ns(CLOCK_BOOTTIME, timespec) - s["offset_ns"]
        if left_ns <= (0 if s["reads"] > 0 else -_GRACE_NS):
            return Why.HOUSEKEEPING
        ready = poll(descriptor, left_ns + _GRACE_NS)
        if ready < 0:
            return Why.SIGNAL
        if ready == 0:
            return Why.HOUSEKEEPING
        if _has_stepped(s, timespec):
            return Why.CLOCKS
        size = read(s["fd"], buffer[state["pending"] : state["pending"] + AT_ONCE])
        t_ns = clock_ns(CLOCK_BOOTTIME, timespec) + s["offset_ns"]
        if size == -EAGAIN or size == -EINTR:
            continue
        if size <= 0:
            return Why.GONE
        for k in range(size):
            wire[s["bytes"] + k] = buffer[state["pending"] + k]
        s["bytes"] += size
        begin = flow["increments"]
        end[0], time[0] = size, t_ns
        feed_bytes(end, time, decoder, stages)
        row = reads[s["reads"]]
        row["t_ns"], row["stop"] = t_ns, s["bytes"]
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
        if s["is_impatient"] and flow["samples"]:
            return Why.SAMPLES
        if flow["rejected"]:
            return Why.REJECTED


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
