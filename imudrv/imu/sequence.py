"""From frames to increments by the unit's counter or time, with every sample accounted for exactly once.

    by counter:  expected = good + reference + damaged + torn + missing + out_of_order
    by arrival:  frames   = good + reference + out_of_order + duplicate + invalid_counter

A frame whose number follows the newest one is good, and output; of running totals the first one is only the
reference of the next. A number that comes after a later one is *out of order*, a second time *duplicate*;
neither is output, because increments go forward only. A lost number is *torn* when part of its messages
came, *damaged* when rejected bytes came in its place, *missing* when nothing did.

One damaged frame in 65 536 passes a CRC of 16 bits with any number in its counter. A frame whose counter
jumps, as after a restart of the unit or a long silence, therefore waits for the next one to agree. If that
continues from before the jump instead, the frame has an *invalid counter*, and counts as damaged bytes.

A *narrow* counter (`imudrv.wire.layout.NARROW_BITS`) begins anew within seconds, so it only goes forward: no
frame waits or is dropped for its sake. How often it went round in a silence, and without a counter how many
samples are missing, is known from the times of arrival (`imudrv.imu.arrivals`). In a capture without times a
gap has its smallest length, and a flag.
"""

from dataclasses import dataclass, fields
from typing import Final, TypeAlias

import numpy as np

from imudrv.imu.arrivals import ARRIVALS, missing_periods
from imudrv.imu.conversion import TOTALS, constants, convert_increments, convert_status, convert_totals
from imudrv.kernels import kernel
from imudrv.records import FRAME, PULSES, Flag, Records
from imudrv.wire.fields import ahead_of
from imudrv.wire.layout import Layout, SequenceKind
from imudrv.wording import counted

WINDOW: Final = 64
"""A number less than this far behind the newest is out of order or duplicate; one up to this far ahead comes
after losses. Beyond, the counter jumps. A jump backward is a restart."""


@dataclass(frozen=True)
class SampleCounts:
    """Number of samples by outcome; see the module."""

    frames: int
    good: int
    reference: int
    duplicate: int
    out_of_order: int
    invalid_counter: int
    damaged: int
    torn: int
    missing: int
    expected: int
    """Numbers from the first to the last of each run of the counter."""
    restarts: int
    recovered: int
    """Lost samples whose pulses are in the next running total; they are counted as lost as well."""
    unknown_gaps: int
    """Gaps with their smallest length: no time of arrival shows how often the counter wrapped."""

    @property
    def closes(self) -> bool:
        """Whether both sums of the module hold."""
        by_counter = self.good + self.reference + self.damaged + self.torn + self.missing + self.out_of_order
        by_arrival = self.good + self.reference + self.out_of_order + self.duplicate + self.invalid_counter
        return by_counter == self.expected and by_arrival == self.frames

    @property
    def lost(self) -> int:
        """Number of samples that were not output."""
        return self.damaged + self.torn + self.missing + self.out_of_order

    def __str__(self) -> str:
        """One-line summary."""
        others = ("reference", "damaged", "torn", "missing", "out_of_order")
        where = "".join(
            f" + {count} {name.replace('_', ' ')}" for name in others if (count := getattr(self, name))
        )
        invalid = f", {self.invalid_counter} with an invalid counter" if self.invalid_counter else ""
        recovered = f"; {self.recovered} of the lost recovered by running totals" if self.recovered else ""
        return (
            f"{counted(self.expected, 'sample')} by the counter = {self.good} good{where}; {self.duplicate} "
            f"duplicate{invalid}, {counted(self.restarts, 'restart')} of the unit{recovered}"
        )


COUNTS: Final = np.dtype([(field.name, np.int64) for field in fields(SampleCounts)])
"""`SampleCounts` in the kernels."""

