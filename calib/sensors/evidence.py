"""Rests and motions as the equations take them: sums over bins of a second, samples, and the noise in them.

A count at the edge of a rest is the mean over a bin of (count - rate t), which the pulse hardly shows in. The
same counts begin and end the motions, so that their errors are shared.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import pi, sqrt
from typing import Final

import numpy as np

from calib.sensors.motion import STEADY
from imudrv.arrays import Array
from imudrv.imu.rate_filter import RateFilter
from imudrv.records import Records


@dataclass(frozen=True)
class Noise:
    """Random walks of a unit's gyros and accelerometers, each axis: rad/sqrt(s), m/s/sqrt(s)."""

    angle_walk: float
    velocity_walk: float


LEAST_NOISE: Final = Noise(1e-7, 1e-5)
"""Least noise that is believed, 0.0003 deg/sqrt(h) and 1 ug/sqrt(Hz); the integration errs by less."""


@dataclass(frozen=True)
class RestBins:
    """A rest: sums of its increments at nominal scale over bins of a second.

    Attributes
    ----------
    session : int
        Number of the capture.
    start, stop : int
        Counter of the first sample, and of the first after the last.
    start_s : float
        Time from the beginning of the capture.
    bin_s : float
        Length of a bin.
    samples : int
        Samples of a bin.
    sums : ndarray, shape (n, 6)
        Increments of gyros and accelerometers X Y Z over each bin, rad, m/s.
    means : ndarray, shape (n, 6)
        Mean over each bin of the sum since its beginning.
    degc : ndarray, shape (4,)
        Mean temperature of the gyros and of each accelerometer; NaN: not measured.
    span_k : float
        Largest change of any of these from bin to bin of the rest.
    shaking : float
        Largest scatter of single angle increments of a gyro, rad, rms.
    """

    session: int
    start: int
    stop: int
    start_s: float
    bin_s: float
    samples: int
    sums: Array
    means: Array
    degc: Array
    span_k: float = 0.0
    shaking: float = 0.0

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return len(self.sums) * self.bin_s

    @property
    def stop_s(self) -> float:
        """Time of the end from the beginning of the capture."""
        return self.start_s + self.duration_s

    @property
    def rate(self) -> Array:
        """Mean rates and forces at nominal scale, shape (6,), rad/s and m/s^2."""
        return _rate(self.sums, self.means, self.bin_s)

    @property
    def edges(self) -> Array:
        """Smoothed less actual sum at the begin and at the end of the rest, shape (2, 6)."""
        early, late = 0.5 * (self.samples + 1), 0.5 * (self.samples - 1)
        step = self.rate * self.bin_s / self.samples
        before = self.means[0] - early * step
        after = self.means[-1] - self.sums[-1] + late * step
        return np.stack([before, after])

    def drift(self, noise: Noise, quantum: float) -> tuple[float, float]:
        """Return the change of the force from the first to the last quarter, m/s^2, and its sigma."""
        n = max(2, len(self.sums) // 4)
        change = _rate(self.sums[-n:], self.means[-n:], self.bin_s) - _rate(
            self.sums[:n], self.means[:n], self.bin_s
        )
        seconds = (n - 1) * self.bin_s
        variance = noise.velocity_walk**2 / seconds + 2.0 * (0.3 * quantum / seconds) ** 2
        return float(np.linalg.norm(change[3:])), sqrt(2.0 * variance)


def _rate(sums: Array, means: Array, bin_s: float) -> Array:
    """Return the rate between the mean counts of the first and the last bin."""
    late = sums[:-1].sum(axis=0) + means[-1]
    rate: Array = (late - means[0]) / ((len(sums) - 1) * bin_s)
    return rate


@dataclass(frozen=True)
class Left:
    """A rest or a motion that is not used as one.

    Attributes
    ----------
    session : int
        Number of the capture, from 0.
    start_s, stop_s : float
        Time from the beginning of the capture.
    what : str
        'rest' or 'motion'.
    reason : str
        Why, in words.
    """

    session: int
    start_s: float
    stop_s: float
    what: str
    reason: str


@dataclass(frozen=True)
class Link:
    """The samples between two rests that follow each other in one capture.

    Attributes
    ----------
    before, after : int
        Numbers of the rests.
    samples : ndarray of SAMPLE
        With the counts of the edges in them.
    """

    before: int
    after: int
    samples: Records = field(repr=False)

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return float(self.samples["T"].sum())


@dataclass(frozen=True)
class Evidence:
    """Everything that captures say: rests, motions, and what was left out.

    Attributes
    ----------
    rests : tuple of RestBins
        In order, capture by capture.
    links : tuple of Link
    left : tuple of Left
    noise : Noise
    quanta : tuple of float
        Pulse of a gyro, rad, and of an accelerometer, m/s.
    fastest : float
        Largest rate of any gyro in a motion, rad/s.
    rate_filter : RateFilter
        For the rate of the size effect: without the dither that the increments of the gyros carry.
    """

    rests: tuple[RestBins, ...]
    links: tuple[Link, ...]
    left: tuple[Left, ...]
    noise: Noise
    quanta: tuple[float, float]
    fastest: float = 0.0
    rate_filter: RateFilter = STEADY

    @property
    def is_dithered(self) -> bool:
        """Whether the increments of the gyros carry dither, which a filter takes off the rates."""
        return self.rate_filter is not STEADY


def rest_noise(rests: Sequence[RestBins]) -> Noise:
    """Return the random walks, from the second differences of the mean counts of the bins.

    With white noise s of a mean count and a random walk q the variance of a second difference over m bins is
    `6 s^2 + q^2 (2 m - 1) T` for m >= 1 bins of length T: the difference of two lags is the walk's alone.
    """
    walks = []
    for axes in (slice(0, 3), slice(3, 6)):
        squares, counts = np.zeros(len(_LAGS)), np.zeros(len(_LAGS))
        bin_s = rests[0].bin_s
        for rest in rests:
            counts_at = np.concatenate([np.zeros((1, 3)), np.cumsum(rest.sums[:-1, axes], axis=0)])
            mean = counts_at + rest.means[:, axes]
            for k, m in enumerate(_LAGS):
                if len(mean) > 2 * m:
                    second = mean[2 * m :] - 2.0 * mean[m:-m] + mean[: -2 * m]
                    squares[k] += float((second**2).sum())
                    counts[k] += second.size
        usable = counts > 0
        variance = squares[usable] / counts[usable]
        lags = np.array(_LAGS)[usable]
        if len(lags) < 2:
            walks.append(0.0)
            continue
        walk = (variance[-1] - variance[0]) / (2.0 * (lags[-1] - lags[0]) * bin_s)
        walks.append(sqrt(max(float(walk), 0.0)))
    return Noise(max(walks[0], LEAST_NOISE.angle_walk), max(walks[1], LEAST_NOISE.velocity_walk))


_LAGS: Final = (1, 6)


def edge_variance(pulses_per_bin: Array) -> Array:
    """Return the variance of a mean count over a bin, in pulses squared, by the pulses that come in it.

    The count is a sawtooth about (rate t); its mean over n periods has the variance
    `sum of (1 / (pi k))^2 / 2 sinc^2(k n)`, here with the mean of sin^2 for a rate that is not known so well.
    """
    k = np.arange(1, 51)
    passed = 1.0 / (1.0 + 2.0 * (pi * np.multiply.outer(np.abs(pulses_per_bin), k)) ** 2)
    return np.asarray((passed * 0.5 / (pi * k) ** 2).sum(axis=-1), np.float64)
