"""Stretches of samples at rest without a gap, found while the samples come in.

Samples are averaged over blocks of 0.1 s. A block is in motion if its mean rate differs from that of the last
block at rest and from the mean of the last seconds at rest, or its mean specific force from that of the block
before, by more than the unit's own noise allows; a second before and after a motion is left out, too. The
noise is that of the quietest fifth of the first 20 s. A missing, saturated or faulty sample also ends a
stretch.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.noise.pyramid import BREAK, KEEP, SKIP
from imudrv.arrays import Array
from imudrv.kernels import kernel
from imudrv.nav.earth import EARTH_RATE
from imudrv.records import Flag, Records
from imudrv.units import NS, UG

BLOCK_S: Final = 0.1
GUARD_S: Final = 1.0
"""Margin on both sides of a motion: a bench swings on."""
FIRST_S: Final = 20.0
"""Beginning of the data that shows how quiet the unit is."""
QUIET: Final = 0.2
"""Part of that beginning that is at rest at least."""
SIGMAS: Final = 8.0
"""Change of a block that is motion, in multiples of the noise."""
LEAST_RATE: Final = 2.0 * EARTH_RATE
"""Smallest change of rate that is motion, rad/s: another attitude may change it by as much."""
LEAST_FORCE: Final = 300.0 * UG
"""Smallest change of specific force that is motion, m/s^2."""
FORGET: Final = 0.05
"""Share of a block in the mean rate at rest: two seconds. The last block may be the beginning of a motion."""
MOST_NAMED: Final = 50
"""Most disturbances that are named; the others are counted."""

_UNUSABLE: Final = int(Flag.SATURATED | Flag.FAULT | Flag.WARM_UP | Flag.LONG_INTERVAL)
_AT_REST, _MOTION, _FLAGGED, _MISSING = range(4)
_NAMES: Final = ("", "motion", "flagged samples", "missing samples")


class Disturbance(NamedTuple):
    """Where samples are missing, not usable or not at rest, s from the beginning of the capture."""

    what: str
    begin_s: float
    end_s: float


_SAMPLE: Final = np.dtype(
    [
        ("values", np.float64, 6),  # gyros, rad, and accelerometers, m/s
        ("interval_s", np.float64),
        ("end_s", np.float64),
        ("flags", np.uint32),
    ]
)


class StretchSplitter:
    """Finds the stretches at rest; the result does not depend on how the samples are divided.

    Parameters
    ----------
    interval_s : float
        Sample interval.
    scales : ndarray, shape (6,)
        Value of a count of each gyro, rad, and of each accelerometer, m/s.
    resolution : ndarray, shape (6,)
        Smallest change of an increment, rad and m/s.

    Attributes
    ----------
    disturbances : list of Disturbance
        The first `MOST_NAMED`.
    disturbed : int
        Number of all.
    """

    def __init__(self, interval_s: float, scales: Array, resolution: Array) -> None:
        self._scales = scales
        self._size = max(1, round(BLOCK_S / interval_s))
        block_s = self._size * interval_s
        self._resolution = _norms(resolution / block_s)
        self._first = round(FIRST_S / block_s)
        self._guard = max(1, round(GUARD_S / block_s))
        self._pending = np.zeros(0, _SAMPLE)  # their neighbours are not known yet
        # Whether each block moves: those that are pending, and a guard before them.
        self._moving: NDArray[np.bool_] = np.zeros(self._guard, np.bool_)
        self._limits = np.zeros(0)
        self._reference = np.zeros(9)
        self.disturbances: list[Disturbance] = []
        self.disturbed = 0

    def feed(self, samples: Records) -> tuple[Array, NDArray[np.int8]]:
        """Process samples.

        Parameters
        ----------
        samples : ndarray of `imudrv.records.samples_type`
            In order.

        Returns
        -------
        values : ndarray, shape (n, 6)
            Increments on the sensing axes, rad and m/s, of samples that came before or now.
        actions : ndarray of int8, shape (n,)
            What `Pyramid.feed` has to do with each.
        """
        counts = np.concatenate([samples["gyro"], samples["accelerometer"]], axis=1)
        new = np.zeros(len(samples), _SAMPLE)
        new["values"], new["flags"] = counts * self._scales, samples["flags"]
        new["interval_s"], new["end_s"] = samples["interval_ns"] * NS, samples["elapsed_ns"] * NS
        self._pending = np.concatenate([self._pending, new])
        if not len(self._limits) and len(self._pending) < self._first * self._size:
            return _NOTHING
        self._judge()
        return self._ready(len(self._moving) - 2 * self._guard)

    def close(self) -> tuple[Array, NDArray[np.int8]]:
        """End the capture and return the rest, see `feed`; an incomplete block is left out."""
        self._judge()
        judged = len(self._moving) - self._guard
        self._moving = np.append(self._moving, np.zeros(self._guard, np.bool_))
        return self._ready(judged)

    def _judge(self) -> None:
        """Find which of the complete blocks that came since are in motion."""
        judged = len(self._moving) - self._guard
        new = self._pending[judged * self._size :]
        n = len(new) // self._size
        if n <= 0:
            return
        new = new[: n * self._size].reshape(n, self._size)
        means = new["values"].sum(axis=1) / new["interval_s"].sum(axis=1)[:, None]
        if not len(self._limits):
            self._begin(means[: self._first])
        moving = np.zeros(n, np.bool_)
        _find_motion(means, self._limits, self._reference, moving)
        self._moving = np.append(self._moving, moving)

    def _begin(self, means: Array) -> None:
        """Set the limits, and the block at rest that the first ones are compared with."""
        changes = _norms(np.diff(means, axis=0)) if len(means) > 1 else np.zeros((1, 2))
        noise = np.maximum(np.quantile(changes, QUIET, axis=0), self._resolution)
        self._limits = np.array([LEAST_RATE, LEAST_FORCE]) + SIGMAS * noise
        self._reference[:6] = np.median(means, axis=0)
        self._reference[6:] = self._reference[:3]

    def _ready(self, blocks: int) -> tuple[Array, NDArray[np.int8]]:
        """Return the samples of the first pending blocks."""
        if blocks <= 0:
            return _NOTHING
        near = np.concatenate([[0], np.cumsum(self._moving)])
        wide = 2 * self._guard + 1
        moving = near[wide : blocks + wide] > near[:blocks]
        ready, self._pending = np.split(self._pending, [blocks * self._size])
        self._moving = self._moving[blocks:]
        state = np.where(np.repeat(moving, self._size), _MOTION, _AT_REST)
        state[ready["flags"] & Flag.MISSING_BEFORE != 0] = _MISSING
        unusable = (ready["flags"] & _UNUSABLE != 0) | (ready["flags"] & Flag.VALID == 0)
        state[unusable] = _FLAGGED
        actions = np.full(len(state), KEEP, np.int8)
        actions[state == _MISSING] = BREAK
        actions[unusable | np.repeat(moving, self._size)] = SKIP
        self._name(state, ready)
        return ready["values"], actions

    def _name(self, state: NDArray[np.int64], samples: NDArray[np.void]) -> None:
        """Add the disturbances among some samples."""
        begins = np.flatnonzero(np.diff(state, prepend=_AT_REST))
        stops = np.append(begins, len(state))[1:]
        for begin, stop in zip(begins.tolist(), stops.tolist(), strict=True):
            if state[begin] == _AT_REST:
                continue
            what = _NAMES[state[begin]]
            begin_s = float(samples["end_s"][begin] - samples["interval_s"][begin])
            end_s = float(samples["end_s"][stop - 1])
            last = self.disturbances[-1] if self.disturbances else None
            if last is not None and last.what == what and begin_s - last.end_s < BLOCK_S:
                self.disturbances[-1] = last._replace(end_s=end_s)
                continue
            self.disturbed += 1
            if len(self.disturbances) < MOST_NAMED:
                self.disturbances.append(Disturbance(what, begin_s, end_s))


_NOTHING: Final = (np.zeros((0, 6)), np.zeros(0, np.int8))


def _norms(six: Array) -> Array:
    """Return the sizes of gyro and accelerometer vectors, shape (..., 2)."""
    sizes: Array = np.linalg.norm(six.reshape(*six.shape[:-1], 2, 3), axis=-1)
    return sizes


@kernel
def _find_motion(means: Array, limits: Array, reference: Array, moving: NDArray[np.bool_]) -> None:
    """Find the blocks in motion.

    `reference`: rate of the last block at rest, force of the last block, mean rate at rest.
    """
    for i in range(len(means)):
        rate = mean_rate = force = 0.0
        for c in range(3):
            rate += (means[i, c] - reference[c]) ** 2
            mean_rate += (means[i, c] - reference[c + 6]) ** 2
            force += (means[i, c + 3] - reference[c + 3]) ** 2
            reference[c + 3] = means[i, c + 3]
        moving[i] = not (min(rate, mean_rate) <= limits[0] ** 2 and force <= limits[1] ** 2)
        if not moving[i]:
            for c in range(3):
                reference[c] = means[i, c]
                reference[c + 6] += FORGET * (means[i, c] - reference[c + 6])
