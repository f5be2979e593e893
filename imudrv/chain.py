r"""The stages in a row, for live and recorded data: decode, account, stamp, compensate, encode.

    bytes    -> decode   \
                           > track -> feed_clock -> compensate -> stamp -> fill_datagrams
    messages -> assemble /

Each stage has a class that owns its state, as arrays, and a kernel. The kernels here, `feed_bytes` and
`feed_messages`, run all stages in one call, since between single samples the cost of a stage is that of
calling it from Python. The live loop (`imudrv.service.serve`) calls them without Python; `Chain.feed` calls
them for a replay and for ports that only Python can read. So live equals replay.

Results are appended to the chain's buffers, which `Chain.clear` empties.
"""

from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from imudrv.imu.clock import ClockArrays, ClockModel, feed_clock, stamp
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import MAX_TAPS, Compensator, CompensatorArrays, compensate
from imudrv.imu.rate_filter import RateFilterName
from imudrv.imu.sequence import SequenceTracker, TrackerArrays, track
from imudrv.kernels import kernel
from imudrv.profiles.schema import Profile
from imudrv.records import FRAME, INCREMENTS, PULSES, REJECT, Flag, Records, Source
from imudrv.wire.can import CanArrays, CanAssembler, assemble
from imudrv.wire.datagram import DATAGRAM, KINDS, SIZE, encode, fill_datagrams
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.stream import StreamArrays, StreamDecoder, decode

FLOW: Final = np.dtype(
    [
        ("samples", np.int64),  # in the buffers
        ("increments", np.int64),
        ("rejected", np.int64),
        ("source", np.int64),  # of the datagrams
        ("flags", np.uint32),  # that increments may have
    ],
    align=True,
)
"""What the kernels have put into the buffers, and what all datagrams have."""

Stages: TypeAlias = tuple[
    Records,  # FRAME; the first row is for the one that waits
    Records,  # PULSES
    Records,  # INCREMENTS
    NDArray[np.uint8],  # datagrams, shape (n, SIZE)
    Records,  # DATAGRAM, the same memory
    Records,  # KINDS
    TrackerArrays,
    ClockArrays,
    CompensatorArrays,
    Records,  # FLOW
]
"""Buffers and states of the stages after the decoder."""

_ALL_FLAGS: Final = 0xFFFF_FFFF


class Output(NamedTuple):
    """Samples of one arrival.

    Parameters
    ----------
    pulses : ndarray of `imudrv.records.samples_type`
        Decoded samples.
    increments : ndarray of INCREMENTS
        Compensated and stamped; with a rate filter that lags, they belong to earlier samples.
    datagrams : bytes
        The increments as `I50N` datagrams.
    """

    pulses: Records
    increments: Records
    datagrams: bytes


