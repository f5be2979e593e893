"""Rest, rotation and orientation, found in the increments themselves; nobody types times.

Increments are summed into blocks of 20 ms in one pass, so that an hour stays small. What moves is decided
from the data's own noise floor: the quietest fifth of all seconds says how restless blocks are at rest.

    motion   rate above twice the Earth's and above the noise, or specific force off the rest's own, or
             samples missing for more than half a block; a quiet spell under a second belongs to it
    rest     what lies between motions

A motion's angle is counted about the vertical as the body sees it (specific force of the rest before, carried
on by the gyros); its axis is that of the sum of its angles. Whether it is a rotation of the procedure is for
`judge` to say: every rejection bears its number and its limit.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from math import acos, hypot, inf
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from imudrv.errors import InputError
from imudrv.nav.attitude import conjugate, product, quaternion_of_vector, turn, unit
from imudrv.nav.earth import EARTH_RATE
from imudrv.records import Flag, Records
from imudrv.units import DEG, NS, STANDARD_GRAVITY, UG, URAD

Array = NDArray[np.float64]

BLOCK_NS: Final = 20_000_000
"""Samples are summed over so long, ns."""
QUIET_S: Final = 1.0
"""A shorter quiet spell belongs to the motion around it, s."""
SIGMAS: Final = 8.0
"""A block so many noise floors off its rest is motion."""
LEAST_FORCE: Final = 300.0 * UG
"""A change of specific force below this is not motion, m/s^2."""
BIN_S: Final = 0.5
"""Velocity at rest is used as means over so long, s: pulses of a level accelerometer are few."""
LAGS: Final = (1, 2, 4, 8, 16)
"""Lags at which noise is looked at, bins."""
LEAST_NOISE_S: Final = 10.0
"""A shorter rest does not tell its noise, s."""

_BLOCK: Final = np.dtype(
    [
        ("index", np.int64),  # of the block, by the counter
        ("samples", np.int64),
        ("interval_ns", np.int64),
        ("dtheta_b", np.float64, 3),
        ("dv_b", np.float64, 3),
        ("angle", np.float64, 3),  # sum over the samples of the angle since the block's beginning
        ("velocity", np.float64, 3),  # likewise
        ("flags", np.int64),  # of any sample
    ]
)


@dataclass(frozen=True)
class Noise:
    """Noise of the sensors at rest, from their sums of increments.

    Attributes
    ----------
    angle_walk : float
        Random walk of angle, rad/sqrt(s), each axis.
    velocity_walk : float
        Random walk of velocity of the level accelerometers, m/s/sqrt(s), each axis.
    velocity_white : float
        White noise of velocity, as pulses make it, in means over `BIN_S`, m/s.
    velocity_pulse : float
        The same of a single value, m/s.
    """

    angle_walk: float
    velocity_walk: float
    velocity_white: float
    velocity_pulse: float


@dataclass(frozen=True)
class Differences:
    """Second differences of the sums of angle and velocity, from which noise is told.

    Of means over w = `BIN_S`; white noise s and a random walk q in them have, over a lag L >= w, the variance
    `6 s^2 + q^2 (2 L - w)`. A constant rate has none.

    Attributes
    ----------
    count : ndarray, shape (lags,)
        How many, each axis, over each of `LAGS`.
    angle, velocity : ndarray, shape (lags,)
        Their mean square, of all axes and of the level ones.
    single : float
        Mean square of those of single velocities, block by block.
    """

    count: Array
    angle: Array
    velocity: Array
    single: float


@dataclass(frozen=True)
class Rest:
    """A stretch at rest.

    Attributes
    ----------
    start, stop : int
        Counter of the first sample and of the first behind the last.
    start_s, stop_s : float
        From the capture's beginning, by the counter.
    up : str
        Body axis that points up, '+X' to '-Z'.
    up_b : ndarray, shape (3,)
        Unit vector up, body axes.
    f_b : ndarray, shape (3,)
        Mean specific force, m/s^2.
    differences : Differences or None
        They tell the noise; None: too short.
    missing : int
        Samples that are missing.
    """

    start: int
    stop: int
    start_s: float
    stop_s: float
    up: str
    up_b: Array
    f_b: Array
    differences: Differences | None
    missing: int

    @property
    def noise(self) -> Noise | None:
        """Noise in this rest; None: too short to tell."""
        return pooled_noise([self]) if self.differences else None

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return self.stop_s - self.start_s


@dataclass(frozen=True)
class Rotation:
    """A motion between two rests; `judge` says whether it is a rotation of the procedure.

    Attributes
    ----------
    start, stop : int
        Counter of the first sample and of the first behind the last.
    start_s, stop_s : float
        From the capture's beginning, by the counter.
    before, after : Rest or None
        The rests beside it; None: the capture begins or ends in motion.
    angle_deg : float
        Turned about the vertical, right-handed about up.
    axis : str
        Body axis that was vertical, '+X' to '-Z'.
    about : str
        Body axis nearest to the axis of the turn, 'X', 'Y' or 'Z'.
    axis_tilt_deg : float
        Of the turn's axis from the vertical, 0 to 90.
    peak_deg_per_s : float
        Largest rate of a block.
    missing : int
        Samples that are missing.
    flags : int
        `Flag` bits that any sample bears.
    """

    start: int
    stop: int
    start_s: float
    stop_s: float
    before: Rest | None
    after: Rest | None
    angle_deg: float
    axis: str
    about: str
    axis_tilt_deg: float
    peak_deg_per_s: float
    missing: int
    flags: int

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return self.stop_s - self.start_s


@dataclass(frozen=True)
class Segments:
    """What a capture consists of.

    Attributes
    ----------
    first : int
        Counter of the first sample.
    interval_s : float
        Sample interval.
    duration_s : float
        Of the capture, by the counter.
    rests : tuple of Rest
        In order.
    rotations : tuple of Rotation
        Every motion, in order.
    """

    first: int
    interval_s: float
    duration_s: float
    rests: tuple[Rest, ...]
    rotations: tuple[Rotation, ...]


@dataclass(frozen=True)
class Limits:
    """What a rotation of the procedure has to keep; degrees and seconds.

    Attributes
    ----------
    angle_deg, angle_tolerance_deg : float
        Angle about the vertical, of either sign.
    least_peak_deg_per_s : float
        Slower than this the lever arms drown in what bias and misalignment do meanwhile.
    axis_tilt_deg : float
        Most that the axis may be off the vertical.
    rest_before_s, rest_after_s : float
        Least lengths: to align and to see the velocity before, and to see it after.
    missing : int
        Most samples missing during the rotation.
    """

    angle_deg: float = 180.0
    angle_tolerance_deg: float = 5.0
    least_peak_deg_per_s: float = 70.0
    axis_tilt_deg: float = 10.0
    rest_before_s: float = 32.0
    rest_after_s: float = 5.0
    missing: int = 0


LEAST_EXTRAPOLATED_DEG_PER_S: Final = 10.0
"""Peak rate below which no error of the arms is extrapolated, deg/s."""


class Segmenter:
    """Finds rests and motions; feed it in any pieces, the result is the same."""

    def __init__(self) -> None:
        self._blocks: list[Records] = []
        self._first = 0
        self._nominal_ns = 0
        self._last = 0

    def feed(self, increments: Records) -> None:
        """Take increments.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order.
        """
        if not len(increments):
            return
        counter = increments["counter"]
        if not self._nominal_ns:
            self._nominal_ns = int(increments["interval_ns"].min())
            self._first = int(counter[0])
        index = (counter - self._first) // self._samples_a_block
        starts = np.concatenate([[0], np.flatnonzero(np.diff(index)) + 1])
        samples = np.diff(starts, append=len(index))
        blocks = np.zeros(len(starts), _BLOCK)
        blocks["index"], blocks["samples"] = index[starts], samples
        blocks["interval_ns"] = np.add.reduceat(increments["interval_ns"], starts)
        for whole, inside in (("dtheta_b", "angle"), ("dv_b", "velocity")):
            sums = np.cumsum(increments[whole], axis=0)
            at_end = sums[starts + samples - 1]
            at_begin = np.concatenate([np.zeros((1, 3)), at_end[:-1]])
            blocks[whole] = at_end - at_begin
            blocks[inside] = np.add.reduceat(sums, starts, axis=0) - samples[:, None] * at_begin
        blocks["flags"] = np.bitwise_or.reduceat(increments["flags"], starts)
        if self._blocks and self._blocks[-1]["index"][-1] == blocks["index"][0]:
            _join(self._blocks[-1][-1:], blocks[:1])
            blocks = blocks[1:]
        if len(blocks):
            self._blocks.append(blocks)
        self._last = int(counter[-1])

    @property
    def _samples_a_block(self) -> int:
        return max(1, BLOCK_NS // self._nominal_ns)

    def result(self) -> Segments:
        """Rests and motions of all that was fed.

        Returns
        -------
        Segments

        Raises
        ------
        InputError
            There is nothing to look at.
        """
        blocks = np.concatenate(self._blocks) if self._blocks else np.zeros(0, _BLOCK)
        if len(blocks) * BLOCK_NS * NS < 2.0 * QUIET_S:
            raise InputError(
                f"segments: expected a capture of {2.0 * QUIET_S:g} s at least, got "
                f"{len(blocks) * BLOCK_NS * NS:.1f} s"
            )
        size, end = self._samples_a_block, self._last + 1
        if (end - self._first) % size:  # a few samples do not average out: they would pass for a motion
            blocks, end = blocks[:-1], self._first + int(blocks["index"][-1]) * size
        return _Found(blocks, size, self._first, end, self._nominal_ns * NS).segments()


def find_segments(pieces: Iterable[Records]) -> Segments:
    """Rests and motions of a whole capture.

    Parameters
    ----------
    pieces : iterable of ndarray of INCREMENTS
        In order.

    Returns
    -------
    Segments

    Raises
    ------
    InputError
        There is nothing to look at.
    """
    segmenter = Segmenter()
    for piece in pieces:
        segmenter.feed(piece)
    return segmenter.result()


def judge(rotation: Rotation, limits: Limits, expected: str | None = None) -> tuple[str, ...]:
    """Why a motion cannot serve as a rotation of the procedure.

    Parameters
    ----------
    rotation : Rotation
        What was found.
    limits : Limits
        What it has to keep.
    expected : {'X', 'Y', 'Z'}, optional
        Body axis that the procedure wants vertical.

    Returns
    -------
    tuple of str
        Reasons, each with its number and its limit; empty: it serves.
    """
    r, reasons = rotation, []
    if expected is not None and r.about != expected:
        reasons.append(f"about {r.about}, expected {expected}")
    if abs(abs(r.angle_deg) - limits.angle_deg) > limits.angle_tolerance_deg:
        reasons.append(
            f"turned {abs(r.angle_deg):.1f} deg, want {limits.angle_deg:g} +- {limits.angle_tolerance_deg:g}"
        )
    if r.axis_tilt_deg > limits.axis_tilt_deg:
        reasons.append(
            f"axis {r.axis_tilt_deg:.1f} deg off the vertical, want {limits.axis_tilt_deg:g} at most"
        )
    if r.peak_deg_per_s < limits.least_peak_deg_per_s:
        error = ""
        if r.peak_deg_per_s >= LEAST_EXTRAPOLATED_DEG_PER_S:
            error = f", expect {expected_error_mm(r.peak_deg_per_s):.1f} mm"
        reasons.append(
            f"peak {r.peak_deg_per_s:.0f} deg/s: slower than {limits.least_peak_deg_per_s:g}{error}"
        )
    if r.missing > limits.missing:
        reasons.append(f"{r.missing} samples missing during the rotation, want {limits.missing} at most")
    for flag, what in ((Flag.SATURATED, "an axis saturated"), (Flag.FAULT, "the unit told a fault")):
        if r.flags & flag:
            reasons.append(f"{what} during the rotation")
    for rest, side, least in (
        (r.before, "before", limits.rest_before_s),
        (r.after, "after", limits.rest_after_s),
    ):
        if rest is None:
            reasons.append(f"no rest {side} it, want {least:g} s")
        elif rest.duration_s < least:
            reasons.append(f"rest {side} {rest.duration_s:.1f} s, want {least:g}")
    return tuple(reasons)


def expected_error_mm(peak_deg_per_s: float) -> float:
    """Error of a lever arm that one velocity a rotation gives, 1 sigma, mm.

    Half a turn from rest to rest of least jerk takes `T = 180 * 1.875 / peak`; it gains 8.8 / T m/s a metre,
    while 50 ug of bias and 30 urad of gyro misalignment gain `T hypot(b, g m)` m/s.
    """
    if peak_deg_per_s <= 0.0:
        return inf
    T = 180.0 * 1.875 / peak_deg_per_s
    return 1e3 * T * T / 8.8 * hypot(50.0 * UG, 30.0 * URAD * STANDARD_GRAVITY)


def pooled_noise(rests: Iterable[Rest]) -> Noise:
    """Noise that explains several rests together.

    Parameters
    ----------
    rests : iterable of Rest
        Those too short to tell are passed over.

    Returns
    -------
    Noise

    Raises
    ------
    InputError
        All are too short.
    """
    told = [rest.differences for rest in rests if rest.differences is not None]
    if not told:
        raise InputError(f"noise: expected a rest of {LEAST_NOISE_S:g} s at least, got none")
    counts = np.array([d.count for d in told])
    count = counts.sum(axis=0)
    share = counts / np.maximum(count, 1.0)
    _, angle_walk = _laws((share * [d.angle for d in told]).sum(axis=0), count)
    white, walk = _laws((share * [d.velocity for d in told]).sum(axis=0), count)
    single = np.average([d.single for d in told], weights=counts[:, 0])
    return Noise(angle_walk, walk, white, float(np.sqrt(single / 6.0)))


def axis_name(v_b: Array) -> str:
    """Body axis nearest to a vector, with its sign: '+X' to '-Z'."""
    k = int(np.argmax(np.abs(v_b)))
    return f"{'+' if v_b[k] > 0 else '-'}{'XYZ'[k]}"


def _join(block: Records, more: Records) -> None:
    """Add to a block, in place, what a later piece has of it."""
    for whole, inside in (("dtheta_b", "angle"), ("dv_b", "velocity")):
        block[inside] += more[inside] + more["samples"] * block[whole]
        block[whole] += more[whole]
    for name in ("samples", "interval_ns"):
        block[name] += more[name]
    block["flags"] |= more["flags"]


class _Found:
    """The work on the blocks of one capture."""

    def __init__(self, blocks: Records, size: int, first: int, end: int, interval_s: float) -> None:
        self.blocks, self.size, self.first, self.end, self.interval_s = blocks, size, first, end, interval_s
        dt = blocks["interval_ns"][:, None] * NS
        self.rate, self.force = blocks["dtheta_b"] / dt, blocks["dv_b"] / dt

    def segments(self) -> Segments:
        rate_floor, force_floor = self._floor(self.rate), self._floor(self.force)
        moving = np.linalg.norm(self.rate, axis=1) > 2.0 * EARTH_RATE + SIGMAS * rate_floor
        moving |= self._holes()
        for begin, stop in _runs(self._joined(moving), False):
            off = self.force[begin:stop] - np.median(self.force[begin:stop], axis=0)
            moving[begin:stop] |= np.linalg.norm(off, axis=1) > LEAST_FORCE + SIGMAS * force_floor
        moving = self._joined(moving)
        rests = {begin: self._rest(begin, stop) for begin, stop in _runs(moving, False)}
        ends = {rest_stop: rests[begin] for begin, rest_stop in _runs(moving, False)}
        rotations = [
            self._rotation(begin, stop, ends.get(begin), rests.get(stop))
            for begin, stop in _runs(moving, True)
        ]
        return Segments(
            self.first,
            self.interval_s,
            (self.end - self.first) * self.interval_s,
            tuple(rests.values()),
            tuple(rotations),
        )

    def _floor(self, x: Array) -> float:
        """Restlessness of the quietest fifth of the seconds."""
        a_second = max(1, round(1.0 / (self.size * self.interval_s)))
        n = len(x) // a_second
        seconds = x[: n * a_second].reshape(n, a_second, 3)
        off = seconds - seconds.mean(axis=1, keepdims=True)
        return float(np.quantile(np.sqrt((off**2).sum(axis=2).mean(axis=1)), 0.2))

    def _holes(self) -> NDArray[np.bool_]:
        """Blocks in or before which too much is missing to call them rest."""
        lost = self.blocks["interval_ns"] * NS < 0.5 * self.size * self.interval_s
        lost[1:] |= np.diff(self.blocks["index"]) > 1
        return np.asarray(lost, np.bool_)

    def _joined(self, moving: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Motion, one block wider on both sides, with the short quiet spells in it."""
        wide = moving.copy()
        wide[1:] |= moving[:-1]
        wide[:-1] |= moving[1:]
        for begin, stop in _runs(wide, False):
            inside = begin > 0 and stop < len(wide)
            if inside and (self._at(stop) - self._at(begin)) * self.interval_s < QUIET_S:
                wide[begin:stop] = True
        return wide

    def _at(self, block: int) -> int:
        """Counter at a block's beginning."""
        if block == len(self.blocks):
            return self.end
        return self.first + int(self.blocks["index"][block]) * self.size

    def _s(self, counter: int) -> float:
        return (counter - self.first) * self.interval_s

    def _missing(self, begin: int, stop: int) -> int:
        """Samples that are missing, but for those that a long interval bridges."""
        there = round(float(self.blocks["interval_ns"][begin:stop].sum()) * NS / self.interval_s)
        return self._at(stop) - self._at(begin) - there

    def _rest(self, begin: int, stop: int) -> Rest:
        part = slice(begin, stop)
        seconds = self.blocks["interval_ns"][part].sum() * NS
        f_b = self.blocks["dv_b"][part].sum(axis=0) / seconds
        start, end = self._at(begin), self._at(stop)
        return Rest(
            start,
            end,
            self._s(start),
            self._s(end),
            up=axis_name(f_b),
            up_b=f_b / np.linalg.norm(f_b),
            f_b=f_b,
            differences=self._differences(part, f_b),
            missing=self._missing(begin, stop),
        )

    def _differences(self, part: slice, f_b: Array) -> Differences | None:
        w = round(BIN_S / (self.size * self.interval_s))
        level = np.arange(3) != int(np.argmax(np.abs(f_b)))
        angle = self._means(part, "dtheta_b", "angle")
        velocity = self._means(part, "dv_b", "velocity")[:, level]
        n = len(angle) // w
        if n * BIN_S < LEAST_NOISE_S:
            return None
        single = np.diff(np.cumsum(self.blocks["dv_b"][part][:, level], axis=0), 2, axis=0)
        angle, velocity = (x[: n * w].reshape(n, w, -1).mean(axis=1) for x in (angle, velocity))
        return Differences(
            np.array([max(0, n - 2 * k) for k in LAGS], np.float64),
            _mean_squares(angle),
            _mean_squares(velocity),
            float((single**2).mean()),
        )

    def _means(self, part: slice, whole: str, inside: str) -> Array:
        """Mean over each block of the sum since the beginning."""
        blocks = self.blocks[part]
        begins = np.cumsum(blocks[whole], axis=0) - blocks[whole]
        return np.asarray(begins + blocks[inside] / blocks["samples"][:, None], np.float64)

    def _rotation(self, begin: int, stop: int, before: Rest | None, after: Rest | None) -> Rotation:
        part = slice(begin, stop)
        dtheta = self.blocks["dtheta_b"][part]
        q = (1.0, 0.0, 0.0, 0.0)  # from the body during the motion to the body before it
        turns = []
        for angle in map(tuple, dtheta.tolist()):
            turns.append(q)  # a fixed axis sees up alike at a block's beginning and in its middle
            q = unit(product(q, quaternion_of_vector(angle)))
        if before is not None:
            up = before.up_b
        elif after is not None:
            up = np.array(turn(q, tuple(after.up_b.tolist())))
        else:
            mean = self.force[part].mean(axis=0)
            up = mean / np.linalg.norm(mean)
        up_b = np.array([turn(conjugate(m), tuple(up.tolist())) for m in turns])
        total = dtheta.sum(axis=0)
        size = float(np.linalg.norm(total)) or 1.0
        start, end = self._at(begin), self._at(stop)
        return Rotation(
            start,
            end,
            self._s(start),
            self._s(end),
            before,
            after,
            angle_deg=float((dtheta * up_b).sum()) / DEG,
            axis=axis_name(up),
            about=axis_name(total)[1],
            axis_tilt_deg=acos(min(1.0, abs(float(total @ up)) / size)) / DEG,
            peak_deg_per_s=float(np.linalg.norm(self.rate[part], axis=1).max()) / DEG,
            missing=self._missing(begin, stop),
            flags=int(np.bitwise_or.reduce(self.blocks["flags"][part])),
        )


