"""From frames to pulse increments, with every sample that the unit numbered in exactly one place.

    by the counter:  expected = good + base + damaged + torn + missing + late
    by arrival:      frames   = good + base + late + duplicate + stray

`expected` counts the numbers from the first to the last of each run of the unit's counter. A lost number is
*torn* when half of its CAN messages came, *damaged* when bytes came in its place, *missing* when nothing did.
A number that comes after a later one is *late*, a second time *duplicate*; neither is handed on, because
increments go forward only. *Base* is a frame that only gives running totals their starting point.

One damaged frame in 65 536 passes a CRC of 16 bits with any number in its counter. So a frame that leaps, as
after a restart of the unit or a long silence, waits until the next one agrees; if that goes on from before
the leap instead, the frame is *stray* and counts as bytes that were damaged.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from imudrv.kernels import kernel
from imudrv.records import FRAME, MAX_TEMPERATURES, NO_TEMPERATURE, PULSES, Flag, Records
from imudrv.wire.fields import ahead_of
from imudrv.wire.layout import Layout

WINDOW: Final = 64
"""How far behind the newest a counter may come and still be late or duplicate, and how far before it without
being a leap. A leap backward is a restart."""

MAX_INTERVAL_NS: Final = 2**32 - 1
"""Longest interval that the output datagram can carry; a longer gap in running totals begins anew."""

_BUCKETS: Final = (
    "frames",
    "good",
    "base",
    "duplicate",
    "late",
    "stray",
    "damaged",
    "torn",
    "missing",
    "expected",
    "restarts",
    "bridged",
)
_FRAMES, _GOOD, _BASE, _DUPLICATE, _LATE, _STRAY = range(6)
_DAMAGED, _TORN, _MISSING, _EXPECTED, _RESTARTS, _BRIDGED = range(6, len(_BUCKETS))
_STARTED, _LAST, _FIRST, _SEEN, _ELAPSED, _HAVE_TOTALS, _LOST_BEFORE = range(7)
_STRAY_DAMAGED, _STRAY_TORN = 7, 8  # since the newest number
_TOTALS, _PREVIOUS = 9, 15  # six each
_STATE_SIZE: Final = 21
_NONE: Final = np.zeros(0, FRAME)
_MISSING_BEFORE: Final = int(Flag.MISSING_BEFORE)
_LONG_INTERVAL: Final = int(Flag.LONG_INTERVAL)
_SATURATED: Final = int(Flag.SATURATED)
_FAULT: Final = int(Flag.FAULT)
_WARM_UP: Final = int(Flag.WARM_UP)
_VALID: Final = int(Flag.VALID)


@dataclass(frozen=True)
class Account:
    """Where every sample went; see the module's text."""

    frames: int
    good: int
    base: int
    duplicate: int
    late: int
    stray: int
    damaged: int
    torn: int
    missing: int
    expected: int
    restarts: int
    bridged: int
    """Lost samples whose pulses a running total brought all the same; they stand in their bucket of loss."""

    @property
    def closes(self) -> bool:
        """Whether both sums of the module's text hold."""
        by_counter = self.good + self.base + self.damaged + self.torn + self.missing + self.late
        by_arrival = self.good + self.base + self.late + self.duplicate + self.stray
        return by_counter == self.expected and by_arrival == self.frames

    @property
    def lost(self) -> int:
        """Samples that the unit numbered and that were not handed on."""
        return self.damaged + self.torn + self.missing + self.late

    def __str__(self) -> str:
        """The books in one line."""
        others = ("base", "damaged", "torn", "missing", "late")
        where = "".join(f" + {count} {name}" for name in others if (count := getattr(self, name)))
        bridged = f"; {self.bridged} of the lost bridged by running totals" if self.bridged else ""
        stray = f", {self.stray} stray" if self.stray else ""
        return (
            f"{self.expected} samples by the counter = {self.good} good{where}"
            f"; {self.duplicate} duplicate{stray}, {self.restarts} restarts of the unit{bridged}"
        )


