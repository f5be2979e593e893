"""Overlapping Allan variance in one pass, in a memory that does not depend on the length of the data.

Level l of the pyramid keeps the latest values of theta, the sum of the increments, at every 2^l-th sample. An
averaging factor m below 128 is evaluated at every sample, another one at every 2^l-th where m / 2^l is 64 to
127. The second differences theta[k] - 2 theta[k - m] + theta[k - 2 m] are added in an order that depends on
the number of the sample in its stretch alone, so the bits do not depend on how the data are divided.
"""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from imudrv.arrays import Array
from imudrv.kernels import kernel
from imudrv.records import Records

FULL_RATE: Final = 128
"""Averaging factors from here on are evaluated at fewer than all samples."""
HISTORY: Final = 2 * FULL_RATE
"""Values of theta that a level needs: two intervals of the longest factor."""
ROOM: Final = 2 * HISTORY
"""Values of theta that a level has room for; they are evaluated when it is full, and at the stretch's end."""
LEVELS: Final = 32
"""Levels of the pyramid: 2^38 samples, 8 years at 1 kHz."""
PER_OCTAVE: Final = 4

KEEP: Final = 0
BREAK: Final = 1
SKIP: Final = 2
"""What to do with a sample: keep it, begin a new stretch with it, or leave it out and end the stretch."""

STATE: Final = np.dtype(
    [
        ("length", np.int64),  # samples of the present stretch
        ("longest", np.int64),  # samples of the longest one
        ("samples", np.int64),  # of all stretches
        ("filled", np.int64, LEVELS),  # values of theta in a level,
        ("done", np.int64, LEVELS),  # those of them that are evaluated
    ],
    align=True,
)
"""Progress of a pyramid."""


