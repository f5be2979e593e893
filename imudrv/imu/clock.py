"""Host time of every sample from the unit's counter and the arrivals: a lower envelope, not an average.

A sample can arrive late, by a latency timer, a scheduler, a full bus, but never early. So the least of
arrival - elapsed shows the clock, and what is above it shows the host. With `elapsed` by the counter alone

    t = y_0 + (1 + skew) elapsed

is the line under all arrivals of the last `WINDOW_NS` that comes closest to them on average
(`imudrv.imu.envelope`). It changes at fixed counts only, and the stamps follow a new line by slewing; so any
cut of the stream into pieces gives the same stamps, as does a replay of it.

All this is on the scale of the arrivals, which never steps. Stamps are UNIX time: when the host's clock is
set, they step with it, by the new offset of the `Timebase`, forward or back; the line stays as it is. After a
suspend a new line begins, because the hardware clock that measured it may be wrong by a second.

Where a timer delivers samples in bursts, the newest of a burst shows the clock. A timer that beats with the
samples more slowly than once in the window hides up to one interval, which the arrivals cannot show.
"""

from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from imudrv.imu.envelope import (
    ENVELOPE,
    MAX_SKEW,
    above,
    add_point,
    begin,
    close_bin,
    height,
    line_of,
    room_for_points,
)
from imudrv.kernels import kernel
from imudrv.records import PULSES, Flag, Records, Timebase
from imudrv.units import NS, NS_PER_S, PPM

