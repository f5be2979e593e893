"""Online detection of rest, tilt, heading and rotation, in blocks of 20 ms.

Blocks are aligned with the counter and do not depend on how the samples are divided. The criterion of motion
is that of `calib.detection.segments`, which evaluates the whole capture afterwards.
"""

from collections import deque
from math import acos, atan2, hypot, pi
from typing import Final

import numpy as np

from calib.axes import axis_name
from calib.detection.blocks import BLOCK_NS, Block
from calib.messages import Message, message
from imudrv.arrays import Array
from imudrv.nav.attitude import (
    Quaternion,
    conjugate,
    product,
    quaternion_of_matrix,
    quaternion_of_vector,
    rows_of,
    turn,
    unit,
)
from imudrv.nav.earth import earth_rate_n
from imudrv.units import DEG, DEG_PER_H, NS, STANDARD_GRAVITY
from imudrv.vectors import Vector, add, cross, dot, scale, subtract

SMOOTH_S: Final = 0.2
"""Time constant of the smoothed gravity while the unit is carried, s."""


LEAST_HORIZONTAL_RATE: Final = 3.0 * DEG_PER_H
"""Smallest horizontal rate at rest that shows a heading, rad/s: more than the bias of a new gyro."""


MG: Final = 1e-3 * STANDARD_GRAVITY
"""One milli-g, m/s^2."""


class StillnessDetector:
    """Online detector of rest, with the criterion of `calib.detection.segments`."""

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
        """Set the largest rate, rad/s, and change of specific force, m/s^2, of a rest."""
        self._rate_limit, self._force_limit = rate, force

    def feed(self, block: Block) -> None:
        """Process a block."""
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
        """Stillness over the last half second, 0 (motion) to 1 (rest)."""
        return 1.0 - min(1.0, max(0.0, max(self._recent) - 1.0) / 9.0)

    @property
    def why(self) -> Message:
        """Description of the latest motion, with value and limit."""
        if self._over >= self._off:
            limit = self._rate_limit / DEG
            return message("rate", rate_deg_per_s=self._over * limit, limit_deg_per_s=limit)
        limit = self._force_limit / MG
        return message("force", off_mg=self._off * limit, limit_mg=limit)


class RestAverages:
    """Mean rate and specific force of a rest, and their noise."""

    def __init__(self) -> None:
        self.flags = 0
        self._rows: list[tuple[float, ...]] = []

    def feed(self, block: Block) -> None:
        """Process a block."""
        self.flags |= block.flags
        self._rows.append((*scale(1.0 / block.seconds, block.dtheta), *block.force))

    @property
    def rate(self) -> Array:
        """Mean rate, rad/s, shape (3,)."""
        mean: Array = np.mean(self._rows, axis=0)[:3]
        return mean

    @property
    def force(self) -> Array:
        """Mean specific force, m/s^2, shape (3,)."""
        mean: Array = np.mean(self._rows, axis=0)[3:]
        return mean

    def forget(self, rate_limit: float, force_limit: float) -> int:
        """Drop everything up to the last block over a limit; return the number of blocks kept."""
        rows = np.array(self._rows).reshape(-1, 2, 3)
        rate, off = rows[:, 0], rows[:, 1] - np.median(rows[:, 1], axis=0)
        moving = (np.linalg.norm(rate, axis=1) > rate_limit) | (np.linalg.norm(off, axis=1) > force_limit)
        if moving.any():
            self._rows = self._rows[int(np.flatnonzero(moving)[-1]) + 1 :]
        return len(self._rows)

    def noise(self) -> tuple[float, float]:
        """Return the rms of rate, rad/s, and specific force, m/s^2, in the quietest fifth of the seconds."""
        a_second = round(1.0 / (BLOCK_NS * NS))
        n = len(self._rows) // a_second
        seconds = np.array(self._rows[: n * a_second]).reshape(n, a_second, 2, 3)
        square = ((seconds - seconds.mean(axis=1, keepdims=True)) ** 2).sum(axis=3).mean(axis=1)
        rate, force = np.sqrt(np.quantile(square, 0.2, axis=0)).tolist()
        return rate, force


