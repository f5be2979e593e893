"""From frames to pulse increments by the unit's counter, with every sample accounted for exactly once.

    by counter:  expected = good + reference + damaged + torn + missing + out_of_order
    by arrival:  frames   = good + reference + out_of_order + duplicate + invalid_counter

A frame whose number follows the newest one is good, and output; of running totals the first one is only the
reference of the next. A number that comes after a later one is *out of order*, a second time *duplicate*;
neither is output, because increments go forward only. A lost number is *torn* when part of its CAN messages
came, *damaged* when rejected bytes came in its place, *missing* when nothing did.

One damaged frame in 65 536 passes a CRC of 16 bits with any number in its counter. A frame whose counter
jumps, as after a restart of the unit or a long silence, therefore waits for the next one to agree. If that
continues from before the jump instead, the frame has an *invalid counter*, and counts as damaged bytes.
"""

from dataclasses import dataclass, fields
from typing import Final

import numpy as np

from imudrv.imu.conversion import TOTALS, constants, convert_increments, convert_status, convert_totals
from imudrv.kernels import kernel
from imudrv.records import FRAME, PULSES, Flag, Records
from imudrv.wire.fields import ahead_of
from imudrv.wire.layout import Layout

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
            f"{self.expected} samples by the counter = {self.good} good{where}"
            f"; {self.duplicate} duplicate{invalid}, {self.restarts} restarts of the unit{recovered}"
        )


COUNTS: Final = np.dtype([(field.name, np.int64) for field in fields(SampleCounts)])
"""`SampleCounts` in the kernels."""

STATE: Final = np.dtype(
    [
        ("started", np.bool_),
        ("newest", np.int64),  # number, unwrapped
        ("oldest", np.int64),  # of this run of the counter
        ("received", np.int64),  # bit k: the number `newest - k` has been received
        ("elapsed_ns", np.int64),  # by the counter
        ("lost_before", np.bool_),  # samples are missing before the next one that is output
        ("damaged", np.int64),  # frames' worth of bytes, and frames with an invalid counter, since `newest`
        ("torn", np.int64),  # samples given up before those frames
        ("totals", TOTALS),
    ],
    align=True,
)
"""State of the kernels between calls."""

_NONE: Final = np.zeros(0, FRAME)
_MISSING_BEFORE: Final = int(Flag.MISSING_BEFORE)


class SequenceTracker:
    """Counter and loss accounting of one unit; any cut of its frames into pieces gives the same bits.

    Parameters
    ----------
    layout : Layout
        Layout of the profile.
    """

    def __init__(self, layout: Layout) -> None:
        self._constants = constants(layout)
        self._state = np.zeros(1, STATE)
        self._counts = np.zeros(1, COUNTS)
        self._waiting = _NONE

    @property
    def counts(self) -> SampleCounts:
        """Sample counts so far; a frame that still waits counts as one with an invalid counter."""
        counts = self._counts.copy()
        counts["frames"] += self._waiting.size
        counts["invalid_counter"] += self._waiting.size
        return SampleCounts(*counts[0].tolist())

    def feed(self, frames: Records) -> Records:
        """Account for frames and convert them to pulses.

        Parameters
        ----------
        frames : ndarray of FRAME
            In the order of arrival.

        Returns
        -------
        ndarray of PULSES
            One for each good frame.
        """
        if self._waiting.size:
            frames = np.concatenate([self._waiting, frames])
        pulses = np.zeros(len(frames), PULSES)
        good, waits = _track(frames, pulses, self._constants, self._state, self._counts)
        self._waiting = frames[-1:].copy() if waits else _NONE
        return pulses[:good]


@kernel
def _track(
    frames: Records, pulses: Records, constants: Records, state: Records, counts: Records
) -> tuple[int, bool]:
    """Account for frames; return the number of pulses, and whether the last frame waits for the next."""
    c, s, n = constants[0], state[0], counts[0]
    bits = c["counter_bits"]
    good = 0
    for i in range(len(frames)):
        frame = frames[i]
        ahead = ahead_of(frame["counter"], s["newest"], bits)
        if s["started"] and (ahead <= -WINDOW or ahead > WINDOW):
            if i + 1 == len(frames):
                return good, True
            if abs(ahead_of(frames[i + 1]["counter"], frame["counter"], bits)) > WINDOW:
                n["frames"] += 1
                n["invalid_counter"] += 1
                s["damaged"] += frame["damaged"] + 1
                s["torn"] += frame["torn"]
                continue
        n["frames"] += 1
        steps = _advance(frame, ahead, s, n)
        if steps == 0:
            continue
        s["elapsed_ns"] += steps * c["interval_ns"]
        out = pulses[good]
        recovers = False
        if c["totals"]:
            recovers = convert_totals(frame, steps, c, s["totals"], out)
        else:
            convert_increments(frame, c, out)
        if recovers:
            n["recovered"] += steps - 1
        elif steps > 1:
            s["lost_before"] = True
        if c["totals"] and not recovers:
            n["reference"] += 1
            continue
        out["counter"], out["elapsed_ns"] = s["newest"], s["elapsed_ns"]
        if s["lost_before"]:
            out["flags"] |= _MISSING_BEFORE
            s["lost_before"] = False
        convert_status(frame, c, out)
        n["good"] += 1
        good += 1
    return good, False


@kernel
def _advance(frame: np.void, ahead: int, s: np.void, n: np.void) -> int:
    """Count a frame whose number is `ahead` of the newest; return by how many samples time advances.

    0: the frame is not output. 1 after a restart, for the time without the unit is not known.
    """
    if not s["started"] or ahead <= -WINDOW:
        if s["started"]:
            n["restarts"] += 1
            s["lost_before"] = True
        s["started"] = True
        s["newest"] = s["oldest"] = frame["counter"]
        s["received"] = 1
        s["totals"]["known"] = False
        n["expected"] += 1
        return 1
    if ahead > 0:
        n["expected"] += ahead
        s["newest"] += ahead
        s["received"] = (s["received"] << ahead | 1) if ahead < WINDOW else 1
        if ahead > 1:
            _count_lost(ahead - 1, frame, s, n)
        return ahead
    _count_behind(ahead, s, n)
    return 0


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
