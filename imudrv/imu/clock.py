"""Host time of every sample from the unit's counter and the arrivals: a lower envelope, not an average.

A sample can arrive late, by a latency timer, a scheduler, a full bus, but never early. So the least of
arrival - elapsed shows the clock, and what lies above it shows the host. With `elapsed` by the counter alone

    t = y_0 + (1 + skew) elapsed

is the line under all arrivals of the last `window_s` that comes closest to them on average: the edge of their
lower convex hull that spans their middle. Of each quarter of a second the least point is kept. The line moves
at the ends of these bins only, that is at fixed counts, and the stamps go over to a new line by slewing; so
any cut of the stream into pieces gives the same stamps, as does a replay of it.

Where a timer hands samples over in bursts, the newest of a burst shows the clock. A timer that beats with the
samples more slowly than once in the window hides up to one interval, and nothing in the arrivals tells.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import Flag, Records
from imudrv.units import NS, NS_PER_S, PPM

SLEW: Final = 200e-6
"""Part of an interval by which a locked stamp may be moved over to the line."""
MAX_SKEW: Final = 500e-6
"""A steeper line is no clock."""
STALL_EDGES_S: Final = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
"""Borders between the buckets of `ClockReport.stalls`."""

_BIN_NS: Final = NS_PER_S // 4
_ENOUGH: Final = 40  # bins with data before a line is trusted: 10 s
_EARLY_NS: Final = 5_000_000  # nothing arrives so much before its time: one of the clocks has stepped
_LATE_NS: Final = 20_000_000  # nor for `_ENOUGH` bins on end so much after it
_CATCH_UP: Final = 0.5  # part of an interval by which a stamp that is ahead waits, while unlocked
_LATEST_NS: Final = 2**62  # in the year 2116; keeps sums of whatever a recording holds inside 64 bits
_KEPT: Final = 1 << 16  # stamps that wait for `stamp`, at the most, besides those of the last piece
_ROOM: Final = 1 << 12

_INTERVAL, _TRANSMISSION, _WINDOW = 0, 1, 2
_STARTED, _COUNTER, _ELAPSED, _ARRIVAL, _STAMP = 3, 4, 5, 6, 7  # of the sample before
_BASE_X, _BASE_Y, _EDGE, _LOW_X, _LOW_Y = 8, 9, 10, 11, 12  # origin; end of the open bin and its least point
_FIRST, _STOP, _FITTED, _LOCKED, _WORST, _STALLS = 13, 14, 15, 16, 17, 18
_STATE_SIZE: Final = _STALLS + len(STALL_EDGES_S) + 1
_X0, _Y0, _SKEW, _AHEAD, _LEAST = range(5)
_NOTHING_YET: Final = 2**62
_UNLOCKED: Final = int(Flag.CLOCK_UNLOCKED)
_EDGES_NS: Final = tuple(round(edge * NS_PER_S) for edge in STALL_EDGES_S)


class ClockReport(NamedTuple):
    """How the clock is.

    Parameters
    ----------
    locked : bool
        The last sample's stamp is on the line, and stays on it.
    skew_ppm : float or None
        Host time that passes in a second of the unit, less one second; None without a line.
    floor_s : float or None
        Least time from stamp to arrival in the last 10 s; the time on the wire, when all is well.
    stalls : tuple of int
        Locked samples by their delay above the line; the buckets meet at `STALL_EDGES_S`.
    worst_s : float
        Longest such delay.
    """

    locked: bool
    skew_ppm: float | None
    floor_s: float | None
    stalls: tuple[int, ...]
    worst_s: float


class ClockModel:
    """Clock of one unit against the host's; feed it in any pieces, the stamps are the same bits.

    Stamps increase strictly, always. While locked they are ``1 + skew`` times the time by the counter apart,
    and `SLEW` of it more or less while they go over to a new line. A sample is not locked before 10 s of data
    give a line; until then stamps follow the least delay seen. What breaks the line begins it anew: the
    counter steps back or does not agree with `elapsed_ns`, a gap is longer than the window, arrivals step
    back, come 5 ms early, or come 20 ms late for 10 s. Stamps that are then ahead wait at half speed.

    Parameters
    ----------
    interval_ns : int
        Sample interval.
    transmission_ns : int, optional
        From the end of an interval to the arrival at the best: a frame's time on the wire.
    window_s : float, optional
        Length of the envelope.
    """

    def __init__(self, interval_ns: int, transmission_ns: int = 0, window_s: float = 90.0) -> None:
        window_ns = round(window_s * NS_PER_S)
        self._state = np.zeros(_STATE_SIZE, np.int64)
        self._state[:3] = interval_ns, transmission_ns, window_ns
        self._line = np.zeros(5)
        # The least points of the bins, x and y, and a stack for the hull; moved to the front when full.
        self._points = np.zeros((3, 2 * (window_ns // _BIN_NS + 2)), np.int64)
        self._elapsed, self._stamps, self._locked = _room(_ROOM)
        self._taken = self._fed = 0

    def feed(self, pulses: Records) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Stamp samples.

        Parameters
        ----------
        pulses : ndarray of PULSES
            In order.

        Returns
        -------
        t_ns : ndarray of int64
            Host time of the end of each interval, ns since the UNIX epoch.
        locked : ndarray of bool
            Whether each is to be trusted.
        """
        begin, end = self._fed, self._fed + len(pulses)
        if end > len(self._stamps):
            begin, end = self._make_room(len(pulses))
        stamps, locked = self._stamps[begin:end], self._locked[begin:end]
        _feed(pulses, self._elapsed[begin:end], stamps, locked, self._state, self._line, self._points)
        self._fed = end
        return stamps, locked

    def stamp(self, increments: Records) -> Records:
        """Put host time into what became of samples that were fed, now or some time ago.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order, from the compensation: `t_ns` is the time by the counter. Changed in place.

        Returns
        -------
        ndarray of INCREMENTS
            The same, `Flag.CLOCK_UNLOCKED` set where it belongs.

        Raises
        ------
        ValueError
            Increments of samples that were never fed, or were stamped before.
        """
        taken = _stamp(increments, self._elapsed, self._stamps, self._locked, self._taken, self._fed)
        if taken < 0:
            raise ValueError("expected increments of the samples fed, in their order, each once; got another")
        self._taken = taken
        return increments

    @property
    def report(self) -> ClockReport:
        """How it is now."""
        state, line = self._state, self._line
        fitted = bool(state[_FITTED])
        floor_ns = line[_LEAST] - line[_AHEAD] + state[_TRANSMISSION]
        return ClockReport(
            locked=bool(state[_LOCKED]),
            skew_ppm=float(line[_SKEW] / PPM) if fitted else None,
            floor_s=float(floor_ns * NS) if fitted else None,
            stalls=tuple(state[_STALLS:].tolist()),
            worst_s=float(state[_WORST] * NS),
        )

    def _make_room(self, count: int) -> tuple[int, int]:
        """Fresh arrays for `count` more stamps; those handed out before keep the old ones."""
        waiting = slice(max(self._taken, self._fed - _KEPT), self._fed)
        old = self._elapsed[waiting], self._stamps[waiting], self._locked[waiting]
        kept = len(old[0])
        fresh = _room(max(_ROOM, 2 * (kept + count)))
        for to, column in zip(fresh, old, strict=True):
            to[:kept] = column
        self._elapsed, self._stamps, self._locked = fresh
        self._taken, self._fed = 0, kept
        return kept, kept + count