WINDOW_NS: Final = 90 * NS_PER_S
"""Length of the window."""
SLEW: Final = 200e-6
"""Largest change of a locked stamp towards a new line, as a fraction of the time since the last sample."""
STALL_EDGES_S: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""Limits between the bins of `ClockReport.stalls`."""

_EARLY_NS: Final = 5_000_000  # no sample arrives so early: one of the clocks has stepped
_WAIT: Final = 0.01  # part of an interval by which a stamp that is ahead moves on, while unlocked
_LATEST_NS: Final = 2**62  # in the year 2116; keeps sums of whatever a recording holds within 64 bits
_KEPT: Final = 1 << 16  # most stamps that wait for `stamp`, besides those of the last piece
_ROOM: Final = 1 << 12
_EDGES_NS: Final = tuple(round(edge * NS_PER_S) for edge in STALL_EDGES_S)
_UNLOCKED: Final = int(Flag.CLOCK_UNLOCKED)
_STEPPED: Final = int(Flag.CLOCK_STEPPED)

CONSTANTS: Final = np.dtype(
    [("interval_ns", np.int64), ("transmission_ns", np.int64), ("counter_step", np.int64)]
)
"""Parameters of `ClockModel`."""

STATE: Final = np.dtype(
    [
        ("started", np.bool_),
        ("counter", np.int64),  # of the latest sample
        ("elapsed_ns", np.int64),
        ("arrival_ns", np.int64),
        ("t_ns", np.int64),  # of its stamp, on the scale of the arrivals
        ("origin_x", np.int64),  # elapsed time at x = 0 of the envelope
        ("origin_y", np.int64),  # arrival less elapsed time at y = 0
        ("envelope", ENVELOPE),
        ("locked", np.bool_),
        ("ahead", np.float64),  # of the stamps, against the line, ns
        ("worst_ns", np.int64),  # see `ClockReport`
        ("stalls", np.int64, len(STALL_EDGES_S) + 1),
        ("offset_ns", np.int64),  # of the timebase in use
        ("stepped", np.bool_),  # the next sample is the first of another timebase
        ("woken", np.bool_),  # it is the first after a suspend
        ("steps", np.int64),
        ("taken", np.int64),  # stamps that `stamp` has used,
        ("fed", np.int64),  # and end of those that are known
    ],
    align=True,
)
"""State of the kernels between calls."""

STAMP: Final = np.dtype(
    [
        ("elapsed_ns", np.int64),  # end of the interval by the counter
        ("t_ns", np.int64),  # and by the host clock, ns since the UNIX epoch
        ("locked", np.bool_),  # the host time is to be trusted
        ("stepped", np.bool_),  # the first of another timebase
    ],
    align=True,
)
"""Times of a sample."""

ClockArrays: TypeAlias = tuple[Records, Records, NDArray[np.int64], Records]
"""Constants, state, points of the envelope, stamps."""


class ClockReport(NamedTuple):
    """State of a clock.

    Parameters
    ----------
    locked : bool
        The last sample's stamp is on the line, and stays on it.
    skew_ppm : float or None
        Host time that passes in a second of the unit, less one second; None without a line.
    floor_s : float or None
        Least time from stamp to arrival in the last 10 s; the time on the wire, when all is well.
    stalls : tuple of int
        Histogram of the delays of locked samples above the line, with bins between `STALL_EDGES_S`.
    worst_s : float
        Longest such delay.
    steps : int
        Number of times that the host's clock was set, or the host slept, since the first sample.
    """

    locked: bool
    skew_ppm: float | None
    floor_s: float | None
    stalls: tuple[int, ...]
    worst_s: float
    steps: int


class ClockModel:
    """Clock of one unit against the host's; any cut of the samples into pieces gives the same bits.

    Stamps increase strictly, except where the host's clock was set back. While locked they are ``1 + skew``
    times the time by the counter apart, and `SLEW` of it more or less while they follow a new line. A sample
    is not locked before 10 s of data give a line; until then stamps follow the least delay so far. These
    break the line, and a new one begins: the counter steps back or does not agree with `elapsed_ns`, a gap is
    longer than the window, the host has slept, arrivals step back, are 5 ms early, or are 20 ms late for
    10 s. Stamps that are then ahead, as after old samples from a buffer, advance by a hundredth of an
    interval a sample until the host has caught up.

    Parameters
    ----------
    interval_ns : int
        Sample interval.
    transmission_ns : int, optional
        Least time from the end of an interval to the arrival: a frame's time on the wire.
    counter_step : int, optional
        Change of the counter from a sample to the next.
    """

    def __init__(self, interval_ns: int, transmission_ns: int = 0, counter_step: int = 1) -> None:
        self._constants = np.array([(interval_ns, transmission_ns, counter_step)], CONSTANTS)
        self._state = np.zeros(1, STATE)
        self._points = room_for_points(WINDOW_NS)
        self._stamps = np.empty(_ROOM, STAMP)
        self._timebase = Timebase()

    def follow(self, timebase: Timebase) -> None:
        """Use a timebase for the samples that are fed from now on; the one in use changes nothing.

        Parameters
        ----------
        timebase : Timebase
            That of the next arrival.
        """
        if timebase == self._timebase:
            return
        s = self._state[0]
        if s["started"]:
            s["stepped"] = True
            s["woken"] |= timebase.slept_ns != self._timebase.slept_ns
            s["steps"] += 1
        s["offset_ns"] = timebase.offset_ns
        self._timebase = timebase

    @property
    def arrays(self) -> ClockArrays:
        """Arguments of `feed_clock` and `stamp`; valid until `reserve` makes room."""
        return self._constants, self._state, self._points, self._stamps

    def reserve(self, samples: int) -> None:
        """Make room for the stamps of so many samples, in addition to those that wait."""
        s = self._state[0]
        waiting = self._stamps[max(s["taken"], s["fed"] - _KEPT) : s["fed"]]
        needed = len(waiting) + samples
        if needed > len(self._stamps):
            self._stamps = np.empty(2 * needed, STAMP)
            self._stamps[: len(waiting)] = waiting
            s["taken"], s["fed"] = 0, len(waiting)

    def feed(self, pulses: Records) -> Records:
        """Stamp samples.

        Parameters
        ----------
        pulses : ndarray of PULSES
            In order.

        Returns
        -------
        ndarray of STAMP
            One for each sample.
        """
        self.reserve(len(pulses))
        feed_clock(pulses.view(PULSES), *self.arrays)
        stop = int(self._state[0]["fed"])
        stamps: Records = self._stamps[stop - len(pulses) : stop].copy()
        return stamps

    def stamp(self, increments: Records) -> Records:
        """Set the host time of increments whose samples were fed, now or some time ago.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order, from the compensation: `t_ns` is the time by the counter. Changed in place.

        Returns
        -------
        ndarray of INCREMENTS
            The same, with `Flag.CLOCK_UNLOCKED` where the time is not to be trusted, and
            `Flag.CLOCK_STEPPED` on the first one after the host's clock was set or the host slept.

        Raises
        ------
        ValueError
            Increments of samples that were never fed, or were stamped before.
        """
        stamp(increments, *self.arrays)
        return increments

    @property
    def report(self) -> ClockReport:
        """Current state."""
        s = self._state[0]
        e = s["envelope"]
        floor_ns = e["clearance"] - s["ahead"] + self._constants[0]["transmission_ns"]
        return ClockReport(
            locked=bool(s["locked"]),
            skew_ppm=float(e["skew"] / PPM) if e["fitted"] else None,
            floor_s=float(floor_ns * NS) if e["fitted"] else None,
            stalls=tuple(s["stalls"].tolist()),
            worst_s=float(s["worst_ns"] * NS),
            steps=int(s["steps"]),
        )


class _Place(NamedTuple):
    """A sample against the origin of the envelope, ns."""

    dx: int  # time by the counter since the sample before
    x: int
    y: int


@kernel
def feed_clock(
    pulses: Records, constants: Records, state: Records, points: NDArray[np.int64], stamps: Records
) -> None:
    """Stamp samples; the stamps wait for `stamp`.

    Parameters
    ----------
    pulses : ndarray of PULSES
        In order.
    constants, state, points, stamps
        `ClockModel.arrays`, with room for them.
    """
    c, s = constants[0], state[0]
    e = s["envelope"]
    if s["fed"] + len(pulses) > len(stamps):
        _move_to_the_beginning(stamps, len(pulses), s)
    for i in range(len(pulses)):
        sample = pulses[i]
        dx, x, y = _place(sample, c, s, points)
        s["ahead"] += add_point(e, x, y)
        if s["locked"]:
            most = SLEW * dx
            s["ahead"] -= min(max(s["ahead"], -most), most)
        else:
            s["ahead"] = max(s["ahead"] - (dx - _WAIT * min(dx, c["interval_ns"])), 0.0)
            s["locked"] = e["fitted"] and s["ahead"] == 0.0
        on_line = height(line_of(e), x)
        if s["locked"]:
            _count_stall(y - on_line, s)
        s["t_ns"] = sample["elapsed_ns"] + s["origin_y"] + np.int64(np.rint(on_line + s["ahead"]))
        row = stamps[s["fed"]]
        row["elapsed_ns"], row["t_ns"] = sample["elapsed_ns"], s["t_ns"] + s["offset_ns"]
        row["locked"], row["stepped"] = s["locked"], s["stepped"]
        s["stepped"] = False
        s["fed"] += 1


@kernel
def _move_to_the_beginning(stamps: Records, samples: int, s: np.void) -> None:
    """Make room for the stamps of so many samples: only the latest of those that wait stay."""
    first = max(s["taken"], s["fed"] + samples - len(stamps))
    for k in range(s["fed"] - first):
        stamps[k] = stamps[first + k]
    s["taken"], s["fed"] = 0, s["fed"] - first


@kernel
def _place(sample: np.void, c: np.void, s: np.void, points: NDArray[np.int64]) -> _Place:
    """Locate a sample; begin a new envelope where it does not continue the old one."""
    e = s["envelope"]
    arrival_ns = min(max(sample["arrival_ns"], 0), _LATEST_NS) - c["transmission_ns"]
    dx = sample["elapsed_ns"] - s["elapsed_ns"]
    steps = (sample["counter"] - s["counter"]) // c["counter_step"]
    x = sample["elapsed_ns"] - s["origin_x"]
    y = arrival_ns - sample["elapsed_ns"] - s["origin_y"]
    continues = (
        s["started"]
        and not s["woken"]
        and steps > 0
        and 0 <= dx - steps * c["interval_ns"] <= steps  # an interval may be a fraction of 1 ns longer
        and arrival_ns > s["arrival_ns"] - _EARLY_NS
    )
    if continues and x >= e["bin_end"]:
        before = height(line_of(e), x - dx)
        continues = close_bin(e, points, x, WINDOW_NS)
        s["ahead"] += above(line_of(e), x - dx, before)  # the stamps stay where they are
    if continues and e["stop"] > e["first"]:
        continues = y > _least(e, points, x) - _EARLY_NS
    if not continues:
        if dx <= 0 or dx > WINDOW_NS:
            dx = c["interval_ns"]
        s["ahead"] = float(s["t_ns"] + dx - arrival_ns) if s["started"] else 0.0
        s["origin_x"], s["origin_y"] = sample["elapsed_ns"], arrival_ns - sample["elapsed_ns"]
        begin(e)
        s["started"], s["locked"], s["woken"] = True, False, False
        x = y = 0
    s["counter"], s["elapsed_ns"], s["arrival_ns"] = sample["counter"], sample["elapsed_ns"], arrival_ns
    return _Place(dx, x, y)


@kernel
def _least(e: np.void, points: NDArray[np.int64], x: int) -> float:
    """Return the least y to expect: that of the line; before there is one, of the first bin less the skew."""
    if e["fitted"]:
        return height(line_of(e), x)
    first = e["first"]
    return float(points[1, first] - MAX_SKEW * (x - points[0, first]))


@kernel
def _count_stall(delay_ns: float, s: np.void) -> None:
    """Count a delay above the line."""
    k = 0
    while k < len(_EDGES_NS) and delay_ns >= _EDGES_NS[k]:
        k += 1
    s["stalls"][k] += 1
    if delay_ns > s["worst_ns"]:
        s["worst_ns"] = np.int64(delay_ns)


@kernel
def stamp(
    increments: Records, constants: Records, state: Records, points: NDArray[np.int64], stamps: Records
) -> None:
    """Replace times by the counter with stamps.

    Parameters
    ----------
    increments : ndarray of INCREMENTS
        See `ClockModel.stamp`.
    constants, state, points, stamps
        `ClockModel.arrays`.

    Raises
    ------
    ValueError
        See `ClockModel.stamp`.
    """
    s = state[0]
    taken, fed = s["taken"], s["fed"]
    for i in range(len(increments)):
        increment = increments[i]
        stepped = False
        while taken < fed and stamps[taken]["elapsed_ns"] != increment["t_ns"]:
            stepped |= stamps[taken]["stepped"]
            taken += 1
        if taken == fed:
            raise ValueError("expected increments of the samples fed, in their order, each once; got another")
        increment["t_ns"] = stamps[taken]["t_ns"]
        if not stamps[taken]["locked"]:
            increment["flags"] |= _UNLOCKED
        if stepped or stamps[taken]["stepped"]:
            increment["flags"] |= _STEPPED
        taken += 1
    s["taken"] = taken
