"""Rests of a capture and the samples of the motions between them.

Three passes over the pulses: where the unit rests; the rests, in bins of a second; the motions.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence, Set
from dataclasses import dataclass
from functools import partial
from itertools import groupby, pairwise
from math import sqrt
from operator import itemgetter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.detection.rest_bins import BIN_S, LEAST_RESTS, Noise, RestBins, binned, rest_noise
from calib.detection.sections import split_at_restarts
from calib.detection.segments import Segmenter
from calib.estimation.dither_line import dither_lines
from calib.messages import english
from calib.sensors.evidence import Evidence, Left, Link
from calib.sensors.motion import SAMPLE, STEADY
from calib.sensors.parameters import NominalScales
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import RateFilter, rate_filter
from imudrv.records import Flag, Records
from imudrv.units import ARCSEC, NS
from imudrv.wire.layout import Layout
from imudrv.wording import counted

GUARD_S: Final = 1.0
"""Time at both ends of a rest that counts as motion: the unit settles, s."""
LEAST_REST_S: Final = 20.0
"""Shortest rest that is used, s."""
LONGEST_MOTION_S: Final = 900.0
"""Longest motion that links two rests, s."""

BAD_FLAGS: Final = int(Flag.SATURATED | Flag.FAULT)
GAP_FLAGS: Final = int(Flag.MISSING_BEFORE | Flag.LONG_INTERVAL)


def read_evidence(
    captures: Sequence[Callable[[], Iterable[Records]]],
    layout: Layout,
    nominal: NominalScales,
) -> Evidence:
    """Read rests and motions.

    Parameters
    ----------
    captures : sequence of callable
        Each gives the pulses of a capture from its beginning, three times.
    layout : Layout
        Layout of the profile.
    nominal : NominalScales

    Returns
    -------
    Evidence

    Raises
    ------
    InputError
        A capture is too short, or there are fewer than three rests.
    """
    quanta = (
        nominal.gyro if nominal.gyro_in_pulses else 0.0,
        1.0 / nominal.accelerometer if nominal.accelerometer_in_pulses else 0.0,
    )
    found: list[RestBins] = []
    left: list[Left] = []
    cuts: set[tuple[int, int]] = set()  # where a long rest was divided
    sessions: list[Callable[[], Iterable[Records]]] = []
    origins: list[int] = []
    windows_of: list[list[_Window]] = []
    for number, pulses in enumerate(captures):
        begin_s, step = 0.0, layout.counter_step
        for section, parts in groupby(split_at_restarts(pulses(), step), key=itemgetter(0)):
            session = len(sessions)
            if section:
                reason = "the unit restarted: attitude and velocity are not carried over it"
                left.append(Left(session, begin_s, begin_s, "motion", reason))
            whole = (part for _, part in parts)
            windows, short, length_s = _windows(session, whole, begin_s, layout, nominal)
            begin_s += length_s
            guards = 2 * round(GUARD_S / samples_s(layout))
            cuts |= {(session, b.start) for a, b in pairwise(windows) if b.start - a.stop == guards}
            left += short
            sessions.append(partial(_section, pulses, section, step))
            origins.append(number)
            windows_of.append(windows)
    for session, (pulses, windows) in enumerate(zip(sessions, windows_of, strict=True)):
        rests, dropped = _bins(session, pulses(), windows, layout, nominal)
        found += rests
        left += dropped
    if len(found) < LEAST_RESTS:
        raise InputError(too_few_text(found, left))
    noise = rest_noise(found)
    still = []
    for rest in found:
        if drift := rest.drift(noise, quanta[1]):
            reason = f"{english(drift)}: no rest, a part of the motion"
            left.append(Left(rest.session, rest.start_s, rest.stop_s, "rest", reason))
        else:
            still.append(rest)
    if len(still) < LEAST_RESTS:
        raise InputError(too_few_text(still, left))
    noise = rest_noise(still)
    links: list[Link] = []
    fastest = 0.0
    for session, pulses in enumerate(sessions):
        numbers = [k for k, rest in enumerate(still) if rest.session == session]
        for item in _links(pulses(), [(k, still[k]) for k in numbers], layout, nominal):
            if isinstance(item, Link):
                links.append(item)
                left += _division(item, still, cuts)
                fastest = max(fastest, float(np.abs(item.samples["gyro"] / item.samples["T"][:, None]).max()))
            else:
                left.append(item)
    ordered = tuple(sorted(left, key=lambda one: (one.session, one.start_s)))
    rates = _rate_filter(still, noise, quanta[0], layout)
    dither = dither_lines(still[0].beginning, samples_s(layout))
    return Evidence(
        tuple(still), tuple(links), ordered, noise, quanta, fastest, rates, dither, tuple(origins)
    )


def _section(pulses: Callable[[], Iterable[Records]], number: int, counter_step: int) -> Iterator[Records]:
    """Yield the pulses of a capture between two restarts of the unit."""
    for section, part in split_at_restarts(pulses(), counter_step):
        if section == number:
            yield part


KNOCK_S: Final = 10.0
KNOCK_RAD: Final = 0.02
"""Longest motion, and largest turn of it, that is a knock within one rest."""


def _division(link: Link, rests: Sequence[RestBins], cuts: Set[tuple[int, int]]) -> Iterator[Left]:
    """Yield that one rest was divided into two, if it was."""
    before, after = rests[link.before], rests[link.after]
    turned = np.abs(link.samples["gyro"].sum(axis=0)).max()
    if link.duration_s > KNOCK_S or turned > KNOCK_RAD:
        return
    reason = f"a knock at {0.5 * (before.stop_s + after.start_s):.1f} s divides it into two rests"
    if (after.session, after.start) in cuts:
        reason = "it is long: divided into two rests"
    yield Left(before.session, before.start_s, after.stop_s, "rest", reason)


DITHER_S: Final = 4.0
"""Length of the beginning of a rest that shows a dither line, s."""
DITHER: Final = 0.5 * ARCSEC
"""Scatter of an angle increment beside pulses and noise that counts as dither, rms."""


def _rate_filter(rests: Sequence[RestBins], noise: Noise, quantum: float, layout: Layout) -> RateFilter:
    """Return the filter of the rate: for dither, where the increments carry any and it can be."""
    usual = 0.5 * quantum + noise.angle_walk * sqrt(samples_s(layout))
    if float(np.median([rest.shaking for rest in rests])) < usual + DITHER:
        return STEADY
    try:
        return rate_filter("dither", layout.interval_ns)
    except InputError:  # it is aliased into the motion; the residuals show it
        return STEADY


def too_few_text(rests: Sequence[RestBins], left: Sequence[Left]) -> str:
    """Return the message for too few rests."""
    lines = [
        f"expected at least {LEAST_RESTS} rests of {LEAST_REST_S:g} s in different poses, got {len(rests)}"
    ]
    lines += [f"{one.what} at {one.start_s:.1f} to {one.stop_s:.1f} s: {one.reason}" for one in left]
    return "\n  ".join(lines)


@dataclass(frozen=True)
class _Window:
    start: int
    stop: int
    start_s: float


def _windows(
    session: int, pulses: Iterable[Records], begin_s: float, layout: Layout, nominal: NominalScales
) -> tuple[list[_Window], list[Left], float]:
    """Find the rests, without a guard at both ends, from a time of the capture on; also return the length."""
    compensator = Compensator(_coefficients(nominal), layout)
    segmenter = Segmenter(begin_s)
    for piece in pulses:
        segmenter.feed(compensator.feed(piece))
    segmenter.feed(compensator.close())
    try:
        segments = segmenter.result()
    except InputError:  # too short for a rest
        return [], [], 0.0
    windows, left = [], []
    guard = round(GUARD_S / segments.interval_s)
    for rest in segments.rests:
        if rest.duration_s < LEAST_REST_S:
            reason = f"it lasts {rest.duration_s:.1f} s, less than {LEAST_REST_S:g} s: a part of the motion"
            left.append(Left(session, rest.start_s, rest.stop_s, "rest", reason))
        else:
            at_s = rest.start_s + guard * segments.interval_s
            windows.append(_Window(rest.start + guard, rest.stop - guard, at_s))
    return windows, left, segments.duration_s


def _coefficients(nominal: NominalScales) -> Coefficients:
    zero, ones = np.zeros(3), np.ones(3)
    return Coefficients(
        gyro_scale=nominal.gyro * ones,
        gyro_bias=zero,
        C_bg=np.eye(3),
        accelerometer_scale=nominal.accelerometer * ones,
        accelerometer_bias=zero,
        C_ba=np.eye(3),
        gyro_in_pulses=nominal.gyro_in_pulses,
        accelerometer_in_pulses=nominal.accelerometer_in_pulses,
    )


class _Binner:
    """Bins of a rest, piece by piece; a loss or a bad sample begins a new run of bins."""

    def __init__(self, samples: int) -> None:
        self._samples = samples
        self.runs: list[tuple[int, list[Array], list[Array], list[Array]]] = []
        self._squares: list[Array] = []  # variance of the gyros' increments, bin by bin
        self._first: list[Array] = []
        self.bad = 0
        self.gaps = 0
        self._rest: Array = np.zeros((0, 10))

    def feed(self, rows: Array, counters: Array, breaks: NDArray[np.int64]) -> None:
        """Process samples: increments (6) and temperatures (4); `breaks` are the rows that follow a loss."""
        for k, part in enumerate(np.split(np.arange(len(rows)), breaks)):
            if (k or not self.runs) and len(part):
                self.runs.append((int(counters[part[0]]), [], [], []))
                self._rest = rows[:0]
            if len(part):
                self._add(rows[part])

    def _add(self, rows: Array) -> None:
        rows = np.concatenate([self._rest, rows])
        n = len(rows) // self._samples
        bins = rows[: n * self._samples].reshape(n, self._samples, 10)
        self._rest = rows[n * self._samples :]
        if n:
            _, sums, means, degc = self.runs[-1]
            for some, new in zip(
                (sums, means), binned(bins[:, :, :6].reshape(-1, 6), self._samples), strict=True
            ):
                some.append(new)
            degc.append(bins[:, :, 6:].mean(axis=1))
            self._squares.append(bins[:, :, :3].var(axis=1))
            if sum(map(len, self._first)) < DITHER_S / BIN_S * self._samples:
                self._first.append(bins[:, :, :3].reshape(-1, 3))

    @property
    def beginning(self) -> Array:
        """The first angle increments, shape (n, 3)."""
        most = round(DITHER_S / BIN_S) * self._samples
        return np.concatenate(self._first)[:most] if self._first else np.zeros((0, 3))

    @property
    def shaking(self) -> float:
        """Largest scatter of the increments of a gyro, rms."""
        return float(np.sqrt(np.concatenate(self._squares).mean(axis=0)).max()) if self._squares else 0.0


def _bins(
    session: int,
    pulses: Iterable[Records],
    windows: Sequence[_Window],
    layout: Layout,
    nominal: NominalScales,
) -> tuple[list[RestBins], list[Left]]:
    """Sum the rests into bins; of one with a loss the longest part counts."""
    samples = max(2, round(BIN_S / (layout.interval_ns * NS)))
    binners = [_Binner(samples) for _ in windows]
    channels = _temperature_columns(layout)
    for piece, counter in _counted(pulses, layout):
        for window, binner in zip(windows, binners, strict=True):
            a, b = np.searchsorted(counter, [window.start, window.stop])
            if a == b:
                continue
            rows = piece[a:b]
            flags = rows["flags"]
            binner.bad += int(np.count_nonzero(flags & BAD_FLAGS))
            lost = np.flatnonzero(flags & GAP_FLAGS)
            binner.gaps += len(lost)
            binner.feed(
                np.concatenate([increments(rows, nominal), _degc(rows, channels)], axis=1), counter[a:b], lost
            )
    rests, left = [], []
    for window, binner in zip(windows, binners, strict=True):
        usable = [run for run in binner.runs if run[1]]
        stop_s = window.start_s + (window.stop - window.start) * samples_s(layout)
        if binner.bad:
            reason = f"{counted(binner.bad, 'saturated or faulted sample')}: not used"
            left.append(Left(session, window.start_s, stop_s, "rest", reason))
            continue
        if not usable:
            left.append(
                Left(session, window.start_s, stop_s, "rest", "it has no second without a loss: not used")
            )
            continue
        first, sums, means, degc = max(usable, key=lambda run: sum(map(len, run[1])))
        bins, temperatures = np.concatenate(sums), np.concatenate(degc)
        duration_s = len(bins) * samples * samples_s(layout)
        start_s = window.start_s + (first - window.start) * samples_s(layout)
        if len(bins) < 4 or (binner.gaps and duration_s < LEAST_REST_S - 2.0 * GUARD_S):
            reason = f"frames are lost, and its longest part lasts {duration_s:.1f} s: a part of the motion"
            left.append(Left(session, window.start_s, stop_s, "rest", reason))
            continue
        if binner.gaps:
            stop = start_s + duration_s
            reason = f"frames are lost: its longer part, {start_s:.1f} to {stop:.1f} s, is the rest"
            left.append(Left(session, window.start_s, stop_s, "part of a rest", reason))
        known = np.isfinite(temperatures).all(axis=0)
        span = float(np.ptp(temperatures[:, known], axis=0).max()) if known.any() else 0.0
        rests.append(
            RestBins(
                session,
                first,
                first + len(bins) * samples,
                start_s,
                samples * samples_s(layout),
                samples,
                bins,
                np.concatenate(means),
                temperatures.mean(axis=0),
                span,
                binner.shaking,
                binner.beginning,
            )
        )
    return rests, left


def samples_s(layout: Layout) -> float:
    """Return the sample interval, s."""
    return float(layout.interval) * NS


def _counted(pulses: Iterable[Records], layout: Layout) -> Iterator[tuple[Records, Array]]:
    """Yield pieces with their counters in samples, as the compensation numbers them."""
    for piece in pulses:
        if len(piece):
            yield piece, piece["counter"] // layout.counter_step


def increments(rows: Records, nominal: NominalScales) -> Array:
    """Return increments at nominal scale, shape (n, 6), rad and m/s."""
    return np.concatenate(
        [rows["gyro"] * nominal.gyro, rows["accelerometer"] / nominal.accelerometer], axis=1
    )


def _temperature_columns(layout: Layout) -> list[int]:
    """Return the channel of the gyros and of each accelerometer; -1: not measured."""
    names = layout.temperature_names

    def channel(*candidates: str) -> int:
        return next((names.index(c) for c in candidates if c in names), -1)

    return [channel("gyro"), *(channel(f"accelerometer_{axis}", "accelerometer") for axis in "xyz")]


def _degc(rows: Records, channels: Sequence[int]) -> Array:
    degc = np.full((len(rows), 4), np.nan)
    for k, channel in enumerate(channels):
        if channel >= 0:
            degc[:, k] = rows["temperature_degc"][:, channel]
    return degc


def _links(
    pulses: Iterable[Records], rests: Sequence[tuple[int, RestBins]], layout: Layout, nominal: NominalScales
) -> Iterator[Link | Left]:
    """Yield the motions between rests that follow each other, or why one links nothing."""
    spans = [_Span(k, j, before, after) for (k, before), (j, after) in pairwise(rests)]
    for piece, counter in _counted(pulses, layout):
        for span in spans:
            span.feed(piece, counter, nominal)
    for span in spans:
        yield span.result()


class _Span:
    """Samples between two rests."""

    def __init__(self, k: int, j: int, before: RestBins, after: RestBins) -> None:
        self._numbers = k, j
        self._before, self._after = before, after
        self._parts: list[Records] = []
        self._lost = self._bad = 0
        self._too_long = after.start_s - before.stop_s > LONGEST_MOTION_S

    def feed(self, piece: Records, counter: Array, nominal: NominalScales) -> None:
        """Take the samples of the span."""
        a, b = np.searchsorted(counter, [self._before.stop, self._after.start])
        if b < len(counter) and counter[b] == self._after.start and piece["flags"][b] & GAP_FLAGS:
            self._lost += 1  # right before the rest
        if a == b:
            return
        rows = piece[a:b]
        self._lost += int(np.count_nonzero(rows["flags"] & GAP_FLAGS))
        self._bad += int(np.count_nonzero(rows["flags"] & BAD_FLAGS))
        if self._lost or self._bad or self._too_long:
            self._parts.clear()
            return
        part = np.zeros(len(rows), SAMPLE)
        part["T"] = rows["interval_ns"] * NS
        both = increments(rows, nominal)
        part["gyro"], part["accelerometer"] = both[:, :3], both[:, 3:]
        self._parts.append(part)

    def result(self) -> Link | Left:
        """Return the link, the smoothed counts of its edges in it."""
        before, after = self._before, self._after
        reason = ""
        if self._lost:
            reason = "frames are lost in it"
        elif self._bad:
            reason = counted(self._bad, "saturated or faulted sample")
        elif self._too_long:
            reason = f"it lasts longer than {LONGEST_MOTION_S:g} s"
        elif not self._parts:
            reason = "it has no samples"
        if reason:
            text = f"{reason}: attitude and velocity are not carried over it"
            return Left(before.session, before.stop_s, after.start_s, "motion", text)
        samples = np.concatenate(self._parts)
        for at, change in ((0, -before.edges[1]), (-1, after.edges[0])):
            samples["gyro"][at] += change[:3]
            samples["accelerometer"][at] += change[3:]
        return Link(*self._numbers, samples)