def _mean_squares(means: Array) -> Array:
    """Mean square of the second differences over each lag; zero where there are none."""
    second = [means[2 * k :] - 2.0 * means[k:-k] + means[: -2 * k] for k in LAGS if len(means) > 2 * k]
    return np.array([(x**2).mean() for x in second] + [0.0] * (len(LAGS) - len(second)))


def _laws(variance: Array, count: Array) -> tuple[float, float]:
    """White noise and random walk that explain the mean squares of second differences."""
    lags = np.array(LAGS)[count > 0]
    variance, count = variance[count > 0], count[count > 0]
    laws = np.stack([np.full(len(lags), 6.0), (2 * lags - 1) * BIN_S], axis=1)
    expected = variance
    for _ in range(4):
        # over lag L there are 1 / L as many independent differences, each as unsure as it is large
        weight = np.sqrt(count / lags) / np.maximum(expected, 1e-40)
        size = np.linalg.norm(laws * weight[:, None], axis=0)
        parts, _ = nnls(laws * weight[:, None] / size, variance * weight)
        expected = laws @ (parts / size)
    white, walk = np.sqrt(parts / size).tolist()
    return white, walk


def _runs(mask: NDArray[np.bool_], value: bool) -> list[tuple[int, int]]:
    """Begin and stop of the stretches of `mask` that are `value`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[not value], mask, [not value]]) == value))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
