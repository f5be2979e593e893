"""Angular rate at an interval's end: an FIR over the angle increments around it (mathematics, section 1).

``omega(end of k) = 1/tau sum_j h_j dtheta_{k+j}``, j = -M..L. L is the lag: so many samples later the
compensated increment comes out, angle and velocity alike.
"""

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from imudrv.errors import InputError

RateFilterName: TypeAlias = Literal["causal", "centred", "dither"]
NAMES: Final[tuple[RateFilterName, ...]] = ("causal", "centred", "dither")

DITHER_HZ: Final = 400.0
"""Dither frequency of a 50-type block, Hz."""
_HALF_LENGTH: Final = 12
_STOP_FROM: Final = 0.25


@dataclass(frozen=True)
class RateFilter:
    """An FIR for the rate at interval ends.

    Parameters
    ----------
    name : str
        How users call it.
    taps : ndarray, shape (M + 1 + lag,)
        h_j from the oldest, j = -M, to the newest, j = lag.
    lag : int
        Samples by which the output is late.
    """

    name: RateFilterName
    taps: NDArray[np.float64]
    lag: int


def rate_filter(name: RateFilterName, interval_ns: int) -> RateFilter:
    """Make the filter called `name` for a sample interval.

    Parameters
    ----------
    name : {'causal', 'centred', 'dither'}
        ``causal``: no lag, exact for a rate quadratic in time. ``centred``: lag 1, exact for a linear one, a
        third of the noise. ``dither``: lag 12, exact for a quadratic one, takes out what lies above a quarter
        of the sample rate, where the dither of a raw block is.
    interval_ns : int
        Sample interval, ns.

    Returns
    -------
    RateFilter
        Its taps and lag.

    Raises
    ------
    InputError
        ``dither`` at a sample rate at which the dither is aliased into the motion.
    """
    if name == "causal":
        return RateFilter(name, np.array([2.0, -7.0, 11.0]) / 6.0, 0)
    if name == "centred":
        return RateFilter(name, np.array([0.5, 0.5]), 1)
    rate_hz = 1e9 / interval_ns
    aliased = abs(DITHER_HZ - rate_hz * round(DITHER_HZ / rate_hz))
    if aliased < _STOP_FROM * rate_hz:
        raise InputError(
            f"rate filter dither: expected a sample rate at which {DITHER_HZ:.0f} Hz stays above a quarter"
            f" of it, got {rate_hz:g} Hz, where it appears at {aliased:g} Hz; use causal or centred"
        )
    return RateFilter(name, _dither_taps(), _HALF_LENGTH)


def _dither_taps() -> NDArray[np.float64]:
    """Least energy above a quarter of the sample rate, exact for a rate up to quadratic in time.

    Symmetric about the interval's end: tap j weighs the mean rate over an interval centred c = j - 1/2
    intervals from it. A constant rate asks for sum h = 1; a quadratic one, whose mean over that interval is
    proportional to c^2 + 1/12, for sum h (c^2 + 1/12) = 0; odd powers vanish by symmetry.
    """
    c = np.arange(_HALF_LENGTH) + 0.5
    frequency = np.linspace(_STOP_FROM, 0.5, 512)
    response = 2.0 * np.cos(2.0 * np.pi * np.outer(frequency, c))
    exactness = 2.0 * np.vstack([np.ones_like(c), c**2 + 1.0 / 12.0])
    size = _HALF_LENGTH
    kkt = np.block([[response.T @ response, exactness.T], [exactness, np.zeros((2, 2))]])
    half = np.linalg.solve(kkt, np.concatenate([np.zeros(size), [1.0, 0.0]]))[:size]
    return np.concatenate([half[::-1], half])