STATE: Final = np.dtype(
    [
        ("started", np.bool_),
        ("ticks", np.int64),  # newest counter or time of the unit, unwrapped
        ("newest", np.int64),  # number of the newest sample; the counter, if that steps by one
        ("oldest", np.int64),  # of this run of the counter
        ("received", np.int64),  # bit k: the number `newest - k` has been received
        ("elapsed_ns", np.int64),  # by the counter
        ("fraction", np.int64),  # of a ns that is not in it, of `parts`
        ("arrival_ns", np.int64),  # of the newest frame
        ("arrivals", ARRIVALS),
        ("lost_before", np.bool_),  # samples are missing before the next one that is output
        ("damaged", np.int64),  # frames' worth of bytes, and frames with an invalid counter, since `newest`
        ("torn", np.int64),  # samples given up before those frames
        ("totals", TOTALS),
        ("waits", np.bool_),  # a frame waits for the next one,
        ("waiting", FRAME),  # this one
    ],
    align=True,
)
"""State of the kernels between calls."""

TrackerArrays: TypeAlias = tuple[Records, Records, Records]
"""Constants, state, counts."""

_WRAPS_BY_TIME: Final = 24
"""A counter of up to this many bits may have gone round in a silence that a service survives."""
_LONGEST: Final = 1 << 31  # a jump forward by more samples is a restart
_MISSING_BEFORE: Final = int(Flag.MISSING_BEFORE)
_GAP_BY_HOST_TIME: Final = int(Flag.GAP_BY_HOST_TIME)
_GAP_LENGTH_UNKNOWN: Final = int(Flag.GAP_LENGTH_UNKNOWN)


class SequenceTracker:
    """Counter and loss accounting of one unit; any cut of its frames into pieces gives the same bits.

    Parameters
    ----------
    layout : Layout
        Layout of the profile.

    Attributes
    ----------
    samples_type : dtype
        Type of its samples, see `imudrv.records.samples_type`.
    """

    def __init__(self, layout: Layout) -> None:
        self.samples_type = layout.samples_type
        self._constants = constants(layout)
        self._state = np.zeros(1, STATE)
        self._counts = np.zeros(1, COUNTS)

    @property
    def counts(self) -> SampleCounts:
        """Sample counts so far; a frame that still waits counts as one with an invalid counter."""
        counts = self._counts.copy()
        counts["frames"] += self._state["waits"]
        counts["invalid_counter"] += self._state["waits"]
        return SampleCounts(*counts[0].tolist())

    @property
    def arrays(self) -> TrackerArrays:
        """Arguments of `track`."""
        return self._constants, self._state, self._counts

    def feed(self, frames: Records) -> Records:
        """Account for frames and convert them to increments.

        Parameters
        ----------
        frames : ndarray of FRAME
            In the order of arrival; of a unit with a narrow counter or none, those with the same time of
            arrival in one piece.

        Returns
        -------
        ndarray of `imudrv.records.samples_type`
            One for each good frame: PULSES, or increments in rad and m/s.
        """
        if self._state[0]["waits"]:
            frames = np.concatenate([self._state["waiting"], frames])
        pulses = np.empty(len(frames), self.samples_type)
        return pulses[: track(frames, *self.arrays, pulses.view(PULSES))]


