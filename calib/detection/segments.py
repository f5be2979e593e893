"""Detection of rests and rotations in increments.

Increments are summed into blocks of 20 ms in one pass. The noise at rest is that of the quietest fifth of all
seconds, so the blocks are judged after the last one, a part of them at a time: the length of a capture hardly
changes the memory needed.

    motion   rate above twice the Earth's and above the noise, or specific force different from that of the
             rest, or more than half a block missing; includes quiet intervals under a second
    rest     the intervals between motions; one of more than half an hour counts as several of equal length

A turn is slow at both ends and sinks in a noise floor F there: a rate that grows as t^2 passes 4 F at twice
the time at which it passes F, so that the turn began as long before F as it took from F to 4 F.

The angle of a motion is measured about the vertical in body axes (specific force of the rest before,
propagated by the gyros); its axis is that of the sum of its angles. `calib.detection.acceptance` decides
whether a motion is a rotation of the procedure.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import acos
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.axes import axis_name
from calib.detection.blocks import BLOCK_NS, BlockStore, BlockSums
from calib.detection.noise import (
    BIN_S,
    LAGS,
    LEAST_NOISE_S,
    Noise,
    SecondDifferences,
    mean_squares,
    pooled_noise,
)
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.nav.attitude import conjugate, product, quaternion_of_vector, turn, unit
from imudrv.nav.earth import EARTH_RATE
from imudrv.records import INCREMENTS, Records
from imudrv.units import DEG, NS, UG

QUIET_S: Final = 1.0
"""Minimum length of a rest; shorter quiet intervals are merged into the motion, s."""


LONGEST_ONSET_S: Final = 1.0
"""Longest time that a motion is widened by at each end, s."""


SIGMAS: Final = 8.0
"""Deviation of a block from its rest that counts as motion, in multiples of the noise floor."""


LEAST_FORCE: Final = 300.0 * UG
"""Smallest change of specific force that counts as motion, m/s^2."""


BLOCKS_AT_ONCE: Final = 90_000
"""Most blocks that are judged together, and of a rest: half an hour."""


_INTERVALS: Final = 16
"""Samples whose shortest interval is that of the unit: a single one may bridge a gap."""


@dataclass(frozen=True)
class Interval:
    """An interval of a capture.

    Attributes
    ----------
    start, stop : int
        Counter of the first sample, and of the first after the last.
    start_s, stop_s : float
        Time from the beginning of the capture, by the counter.
    missing : int
        Number of missing samples.
    """

    start: int
    stop: int
    start_s: float
    stop_s: float
    missing: int

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return self.stop_s - self.start_s


@dataclass(frozen=True)
class Rest(Interval):
    """An interval at rest.

    Attributes
    ----------
    up : str
        Body axis that points up, '+X' to '-Z'.
    up_b : ndarray, shape (3,)
        Unit vector up, body axes.
    differences : SecondDifferences or None
        For the noise; None: the rest is too short.
    """

    up: str
    up_b: Array
    differences: SecondDifferences | None

    @property
    def noise(self) -> Noise | None:
        """Noise of this rest, or None if it is too short."""
        return pooled_noise([self.differences]) if self.differences else None


@dataclass(frozen=True)
class Rotation(Interval):
    """A motion between two rests; `calib.detection.turns.find_runs` accepts or rejects it.

    Attributes
    ----------
    before, after : Rest or None
        The rests before and after it; None: the capture begins or ends in motion.
    angle_deg : float
        Angle about the vertical, right-handed about up.
    axis : str
        Body axis that was vertical, '+X' to '-Z'.
    about : str
        Body axis nearest to the rotation axis, 'X', 'Y' or 'Z'.
    axis_tilt_deg : float
        Angle between the rotation axis and the vertical, 0 to 90.
    peak_deg_per_s : float
        Largest rate of a block.
    flags : int
        `Flag` bits of any sample.
    """

    before: Rest | None
    after: Rest | None
    angle_deg: float
    axis: str
    about: str
    axis_tilt_deg: float
    peak_deg_per_s: float
    flags: int


@dataclass(frozen=True)
class Segments:
    """Rests and rotations of a capture.

    Attributes
    ----------
    interval_s : float
        Sample interval.
    duration_s : float
        Length of the capture, by the counter.
    rests : tuple of Rest
        All rests, in order.
    rotations : tuple of Rotation
        Every motion, in order.
    """

    interval_s: float
    duration_s: float
    rests: tuple[Rest, ...]
    rotations: tuple[Rotation, ...]


class Segmenter:
    """Detector of rests and motions; the result does not depend on how the increments are divided.

    Parameters
    ----------
    begin_s : float
        Time of the first sample from the beginning of the capture.
    """

    def __init__(self, begin_s: float = 0.0) -> None:
        self._begin_s = begin_s
        self._store = BlockStore()
        self._sums: BlockSums | None = None
        self._waiting = np.zeros(0, INCREMENTS)
        self._first = self._last = 0
        self._nominal_ns = 0

    def feed(self, increments: Records) -> None:
        """Process increments.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order.
        """
        if self._sums is None:
            increments = self._waiting = np.concatenate([self._waiting, increments])
            if len(increments) < _INTERVALS:
                return
            self._nominal_ns = int(increments["interval_ns"][:_INTERVALS].min())
            self._first = int(increments["counter"][0])
            self._sums = BlockSums(self._first, self._samples_a_block)
            self._waiting = np.zeros(0, INCREMENTS)
        if len(increments):
            self._store.append(self._sums.feed(increments))
            self._last = int(increments["counter"][-1])

    @property
    def _samples_a_block(self) -> int:
        return max(1, BLOCK_NS // self._nominal_ns)

    def result(self) -> Segments:
        """Return the rests and motions of all increments.

        Returns
        -------
        Segments

        Raises
        ------
        InputError
            The capture is too short.
        """
        # The noise of the few samples of an incomplete block would look like motion.
        incomplete = self._sums.incomplete if self._sums is not None else None
        count = len(self._store) + (incomplete is not None)
        if count * BLOCK_NS * NS < 2.0 * QUIET_S:
            raise InputError(
                f"segments: expected a capture of at least {2.0 * QUIET_S:g} s, got "
                f"{count * BLOCK_NS * NS:.1f} s"
            )
        size = self._samples_a_block
        end = self._last + 1 if incomplete is None else self._first + incomplete * size
        return _segments(_Blocks(self._store, size, self._first, end, self._nominal_ns * NS, self._begin_s))


def find_segments(pieces: Iterable[Records]) -> Segments:
    """Return the rests and motions of a whole capture.

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
        The capture is too short.
    """
    segmenter = Segmenter()
    for piece in pieces:
        segmenter.feed(piece)
    return segmenter.result()


class _Blocks(NamedTuple):
    """Blocks of a capture and their place on the counter."""

    store: BlockStore
    size: int  # samples per block
    first: int  # counter of the first sample
    end: int  # counter after the last sample
    interval_s: float
    begin_s: float  # time of the first sample

    @property
    def per_second(self) -> int:
        """Blocks per second."""
        return max(1, round(1.0 / (self.size * self.interval_s)))

    def pieces(self, begin: int, stop: int, multiple: int = 1) -> Iterator[Records]:
        """Yield the blocks from `begin` to `stop`, a multiple at a time, of at most `BLOCKS_AT_ONCE`."""
        size = BLOCKS_AT_ONCE // multiple * multiple
        for at in range(begin, stop, size):
            yield self.store.rows(at, min(at + size, stop))

    def interval(self, begin: int, stop: int) -> Interval:
        """Return the interval of the blocks from `begin` to `stop`."""
        first, end = self.counter(begin), self.counter(stop)
        covered_ns = sum(int(rows["interval_ns"].sum()) for rows in self.pieces(begin, stop))
        # A long interval covers samples that were missing.
        missing = end - first - round(float(covered_ns) * NS / self.interval_s)
        return Interval(first, end, self.seconds(begin), self.seconds(stop), missing)

    def counter(self, block: int) -> int:
        """Return the counter at a block's beginning."""
        if block == len(self.store):
            return self.end
        return self.first + int(self.store.rows(block, block + 1)["index"][0]) * self.size

    def seconds(self, block: int) -> float:
        """Return the time at a block's beginning, s."""
        return self.begin_s + (self.counter(block) - self.first) * self.interval_s


