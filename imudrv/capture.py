"""A capture file, or a recording, through the stages that live samples take: decode, account, compensate."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np

from imudrv import profiles
from imudrv.calibration import Calibration, coefficients, read_calibration
from imudrv.capture_files import CaptureFile, DamageSigns
from imudrv.diagnosis import find_mismatch, fitting_profiles, sequence_fault
from imudrv.errors import InputError
from imudrv.imu.clock import ClockModel
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import RateFilterName
from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles.schema import Profile
from imudrv.recording.reader import Recording
from imudrv.records import Flag, Reason, Records
from imudrv.wire.candump import CandumpDecoder
from imudrv.wire.decoder import CaptureDecoder, FrameDecoder, RejectedRuns
from imudrv.wording import counted

MANY_ERROR_FRAMES = 0.01
"""Ratio of error frames to messages above which a bus is faulty."""

Advance: TypeAlias = Callable[[int], object]
"""Called with the number of bytes read after each piece, to show progress."""


def _no_progress(_: int) -> None:
    pass


class Capture:
    """A capture file and the counts of its samples.

    Parameters
    ----------
    path : path-like
        Wire bytes, a CAN log or a recording, in any of the forms of `imudrv.capture_files`.
    profile : Profile or path-like, optional
        Wire format of the unit: a profile, the name of a shipped one, or the path of its file. A recording
        contains it. If absent, that of the shipped ones which fits the beginning of the file.
    channel : str, optional
        Channel of a CAN log to read; needed if the log has several.

    Attributes
    ----------
    path : Path
    size : int
        Size of the file as it is stored, bytes; of a pipe what was read so far.
    file : CaptureFile
        What the file is.
    is_profile_found : bool
        Whether the profile was found among the shipped ones.
    recording : Recording or None
        The recording, if the file is one.
    profile : Profile
    layout : Layout
        Layout of the profile.
    tracker : SequenceTracker
        Its `counts` are those of the samples read so far; each reading of the file begins anew.
    sequence_fault : str
        Why most good frames read so far do not continue the counter; empty if they do.

    Raises
    ------
    InputError
        There is no such file, it is empty or is none of the known forms by its name or content, none or
        several of the shipped profiles fit, or there is a channel and the file is no CAN log.

    Examples
    --------
    >>> imudrv.Capture("z_up.raw", "imu50-rs422")
    <Capture z_up.raw, imu50-rs422, 0 samples read>
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        profile: Profile | str | os.PathLike[str] | None = None,
        channel: str | None = None,
    ) -> None:
        self.path = path = Path(path)
        self.file = CaptureFile(path)
        self.recording = Recording(path) if self.file.is_recording else None
        self._channel = channel
        self.is_profile_found = profile is None and self.recording is None
        if profile is None:
            profile = self._found_profile() if self.recording is None else self.recording.profile
        self.profile = profile if isinstance(profile, Profile) else profiles.load(profile)
        self.layout = self.profile.layout()
        self._check_transport()
        self._begin()
        self._decoder: CaptureDecoder | FrameDecoder = FrameDecoder(self.layout)
        self._signs = DamageSigns()

    def __repr__(self) -> str:
        return f"<Capture {self.path}, {self.profile.name}, {self.tracker.counts.frames} samples read>"

    def _begin(self) -> None:
        self.tracker = SequenceTracker(self.layout)
        self._gaps = 0
        self._counters = np.zeros(0, np.int64)

    @property
    def size(self) -> int:
        """See the class."""
        return self.file.size

    @property
    def sequence_fault(self) -> str:
        """See the class."""
        return sequence_fault(self.tracker.counts, self._gaps, self._counters)

    @property
    def rejected(self) -> dict[Reason, RejectedRuns]:
        """Input that was no frame, by reason."""
        return self._decoder.rejected

    @property
    def channels(self) -> dict[str, int]:
        """Number of messages of each channel of a CAN log, first of the one that is read."""
        return self._log.channels if self._log is not None else {}

    @property
    def hints(self) -> list[str]:
        """What the losses look like and what to do, one sentence each; of what was read so far."""
        counts, hints = self.tracker.counts, []
        if counts.lost or not counts.frames:
            hints += self._signs.hints
        errors, messages = self.rejected.get(Reason.ERROR_FRAME), sum(self.channels.values())
        if errors is not None and errors.runs > MANY_ERROR_FRAMES * messages:
            hints.append(
                f"{counted(errors.runs, 'error frame')} beside {counted(messages, 'message')}: the bus is "
                "faulty; check its wiring, termination and bit rate"
            )
        return hints

    @property
    def _log(self) -> CandumpDecoder | None:
        return self._decoder.log if isinstance(self._decoder, CaptureDecoder) else None

    def pulses(self, advance: Advance = _no_progress) -> Iterator[Records]:
        """Decode the file from its beginning, piece by piece.

        Parameters
        ----------
        advance : callable, optional
            Called with the number of bytes read after each piece.

        Yields
        ------
        ndarray of PULSES
            In order.

        Raises
        ------
        InputError
            The whole file held no frame of the profile; the message names the shipped profile that fits, if
            one does. Or a log has several channels and none was chosen, or not the chosen one.
        """
        self._begin()
        self._clock = ClockModel(
            self.layout.interval_ns, self.profile.transmission_ns, self.layout.counter_step
        )
        for frames in self._frames(advance):
            if not len(self._counters):
                self._counters = frames["counter"].copy()
            pulses = self.tracker.feed(frames)
            self._gaps += int(np.count_nonzero(pulses["flags"] & Flag.MISSING_BEFORE))
            yield pulses
        if self.tracker.counts.frames == 0:
            raise InputError(
                f"{self.path}: expected frames of {self.layout.name}, got none in {self.size} bytes of "
                f"{self.file.description}: {'; '.join([*self.hints, self._mismatch()])}"
            )

    def increments(self, compensator: Compensator, advance: Advance = _no_progress) -> Iterator[Records]:
        """Decode and compensate the file from its beginning, piece by piece.

        Parameters
        ----------
        compensator : Compensator
            Compensation for this layout.
        advance : callable, optional
            Called with the number of bytes read after each piece.

        Yields
        ------
        ndarray of INCREMENTS
            In order. Those of a recording have the stamps that they had live; in a capture times count from
            its beginning, and are flagged as not UNIX time.

        Raises
        ------
        InputError
            See `pulses`.
        """
        if self.recording is None:
            for pulses in self.pulses(advance):
                yield _unlocked(compensator.feed(pulses))
            yield _unlocked(compensator.close())
            return
        for pulses in self.pulses(advance):
            self._clock.feed(pulses)
            yield self._clock.stamp(compensator.feed(pulses))
        yield self._clock.stamp(compensator.close())

    def _frames(self, advance: Advance) -> Iterator[Records]:
        if self.recording is None:
            self._decoder = decoder = CaptureDecoder(self.layout, self._channel)
            self._signs = DamageSigns()
            for piece in self.file.pieces():
                if not self.layout.can:
                    self._signs.feed(piece.data)
                frames = decoder.feed(piece.data)
                self._check_channel()
                yield frames
                advance(piece.bytes_read)
        else:
            self._decoder = frame_decoder = FrameDecoder(self.layout)
            for reads in self.recording.reads(self.layout):
                self._clock.follow(reads.timebase)
                yield frame_decoder.feed_reads(reads.data, reads.ends, reads.times)
                advance(reads.data.nbytes)
        frames = self._decoder.close()
        self._check_channel()
        yield frames

    def _check_channel(self) -> None:
        if self._log is not None:
            self._log.check_channel(str(self.path), "--channel ")

    def _mismatch(self) -> str:
        """Say what the beginning of the file holds instead of frames, and which shipped profile fits it."""
        if self.recording is not None:
            return "its profile is not that of the unit"
        head = self.file.head()
        data = CandumpDecoder(self._channel).feed(head)[0] if self.layout.can else head
        return f"{find_mismatch(self.profile, data, ()).found}; {self._other_profile()}"

    def _check_transport(self) -> None:
        """Refuse a profile, or a channel, that does not fit what the file is."""
        kind = self.file.kind
        if self._channel is not None and (self.recording is not None or not self.layout.can):
            came = "a recording" if self.recording is not None else f"a capture of {self.layout.name}"
            raise InputError(
                f"{self.path}: --channel {self._channel}: expected a CAN log, got {came}; leave --channel out"
            )
        if kind is not None and kind.transport and (kind.transport == "can") != self.layout.can:
            expected = "a CAN log" if self.layout.can else "wire bytes"
            raise InputError(
                f"{self.path}: expected {expected} for {self.layout.name}, got {self.file.description}; "
                f"{self._other_profile()}"
            )

    def _found_profile(self) -> Profile:
        """Return the shipped profile that fits the beginning of the file."""
        found = self._fitting_profiles()
        if len(found) == 1:
            return found[0]
        if found:
            names = " and ".join(profile.name for profile in found)
            raise InputError(
                f"{self.path}: its beginning fits {names} equally well; choose one with --profile"
            )
        raise InputError(
            f"{self.path}: expected a capture of a shipped profile (list them with `imudrv profiles`), got "
            f"{self.file.description}, which none of them fits; choose the unit's with --profile"
        )

    def _other_profile(self) -> str:
        """Return which profile to try instead."""
        found = [profile for profile in self._fitting_profiles() if profile.name != self.layout.name]
        if not found:
            return "no shipped profile fits its beginning; check the line settings, or write a profile"
        return f"its beginning has frames of {found[0].name}: try --profile {found[0].name}"

    def _fitting_profiles(self) -> list[Profile]:
        head, kind = self.file.head(), self.file.kind
        shipped = [profiles.load(name) for name in profiles.shipped()]
        found = [] if kind is not None and kind.transport == "can" else fitting_profiles(shipped, head)
        if not found:
            log = CandumpDecoder(self._channel)
            messages, _ = log.feed(head)
            log.check_channel(str(self.path), "--channel ")
            found = fitting_profiles(shipped, messages)
        return found