@kernel
def track(frames: Records, constants: Records, state: Records, counts: Records, samples: Records) -> int:
    """Account for frames.

    Parameters
    ----------
    frames : ndarray of FRAME
        If one `waits` by the state, that and at least one more.
    constants, state, counts
        `SequenceTracker.arrays`.
    samples : ndarray of PULSES
        Receives the samples, one for each good frame.

    Returns
    -------
    int
        Number of samples.
    """
    c, s, n = constants[0], state[0], counts[0]
    always_forward = c["narrow"] or c["sequence"] == SequenceKind.NONE
    good = 0
    for i in range(len(frames)):
        frame = frames[i]
        flags = 0
        if always_forward:
            ahead = _forward(frames, i, c, s) if s["started"] else 1
            if s["started"] and (ahead > 1 or _has_hole(frame, c)):
                flags = _GAP_BY_HOST_TIME if frame["t_ns"] else _GAP_LENGTH_UNKNOWN
        else:
            ahead = _ahead(frame, c, s)
            if s["started"] and (ahead <= -WINDOW or ahead > WINDOW):
                if i + 1 == len(frames):
                    s["waits"], s["waiting"] = True, frame
                    return good
                if abs(_samples(_ticks(frames[i + 1], frame["counter"], c), c)) > WINDOW:
                    n["frames"] += 1
                    n["invalid_counter"] += 1
                    s["damaged"] += frame["damaged"] + 1
                    s["torn"] += frame["torn"]
                    continue
        n["frames"] += 1
        steps = _advance(frame, ahead, c, s, n)
        s["arrival_ns"] = frame["t_ns"]
        if steps == 0:
            continue
        interval_ns = _interval(steps, c, s)
        s["elapsed_ns"] += interval_ns
        out = samples[good]
        recovers = False
        if c["totals"]:
            recovers = convert_totals(frame, steps, c, interval_ns, s["totals"], out)
        else:
            convert_increments(frame, c, interval_ns if steps == 1 else c["interval_ns"], out)
        if recovers:
            n["recovered"] += steps - 1
        elif steps > 1 or flags:
            s["lost_before"] = True
        if flags & _GAP_LENGTH_UNKNOWN:
            n["unknown_gaps"] += 1
        if c["totals"] and not recovers:
            n["reference"] += 1
            continue
        out["counter"] = s["ticks"] if c["sequence"] == SequenceKind.COUNTER else s["newest"]
        out["elapsed_ns"] = s["elapsed_ns"]
        out["flags"] |= flags
        if s["lost_before"]:
            out["flags"] |= _MISSING_BEFORE
            s["lost_before"] = False
        convert_status(frame, c, out)
        n["good"] += 1
        good += 1
    if len(frames):
        s["waits"] = False
    return good


@kernel
def _ticks(frame: np.void, counter: int, c: np.void) -> int:
    """By how much the number of a frame is ahead of another, in counts."""
    return ahead_of(frame["counter"], counter, c["bits"])


@kernel
def _samples(ticks: int, c: np.void) -> int:
    """By how many samples a number has gone on."""
    if c["step"] == 1 and c["step_parts"] == 1:
        return ticks
    return int(np.rint(float(ticks) * c["step_parts"] / c["step"]))


@kernel
def _ahead(frame: np.void, c: np.void, s: np.void) -> int:
    """By how many samples a frame is ahead of the newest, with the times a wide counter went round."""
    ahead = _samples(_ticks(frame, s["ticks"], c), c)
    if c["bits"] <= _WRAPS_BY_TIME and s["arrival_ns"] and frame["t_ns"]:
        waited = (frame["t_ns"] - s["arrival_ns"]) / c["interval_ns"]
        if c["span"] / 2 < waited < _LONGEST:
            ahead += int(np.rint(c["span"] * np.rint((waited - ahead) / c["span"])))
    return ahead


@kernel
def _forward(frames: Records, i: int, c: np.void, s: np.void) -> int:
    """By how many samples frame `i` is ahead, if a number only goes forward; 0 for a duplicate."""
    frame = frames[i]
    t_ns = frame["t_ns"]
    period_ns = c["span"] * c["interval_ns"]
    # When the newest frame came without delay; its own time may be that of a reader that paused.
    newest_ns = s["arrivals"]["least_ns"] + s["elapsed_ns"]
    is_soon = t_ns and s["arrivals"]["t_ns"] and t_ns - newest_ns < period_ns / 2
    ahead = _one_forward(frame, s["ticks"], is_soon, c)
    if t_ns == 0 or t_ns == s["arrivals"]["t_ns"]:
        return ahead
    to_last, k = ahead, i + 1
    while k < len(frames) and frames[k]["t_ns"] == t_ns:
        to_last += _one_forward(frames[k], frames[k - 1]["counter"], True, c)
        k += 1
    elapsed_ns = s["elapsed_ns"] + to_last * c["interval_ns"]
    periods = missing_periods(s["arrivals"], t_ns, elapsed_ns, period_ns, c["interval_ns"])
    return ahead + int(np.rint(periods * c["span"]))