def _segments(blocks: _Blocks) -> Segments:
    """Divide a capture into rests and rotations."""
    moving = _moving_mask(blocks)
    still = _still(moving)
    rests = [_rest(blocks, begin, stop) for begin, stop in still]
    before = {stop: rest for (_, stop), rest in zip(still, rests, strict=True)}
    after = {begin: rest for (begin, _), rest in zip(still, rests, strict=True)}
    return Segments(
        blocks.interval_s,
        (blocks.end - blocks.first) * blocks.interval_s,
        tuple(rests),
        tuple(
            _rotation(blocks, begin, stop, before.get(begin), after.get(stop))
            for begin, stop in _runs(moving, True)
        ),
    )


def _still(moving: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return begin and stop of the rests, the long ones in equal parts."""
    parts = []
    for begin, stop in _runs(moving, False):
        count = -(-(stop - begin) // BLOCKS_AT_ONCE)
        edges = [begin + k * (stop - begin) // count for k in range(count + 1)]
        parts += list(pairwise(edges))
    return parts


def _moving_mask(blocks: _Blocks) -> NDArray[np.bool_]:
    """Return which blocks are in motion."""
    rate_noise, force_noise = _noise_floors(blocks)
    floor = 2.0 * EARTH_RATE + SIGMAS * rate_noise
    masks, fast, index = [], [], 0
    for rows in blocks.pieces(0, len(blocks.store)):
        rate = np.linalg.norm(rows["dtheta_b"] / (rows["interval_ns"][:, None] * NS), axis=1)
        fast.append(rate > 4.0 * floor)
        mask = rate > floor
        mask |= rows["interval_ns"] * NS < 0.5 * blocks.size * blocks.interval_s
        mask |= np.diff(rows["index"], prepend=index) > 1  # whole blocks are missing
        masks.append(mask)
        index = rows["index"][-1]
    moving = np.concatenate(masks)
    for begin, stop in _still(_merged(moving, blocks)):
        rows = blocks.store.rows(begin, stop)
        force = rows["dv_b"] / (rows["interval_ns"][:, None] * NS)
        change = force - np.median(force, axis=0)
        moving[begin:stop] |= np.linalg.norm(change, axis=1) > LEAST_FORCE + SIGMAS * force_noise
    return _with_slow_ends(_merged(moving, blocks), np.concatenate(fast), blocks.per_second)


def _noise_floors(blocks: _Blocks) -> tuple[float, float]:
    """Return the rms of rate and force about the mean of a second, of the quietest fifth of all seconds."""
    per_second = blocks.per_second
    rates, forces = [], []
    for rows in blocks.pieces(0, len(blocks.store), per_second):
        dt = rows["interval_ns"][:, None] * NS
        rates.append(_rms_of_seconds(rows["dtheta_b"] / dt, per_second))
        forces.append(_rms_of_seconds(rows["dv_b"] / dt, per_second))
    rate, force = (float(np.quantile(np.concatenate(rms), 0.2)) for rms in (rates, forces))
    return rate, force


def _rms_of_seconds(x: Array, per_second: int) -> Array:
    n = len(x) // per_second
    seconds = x[: n * per_second].reshape(n, per_second, 3)
    deviation = seconds - seconds.mean(axis=1, keepdims=True)
    return np.asarray(np.sqrt((deviation**2).sum(axis=2).mean(axis=1)), np.float64)


def _merged(moving: NDArray[np.bool_], blocks: _Blocks) -> NDArray[np.bool_]:
    """Widen each motion by one block on both sides and include the short quiet intervals in it."""
    wide = moving.copy()
    wide[1:] |= moving[:-1]
    wide[:-1] |= moving[1:]
    for begin, stop in _runs(wide, False):
        inside = begin > 0 and stop < len(wide)
        if inside and (blocks.counter(stop) - blocks.counter(begin)) * blocks.interval_s < QUIET_S:
            wide[begin:stop] = True
    return wide


def _with_slow_ends(merged: NDArray[np.bool_], fast: NDArray[np.bool_], per_second: int) -> NDArray[np.bool_]:
    """Widen each motion by what sinks in the noise floor at its ends; `fast` is four times above it."""
    whole, longest = merged.copy(), round(LONGEST_ONSET_S * per_second)
    for begin, stop in _runs(merged, True):
        at = begin + np.flatnonzero(fast[begin:stop])
        if len(at):
            # the motion has been widened by one block on both sides
            early, late = (min(int(n) - 2, longest) for n in (at[0] - begin, stop - 1 - at[-1]))
            whole[max(0, begin - max(0, early)) : stop + max(0, late)] = True
    return whole


def _rest(blocks: _Blocks, begin: int, stop: int) -> Rest:
    rows = blocks.store.rows(begin, stop)
    f_b = rows["dv_b"].sum(axis=0) / (rows["interval_ns"].sum() * NS)
    return Rest(
        **vars(blocks.interval(begin, stop)),
        up=axis_name(f_b),
        up_b=f_b / np.linalg.norm(f_b),
        differences=_second_differences(rows, round(BIN_S / (blocks.size * blocks.interval_s)), f_b),
    )


def _second_differences(rows: Records, per_bin: int, f_b: Array) -> SecondDifferences | None:
    """Return the second differences of a rest, or None if it is too short."""
    n = len(rows) // per_bin
    if n * BIN_S < LEAST_NOISE_S:
        return None
    level = np.arange(3) != int(np.argmax(np.abs(f_b)))
    angle = _block_means(rows, "dtheta_b", "angle")
    velocity = _block_means(rows, "dv_b", "velocity")[:, level]
    single = np.diff(np.cumsum(rows["dv_b"][:, level], axis=0), 2, axis=0)
    angle, velocity = (x[: n * per_bin].reshape(n, per_bin, -1).mean(axis=1) for x in (angle, velocity))
    return SecondDifferences(
        np.array([max(0, n - 2 * k) for k in LAGS], np.float64),
        mean_squares(angle),
        mean_squares(velocity),
        float((single**2).mean()),
    )


def _block_means(rows: Records, whole: str, inside: str) -> Array:
    """Return the mean over each block of the sum since the beginning."""
    begins = np.cumsum(rows[whole], axis=0) - rows[whole]
    return np.asarray(begins + rows[inside] / rows["samples"][:, None], np.float64)


def _rotation(blocks: _Blocks, begin: int, stop: int, before: Rest | None, after: Rest | None) -> Rotation:
    up = _up_before(blocks, begin, stop, before, after)
    q = _NO_ROTATION  # from the body during the motion to the body before it
    angle, peak, total, flags = 0.0, 0.0, np.zeros(3), 0
    for rows in blocks.pieces(begin, stop):
        dtheta = rows["dtheta_b"]
        attitudes = []
        for turned in map(tuple, dtheta.tolist()):
            attitudes.append(q)  # for a fixed axis, up_b is the same at a block's beginning and in its middle
            q = unit(product(q, quaternion_of_vector(turned)))
        up_b = np.array([turn(conjugate(attitude), tuple(up.tolist())) for attitude in attitudes])
        angle += float((dtheta * up_b).sum())
        total += dtheta.sum(axis=0)
        rate = dtheta / (rows["interval_ns"][:, None] * NS)
        peak = max(peak, float(np.linalg.norm(rate, axis=1).max()))
        flags |= int(np.bitwise_or.reduce(rows["flags"]))
    size = float(np.linalg.norm(total)) or 1.0
    return Rotation(
        **vars(blocks.interval(begin, stop)),
        before=before,
        after=after,
        angle_deg=angle / DEG,
        axis=axis_name(up),
        about=axis_name(total)[1],
        axis_tilt_deg=acos(min(1.0, abs(float(total @ up)) / size)) / DEG,
        peak_deg_per_s=peak / DEG,
        flags=flags,
    )


_NO_ROTATION: Final = (1.0, 0.0, 0.0, 0.0)


def _up_before(blocks: _Blocks, begin: int, stop: int, before: Rest | None, after: Rest | None) -> Array:
    """Return the unit vector up at the beginning of a motion, body axes."""
    if before is not None:
        return before.up_b
    if after is not None:
        q = _NO_ROTATION
        for rows in blocks.pieces(begin, stop):
            for turned in map(tuple, rows["dtheta_b"].tolist()):
                q = unit(product(q, quaternion_of_vector(turned)))
        return np.array(turn(q, tuple(after.up_b.tolist())))
    force = np.zeros(3)
    for rows in blocks.pieces(begin, stop):
        force += (rows["dv_b"] / (rows["interval_ns"][:, None] * NS)).sum(axis=0)
    mean = force / (stop - begin)
    return np.asarray(mean / np.linalg.norm(mean), np.float64)


def _runs(mask: NDArray[np.bool_], value: bool) -> list[tuple[int, int]]:
    """Return begin and stop of the intervals in which `mask` is `value`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[not value], mask, [not value]]) == value))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
