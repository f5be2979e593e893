"""A rest in bins of a second: its mean rates and forces, the noise in it, and whether it is one.

A count at the edge of a rest is the mean over a bin of (count - rate t), which the pulse hardly shows in.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from math import hypot, sqrt
from typing import Final

import numpy as np

from calib.messages import Message, message
from imudrv.arrays import Array
from imudrv.units import ARCSEC, STANDARD_GRAVITY, UG

BIN_S: Final = 1.0
"""Averaging time of a count at an edge, s."""
LEAST_RESTS: Final = 3
"""Fewest rests that show anything of the sensors."""
DRIFT_SIGMAS: Final = 5.0
DRIFT_FLOOR: Final = 1.5 * UG
"""A rest moves if its force changes by more than this many sigma; the floor allows for wander, m/s^2."""
VERTICAL_PER_K: Final = 200 * UG
"""Change of a force upward that a kelvin explains, m/s^2: 100 ug of bias and 100 ppm of scale."""


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
    beginning : ndarray, shape (n, 3)
        The first angle increments, rad: they show a dither line.
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
    beginning: Array = field(default_factory=lambda: np.zeros((0, 3)), repr=False)

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

    @property
    def steady(self) -> "RestBins":
        """The same without a linear change of rates and forces: its noise alone."""
        k = np.arange(len(self.sums)) - 0.5 * (len(self.sums) - 1)
        trend = np.outer(k, k @ self.sums / (k @ k))
        return replace(self, sums=self.sums - trend, means=self.means - 0.5 * trend)

    def drift(self, noise: Noise, quantum: float) -> Message | None:
        """Return how the force changes from the first to the last quarter; None: within the noise.

        A tilt changes the level part. The part along gravity may be that of a temperature that changes; the
        level part may be so, too, but it cannot be distinguished from a tilt.

        Parameters
        ----------
        noise : Noise
            Random walks of the sensors.
        quantum : float
            Pulse of an accelerometer, m/s.
        """
        n = max(2, len(self.sums) // 4)
        first = _rate(self.sums[:n], self.means[:n], self.bin_s)
        last = _rate(self.sums[-n:], self.means[-n:], self.bin_s)
        difference, up = (last - first)[3:], self.rate[3:] / np.linalg.norm(self.rate[3:])
        upward = float(difference @ up)
        unexplained = max(0.0, abs(upward) - VERTICAL_PER_K * self.span_k)
        change = hypot(float(np.linalg.norm(difference - upward * up)), unexplained)
        seconds = (n - 1) * self.bin_s
        variance = 2.0 * (noise.velocity_walk**2 / seconds + 2.0 * (0.3 * quantum / seconds) ** 2)
        if change <= DRIFT_SIGMAS * sqrt(variance + DRIFT_FLOOR**2):
            return None
        tilt_arcsec = change / STANDARD_GRAVITY / ARCSEC
        return message("rest_drifts", change_ug=change / UG, tilt_arcsec=tilt_arcsec)


def _rate(sums: Array, means: Array, bin_s: float) -> Array:
    """Return the rate between the mean counts of the first and the last bin."""
    late = sums[:-1].sum(axis=0) + means[-1]
    rate: Array = (late - means[0]) / ((len(sums) - 1) * bin_s)
    return rate


def binned(increments: Array, samples: int) -> tuple[Array, Array]:
    """Return sums, and means of the sum since the beginning, of bins.

    Parameters
    ----------
    increments : ndarray, shape (n, k)
        Of n whole bins.
    samples : int
        Samples of a bin.

    Returns
    -------
    sums, means : ndarray, shape (n // samples, k)
    """
    bins = increments.reshape(-1, samples, increments.shape[1])
    weights = (samples - np.arange(samples)) / samples
    return bins.sum(axis=1), np.tensordot(bins, weights, (1, 0))


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
