"""What samples tell about motion as they come: rest, gravity, attitude, a turn; in blocks of 20 ms.

The counter bounds the blocks, so that any cut into pieces gives the same ones. What counts as motion is the
rule of `calib.segments`, which judges the whole afterwards.
"""

from collections import deque
from math import acos, atan2, hypot, pi
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.segments import BLOCK_NS, axis_name
from imudrv.nav.attitude import Quaternion, conjugate, product, quaternion_of_vector, turn, unit
from imudrv.nav.earth import earth_rate_n
from imudrv.records import Records
from imudrv.units import DEG, NS, STANDARD_GRAVITY
from imudrv.vectors import Vector, add, dot, scale, subtract

Array = NDArray[np.float64]

SMOOTH_S: Final = 0.2
"""Gravity is smoothed over so long while the unit is carried, s."""
MG: Final = 1e-3 * STANDARD_GRAVITY
"""One milli-g, m/s^2."""


class Block(NamedTuple):
    """20 ms of samples."""

    rows: Records
    last: int  # counter of the last sample
    seconds: float  # that the samples cover
    dtheta: Vector  # rad, body axes
    force: Vector  # mean, m/s^2
    flags: int  # of any sample
    missing: int  # samples since the block before's last that are not there
    hole: bool  # too much is missing to tell rest from motion
    restarted: bool  # the counter began anew