@kernel
def _one_forward(frame: np.void, counter: int, is_soon: bool, c: np.void) -> int:
    """By how many samples a frame is ahead of the one before it, within one round of the counter."""
    if c["sequence"] == SequenceKind.NONE:
        return 1 + int(frame["torn"])
    ticks = (frame["counter"] - counter) & ((np.int64(1) << c["bits"]) - 1)
    if ticks == 0 and is_soon:
        return 0
    return max(1, _samples(ticks if ticks else np.int64(1) << c["bits"], c))


@kernel
def _has_hole(frame: np.void, c: np.void) -> bool:
    """Whether bytes were rejected before a frame without number and time: of how many samples is unknown."""
    return bool(c["sequence"] == SequenceKind.NONE and frame["t_ns"] == 0 and frame["damaged"] > 0)


@kernel
def _interval(steps: int, c: np.void, s: np.void) -> int:
    """Time of that many samples, in whole ns whose sum never drifts."""
    if c["remainder"] == 0:
        return int(steps * c["interval_ns"])
    s["fraction"] += steps * c["remainder"]
    whole = s["fraction"] // c["parts"]
    s["fraction"] -= whole * c["parts"]
    return int(steps * c["interval_ns"] + whole)


@kernel
def _advance(frame: np.void, ahead: int, c: np.void, s: np.void, n: np.void) -> int:
    """Count a frame whose number is `ahead` of the newest; return by how many samples time advances.

    0: the frame is not output. 1 after a restart, for the time without the unit is not known.
    """
    if not s["started"] or ahead <= -WINDOW or ahead > _LONGEST:
        counts_by_one = c["sequence"] == SequenceKind.COUNTER and c["step"] == c["step_parts"]
        if s["started"]:
            n["restarts"] += 1
            s["lost_before"] = True
        number = s["newest"] + 1 if s["started"] else 0
        s["started"] = True
        s["newest"] = s["oldest"] = frame["counter"] if counts_by_one else number
        s["ticks"] = frame["counter"]
        s["received"] = 1
        s["totals"]["known"] = False
        n["expected"] += 1
        return 1
    if ahead > 0:
        n["expected"] += ahead
        s["newest"] += ahead
        _count_ticks(frame, ahead, c, s)
        s["received"] = (s["received"] << ahead | 1) if ahead < WINDOW else 1
        if ahead > 1:
            _count_lost(ahead - 1, frame, s, n)
        return ahead
    _count_behind(ahead, s, n)
    return 0


@kernel
def _count_ticks(frame: np.void, ahead: int, c: np.void, s: np.void) -> None:
    """Unwrap the number of a frame that many samples ahead."""
    if c["step"] == c["step_parts"]:
        s["ticks"] += ahead
        return
    expected = s["ticks"] + np.int64(np.rint(float(ahead) * c["step"] / c["step_parts"]))
    s["ticks"] = expected + ahead_of(frame["counter"], expected, c["bits"])


@kernel
def _count_lost(gap: int, frame: np.void, s: np.void, n: np.void) -> None:
    """Count the numbers that are lost right before a frame."""
    torn = min(gap, np.int64(frame["torn"]) + s["torn"])
    damaged = min(gap - torn, np.int64(frame["damaged"]) + s["damaged"])
    n["torn"] += torn
    n["damaged"] += damaged
    n["missing"] += gap - torn - damaged
    s["damaged"] = s["torn"] = 0


@kernel
def _count_behind(ahead: int, s: np.void, n: np.void) -> None:
    """Count a frame that is not ahead: a duplicate, or one out of order that was counted as lost before."""
    mark = np.int64(1) << -ahead
    if s["received"] & mark:
        n["duplicate"] += 1
        return
    s["received"] |= mark
    n["out_of_order"] += 1
    number = s["newest"] + ahead
    if number < s["oldest"]:
        n["expected"] += s["oldest"] - number
        n["missing"] += s["oldest"] - number - 1
        s["oldest"] = number
    elif n["missing"] > 0:
        n["missing"] -= 1
    elif n["damaged"] > 0:
        n["damaged"] -= 1
    else:
        n["torn"] -= 1
