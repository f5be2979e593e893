"""Rests and motions as the equations take them: sums over bins of a second, samples, and the noise in them.

A count at the edge of a rest is the mean over a bin of (count - rate t), which the pulse hardly shows in. The
same counts begin and end the motions, so that their errors are shared.
"""

from dataclasses import dataclass, field
from math import pi

import numpy as np

from calib.detection.rest_bins import Noise, RestBins
from calib.estimation.dither_line import DitherLine
from calib.sensors.motion import STEADY
from imudrv.arrays import Array
from imudrv.imu.rate_filter import RateFilter
from imudrv.records import Records


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
    dither : tuple of DitherLine
        Its lines in the first rest.
    captures : tuple of int
        Number of the capture of each session: a restart of the unit begins another session.
    """

    rests: tuple[RestBins, ...]
    links: tuple[Link, ...]
    left: tuple[Left, ...]
    noise: Noise
    quanta: tuple[float, float]
    fastest: float = 0.0
    rate_filter: RateFilter = STEADY
    dither: tuple[DitherLine, ...] = ()
    captures: tuple[int, ...] = (0,)

    @property
    def is_dithered(self) -> bool:
        """Whether the increments of the gyros carry dither, which a filter takes off the rates."""
        return self.rate_filter is not STEADY


def edge_variance(pulses_per_bin: Array) -> Array:
    """Return the variance of a mean count over a bin, in pulses squared, by the pulses that come in it.

    The count is a sawtooth about (rate t); its mean over n periods has the variance
    `sum of (1 / (pi k))^2 / 2 sinc^2(k n)`, here with the mean of sin^2 for a rate that is not known so well.
    """
    k = np.arange(1, 51)
    passed = 1.0 / (1.0 + 2.0 * (pi * np.multiply.outer(np.abs(pulses_per_bin), k)) ** 2)
    return np.asarray((passed * 0.5 / (pi * k) ** 2).sum(axis=-1), np.float64)