def _room(size: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    return np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.bool_)


@kernel
def _feed(pulses, elapsed, stamps, locked, state, line, points):  # type: ignore[no-untyped-def]
    for i in range(pulses.shape[0]):
        p = pulses[i]
        dx, x, y = _place(p, state, line, points)
        if y < state[_LOW_Y]:
            state[_LOW_X], state[_LOW_Y] = x, y
        if state[_FITTED] == 0 and y < line[_Y0]:
            line[_AHEAD] += line[_Y0] - y
            line[_Y0] = y
        if state[_LOCKED] != 0:
            most = SLEW * dx
            line[_AHEAD] -= min(max(line[_AHEAD], -most), most)
        else:
            line[_AHEAD] = max(line[_AHEAD] - _CATCH_UP * dx, 0.0)
            state[_LOCKED] = state[_FITTED] != 0 and line[_AHEAD] == 0.0
        on_line = line[_Y0] + line[_SKEW] * (x - line[_X0])
        if state[_LOCKED] != 0:
            _count(y - on_line, state)
        state[_STAMP] = p["elapsed_ns"] + state[_BASE_Y] + np.int64(np.rint(on_line + line[_AHEAD]))
        elapsed[i], stamps[i], locked[i] = p["elapsed_ns"], state[_STAMP], state[_LOCKED] != 0


