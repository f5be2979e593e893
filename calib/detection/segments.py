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
from math import acos
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.axes import axis_name
from calib.detection.blocks import BLOCK, BLOCK_NS, join_blocks
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
from imudrv.records import Records
from imudrv.units import DEG, NS, UG

QUIET_S: Final = 1.0
"""A shorter quiet spell belongs to the motion around it, s."""


SIGMAS: Final = 8.0
"""A block so many noise floors off its rest is motion."""


LEAST_FORCE: Final = 300.0 * UG
"""A change of specific force below this is not motion, m/s^2."""


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
    differences: SecondDifferences | None
    missing: int

    @property
    def noise(self) -> Noise | None:
        """Noise in this rest; None: too short to tell."""
        return pooled_noise([self.differences]) if self.differences else None

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
        blocks = np.zeros(len(starts), BLOCK)
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
            join_blocks(self._blocks[-1][-1:], blocks[:1])
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
        blocks = np.concatenate(self._blocks) if self._blocks else np.zeros(0, BLOCK)
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

    def _differences(self, part: slice, f_b: Array) -> SecondDifferences | None:
        w = round(BIN_S / (self.size * self.interval_s))
        level = np.arange(3) != int(np.argmax(np.abs(f_b)))
        angle = self._means(part, "dtheta_b", "angle")
        velocity = self._means(part, "dv_b", "velocity")[:, level]
        n = len(angle) // w
        if n * BIN_S < LEAST_NOISE_S:
            return None
        single = np.diff(np.cumsum(self.blocks["dv_b"][part][:, level], axis=0), 2, axis=0)
        angle, velocity = (x[: n * w].reshape(n, w, -1).mean(axis=1) for x in (angle, velocity))
        return SecondDifferences(
            np.array([max(0, n - 2 * k) for k in LAGS], np.float64),
            mean_squares(angle),
            mean_squares(velocity),
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


def _runs(mask: NDArray[np.bool_], value: bool) -> list[tuple[int, int]]:
    """Begin and stop of the stretches of `mask` that are `value`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[not value], mask, [not value]]) == value))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
