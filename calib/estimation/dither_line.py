"""Dither line of each gyro in the angle increments at rest.

The spectrum of the increments is the mean over windows of a second. A line stands out of the median
of the spectrum above `LOWEST_HZ`, or above `LEAST_HZ` at a sample rate that aliases dither into the motion.
Increments of an angle a sin(2 pi f t) have the amplitude 2 a sin(pi f tau).
"""

from math import pi, sin
from typing import Final, NamedTuple

import numpy as np

from imudrv.arrays import Array
from imudrv.imu.rate_filter import DITHER_BAND_HZ, DITHER_HZ

WINDOW_S: Final = 1.0
"""Length of a window, s: lines 1 Hz apart are separate."""

LOWEST_HZ: Final = 50.0
"""Lowest frequency of a line: below it are the movements of a bench."""

LEAST_HZ: Final = 3.0
"""Lowest frequency of a line that may be aliased dither; no rate filter separates it from the motion."""

LEAST_RATIO: Final = 20.0
"""Power of a line over the median; noise reaches 10 in 500 frequencies and a few windows."""

LEAST_RECTIFIED: Final = 1e-7
"""Half the squared rate of the weakest line that matters, 1/s^2; the pulses of the gyros make weaker ones."""


class DitherLine(NamedTuple):
    """Dither of a gyro in the increments."""

    axis: str  # body axis, X to Z
    frequency_hz: float  # as sampled: above half the sample rate it is aliased
    amplitude_rad: float  # of the angle


def dither_lines(dtheta_b: Array, interval_s: float) -> tuple[DitherLine, ...]:
    """Find the dither line of each axis.

    Parameters
    ----------
    dtheta_b : ndarray, shape (n, 3)
        Angle increments at rest, rad.
    interval_s : float
        Sample interval.

    Returns
    -------
    tuple of DitherLine
        At most one for each axis, the strongest.
    """
    size = round(WINDOW_S / interval_s)
    count = len(dtheta_b) // size
    frequency_hz = np.fft.rfftfreq(size, interval_s)
    sample_hz = 1.0 / interval_s
    aliased_hz = abs(DITHER_HZ - sample_hz * round(DITHER_HZ / sample_hz)) - DITHER_BAND_HZ
    wanted = frequency_hz >= (LOWEST_HZ if aliased_hz > LOWEST_HZ else LEAST_HZ)
    if not count or not wanted.any():
        return ()
    windows = dtheta_b[: count * size].reshape(count, size, 3)
    shape = np.hanning(size)
    spectrum = np.fft.rfft((windows - windows.mean(axis=1, keepdims=True)) * shape[:, None], axis=1)
    power = (np.abs(spectrum[:, wanted]) ** 2).mean(axis=0)
    frequency_hz = frequency_hz[wanted]
    lines = []
    for k, axis in enumerate("XYZ"):
        at = int(power[:, k].argmax())
        if power[at, k] < LEAST_RATIO * np.median(power[:, k]):
            continue
        # half a window beside the line: all of its power, whatever its place between two frequencies
        near = power[max(0, at - 3) : at + 4, k].sum()
        increment = 2.0 * float(np.sqrt(near / (size * (shape**2).sum())))
        if 0.5 * (increment / interval_s) ** 2 < LEAST_RECTIFIED:
            continue
        f = float(frequency_hz[at])
        lines.append(DitherLine(axis, f, increment / (2.0 * sin(pi * f * interval_s))))
    return tuple(lines)