def default_factors() -> NDArray[np.int64]:
    """Return averaging factors, `PER_OCTAVE` an octave, for data of any length."""
    fractions = 2.0 ** (np.arange(7 * PER_OCTAVE) / PER_OCTAVE)
    low = np.unique(np.rint(fractions).astype(np.int64))
    top = low[low >= FULL_RATE // 2]
    return np.concatenate([low, *(top << level for level in range(1, LEVELS))])


@dataclass(frozen=True)
class AllanVariance:
    """Allan variances of some channels.

    Attributes
    ----------
    factors : ndarray of int64, shape (n,)
        Averaging factors.
    counts : ndarray of int64, shape (n,)
        Number of second differences of each.
    variance : ndarray, shape (n, channels)
        Allan variance, in (unit of theta per sample interval)^2.
    samples : int
        Number of samples in all stretches.
    longest : int
        Number of samples of the longest stretch.
    """

    factors: NDArray[np.int64]
    counts: NDArray[np.int64]
    variance: Array
    samples: int
    longest: int

    @property
    def steps(self) -> NDArray[np.int64]:
        """Samples from one second difference to the next, shape (n,)."""
        return np.int64(1) << _levels(self.factors)

    def tau_s(self, interval_s: float) -> Array:
        """Return the averaging times, shape (n,)."""
        times: Array = self.factors.astype(np.float64) * interval_s
        return times

    @property
    def independent(self) -> Array:
        """Intervals of each averaging time in all stretches, less two in each stretch, shape (n,)."""
        number: Array = self.counts * self.steps / self.factors
        return number

    def part(self, chosen: NDArray[np.bool_]) -> Self:
        """Return the same for some of the averaging factors."""
        kept = self.factors[chosen], self.counts[chosen], self.variance[chosen]
        return type(self)(*kept, self.samples, self.longest)


class Pyramid:
    """Allan variances of channels, fed with increments in any pieces.

    Parameters
    ----------
    channels : int
        Number of channels.
    factors : ndarray of int64, optional
        Averaging factors, ascending; those from 128 on multiples of the step of their level.
    """

    def __init__(self, channels: int, factors: NDArray[np.int64] | None = None) -> None:
        self._factors = default_factors() if factors is None else factors
        levels = _levels(self._factors)
        if np.any(self._factors % (1 << levels)):
            raise ValueError("expected averaging factors m that are multiples of 2^l, m / 2^l from 64 to 127")
        self._lags = self._factors >> levels
        self._first = np.searchsorted(levels, np.arange(LEVELS + 1))  # factor of each level
        self._history = np.zeros((LEVELS, channels, ROOM))
        self._theta = np.zeros(channels)
        self._sums = np.zeros((len(self._factors), channels))
        self._counts = np.zeros(len(self._factors), np.int64)
        self._state = np.zeros(1, STATE)

    @property
    def _evaluation(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array, NDArray[np.int64]]:
        return self._lags, self._first, self._history, self._sums, self._counts

    def feed(self, increments: Array, actions: NDArray[np.int8]) -> None:
        """Process samples.

        Parameters
        ----------
        increments : ndarray, shape (n, channels)
            Increments of theta.
        actions : ndarray of int8, shape (n,)
            `KEEP`, `BREAK` or `SKIP`.
        """
        _add(increments, actions, self._theta, *self._evaluation, self._state)

    def end_stretch(self) -> None:
        """End the present stretch: what follows is pooled with it and not joined to it."""
        _end(*self._evaluation, self._state)

    def result(self) -> AllanVariance:
        """End the present stretch, and return the variances of the factors that have second differences."""
        self.end_stretch()
        known = self._counts > 0
        factors, counts = self._factors[known], self._counts[known]
        variance = self._sums[known] / (2.0 * counts * factors.astype(np.float64) ** 2)[:, None]
        samples, longest = int(self._state["samples"][0]), int(self._state["longest"][0])
        return AllanVariance(factors, counts, variance, samples, longest)


def _levels(factors: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the level of each averaging factor."""
    levels: NDArray[np.int64] = np.maximum(np.frexp(factors.astype(np.float64))[1] - 7, 0).astype(np.int64)
    return levels


@kernel
def _add(
    increments: Array,
    actions: NDArray[np.int8],
    theta: Array,
    lags: NDArray[np.int64],
    first: NDArray[np.int64],
    history: Array,
    sums: Array,
    counts: NDArray[np.int64],
    state: Records,
) -> None:
    """Add samples."""
    channels, s = len(theta), state[0]
    for i in range(len(increments)):
        if actions[i] != KEEP:
            _end(lags, first, history, sums, counts, state)
        if actions[i] == SKIP:
            continue
        if s["length"] == 0:
            for level in range(LEVELS):
                s["filled"][level], s["done"][level] = 1, 0
                for c in range(channels):
                    theta[c] = history[level, c, 0] = 0.0
        s["length"] += 1
        s["samples"] += 1
        for c in range(channels):
            theta[c] += increments[i, c]
        level, k = 0, s["length"]
        while True:
            at = s["filled"][level]
            for c in range(channels):
                history[level, c, at] = theta[c]
            s["filled"][level] = at + 1
            if at + 1 == ROOM:
                _evaluate(level, lags, first, history, sums, counts, state)
                for c in range(channels):
                    for k_old in range(HISTORY):
                        history[level, c, k_old] = history[level, c, k_old + HISTORY]
                s["filled"][level] = s["done"][level] = HISTORY
            if k & 1 or level == LEVELS - 1:
                break
            level, k = level + 1, k >> 1


@kernel
def _end(
    lags: NDArray[np.int64],
    first: NDArray[np.int64],
    history: Array,
    sums: Array,
    counts: NDArray[np.int64],
    state: Records,
) -> None:
    """End the present stretch."""
    s = state[0]
    if s["length"]:
        for level in range(LEVELS):
            _evaluate(level, lags, first, history, sums, counts, state)
        s["longest"] = max(s["longest"], s["length"])
        s["length"] = 0


@kernel
def _evaluate(
    level: int,
    lags: NDArray[np.int64],
    first: NDArray[np.int64],
    history: Array,
    sums: Array,
    counts: NDArray[np.int64],
    state: Records,
) -> None:
    """Add the squared second differences that end at the new values of a level."""
    s = state[0]
    stop = s["filled"][level]
    for j in range(first[level], first[level + 1]):
        m = lags[j]
        begin = max(s["done"][level], 2 * m)
        if begin >= stop:
            break
        counts[j] += stop - begin
        for c in range(history.shape[1]):
            theta = history[level, c]
            even = odd = 0.0  # two sums are twice as fast as one
            for k in range(begin, stop - 1, 2):
                d = theta[k] - 2.0 * theta[k - m] + theta[k - 2 * m]
                e = theta[k + 1] - 2.0 * theta[k + 1 - m] + theta[k + 1 - 2 * m]
                even += d * d
                odd += e * e
            if (stop - begin) & 1:
                d = theta[stop - 1] - 2.0 * theta[stop - 1 - m] + theta[stop - 1 - 2 * m]
                odd += d * d
            sums[j, c] += even + odd
