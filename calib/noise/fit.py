"""Coefficients of the noise by generalised least squares on Allan variances.

The estimates at different averaging times come from the same data, so they are correlated. Their covariance
follows from the spectrum of the fitted model; fit and covariance are computed in turn. The lowest averaging
times are left out where the model does not describe them: pulses that come regularly are lines there, not
white noise.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy  # its parts are loaded when they are used
from scipy.linalg import cholesky, solve_triangular

from calib.noise.estimates import EstimatesCovariance
from calib.noise.model import B, variance_terms
from calib.noise.pyramid import AllanVariance
from imudrv.arrays import Array

PART: Final = 8.0
"""Averaging times go up to this part of the longest stretch."""
ROUNDS: Final = 3
MOST_CHI_SQUARE: Final = 2.0
"""Reduced chi-square above which the model does not describe the data."""
HOPELESS: Final = 10.0 * MOST_CHI_SQUARE
"""That of the first round above which there is no second."""
LEAST_RANGE: Final = 30.0
"""Least ratio of the longest to the shortest fitted averaging time."""
OCTAVE: Final = 2.0
"""Factor by which the shortest fitted averaging time is raised."""
SIGMAS: Final = 2.0
"""A coefficient is observable if its square is this many times its standard uncertainty."""
QUANTILE_95: Final = 1.645
"""Quantile of the normal distribution, one-sided."""

_RIDGE: Final = 1e-9
"""Added to the correlation matrix of the estimates, against rounding."""


@dataclass(frozen=True)
class Fit:
    """Coefficients of one channel, SI; arrays have the columns of `calib.noise.model.KINDS`.

    Attributes
    ----------
    tau_s : ndarray, shape (n,)
        Fitted averaging times.
    value, sigma : ndarray, shape (5,)
        Coefficients and their standard uncertainties; NaN: not observable.
    below : ndarray, shape (5,)
        Upper limits, 95 %, beside all other kinds.
    squares : ndarray, shape (5,)
        Squares of the coefficients of the fitted curve.
    deviation_sigma : ndarray, shape (n,)
        Standard uncertainty of the Allan deviations.
    chi_square : float
        Chi-square of the fit.
    degrees_of_freedom : int
    """

    tau_s: Array
    value: Array
    sigma: Array
    below: Array
    squares: Array
    deviation_sigma: Array
    chi_square: float
    degrees_of_freedom: int

    @property
    def reduced_chi_square(self) -> float:
        """Chi-square per degree of freedom."""
        return self.chi_square / self.degrees_of_freedom

    @property
    def is_accepted(self) -> bool:
        """Whether the model describes the data."""
        return self.reduced_chi_square <= MOST_CHI_SQUARE


def usable(allan: AllanVariance) -> AllanVariance:
    """Return the variances of the averaging times that the longest stretch allows."""
    return allan.part(allan.factors <= allan.longest / PART)


def fit(allan: AllanVariance, channel: int, interval_s: float, estimates: EstimatesCovariance) -> Fit:
    """Fit the model to one channel.

    Parameters
    ----------
    allan : AllanVariance
        From `usable`; theta in SI.
    channel : int
        Its number.
    interval_s : float
        Sample interval.
    estimates : EstimatesCovariance
        That of `allan`; the same for all channels.

    Returns
    -------
    Fit
        That with the shortest averaging times which the model describes; if there is none, that over all.
    """
    tau_s = allan.tau_s(interval_s)
    variance = allan.variance[:, channel] / interval_s**2
    whole = candidate = _fit(tau_s, variance, allan.independent, estimates)
    least_s = tau_s[0]
    while not candidate.is_accepted:
        least_s *= OCTAVE
        kept = tau_s >= least_s
        if least_s * LEAST_RANGE > tau_s[-1]:
            return whole
        candidate = _fit(tau_s[kept], variance[kept], allan.independent[kept], estimates.part(kept))
    return candidate


def _fit(tau_s: Array, variance: Array, independent: Array, estimates: EstimatesCovariance) -> Fit:
    terms = variance_terms(tau_s)
    covariance = np.diag(variance**2 / independent)
    for round_ in range(1 + ROUNDS):
        root = _root(covariance)
        whitened, size = _whitened(root, terms)
        squares, norm = scipy.optimize.nnls(whitened, solve_triangular(root, variance, lower=True))
        squares /= size
        degrees = len(tau_s) - int(np.count_nonzero(squares))
        if round_ and norm**2 > HOPELESS * degrees:
            break
        covariance = estimates.matrix(squares)
    sigma = _sigma(whitened) / size
    observable = squares > SIGMAS * sigma  # beside all other kinds, also those that are not there
    limits = _limits(squares, sigma, terms, estimates)
    present = squares > 0.0
    sigma[present] = _sigma(whitened[:, present]) / size[present]
    observable[B] &= np.argmin(variance) < len(variance) - 1  # it may fall further
    value = np.sqrt(np.where(observable, squares, np.nan))
    return Fit(
        tau_s,
        value,
        sigma / (2.0 * value),
        np.sqrt(limits),
        squares,
        np.sqrt(np.diag(covariance)) / (2.0 * np.sqrt(variance)),
        float(norm**2),
        degrees,
    )


def _limits(squares: Array, sigma: Array, terms: Array, estimates: EstimatesCovariance) -> Array:
    """Return the upper limits of the squares.

    A noise that is as strong as its limit scatters more than the fitted one; its own scatter counts.
    """
    limits = np.empty_like(squares)
    for k in range(len(squares)):
        strong = squares.copy()
        strong[k] += QUANTILE_95 * sigma[k]
        whitened, size = _whitened(_root(estimates.matrix(strong)), terms)
        limits[k] = squares[k] + QUANTILE_95 * (_sigma(whitened) / size)[k]
    return limits


def _whitened(root: Array, terms: Array) -> tuple[Array, Array]:
    """Return the whitened terms of the model, scaled to unit length, and their lengths before that."""
    whitened = solve_triangular(root, terms, lower=True)
    size = np.linalg.norm(whitened, axis=0)
    return whitened / size, size


def _sigma(whitened: Array) -> Array:
    """Return the standard uncertainties of the parameters of whitened equations."""
    sigma: Array = np.sqrt(np.diag(np.linalg.inv(whitened.T @ whitened)))
    return sigma


def _root(covariance: Array) -> Array:
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / sigma / sigma[:, None]
    root: Array = sigma[:, None] * cholesky(correlation + _RIDGE * np.eye(len(sigma)), lower=True)
    return root
