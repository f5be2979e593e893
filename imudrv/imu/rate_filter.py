"""Angular rate at an interval's end: an FIR over the angle increments around it (mathematics, section 1).

``omega(end of k) = 1/tau sum_j h_j dtheta_{k+j}``, j = -M..L. L is the lag: the compensated increment, angle
and velocity alike, is output L samples later.
"""

from dataclasses import dataclass
from functools import cache
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from imudrv.errors import InputError

RateFilterName: TypeAlias = Literal["causal", "centred", "dither"]
NAMES: Final[tuple[RateFilterName, ...]] = ("causal", "centred", "dither")

DITHER_HZ: Final = 400.0
"""Dither frequency of a 50-type block, Hz."""
DITHER_BAND_HZ: Final = 30.0
"""Largest deviation of a block's own frequency from it, Hz."""
_LOWEST: Final = 0.2  # of the sample rate: aliased dither below it cannot be separated from motion
_STOP_TAPS: Final = 13


@dataclass(frozen=True)
class RateFilter:
    """An FIR for the rate at interval ends.

    Parameters
    ----------
    name : str
        Name for users.
    taps : ndarray, shape (M + 1 + lag,)
        h_j from the oldest, j = -M, to the newest, j = lag.
    lag : int
        Delay of the output, samples.
    middle_from_ends : bool
        Whether the rate in the middle of an interval is the mean of the filtered rates at its ends; otherwise
        it is the interval's own angle over its length, with all the dither in it.
    """

    name: RateFilterName
    taps: NDArray[np.float64]
    lag: int
    middle_from_ends: bool = False


@cache
def rate_filter(name: RateFilterName, interval_ns: int) -> RateFilter:
    """Make the filter called `name` for a sample interval.

    Parameters
    ----------
    name : {'causal', 'centred', 'dither'}
        ``causal``: no lag, exact for a rate quadratic in time. ``centred``: lag 1, exact for a linear one, a
        third of the noise. ``dither``: lag 8, exact for a quadratic one, removes what a raw block leaves in
        the increments at 370-430 Hz.
    interval_ns : int
        Sample interval, ns.

    Returns
    -------
    RateFilter
        Its taps and lag.

    Raises
    ------
    InputError
        ``dither`` at a sample rate that aliases the dither into the motion.
    """
    if name == "causal":
        return RateFilter(name, np.array([2.0, -7.0, 11.0]) / 6.0, 0)
    if name == "centred":
        return RateFilter(name, np.array([0.5, 0.5]), 1)
    rate_hz = 1e9 / interval_ns
    aliased = abs(DITHER_HZ - rate_hz * round(DITHER_HZ / rate_hz))
    if aliased - DITHER_BAND_HZ < _LOWEST * rate_hz:
        raise InputError(
            f"rate filter dither: expected a sample rate at which {DITHER_HZ:.0f} Hz, give or take"
            f" {DITHER_BAND_HZ:.0f}, stays above a fifth of it, got {rate_hz:g} Hz, where it appears at"
            f" {aliased:g} Hz; use causal or centred"
        )
    taps = _dither_taps(aliased / rate_hz, DITHER_BAND_HZ / rate_hz)
    return RateFilter(name, taps, len(taps) // 2, middle_from_ends=True)


def _dither_taps(centre: float, width: float) -> NDArray[np.float64]:
    """Minimise the largest gain within `width` of `centre`; exact for a rate up to quadratic in time.

    Frequencies are fractions of the sample rate. An equiripple stop filter (Parks-McClellan; with hardly any
    pass band, so that all its zeros go to the dither) is convolved with four taps p, q, q, p, which centre
    the whole at the interval's end and make it exact. Tap j weighs the mean rate over an interval centred
    c = j - 1/2 intervals from the end. A constant rate requires sum h = 1; a quadratic one, whose mean over
    that interval is proportional to c^2 + 1/12, sum h c^2 = -1/12; odd powers vanish by symmetry. The second
    moments of convolved filters add.

    At 1 kHz 4e-9 of what is at 370-430 Hz passes; a rate at 3 Hz comes out 2.5e-7 too small.
    """
    from scipy.signal import remez  # here, because it takes most of a second to load

    nearest, farthest = centre - width, min(centre + width, 0.5)
    stop = remez(_STOP_TAPS, [0.0, 1e-3, nearest, farthest], [1.0, 0.0])
    stop /= stop.sum()
    c = np.arange(_STOP_TAPS) - _STOP_TAPS // 2
    second_moment = -1.0 / 12.0 - stop @ c**2  # of p, q, q, p: 9/2 p + 1/2 q
    p = (second_moment - 0.25) / 4.0
    taps: NDArray[np.float64] = np.convolve(stop, np.array([p, 0.5 - p, 0.5 - p, p]))
    return 0.5 * (taps + taps[::-1])  # linear phase to the last bit
