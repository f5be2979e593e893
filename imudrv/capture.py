"""A capture file, or a recording, through the stages that live samples take: decode, account, compensate."""

from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.imu.clock import ClockModel
from imudrv.imu.compensation import Compensator
from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles.schema import Profile
from imudrv.recording.reader import Recording
from imudrv.records import Flag, Reason, Records
from imudrv.wire.candump import CandumpDecoder
from imudrv.wire.decoder import CaptureDecoder, FrameDecoder, RejectedRuns

CHUNK_BYTES = 1 << 19
"""Read at once: small enough for the cache, large enough that Python's part does not show."""


READS_AT_ONCE = 1000
"""Of a recording."""


class Capture:
    """A capture file and the counts of its samples.

    Parameters
    ----------
    path : Path
        Wire bytes; for a CAN profile a candump log; where the name ends in ``.mcap`` a recording.
    profile : Profile, optional
        What the unit sends. A recording knows it.
    channel : str, optional
        The channel of a candump log to read; needed where the log has several.

    Raises
    ------
    InputError
        There is no such file, it is empty, it is no recording and there is no profile, or there is a channel
        and it is no candump log.
    """

    def __init__(self, path: Path, profile: Profile | None = None, channel: str | None = None) -> None:
        self.path = path
        try:
            with path.open("rb") as file:
                self._head = file.read(1 << 16)
            self.size = path.stat().st_size
        except OSError as error:
            raise InputError(f"{path}: expected a capture file, cannot read it: {error.strerror}") from error
        if not self._head:
            raise InputError(f"{path}: expected a capture, got an empty file")
        self.recording = Recording(path) if path.suffix == ".mcap" else None
        if profile is None and self.recording is not None:
            profile = self.recording.profile
        if profile is None:
            raise InputError(f"{path}: expected --profile, for only a recording knows what the unit sends")
        self.profile = profile
        self.layout = profile.layout()
        if channel is not None and (self.recording is not None or not self.layout.can):
            kind = "a recording" if self.recording is not None else f"a capture of {self.layout.name}"
            raise InputError(
                f"{path}: --channel {channel}: expected a candump log, got {kind}; leave --channel out"
            )
        self.tracker = SequenceTracker(self.layout)
        self._channel = channel
        self._decoder: CaptureDecoder | FrameDecoder = (
            FrameDecoder(self.layout) if self.recording is not None else CaptureDecoder(self.layout, channel)
        )

    @property
    def rejected(self) -> dict[Reason, RejectedRuns]:
        """What was no frame, by reason."""
        return self._decoder.rejected

    @property
    def channels(self) -> dict[str, int]:
        """Number of messages of each channel of a candump log, first of the one that is read."""
        return self._log.channels if self._log is not None else {}

    @property
    def _log(self) -> CandumpDecoder | None:
        return self._decoder.log if isinstance(self._decoder, CaptureDecoder) else None

    def pulses(self, advance: Callable[[int], None]) -> Iterator[Records]:
        """Decode the file, piece by piece.

        Parameters
        ----------
        advance : callable
            Told the number of bytes read after each piece.

        Yields
        ------
        ndarray of PULSES
            In order.

        Raises
        ------
        InputError
            The whole file held no frame of the profile; says which shipped profile fits, if one does. A log
            has several channels and none was chosen, or not the chosen one; names them.
        """
        for frames in self._frames(advance):
            yield self.tracker.feed(frames)
        frames = self._decoder.close()
        self._check_channel()
        yield self.tracker.feed(frames)
        if self.tracker.counts.frames == 0:
            raise InputError(
                f"{self.path}: expected frames of {self.layout.name}, "
                f"got none in {self.size} bytes{self._hint()}"
            )

    def increments(self, compensator: Compensator, advance: Callable[[int], None]) -> Iterator[Records]:
        """Decode and compensate the file, piece by piece.

        Parameters
        ----------
        compensator : Compensator
            For this layout.
        advance : callable
            Told the number of bytes read after each piece.

        Yields
        ------
        ndarray of INCREMENTS
            In order. Those of a recording bear the stamps that they had live; in a capture times count from
            its beginning, and are flagged as not UNIX time.
        """
        if self.recording is None:
            for pulses in self.pulses(advance):
                yield _unlocked(compensator.feed(pulses))
            yield _unlocked(compensator.close())
            return
        clock = ClockModel(self.layout.interval_ns, self.profile.transmission_ns)
        for pulses in self.pulses(advance):
            clock.feed(pulses)
            yield clock.stamp(compensator.feed(pulses))
        yield clock.stamp(compensator.close())

    def _frames(self, advance: Callable[[int], None]) -> Iterator[Records]:
        if isinstance(self._decoder, CaptureDecoder):
            with self.path.open("rb") as file:
                while data := file.read(CHUNK_BYTES):
                    frames = self._decoder.feed(data)
                    self._check_channel()
                    yield frames
                    advance(len(data))
            return
        assert self.recording is not None
        arrivals = self.recording.arrivals()
        while some := list(islice(arrivals, READS_AT_ONCE)):
            # Each read has its own time; the stages behind cost by the call.
            yield np.concatenate([self._decoder.feed(arrival.data, arrival.t_ns) for arrival in some])
            advance(sum(len(arrival.data) for arrival in some))

    def _check_channel(self) -> None:
        if self._log is not None:
            self._log.check_channel(str(self.path), "--channel ")

    def _hint(self) -> str:
        if self.recording is None:
            for name in profiles.shipped():
                layout = profiles.load(name).layout()
                decoder = CaptureDecoder(layout, self._channel)
                if layout.name != self.layout.name and len(decoder.feed(self._head)):
                    return f"; its beginning has frames of {name}: try --profile {name}"
        return "; is it the right file, and the right --profile?"


def _unlocked(increments: Records) -> Records:
    increments["flags"] |= np.uint32(Flag.CLOCK_UNLOCKED)
    return increments
