"""Velocity readings of the accelerometers at rest, with a known and small error.

Level accelerometers are read where their pulses arrive (`calib.estimation.channel`). The readings are dense
next to a turn, where they count most: the noise is a random walk. Where no pulse arrives within `SPACING_S`
of a turn, the end of the rest is read, too: the pulses of the turn determine its velocity.

Where the three sensing axes are not one vertical and two level ones, all three accelerometers sense gravity
and send pulses in nearly every sample: the velocities east and north are then read as if not quantised.

**In a turn** an error e of the sum of an axis is turned into other axes and leaves the integral of w e, with
the rate w. Where the case vibrates, as in reaction to the dither, pulses come and go with it: e is another
fraction of a pulse in each sample, of variance p^2 / 12. Samples of length tau leave

    variance = p^2 / 12 tau integral of w^2 dt = p^2 / 12 tau (10 / 7) pi^2 / T

after half a turn of least jerk in T, whatever the amplitude. A single velocity next to a turn is off by the
vibration itself.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.estimation.channel import Channel, channel, vibration
from imudrv.arrays import Array

NEAR_S: Final = (0.0, 0.02, 0.05, 0.1, 0.2, 0.35)
"""Distances of readings from a turn, s; farther away there is one every `SPACING_S`."""

SPACING_S: Final = 0.5

LEVEL: Final = 0.35
"""Largest component of a level sensing axis along the vertical."""

EDGE_SHARE: Final = 0.03
"""Error at such an end, in pulses. Simulated: 0.007 rms near the axis of the turn, 0.023 with the unit 150 mm
off it and turned in 1.5 s."""

TURN_SHARE: Final = 0.008
"""What the motion between two pulses is off by in a turn, in pulses: turned into other axes, it stays.
Simulated: 0.004 and 0.011 rms in these cases."""

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
    turn: Array  # (3, 3), covariance of what the pulses add at each turn

    def take(self, at: NDArray[np.int64]) -> "Readings":
        """Return some of the readings."""
        return Readings(
            self.t_s[at],
            self.arrest[at],
            self.direction_n[at],
            self.v[at],
            self.variance[at],
            self.start,
            self.turn,
        )


class RestSamples(NamedTuple):
    """Samples of one rest."""

    t_s: Array  # (n,), end of each sample
    v_n: Array  # (n, 3), m/s, there
    dv_a: Array  # (n, 3), increments on the sensing axes, m/s
    C_nb: Array  # (3, 3)


def read_rests(rests: Sequence[RestSamples], A: Array, pulse: Array, walk: float) -> Readings:
    """Return the readings of all rests of a run.

    Parameters
    ----------
    rests : sequence of RestSamples
        In order; the first one begins with the navigation, and turns separate them.
    A : ndarray, shape (3, 3)
        Row i: sensing axis of accelerometer i, body axes.
    pulse : ndarray, shape (3,)
        Velocity of one pulse of each accelerometer, m/s; 0: its increments are not quantised.
    walk : float
        Random walk of the velocity, m/s/sqrt(s).

    Returns
    -------
    Readings
    """
    first, parts = rests[0], []
    shaken = beyond_pulses(first.t_s, first.dv_a, pulse)
    edge = (EDGE_SHARE * pulse) ** 2 + shaken
    for k, rest in enumerate(rests):
        after, before = k > 0, k + 1 < len(rests)
        grid = _grid(rest.t_s, after_a_turn=after, before_a_turn=before)
        for direction_n, v, found, of_one in _channels(rest, A, pulse, walk, edge):
            read = found.take(found.nearest(*grid))
            read = read.joined(_next_to_turns(rest, v, read.t_s, of_one, after=after, before=before))
            parts.append((np.full(len(read.t_s), k), np.tile(direction_n, (len(read.t_s), 1)), *read))
    arrest, direction_n, t_s, v, variance = map(np.concatenate, zip(*parts, strict=True))
    M = first.C_nb @ np.linalg.inv(A)
    start = pulse**2 / 12.0 + shaken
    turn = (TURN_SHARE * pulse) ** 2 + np.minimum(shaken, pulse**2 / 12.0) * _squared_rate(rests)
    least = np.maximum(variance, LEAST_VARIANCE)
    return Readings(t_s, arrest, direction_n, v, least, M * start @ M.T, M * turn @ M.T)


def beyond_pulses(t_s: Array, dv_a: Array, pulse: Array) -> Array:
    """Return the mean square of the vibration of each accelerometer beyond that of its pulses, (m/s)^2.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        End of each sample, at rest.
    dv_a : ndarray, shape (n, 3)
        Increments on the sensing axes, m/s.
    pulse : ndarray, shape (3,)
        Velocity of one pulse, m/s; 0: not quantised, and the result is 0.

    Returns
    -------
    ndarray, shape (3,)
    """
    swing = np.array([vibration(t_s, dv) for dv in dv_a.T])
    return np.asarray(np.maximum(swing - pulse**2 / 12.0, 0.0) * (pulse > 0.0), np.float64)


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


def _channels(
    rest: RestSamples, A: Array, pulse: Array, walk: float, edge: Array
) -> Iterator[tuple[Array, Array, Channel, float]]:
    """Yield direction, velocity and readings of each channel, and the variance of a single velocity.

    The channels are the level accelerometers, or east and north.
    """
    axes_n = A @ rest.C_nb.T
    level = level_channels(axes_n[:, 2])
    if len(level) != 2:
        axes_n, level, pulse, edge = np.eye(3), [0, 1], np.zeros(3), np.zeros(3)
    axes_n[:, 2] = 0.0  # the vertical velocity has the error of gravity
    for i in level:
        v = rest.v_n @ axes_n[i]
        yield axes_n[i], v, channel(rest.t_s, v, rest.dv_a[:, i], float(pulse[i]), walk), float(edge[i])


def _next_to_turns(
    rest: RestSamples, v: Array, read_s: Array, variance: float, *, after: bool, before: bool
) -> Channel:
    """Return readings at the ends of a rest that are next to a turn, where there is no other one near."""
    ends = [0] * after + [-1] * before
    at = [k for k in ends if not (np.abs(read_s - rest.t_s[k]) < SPACING_S).any()]
    return Channel(rest.t_s[at], v[at], np.full(len(at), variance))


def _squared_rate(rests: Sequence[RestSamples]) -> float:
    """Return the integral of the squared rate over a turn times the sample interval, mean of all turns."""
    tau = rests[0].t_s[1] - rests[0].t_s[0]
    turn_s = np.array([after.t_s[0] - before.t_s[-1] for before, after in pairwise(rests)])
    return float(np.mean(10.0 / 7.0 * np.pi**2 / turn_s) * tau)


def _grid(t_s: Array, *, after_a_turn: bool, before_a_turn: bool) -> tuple[Array, Array]:
    """Return times at or after which, and at or before which, readings are wanted."""
    spaced = np.arange(0.0, 0.5 * (t_s[-1] - t_s[0]), SPACING_S)
    dense = np.concatenate([NEAR_S, spaced[1:]])
    return (
        t_s[0] + (dense if after_a_turn else spaced),
        t_s[-1] - (dense if before_a_turn else spaced),
    )