@kernel
def _place(p, state, line, points):  # type: ignore[no-untyped-def]
    """Take a sample in; unit's time since the one before, and its place against the origin."""
    arrival = min(max(p["arrival_ns"], 0), _LATEST_NS) - state[_TRANSMISSION]
    dx = p["elapsed_ns"] - state[_ELAPSED]
    steps = p["counter"] - state[_COUNTER]
    x = p["elapsed_ns"] - state[_BASE_X]
    y = arrival - p["elapsed_ns"] - state[_BASE_Y]
    goes_on = (
        state[_STARTED] != 0
        and steps > 0
        and dx == steps * state[_INTERVAL]
        and arrival > state[_ARRIVAL] - _EARLY_NS
    )
    if goes_on and x >= state[_EDGE]:
        goes_on = _close_bin(x, x - dx, state, line, points)
    if goes_on and state[_FITTED] != 0:
        goes_on = y > line[_Y0] + line[_SKEW] * (x - line[_X0]) - _EARLY_NS
    if not goes_on:
        if dx <= 0 or dx > state[_WINDOW]:
            dx = state[_INTERVAL]
        line[:] = 0.0
        if state[_STARTED] != 0:
            line[_AHEAD] = state[_STAMP] + dx - arrival
        state[_BASE_X], state[_BASE_Y] = p["elapsed_ns"], arrival - p["elapsed_ns"]
        state[_EDGE], state[_LOW_Y] = _BIN_NS, _NOTHING_YET
        state[_FIRST] = state[_STOP] = state[_FITTED] = state[_LOCKED] = 0
        state[_STARTED] = 1
        x = y = 0
    state[_COUNTER], state[_ELAPSED], state[_ARRIVAL] = p["counter"], p["elapsed_ns"], arrival
    return dx, x, y


@kernel
def _close_bin(x, x_before, state, line, points):  # type: ignore[no-untyped-def]
    """Keep the bin's least point and draw the line anew; whether a line, where there was one, still holds."""
    first, stop = state[_FIRST], state[_STOP]
    if stop == points.shape[1]:
        for k in range(first, stop):
            points[0, k - first], points[1, k - first] = points[0, k], points[1, k]
        first, stop = 0, stop - first
    points[0, stop], points[1, stop] = state[_LOW_X], state[_LOW_Y]
    stop += 1
    while first < stop and points[0, first] < x - state[_WINDOW]:
        first += 1
    if first == stop:
        return False
    state[_FIRST], state[_STOP] = first, stop
    state[_EDGE], state[_LOW_Y] = x - x % _BIN_NS + _BIN_NS, _NOTHING_YET
    before = line[_Y0] + line[_SKEW] * (x_before - line[_X0])
    good = stop - first >= _ENOUGH
    if good:
        line[_X0], line[_Y0], line[_SKEW] = _middle_edge(points, first, stop)
        line[_LEAST] = np.inf
        for k in range(stop - _ENOUGH, stop):
            above = points[1, k] - line[_Y0] - line[_SKEW] * (points[0, k] - line[_X0])
            line[_LEAST] = min(line[_LEAST], above)
        good = abs(line[_SKEW]) <= MAX_SKEW and line[_LEAST] <= _LATE_NS
    if not good:
        if state[_FITTED] != 0:
            return False
        line[_X0] = line[_SKEW] = 0.0
        line[_Y0] = points[1, first:stop].min()
    state[_FITTED] = good
    line[_AHEAD] += before - line[_Y0] - line[_SKEW] * (x_before - line[_X0])
    return True


@kernel
def _middle_edge(points, first, stop):  # type: ignore[no-untyped-def]
    """Edge of the lower convex hull that spans the mean x: a point of it and its slope (Andrew, 1979)."""
    x, y, hull = points[0], points[1], points[2]
    top = 0
    total = 0.0
    for k in range(first, stop):
        total += x[k] - x[first]
        while top >= 2:
            a, b = hull[top - 2], hull[top - 1]
            if float(x[b] - x[a]) * (y[k] - y[a]) > float(x[k] - x[a]) * (y[b] - y[a]):
                break
            top -= 1
        hull[top] = k
        top += 1
    middle = x[first] + total / (stop - first)
    j = 1
    while x[hull[j]] < middle:
        j += 1
    a, b = hull[j - 1], hull[j]
    return float(x[a]), float(y[a]), (y[b] - y[a]) / float(x[b] - x[a])


@kernel
def _count(delay, state):  # type: ignore[no-untyped-def]
    bucket = 0
    while bucket < len(_EDGES_NS) and delay >= _EDGES_NS[bucket]:
        bucket += 1
    state[_STALLS + bucket] += 1
    if delay > state[_WORST]:
        state[_WORST] = np.int64(delay)


@kernel
def _stamp(increments, elapsed, stamps, locked, taken, fed):  # type: ignore[no-untyped-def]
    """Replace times by the counter with stamps; the first stamp not taken, -1 for a time that has none."""
    for i in range(increments.shape[0]):
        row = increments[i]
        while taken < fed and elapsed[taken] != row["t_ns"]:
            taken += 1
        if taken == fed:
            return -1
        row["t_ns"] = stamps[taken]
        if not locked[taken]:
            row["flags"] |= _UNLOCKED
        taken += 1
    return taken