class Cutter:
    """Cuts samples into blocks that the counter bounds, however they come in."""

    def __init__(self, interval_ns: int) -> None:
        self._size = max(1, BLOCK_NS // interval_ns)
        self._waiting: list[Records] = []
        self._newest: int | None = None  # counter of the newest sample
        self._restarts = 0
        self._began(0)

    def _began(self, counter: int) -> None:
        """The counter begins here."""
        self._origin = counter
        self._index, self._last = -1, counter - 1  # of the newest block handed on
        self._waiting.clear()

    def feed(self, increments: Records) -> list[Block]:
        """Take samples and give the blocks that are complete."""
        if not len(increments):
            return []
        counter = increments["counter"]
        if self._newest is None:
            self._newest = int(counter[0]) - 1
            self._began(int(counter[0]))
        back = np.flatnonzero(np.diff(counter, prepend=self._newest) <= 0)
        self._newest = int(counter[-1])
        if not len(back):
            return self._more(increments)
        blocks = []
        for k, piece in enumerate(np.split(increments, back)):
            if k:
                self._began(int(piece["counter"][0]))
                self._restarts += 1
            if len(piece):
                blocks += self._more(piece)
        return blocks

    def _more(self, rows: Records) -> list[Block]:
        self._waiting.append(rows)
        newest = int(rows["counter"][-1])
        first = (int(self._waiting[0]["counter"][0]) - self._origin) // self._size
        if newest < self._end(first):
            return []
        rows = np.concatenate(self._waiting) if len(self._waiting) > 1 else rows
        self._waiting.clear()
        index = (rows["counter"] - self._origin) // self._size
        if newest < self._end(int(index[-1])):
            whole = int(np.searchsorted(index, index[-1]))
            self._waiting.append(rows[whole:])
            rows, index = rows[:whole], index[:whole]
        return self._blocks(rows, index)

    def _end(self, index: int) -> int:
        """Counter of a block's last sample."""
        return self._origin + (index + 1) * self._size - 1

    def _blocks(self, rows: Records, index: NDArray[np.int64]) -> list[Block]:
        starts = np.concatenate([[0], np.flatnonzero(np.diff(index)) + 1])
        stops = np.append(starts[1:], len(rows))
        index, last = index[starts], rows["counter"][stops - 1]
        interval_ns = np.add.reduceat(rows["interval_ns"], starts)
        missing = np.diff(last, prepend=self._last) - (stops - starts)
        hole = (2 * missing >= self._size) | (np.diff(index, prepend=self._index) > 1)
        seconds = interval_ns * NS
        dtheta = np.add.reduceat(rows["dtheta_b"], starts)
        force = np.add.reduceat(rows["dv_b"], starts) / seconds[:, None]
        flags = np.bitwise_or.reduceat(rows["flags"], starts)
        restarted = self._index < 0 < self._restarts
        self._index, self._last = int(index[-1]), int(last[-1])
        columns = (a.tolist() for a in (starts, stops, last, seconds, dtheta, force, flags, missing, hole))
        return [
            Block(rows[a:b], at, s, tuple(w), tuple(f), bits, lost, empty, restarted and not a)
            for a, b, at, s, w, f, bits, lost, empty in zip(*columns, strict=True)
        ]


class Stillness:
    """Whether the unit stands still, by the rule of `calib.segments`, as the samples come."""

    def __init__(self, rate_limit: float, force_limit: float) -> None:
        self.moving = False
        self.quiet_s = 0.0  # since the last motion
        self.rate = 0.0  # rad/s
        self._recent: deque[float] = deque([10.0], maxlen=round(0.5 / (BLOCK_NS * NS)))
        self._over = 0.0
        self._off = 0.0
        self._force = (0.0, 0.0, 0.0)  # sum since the last motion
        self._blocks = 0
        self.limit(rate_limit, force_limit)

    def limit(self, rate: float, force: float) -> None:
        """What counts as motion: a rate of more, rad/s, or a change of specific force, m/s^2."""
        self._rate_limit, self._force_limit = rate, force

    def feed(self, block: Block) -> None:
        """Take a block."""
        self.rate = hypot(*block.dtheta) / block.seconds
        over, off = self.rate / self._rate_limit, 0.0
        if self._blocks:
            off = hypot(*subtract(block.force, scale(1.0 / self._blocks, self._force))) / self._force_limit
        lost = block.hole or block.restarted
        self._recent.append(10.0 if lost else max(over, off))
        self.moving = lost or max(over, off) > 1.0
        if self.moving:
            self._over, self._off = over, off
            self.quiet_s, self._blocks, self._force = 0.0, 0, (0.0, 0.0, 0.0)
        else:
            self.quiet_s += block.seconds
            self._blocks += 1
            self._force = add(self._force, block.force)

    @property
    def stillness(self) -> float:
        """As in `View`."""
        return 1.0 - min(1.0, max(0.0, max(self._recent) - 1.0) / 9.0)

    @property
    def why(self) -> str:
        """Latest motion, with its number and limit."""
        if self._over >= self._off:
            return f"{self._over * self._rate_limit / DEG:.2f} deg/s, limit {self._rate_limit / DEG:.2f}"
        mg = self._force_limit / MG
        return f"specific force {self._off * mg:.1f} mg off its mean, limit {mg:.1f}"


class Means:
    """Mean readings of a rest, and their noise."""

    def __init__(self) -> None:
        self.flags = 0
        self._rows: list[tuple[float, ...]] = []

    def feed(self, block: Block) -> None:
        """Take a block."""
        self.flags |= block.flags
        self._rows.append((*scale(1.0 / block.seconds, block.dtheta), *block.force))

    @property
    def rate(self) -> Array:
        """Rad/s, shape (3,)."""
        mean: Array = np.mean(self._rows, axis=0)[:3]
        return mean

    @property
    def force(self) -> Array:
        """m/s^2, shape (3,)."""
        mean: Array = np.mean(self._rows, axis=0)[3:]
        return mean

    def forget(self, rate_limit: float, force_limit: float) -> int:
        """Leave out all up to the last motion, which has a rate or a change of force of more; blocks kept."""
        rows = np.array(self._rows).reshape(-1, 2, 3)
        rate, off = rows[:, 0], rows[:, 1] - np.median(rows[:, 1], axis=0)
        moving = (np.linalg.norm(rate, axis=1) > rate_limit) | (np.linalg.norm(off, axis=1) > force_limit)
        if moving.any():
            self._rows = self._rows[int(np.flatnonzero(moving)[-1]) + 1 :]
        return len(self._rows)

    def noise(self) -> tuple[float, float]:
        """Rms of rate, rad/s, and specific force, m/s^2, in the quietest fifth of the seconds."""
        a_second = round(1.0 / (BLOCK_NS * NS))
        n = len(self._rows) // a_second
        seconds = np.array(self._rows[: n * a_second]).reshape(n, a_second, 2, 3)
        square = ((seconds - seconds.mean(axis=1, keepdims=True)) ** 2).sum(axis=3).mean(axis=1)
        rate, force = np.sqrt(np.quantile(square, 0.2, axis=0)).tolist()
        return rate, force


class Posture:
    """How the unit lies: gravity, and once an alignment has told it, attitude, carried on by the gyros.

    Parameters
    ----------
    latitude_rad : float
        Of the place.
    """

    def __init__(self, latitude_rad: float) -> None:
        self.force: Vector | None = None  # smoothed, m/s^2
        self.q_nb: Quaternion | None = None
        self._earth_n = earth_rate_n(latitude_rad)

    def feed(self, block: Block) -> None:
        """Take a block."""
        share = min(1.0, block.seconds / SMOOTH_S)
        before = self.force or block.force
        self.force = add(before, scale(share, subtract(block.force, before)))
        if block.hole or block.restarted:
            self.q_nb = None
        elif self.q_nb is not None:
            earth = quaternion_of_vector(scale(-block.seconds, self._earth_n))
            self.q_nb = unit(product(earth, product(self.q_nb, quaternion_of_vector(block.dtheta))))

    @property
    def up(self) -> str:
        """Body axis that is up, '+X' to '-Z'."""
        return axis_name(np.array(self.force or (0.0, 0.0, 1.0)))

    def lean(self, axis_b: Array) -> float:
        """Angle between an axis and the vertical, rad."""
        if self.force is None:
            return pi
        return acos(max(-1.0, min(1.0, dot(self.force, _vector(axis_b)) / hypot(*self.force))))

    def azimuth(self, axis_b: Array) -> float | None:
        """Direction of an axis, from north to east, rad, -pi to pi; None: not known."""
        if self.q_nb is None:
            return None
        east, north, _ = turn(self.q_nb, _vector(axis_b))
        return atan2(east, north)


def _vector(v: Array) -> Vector:
    x, y, z = v.tolist()
    return x, y, z


class Turn:
    """A turn as it happens."""

    def __init__(self, up_b: Vector = (0.0, 0.0, 1.0)) -> None:
        self.begun: int | None = None  # counter
        self.angle = 0.0  # about the vertical, rad
        self.rate = 0.0  # about the vertical, rad/s
        self.peak = 0.0  # rad/s
        self._total = (0.0, 0.0, 0.0)
        self._up_before = self._up = up_b

    def feed(self, block: Block) -> None:
        """Take a block."""
        if self.begun is None:
            self.begun = block.last
        about_up = dot(block.dtheta, self._up)
        self.angle += about_up
        self.rate = about_up / block.seconds
        self.peak = max(self.peak, hypot(*block.dtheta) / block.seconds)
        self._total = add(self._total, block.dtheta)
        self._up = turn(conjugate(quaternion_of_vector(block.dtheta)), self._up)

    @property
    def size(self) -> float:
        """Of the whole turn, rad."""
        return hypot(*self._total)

    @property
    def axis_tilt(self) -> float:
        """Of its axis from the vertical, rad."""
        return acos(min(1.0, abs(dot(self._total, self._up_before)) / self.size))

    @property
    def about(self) -> str:
        """Body axis nearest to its axis, 'X', 'Y' or 'Z'."""
        return axis_name(np.array(self._total))[1]
