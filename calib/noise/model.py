"""The model of IEEE 647 and 952: five kinds of noise, their Allan variance and spectrum, and their units.

    sigma^2 = 3 Q^2 / tau^2 + N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3 + R^2 tau^2 / 2

N is the square root of a two-sided density, as in the standards: that of a one-sided one, divided by sqrt(2).
"""

from math import log, pi
from typing import Final, NamedTuple

import numpy as np

from imudrv.arrays import Array
from imudrv.units import ARCSEC, DEG_PER_H, DEG_PER_SQRT_H, MM, UG

KINDS: Final = "QNBKR"
Q, N, B, K, R = range(5)
"""Quantisation, random walk, bias instability, rate random walk, ramp: columns of all arrays here."""
FLICKER: Final = 2.0 * log(2.0) / pi
"""Allan variance of flicker noise, in units of B^2."""


class Coefficient(NamedTuple):
    """A coefficient of a sensor: its name, its key in a certificate, its unit, and that unit in SI."""

    name: str
    key: str
    unit: str
    si: float


_HOUR: Final = 3600.0
GYRO: Final = (
    Coefficient("quantisation", "quantisation_arcsec", "arcsec", ARCSEC),
    Coefficient("angle random walk", "angle_random_walk_deg_per_sqrt_h", "deg/sqrt(h)", DEG_PER_SQRT_H),
    Coefficient("bias instability", "bias_instability_deg_per_h", "deg/h", DEG_PER_H),
    Coefficient(
        "rate random walk",
        "rate_random_walk_deg_per_h_per_sqrt_h",
        "deg/h/sqrt(h)",
        DEG_PER_H / _HOUR**0.5,
    ),
    Coefficient("rate ramp", "rate_ramp_deg_per_h_per_h", "deg/h/h", DEG_PER_H / _HOUR),
)
ACCELEROMETER: Final = (
    Coefficient("quantisation", "quantisation_mm_per_s", "mm/s", MM),
    Coefficient("velocity random walk", "velocity_random_walk_ug_per_sqrt_hz", "ug/sqrt(Hz)", UG),
    Coefficient("bias instability", "bias_instability_ug", "ug", UG),
    Coefficient(
        "acceleration random walk", "acceleration_random_walk_ug_per_sqrt_h", "ug/sqrt(h)", UG / _HOUR**0.5
    ),
    Coefficient("acceleration ramp", "acceleration_ramp_ug_per_h", "ug/h", UG / _HOUR),
)
VELOCITY_WALK: Final = Coefficient("velocity random walk", "", "m/s/sqrt(h)", 1.0 / _HOUR**0.5)
"""The same in the unit of a velocity that grows with time."""


def variance_terms(tau_s: Array) -> Array:
    """Return the Allan variance of each kind of noise with a coefficient of 1.

    Parameters
    ----------
    tau_s : ndarray, shape (n,)
        Averaging times.

    Returns
    -------
    ndarray, shape (n, 5)
    """
    one = np.ones_like(tau_s)
    terms: Array = np.stack(
        [3.0 / tau_s**2, one / tau_s, FLICKER * one, tau_s / 3.0, tau_s**2 / 2.0], axis=-1
    )
    return terms


def spectrum(squares: Array, omega: Array) -> Array:
    """Return the two-sided spectral density of the rate without quantisation and ramp.

    Parameters
    ----------
    squares : ndarray, shape (5,)
        Squares of the coefficients.
    omega : ndarray, shape (f,)
        Angular frequencies, rad/s; for samples 2 sin(pi f tau0) / tau0, as of a difference.

    Returns
    -------
    ndarray, shape (f,)
    """
    density: Array = squares[N] + squares[B] / omega + squares[K] / omega**2
    return density