def compensate(
    capture: Capture | str | os.PathLike[str],
    calibration: Calibration | str | os.PathLike[str] | None = None,
    *,
    profile: Profile | str | os.PathLike[str] | None = None,
    rate_filter: RateFilterName = "causal",
    advance: Advance = _no_progress,
) -> Records:
    """Compensate a whole capture or recording.

    Parameters
    ----------
    capture : Capture or path-like
        The capture; of a file with several channels a `Capture`.
    calibration : Calibration or path-like, optional
        Calibration of the unit; if absent that of the recording.
    profile : Profile or path-like, optional
        Wire format, for a path; see `Capture`.
    rate_filter : {'causal', 'centred', 'dither'}
        Filter of the angular rate for the size effect; see `imudrv.rate_filter`.
    advance : callable, optional
        Called with the number of bytes read after each piece.

    Returns
    -------
    ndarray of INCREMENTS
        One row a sample: ``counter``, ``t_ns``, ``interval_ns``, ``dtheta_b`` (rad), ``dv_b`` (m/s),
        ``flags`` (`imudrv.Flag`).

    Raises
    ------
    InputError
        A file cannot be used, there is no calibration, or a `Capture` comes with another profile.

    Examples
    --------
    >>> increments = imudrv.compensate("z_up.raw", calibration="unit.yaml", profile="imu50-rs422")
    >>> increments.dtype.names
    ('counter', 't_ns', 'interval_ns', 'dtheta_b', 'dv_b', 'flags')
    >>> len(increments)
    1000
    """
    if not isinstance(capture, Capture):
        capture = Capture(capture, profile)
    elif profile is not None:
        raise InputError(f"{capture.path}: expected no profile beside a Capture, which has its own")
    if calibration is None and capture.recording is not None:
        calibration = capture.recording.calibration
    if calibration is None:
        raise InputError(f"{capture.path}: expected a calibration, for the file contains none; give one")
    if not isinstance(calibration, Calibration):
        calibration = read_calibration(calibration)
    compensator = Compensator(coefficients(calibration), capture.layout, rate_filter)
    return np.concatenate(list(capture.increments(compensator, advance)))


def _unlocked(increments: Records) -> Records:
    increments["flags"] |= np.uint32(Flag.CLOCK_UNLOCKED)
    return increments