class Chain:
    """Converts received data to stamped increments; any cut of the data into pieces gives the same bits.

    Parameters
    ----------
    profile : Profile
        Profile of the unit.
    coefficients : Coefficients
        Calibration of the unit.
    rate_filter : {'causal', 'centred', 'dither'}
        Rate filter of the size effect.
    source : Source, optional
        Origin of the samples, for the datagrams.
    """

    def __init__(
        self,
        profile: Profile,
        coefficients: Coefficients,
        rate_filter: RateFilterName,
        source: Source = Source.HARDWARE,
    ) -> None:
        self._layout = profile.layout()
        self._rate_filter = rate_filter
        self._source = source
        self.decoder = FrameDecoder(self._layout)
        self.tracker = SequenceTracker(self._layout)
        self.clock = ClockModel(self._layout.interval_ns, profile.transmission_ns, self._layout.counter_step)
        self._compensator = Compensator(coefficients, self._layout, rate_filter)
        self._next: Compensator | None = None
        self._repeats = False
        self._last_ns = 0  # time by the counter of the newest increment output, while it matters
        self._flow = np.zeros(1, FLOW)
        self._flow["source"], self._flow["flags"] = source, _ALL_FLAGS
        self._end: NDArray[np.int64] = np.zeros(1, np.int64)  # of the one read of `feed`
        self._time: NDArray[np.int64] = np.zeros(1, np.int64)
        self._room = -1
        self.reserve(0)

    @property
    def is_exchanging(self) -> bool:
        """Whether two calibrations are in use, see `replace_calibration`; the kernels know only one."""
        return self._next is not None or self._repeats

    @property
    def leaves_out_skew(self) -> bool:
        """Whether the rate filter does not compensate the skew of the calibration."""
        return self._compensator.leaves_out_skew

    def allow_valid(self, valid: bool) -> None:
        """Set whether increments may be flagged as valid, from now on."""
        self._flow["flags"] = _ALL_FLAGS if valid else ~Flag.VALID & _ALL_FLAGS

    def feed(self, data: bytes | memoryview | Records, t_ns: int) -> Output:
        """Process an arrival.

        Parameters
        ----------
        data : bytes-like or ndarray of MESSAGE
            Wire bytes, or CAN messages.
        t_ns : int
            Time of arrival of bytes by the host clock, ns; messages have their own.

        Returns
        -------
        Output
        """
        if self.is_exchanging:
            return self._by_stages(self.decoder.feed(data, t_ns))
        self.clear()
        self.reserve(len(data))
        decoder = self.decoder.decoder
        if isinstance(decoder, StreamDecoder) and not isinstance(data, np.ndarray):
            self._end[0], self._time[0] = decoder.put(data), t_ns
            feed_bytes(self._end, self._time, decoder.arrays, self.stages)
        elif isinstance(decoder, CanAssembler) and isinstance(data, np.ndarray):
            feed_messages(data, decoder.arrays, self._rejects, self.stages)
        else:
            raise TypeError("expected CAN messages for a CAN profile, bytes for any other")
        return self.collect()

    def close(self) -> Output:
        """End the stream and return what was held back."""
        pulses, increments, datagrams = self._by_stages(self.decoder.close())
        rest = self._compensator.close()
        if self._repeats:
            rest = self._drop_overlap(rest)
        last = self._finished(rest)
        return Output(pulses, np.concatenate([increments, last]), datagrams + encode(last, self._source))

    def replace_calibration(self, coefficients: Coefficients) -> None:
        """Replace the calibration between two samples.

        The new compensation first runs beside the old one until its rates are known, so that no sample
        lacks its size effect.

        Parameters
        ----------
        coefficients : Coefficients
            The new calibration.
        """
        self._next = Compensator(coefficients, self._layout, self._rate_filter)
        self._repeats = True

    def reserve(self, size: int, times: int = 1) -> None:
        """Make room in the buffers.

        Parameters
        ----------
        size : int
            Largest number of bytes, or messages, of one arrival.
        times : int
            Number of such arrivals before `clear`.
        """
        if size > self._room:
            self._room = size
            decoder = self.decoder.decoder
            if isinstance(decoder, StreamDecoder):
                decoder.reserve(size)
            else:
                self._rejects = np.zeros(decoder.most_rejects(size), REJECT)
            frames = 1 + decoder.most_frames(size)
            rows = times * (frames + MAX_TAPS)
            self.clock.reserve(frames + MAX_TAPS)
            self._frames = np.zeros(frames, FRAME)
            self._samples = np.zeros(rows, self.tracker.samples_type)
            self._increments = np.zeros(rows, INCREMENTS)
            self._datagrams = np.zeros((rows, SIZE), np.uint8)
            self._gather()

    @property
    def rejects(self) -> Records:
        """Argument of `feed_messages`; valid until `reserve` is called."""
        return self._rejects

    @property
    def stages(self) -> Stages:
        """Arguments of the kernels; valid until `reserve` or `replace_calibration` is called."""
        return self._stages

    def clear(self) -> None:
        """Empty the buffers."""
        self._flow["samples"] = self._flow["increments"] = self._flow["rejected"] = 0

    def collect(self) -> Output:
        """Return copies of what the kernels have put into the buffers, and count the rejects."""
        samples, increments, rejected, *_ = self._flow.item()
        if rejected:
            decoder = self.decoder.decoder
            rejects = decoder.arrays[3] if isinstance(decoder, StreamDecoder) else self._rejects
            self.decoder.count_rejects(rejects[:rejected])
        return Output(
            self._samples[:samples].copy(),
            self._increments[:increments].copy(),
            self._datagrams[:increments].tobytes(),
        )

    def _gather(self) -> None:
        """Put the arrays of all stages together."""
        self._stages: Stages = (
            self._frames,
            self._samples.view(PULSES),
            self._increments,
            self._datagrams,
            self._datagrams.view(DATAGRAM),
            KINDS,
            self.tracker.arrays,
            self.clock.arrays,
            self._compensator.arrays,
            self._flow,
        )

    def _by_stages(self, frames: Records) -> Output:
        """Process frames stage by stage, with two calibrations if there are."""
        pulses = self.tracker.feed(frames)
        self.clock.feed(pulses)
        increments = self._compensator.feed(pulses)
        if self._next is not None:
            increments = self._switched(self._next, pulses, increments)
        if self._repeats:
            increments = self._drop_overlap(increments)
        increments = self._finished(increments)
        self._gather()
        return Output(pulses, increments, encode(increments, self._source))

    def _finished(self, increments: Records) -> Records:
        increments = self.clock.stamp(increments)
        increments["flags"] &= self._flow["flags"]
        return increments

    def _switched(self, new: Compensator, pulses: Records, old: Records) -> Records:
        """Return increments of the old calibration until the new one knows its rates, then of the new one."""
        fresh = new.feed(pulses)
        if new.has_size_effect:
            ready = fresh["flags"] & Flag.SIZE_EFFECT != 0
        else:
            ready = np.ones(len(fresh), np.bool_)
        if not ready.any():
            return old
        since = fresh["t_ns"][ready.argmax()]
        if new.lag < self._compensator.lag:
            old = np.concatenate([old, self._compensator.close()])
        self._compensator, self._next = new, None
        return np.concatenate([old[old["t_ns"] < since], fresh[fresh["t_ns"] >= since]])

    def _drop_overlap(self, increments: Records) -> Records:
        """Drop increments already output: a new compensation that lags more gives some samples again."""
        fresh = increments[increments["t_ns"] > self._last_ns]
        if len(fresh):
            # Nothing is repeated once the new one has passed the last increment of the old one.
            self._repeats = self._next is not None or len(fresh) < len(increments)
            self._last_ns = int(fresh["t_ns"][-1])
        return fresh


