"""Low-pass filter of the angle increments, for the rates of H.

A dithering block rotates relative to the case; the accelerometers do not sense it. Its residue in the
increments is not a rotation of the body: the squared rates in H rectify it, 32 m/s per m in ten seconds for
100 arcsec at 400 Hz. The filters are those of `imudrv.imu.rate_filter`, as the mean of the rates at both ends
of an interval: linear phase, no lag, sum 1, so that the total angle is unchanged.
"""

from collections.abc import Iterable, Iterator
from typing import Literal, TypeAlias

import numpy as np

from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.imu.rate_filter import RateFilterName, rate_filter
from imudrv.records import INCREMENTS, Records

FilterChoice: TypeAlias = Literal["auto"] | RateFilterName


def chosen_filter(choice: FilterChoice, interval_ns: int) -> RateFilterName:
    """Return the filter for a sample interval; `auto` is `dither` wherever the sample rate allows it.

    Raises
    ------
    InputError
        `dither` is required at a sample rate that aliases the dither into the motion.
    """
    if choice != "auto":
        rate_filter(choice, interval_ns)
        return choice
    try:
        return rate_filter("dither", interval_ns).name
    except InputError:
        return "causal"


def weights(name: RateFilterName, interval_ns: int) -> Array:
    """Return the weights of the angle increments, an odd number; a single one leaves them unchanged."""
    if name == "causal":
        return np.ones(1)
    return np.asarray(np.convolve(rate_filter(name, interval_ns).taps, (0.5, 0.5)), np.float64)


def without_dither(pieces: Iterable[Records]) -> Iterator[Records]:
    """Low-pass filter the angle increments of a capture; bits do not depend on how it is divided.

    Parameters
    ----------
    pieces : iterable of INCREMENTS
        In order; the first interval is the sample interval.

    Yields
    ------
    ndarray of INCREMENTS
        All rows except the first and last eight; unchanged at a sample rate that aliases the dither into the
        motion.
    """
    rows, taps, done = np.zeros(0, INCREMENTS), None, 0
    for piece in pieces:
        if taps is None and len(piece):
            interval_ns = int(piece["interval_ns"][0])
            taps = weights(chosen_filter("auto", interval_ns), interval_ns)
            done = len(taps) // 2
        if taps is None:
            continue
        rows = np.concatenate([rows, piece])
        ready = len(rows) - len(taps) // 2
        if ready > done:
            yield low_passed(rows, taps)[done:ready]
            rows, done = rows[ready - len(taps) // 2 :], len(taps) // 2


def low_passed(rows: Records, taps: Array) -> Records:
    """Low-pass filter the angle increments.

    Parameters
    ----------
    rows : ndarray of INCREMENTS, shape (n,)
        In order.
    taps : ndarray
        From `weights`.

    Returns
    -------
    ndarray of INCREMENTS, shape (n,)
        Unchanged are the first and last `len(taps) // 2` rows, and those next to a gap.
    """
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
