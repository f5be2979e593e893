"""Upper limits of the coefficients for any data: no other noise makes an Allan variance smaller."""

from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri

from calib.noise.model import KINDS, N, variance_terms
from calib.noise.pyramid import AllanVariance

LEAST_INDEPENDENT: Final = 6.0
"""Least number of independent intervals: those of averaging times up to an eighth of a single stretch."""

CONFIDENCE: Final = 0.95


class Bound(NamedTuple):
    """Upper limit of a coefficient, SI, and the averaging time that gives it.

    Attributes
    ----------
    kind : str
        One of `calib.noise.model.KINDS`.
    value : float
        The limit, 95 %.
    estimate : float
        The coefficient if nothing else made the Allan deviation of that averaging time.
    tau_s : float
    """

    kind: str
    value: float
    estimate: float
    tau_s: float


def is_of_pulses(allan: AllanVariance, channel: int, interval_s: float, pulse: float) -> bool:
    """Return whether a count of pulses, with a random walk below its limit, explains what one channel shows.

    The error of a count is uniform within a pulse. Where pulses come regularly it is no noise: one that
    reverses from averaging time to averaging time has second differences with a mean square of 4/3 pulse^2,
    which is the largest.

    Parameters
    ----------
    allan, channel, interval_s
        As in `bounds`.
    pulse : float
        Smallest change of theta, SI.
    """
    allan = allan.part(allan.independent >= LEAST_INDEPENDENT)
    tau_s = allan.tau_s(interval_s)
    walk = bounds(allan, channel, interval_s)[N].value
    explained = (2.0 / 3.0) * (pulse / tau_s) ** 2 + walk**2 / tau_s
    return bool((allan.variance[:, channel] / interval_s**2 <= explained).all())


def bounds(allan: AllanVariance, channel: int, interval_s: float) -> tuple[Bound, ...]:
    """Return the upper limit of each coefficient of one channel.

    Parameters
    ----------
    allan : AllanVariance
        Theta in SI.
    channel : int
        Its number.
    interval_s : float
        Sample interval.

    Returns
    -------
    tuple of Bound
        In the order of `calib.noise.model.KINDS`.
    """
    allan = allan.part(allan.independent >= LEAST_INDEPENDENT)
    tau_s = allan.tau_s(interval_s)
    degrees = np.floor(allan.independent)
    deviation = np.sqrt(allan.variance[:, channel]) / interval_s
    estimates = deviation[:, None] / np.sqrt(variance_terms(tau_s))
    limits = estimates * np.sqrt(degrees / chdtri(degrees, CONFIDENCE))[:, None]
    at = np.argmin(limits, axis=0)
    return tuple(
        Bound(kind, float(limits[i, k]), float(estimates[i, k]), float(tau_s[i]))
        for k, (kind, i) in enumerate(zip(KINDS, at.tolist(), strict=True))
    )