@kernel
def feed_bytes(
    ends: NDArray[np.int64], times: NDArray[np.int64], decoder: StreamArrays, stages: Stages
) -> None:
    """Process the bytes of reads, which follow the pending ones in the decoder's buffer.

    Parameters
    ----------
    ends : ndarray of int64, shape (n,)
        Where each read ends in the new bytes.
    times : ndarray of int64, shape (n,)
        Time of arrival of each read.
    decoder
        `StreamDecoder.arrays`.
    stages
        `Chain.stages`.
    """
    frames, flow = stages[0], stages[-1][0]
    found, flow["rejected"] = decode(ends, times, *decoder, frames[1:])
    if found:
        _through(found, *stages)


@kernel
def feed_messages(messages: Records, assembler: CanArrays, rejects: Records, stages: Stages) -> None:
    """Process CAN messages.

    Parameters
    ----------
    messages : ndarray of MESSAGE
        In the order of arrival.
    assembler
        `CanAssembler.arrays`.
    rejects : ndarray of REJECT
        Receives the rejects.
    stages
        `Chain.stages`.
    """
    frames, flow = stages[0], stages[-1][0]
    found, flow["rejected"] = assemble(messages, *assembler, rejects, frames[1:])
    if found:
        _through(found, *stages)


@kernel
def _through(
    found: int,
    frames: Records,
    samples: Records,
    increments: Records,
    datagrams: NDArray[np.uint8],
    rows: Records,
    kinds: Records,
    tracker: TrackerArrays,
    clock: ClockArrays,
    compensator: CompensatorArrays,
    flow: Records,
) -> None:
    """Process the frames after the first row of `frames`: account, stamp, compensate, encode."""
    f, s = flow[0], tracker[1][0]
    first = 1
    if s["waits"]:
        frames[0] = s["waiting"]
        first = 0
    new = samples[f["samples"] :]
    new = new[: track(frames[first : 1 + found], *tracker, new)]
    f["samples"] += len(new)
    feed_clock(new, *clock)
    begin = f["increments"]
    f["increments"] += compensate(new, *compensator, increments[begin:])
    ready = increments[begin : f["increments"]]
    stamp(ready, *clock)
    for i in range(len(ready)):
        ready[i]["flags"] &= f["flags"]
    fill_datagrams(ready, f["source"], kinds, datagrams[begin:], rows[begin:])