class AttitudeTracker:
    """Gravity in body axes and, after an alignment, the attitude propagated by the gyros.

    Parameters
    ----------
    latitude_rad : float
        Geodetic latitude.
    """

    def __init__(self, latitude_rad: float) -> None:
        self.force: Vector | None = None  # smoothed, m/s^2
        self.q_nb: Quaternion | None = None
        self._earth_n = earth_rate_n(latitude_rad)

    def feed(self, block: Block) -> None:
        """Process a block."""
        share = min(1.0, block.seconds / SMOOTH_S)
        before = self.force or block.force
        self.force = add(before, scale(share, subtract(block.force, before)))
        if block.hole or block.restarted:
            self.q_nb = None
        elif self.q_nb is not None:
            earth = quaternion_of_vector(scale(-block.seconds, self._earth_n))
            self.q_nb = unit(product(earth, product(self.q_nb, quaternion_of_vector(block.dtheta))))

    def align(self, rate: Array, force: Array) -> None:
        """Set the attitude from the mean rate, rad/s, and force, m/s^2, of a rest.

        The rate is that of the Earth but for the biases of the gyros; where it has no horizontal part to
        speak of, there is no heading.
        """
        up = force / np.linalg.norm(force)
        east = np.cross(rate, up)
        if (size := float(np.linalg.norm(east))) < LEAST_HORIZONTAL_RATE:
            self.q_nb = None
            return
        C_nb = np.stack([east / size, np.cross(up, east / size), up])
        w, x, y, z = quaternion_of_matrix(C_nb).tolist()
        self.q_nb = w, x, y, z

    def turned_from(self, before: Quaternion | None) -> float | None:
        """Return the angle from an earlier attitude, rad; None: one of them is not known."""
        if before is None or self.q_nb is None:
            return None
        return 2.0 * acos(min(1.0, abs(product(conjugate(before), self.q_nb)[0])))

    @property
    def up(self) -> str:
        """Body axis that is up, '+X' to '-Z'."""
        return axis_name(np.array(self.force or (0.0, 0.0, 1.0)))

    def lean(self, axis_b: Array) -> float:
        """Return the angle between an axis and the vertical, rad."""
        if self.force is None:
            return pi
        return acos(max(-1.0, min(1.0, dot(self.force, _vector(axis_b)) / hypot(*self.force))))

    def C_nb(self, east_b: Array) -> tuple[Vector, Vector, Vector] | None:
        """Return the attitude; before an alignment, with an axis about east. None: unknown."""
        if self.q_nb is not None:
            return rows_of(self.q_nb)
        if self.force is None or not (size := hypot(*self.force)):
            return None
        up = scale(1.0 / size, self.force)
        level = cross(cross(up, _vector(east_b)), up)
        if hypot(*level) < 0.1:  # the axis is nearly vertical
            level = cross(up, (up[2], up[0], up[1]))
        east = scale(1.0 / hypot(*level), level)
        return east, cross(up, east), up

    def azimuth(self, axis_b: Array) -> float | None:
        """Return the azimuth of an axis, from north to east, rad, -pi to pi; None: unknown."""
        if self.q_nb is None:
            return None
        east, north, _ = turn(self.q_nb, _vector(axis_b))
        return atan2(east, north)


def _vector(v: Array) -> Vector:
    x, y, z = v.tolist()
    return x, y, z


class RotationTracker:
    """Angle, rate and axis of a rotation in progress."""

    def __init__(self, up_b: Vector = (0.0, 0.0, 1.0)) -> None:
        self.begun: int | None = None  # counter
        self.angle = 0.0  # about the vertical, rad
        self.rate = 0.0  # about the vertical, rad/s
        self.peak = 0.0  # rad/s
        self._total = (0.0, 0.0, 0.0)
        self._up_before = self.up_b = up_b

    def feed(self, block: Block) -> None:
        """Process a block."""
        if self.begun is None:
            self.begun = block.last
        about_up = dot(block.dtheta, self.up_b)
        self.angle += about_up
        self.rate = about_up / block.seconds
        self.peak = max(self.peak, hypot(*block.dtheta) / block.seconds)
        self._total = add(self._total, block.dtheta)
        self.up_b = turn(conjugate(quaternion_of_vector(block.dtheta)), self.up_b)

    @property
    def size(self) -> float:
        """Total angle, rad."""
        return hypot(*self._total)

    @property
    def axis_tilt(self) -> float:
        """Angle between the axis and the vertical, rad."""
        return acos(min(1.0, abs(dot(self._total, self._up_before)) / self.size))

    @property
    def about(self) -> str:
        """Body axis nearest to the rotation axis, 'X', 'Y' or 'Z'."""
        return axis_name(np.array(self._total))[1]
