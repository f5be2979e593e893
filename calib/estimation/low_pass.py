"""Low-pass filter of the angle increments, which removes the dither of the gyro blocks.

A dithering block rotates relative to the case; the accelerometers do not sense it. Its residue in the
increments is not a rotation of the body: the squared rates in H rectify it, 32 m/s per m in ten seconds for
100 arcsec at 400 Hz. The filter is ``dither`` of `imudrv.imu.rate_filter`, as the mean of the rates at both
ends of an interval: linear phase, no lag, sum 1, so that the total angle is unchanged.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.imu.rate_filter import rate_filter
from imudrv.records import INCREMENTS, Records


def without_dither(pieces: Iterable[Records]) -> Iterator[Records]:
    """Low-pass filter the angle increments of a capture; bits do not depend on how it is divided.

    Parameters
    ----------
    pieces : iterable of INCREMENTS
        In order; the first interval is the sample interval.

    Yields
    ------
    ndarray of INCREMENTS
        All rows except the first and last eight. Next to a gap, and everywhere at a sample rate that aliases
        the dither into the motion, rows are unchanged.
    """
    rows, taps, done = np.zeros(0, INCREMENTS), None, 0
    for piece in pieces:
        if taps is None and len(piece):
            taps = _taps(int(piece["interval_ns"][0]))
            done = len(taps) // 2
        if taps is None:
            continue
        rows = np.concatenate([rows, piece])
        ready = len(rows) - len(taps) // 2
        if ready > done:
            yield _filtered(rows, taps)[done:ready]
            rows, done = rows[ready - len(taps) // 2 :], len(taps) // 2


def _taps(interval_ns: int) -> Array:
    """Return the weights of the angle increments; a single one at sample rates without a filter."""
    try:
        return np.convolve(rate_filter("dither", interval_ns).taps, (0.5, 0.5))
    except InputError:
        return np.ones(1)


def _filtered(rows: Records, taps: Array) -> Records:
    """Filter the angle where no neighbour is missing."""
    out, n = rows.copy(), len(rows) - len(taps) + 1
    if n < 1 or len(taps) == 1:
        return out
    dtheta, interval_ns = rows["dtheta_b"], rows["interval_ns"]
    angle = taps[0] * dtheta[:n]
    for j in range(1, len(taps)):
        angle += taps[j] * dtheta[j : j + n]
    broken = (np.diff(rows["counter"]) != 1) | (interval_ns[1:] != interval_ns[:-1])
    count = np.concatenate([[0], np.cumsum(broken)])
    at = np.flatnonzero(count[len(taps) - 1 :] == count[:n])
    out["dtheta_b"][at + len(taps) // 2] = angle[at]
    return out
