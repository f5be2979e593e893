"""Velocity readings of the accelerometers at rest, with a known and small error.

A level accelerometer sends few pulses a second, so that its velocity is a sawtooth of one pulse; readings
are taken where a pulse arrives (`calib.estimation.pulses`). They are dense next to a turn, where they count
most: the noise is a random walk. Where a channel sends less than two pulses p in a rest, it is read at both
ends of the rest, with the variance p^2 / 6.

Where the three sensing axes are not one vertical and two level ones, all three accelerometers sense gravity
and send pulses in nearly every sample: the readings are then means over 20 ms of the velocities east and
north.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.estimation.pulses import passages
from imudrv.arrays import Array

NEAR_S: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35)
"""Distances of readings from a turn, s; farther away there is one every `SPACING_S`."""

SPACING_S: Final = 0.5

LEVEL: Final = 0.35
"""Largest component of a level sensing axis along the vertical."""

MEAN_S: Final = 0.02
"""Length of the means where the axes are not level, s."""

LEAST_VARIANCE: Final = (2e-6) ** 2
"""Smallest variance of a reading, (m/s)^2, for the effects that the model neglects."""


class Readings(NamedTuple):
    """Readings of a run."""

    t_s: Array  # (n,), from the start of navigation
    arrest: NDArray[np.int64]  # (n,)
    direction_n: Array  # (n, 3), unit vector along which the velocity is read
    v: Array  # (n,), m/s
    variance: Array  # (n,), (m/s)^2, of each on its own
    start: Array  # (3, 3), covariance of the constant of a run, (m/s)^2, in n

    def take(self, at: NDArray[np.int64]) -> "Readings":
        """Return some of the readings."""
        return Readings(
            self.t_s[at], self.arrest[at], self.direction_n[at], self.v[at], self.variance[at], self.start
        )


class RestSamples(NamedTuple):
    """Samples of one rest."""

    t_s: Array  # (n,), end of each sample
    v_n: Array  # (n, 3), m/s, there
    dv_a: Array  # (n, 3), increments on the sensing axes, m/s
    C_nb: Array  # (3, 3)


def read_rests(rests: Sequence[RestSamples], A: Array, pulse: Array) -> Readings:
    """Return the readings of all rests of a run.

    Parameters
    ----------
    rests : sequence of RestSamples
        In order; the first one begins with the navigation, and turns separate them.
    A : ndarray, shape (3, 3)
        Row i: sensing axis of accelerometer i, body axes.
    pulse : ndarray, shape (3,)
        Velocity of one pulse of each accelerometer, m/s; 0: its increments are not quantised.

    Returns
    -------
    Readings
    """
    parts = []
    for k, rest in enumerate(rests):
        grid = _grid(rest.t_s, after_a_turn=k > 0, before_a_turn=k + 1 < len(rests))
        for direction_n, channel in _channels(rest, A, pulse):
            at = channel.nearest(*grid)
            parts.append((np.full(len(at), k), np.tile(direction_n, (len(at), 1)), *channel.take(at)))
    arrest, direction_n, t_s, v, variance = map(np.concatenate, zip(*parts, strict=True))
    edges = rests[0].C_nb @ np.linalg.inv(A) * pulse  # column i: a pulse of accelerometer i, in n
    return Readings(t_s, arrest, direction_n, v, np.maximum(variance, LEAST_VARIANCE), edges @ edges.T / 12.0)


def level_channels(up_a: Array) -> list[int]:
    """Return the two level accelerometers, or all three where not exactly two are level.

    Parameters
    ----------
    up_a : ndarray, shape (3,)
        Component of each sensing axis along the vertical.

    Returns
    -------
    list of int
    """
    level = np.flatnonzero(np.abs(up_a) < LEVEL).tolist()
    return level if len(level) == 2 else [0, 1, 2]


class Channel(NamedTuple):
    """All readings of one channel in a rest."""

    t_s: Array
    v: Array
    variance: Array

    def nearest(self, after: Array, before: Array) -> NDArray[np.int64]:
        """Return the first readings at or after some times, and the last ones at or before others."""
        first = np.searchsorted(self.t_s, after)
        last = np.searchsorted(self.t_s, before, side="right") - 1
        at = np.unique(np.concatenate([first, last]))
        return at[(at >= 0) & (at < len(self.t_s))]

    def take(self, at: NDArray[np.int64]) -> "Channel":
        """Return some of the readings."""
        return Channel(self.t_s[at], self.v[at], self.variance[at])


def channel(t_s: Array, v: Array, dv: Array, pulse: float) -> Channel:
    """Return the readings of one accelerometer: where its pulses arrive.

    Parameters
    ----------
    t_s, v : ndarray, shape (n,)
        End of each sample, and the velocity there, m/s.
    dv : ndarray, shape (n,)
        Increments of the accelerometer, m/s.
    pulse : float
        Velocity of one pulse, m/s; 0: not quantised.

    Returns
    -------
    Channel
    """
    at, variance = passages(dv, pulse)
    found = Channel(0.5 * (t_s[at] + t_s[at - 1]), 0.5 * (v[at] + v[at - 1]), np.full(len(at), variance))
    if len(at) > 1:
        return found
    first, last = (Channel(t_s[edge], v[edge], np.full(1, pulse**2 / 6.0)) for edge in ([0], [-1]))
    return Channel(*map(np.concatenate, zip(first, found, last, strict=True)))


def _channels(rest: RestSamples, A: Array, pulse: Array) -> list[tuple[Array, Channel]]:
    """Return direction and readings of each channel: the level accelerometers, or east and north."""
    axes_n = A @ rest.C_nb.T
    level = level_channels(axes_n[:, 2])
    if len(level) == 2:
        axes_n[:, 2] = 0.0  # the vertical velocity has the error of gravity
        return [
            (axes_n[i], channel(rest.t_s, rest.v_n @ axes_n[i], rest.dv_a[:, i], float(pulse[i])))
            for i in level
        ]
    size = max(1, round(MEAN_S / float(np.median(np.diff(rest.t_s)))))
    n = len(rest.t_s) // size
    t_s, v_n = (x[: n * size].reshape(n, size, -1).mean(axis=1) for x in (rest.t_s, rest.v_n))
    variance = ((rest.C_nb @ np.linalg.inv(A)) ** 2 @ pulse**2) / (12.0 * size)
    return [(np.eye(3)[j], Channel(t_s[:, 0], v_n[:, j], np.full(n, variance[j]))) for j in range(2)]


def _grid(t_s: Array, *, after_a_turn: bool, before_a_turn: bool) -> tuple[Array, Array]:
    """Return times at or after which, and at or before which, readings are wanted."""
    spaced = np.arange(0.0, 0.5 * (t_s[-1] - t_s[0]), SPACING_S)
    dense = np.concatenate([NEAR_S, spaced[1:]])
    return (
        t_s[0] + (dense if after_a_turn else spaced),
        t_s[-1] - (dense if before_a_turn else spaced),
    )
