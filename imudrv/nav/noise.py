"""Noise from the variances of differences."""

import numpy as np
import scipy  # its parts are loaded when they are used

from imudrv.arrays import Array


def fit_noise_model(variance: Array, model: Array, weight: Array) -> Array:
    """Fit variances over several lags by a sum of kinds of noise, none of them negative.

    Parameters
    ----------
    variance : ndarray, shape (n,)
        Variance of the differences over each lag.
    model : ndarray, shape (n, k)
        What each kind of noise contributes to it, per unit of its own variance.
    weight : ndarray, shape (n,)
        One over the standard deviation of each variance.

    Returns
    -------
    ndarray, shape (k,)
        Variance of each kind of noise.
    """
    weighted = model * weight[:, None]
    size = np.linalg.norm(weighted, axis=0)
    parts, _ = scipy.optimize.nnls(weighted / size, variance * weight)
    fitted: Array = parts / size
    return fitted