class Accountant:
    """Counter and loss accounting of one unit.

    Parameters
    ----------
    layout : Layout
        Of the profile.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._state = np.zeros(_STATE_SIZE, np.int64)
        self._buckets = np.zeros(len(_BUCKETS), np.int64)
        self._waiting = _NONE
        self._masks = np.array(layout.status, np.int64)
        self._degc = np.full((2, MAX_TEMPERATURES), np.nan)
        known = len(layout.temperature_names)
        self._degc[0, :known] = layout.degc_per_count
        self._degc[1, :known] = layout.degc_at_zero

    @property
    def account(self) -> Account:
        """The state of the books."""
        buckets = self._buckets.copy()
        buckets[[_FRAMES, _STRAY]] += self._waiting.size
        return Account(*buckets.tolist())

    def feed(self, frames: Records) -> Records:
        """Account for frames and hand on their pulses.

        Parameters
        ----------
        frames : ndarray of FRAME
            In the order of arrival.

        Returns
        -------
        ndarray of PULSES
            One a good frame.
        """
        if self._waiting.size:
            frames = np.concatenate([self._waiting, frames])
        pulses = np.zeros(len(frames), PULSES)
        layout = self._layout
        count, waits = _account(
            frames,
            pulses,
            self._state,
            self._buckets,
            layout.interval_ns,
            layout.counter_bits,
            layout.pulse_bits,
            layout.totals,
            self._masks,
            self._degc,
        )
        self._waiting = frames[-1:].copy() if waits else _NONE
        return pulses[:count]


@kernel
def _account(  # type: ignore[no-untyped-def]
    frames, pulses, state, buckets, interval_ns, counter_bits, pulse_bits, totals, masks, degc
):
    """Account for frames; how many are handed on, and whether the last one waits for the next to agree."""
    count = 0
    for i in range(frames.shape[0]):
        frame = frames[i]
        ahead = ahead_of(frame["counter"], state[_LAST], counter_bits)
        if state[_STARTED] != 0 and (ahead <= -WINDOW or ahead > WINDOW):
            if i + 1 == frames.shape[0]:
                return count, 1
            if abs(ahead_of(frames[i + 1]["counter"], frame["counter"], counter_bits)) > WINDOW:
                buckets[_FRAMES] += 1
                buckets[_STRAY] += 1
                state[_STRAY_DAMAGED] += frame["damaged"] + 1
                state[_STRAY_TORN] += frame["torn"]
                continue
        buckets[_FRAMES] += 1
        lost_before = state[_LOST_BEFORE]
        steps = _place(frame, ahead, state, buckets)
        if steps == 0:
            continue
        out = pulses[count]
        state[_ELAPSED] += steps * interval_ns
        if totals:
            long = steps * interval_ns
            known = state[_HAVE_TOTALS] != 0 and long <= MAX_INTERVAL_NS
            if known:
                out["interval_ns"] = long
                out["flags"] = _difference(frame, out, state, steps, pulse_bits)
                buckets[_BRIDGED] += steps - 1
                state[_LOST_BEFORE] = lost_before  # this gap is bridged; one before a base is not
            for axis in range(3):
                state[_TOTALS + axis] = frame["gyro"][axis]
                state[_TOTALS + 3 + axis] = frame["accelerometer"][axis]
            state[_HAVE_TOTALS] = 1
            if not known:
                buckets[_BASE] += 1
                continue
        else:
            out["interval_ns"] = interval_ns
            out["flags"] = 0
            limit = (1 << (pulse_bits - 1)) - 1
            for axis in range(3):
                out["gyro"][axis] = frame["gyro"][axis]
                out["accelerometer"][axis] = frame["accelerometer"][axis]
                if max(abs(out["gyro"][axis]), abs(out["accelerometer"][axis])) >= limit:
                    out["flags"] |= _SATURATED
        # Nothing is missing before the first sample of all; before one that follows a new base something is.
        if state[_LOST_BEFORE] != 0:
            out["flags"] |= _MISSING_BEFORE
            state[_LOST_BEFORE] = 0
        out["counter"] = state[_LAST]
        out["arrival_ns"] = frame["t_ns"]
        out["elapsed_ns"] = state[_ELAPSED]
        out["status"] = frame["status"]
        for k in range(MAX_TEMPERATURES):
            if frame["temperature"][k] == NO_TEMPERATURE:
                out["temperature_degc"][k] = np.nan
            else:
                out["temperature_degc"][k] = degc[0, k] * frame["temperature"][k] + degc[1, k]
        status = np.int64(frame["status"])
        if status & masks[0]:
            out["flags"] |= _FAULT
        if status & masks[1]:
            out["flags"] |= _SATURATED
        if status & masks[2]:
            out["flags"] |= _WARM_UP
        if out["flags"] & (_FAULT | _SATURATED) == 0:
            out["flags"] |= _VALID
        buckets[_GOOD] += 1
        count += 1
    return count, 0


@kernel
def _place(frame, ahead, state, buckets):  # type: ignore[no-untyped-def]
    """Put a number `ahead` of the newest in its bucket; intervals from that, 0 for a frame not handed on."""
    if state[_STARTED] == 0 or ahead <= -WINDOW:
        if state[_STARTED] != 0:
            buckets[_RESTARTS] += 1
            state[_LOST_BEFORE] = 1
        state[_STARTED] = 1
        state[_LAST] = state[_FIRST] = frame["counter"]
        state[_SEEN] = 1
        state[_HAVE_TOTALS] = 0
        buckets[_EXPECTED] += 1
        return 1
    if ahead > 0:
        buckets[_EXPECTED] += ahead
        state[_LAST] += ahead
        state[_SEEN] = (state[_SEEN] << ahead | 1) if ahead < WINDOW else 1
        if ahead > 1:
            gap = ahead - 1
            torn = min(gap, np.int64(frame["torn"]) + state[_STRAY_TORN])
            damaged = min(gap - torn, np.int64(frame["damaged"]) + state[_STRAY_DAMAGED])
            buckets[_TORN] += torn
            buckets[_DAMAGED] += damaged
            buckets[_MISSING] += gap - torn - damaged
            state[_STRAY_DAMAGED] = state[_STRAY_TORN] = 0
            state[_LOST_BEFORE] = 1
        return ahead
    mark = np.int64(1) << -ahead
    if state[_SEEN] & mark:
        buckets[_DUPLICATE] += 1
        return 0
    state[_SEEN] |= mark
    buckets[_LATE] += 1
    number = state[_LAST] + ahead
    if number < state[_FIRST]:
        buckets[_EXPECTED] += state[_FIRST] - number
        buckets[_MISSING] += state[_FIRST] - number - 1
        state[_FIRST] = number
    elif buckets[_MISSING] > 0:
        buckets[_MISSING] -= 1
    elif buckets[_DAMAGED] > 0:
        buckets[_DAMAGED] -= 1
    else:
        buckets[_TORN] -= 1
    return 0


@kernel
def _difference(frame, out, state, steps, pulse_bits):  # type: ignore[no-untyped-def]
    """Increments from running totals, as signed numbers of their width; the flags that follow."""
    flags = 0
    if steps > 1:
        flags |= _LONG_INTERVAL
    shift = 64 - pulse_bits
    for k in range(6):
        axis = k % 3
        total = np.int64(frame["gyro"][axis]) if k < 3 else np.int64(frame["accelerometer"][axis])
        pulses = ((total - state[_TOTALS + k]) << shift) >> shift
        # Across a gap the difference is sure only while the rate before it stays well inside the width.
        if abs(state[_PREVIOUS + k]) * steps >= np.int64(1) << (pulse_bits - 2) and steps > 1:
            flags |= _SATURATED
        state[_PREVIOUS + k] = pulses // steps
        if k < 3:
            out["gyro"][axis] = pulses
        else:
            out["accelerometer"][axis] = pulses
    return flags
