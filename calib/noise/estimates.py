"""Covariance of Allan variances at several averaging times, estimated from the same data."""

from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from calib.noise.model import K, Q, R, spectrum
from calib.noise.pyramid import AllanVariance
from imudrv.arrays import Array

_PER_DECADE: Final = 200
_LOWEST: Final = 1e-3
"""Lowest frequency of the integrals, times the longest averaging time: their error, at most."""


class EstimatesCovariance:
    """Covariance of Allan variances for any coefficients of the model.

    Parameters
    ----------
    allan : AllanVariance
        Averaging factors and counts.
    interval_s : float
        Sample interval.

    Notes
    -----
    4/T int S^2 H_1 H_2 df with H = 2 sin^4(pi f tau) / (pi f tau)^2, for samples instead of a continuous
    signal. The part of the quantisation alone, which has no end towards high frequencies, is that of a white
    angle in closed form. A ramp is no noise; it multiplies the noise at zero frequency.
    """

    def __init__(self, allan: AllanVariance, interval_s: float) -> None:
        self._interval_s = interval_s
        self._tau_s = tau_s = allan.tau_s(interval_s)
        total_s = allan.counts * allan.steps * interval_s
        self._total_s = np.maximum(total_s, total_s[:, None])
        step = np.minimum(allan.steps, allan.steps[:, None])
        number = self._total_s / (interval_s * step)
        self._of_quantisation = _white_angle(allan.factors) / (2.0 * number * np.outer(tau_s, tau_s) ** 2)
        nyquist, lowest = 0.5 / interval_s, _LOWEST / tau_s[-1]
        self._frequency = np.geomspace(lowest, nyquist, round(_PER_DECADE * np.log10(nyquist / lowest)))
        self._omega = 2.0 * np.sin(np.pi * self._frequency * interval_s) / interval_s
        self._width = np.gradient(self._frequency)
        self._width[-1] *= 0.5  # its cell ends at half the sample rate
        self._H = (
            8.0 * np.sin(np.pi * np.outer(tau_s, self._frequency)) ** 4 / np.outer(tau_s, self._omega) ** 2
        )

    def part(self, chosen: NDArray[np.bool_]) -> Self:
        """Return the same for some of the averaging times."""
        part = object.__new__(type(self))
        part.__dict__.update(self.__dict__)
        part._tau_s, part._H = self._tau_s[chosen], self._H[chosen]
        part._total_s = self._total_s[np.ix_(chosen, chosen)]
        part._of_quantisation = self._of_quantisation[np.ix_(chosen, chosen)]
        return part

    def matrix(self, squares: Array) -> Array:
        """Return the covariance.

        Parameters
        ----------
        squares : ndarray, shape (5,)
            Squares of the coefficients, SI.

        Returns
        -------
        ndarray, shape (n, n)
            (rad/s)^4 or (m/s^2)^4.
        """
        smooth = spectrum(squares, self._omega)
        quantised = squares[Q] * self._interval_s * self._omega**2
        root = self._H * np.sqrt(smooth * (smooth + 2.0 * quantised) * self._width)
        covariance: Array = 4.0 / self._total_s * (root @ root.T)
        covariance += squares[Q] ** 2 * self._of_quantisation
        ramp = self._tau_s**2 * np.sqrt(squares[R] * squares[K])  # 2 mu sqrt(S_y(0)), mu^2 = R^2 tau^2 / 2
        covariance += np.outer(ramp, ramp) / self._total_s
        return covariance


def _white_angle(factors: NDArray[np.int64]) -> Array:
    """Return the sum over all lags of the squared covariance of second differences of a white angle."""
    ends = np.array([-1, 0, 1])
    weights = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]).reshape(9)
    first = factors[:, None, None, None] * ends[:, None]
    second = factors[:, None, None] * ends
    lags = (first - second).reshape(len(factors), len(factors), 9)
    total = np.zeros((len(factors), len(factors)))
    for one, weight in enumerate(weights):
        same = lags == lags[:, :, one : one + 1]
        total += weight * (same @ weights)
    return total
