"""Prior uncertainty of a unit: residual errors of its static calibration."""

import re
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from imudrv.arrays import Array
from imudrv.calibration import Calibration
from imudrv.units import DEG_PER_H, MM, PPM, STANDARD_GRAVITY, UG, URAD

SHARED: Final = (
    *(f"accelerometer_bias_{a}" for a in "xyz"),
    *(f"accelerometer_matrix_{a}{b}" for a in "xyz" for b in "xyz"),
    *(f"gyro_bias_{a}" for a in "xyz"),
    *(f"gyro_matrix_{a}{b}" for a in "xyz" for b in "xyz"),
)
"""Errors of the increments that are common to all runs: b_a, dA, b_g, dG; measured minus true."""


@dataclass(frozen=True)
class Priors:
    """Prior uncertainty: 1-sigma of the residual errors, independent unless a covariance is given.

    The defaults are for a unit whose certificate says nothing, and wide for
    the misalignments. With a misalignment m, lever arms r are uncertain by some m r.

    Attributes
    ----------
    accelerometer_bias, accelerometer_scale, accelerometer_misalignment : float
        m/s^2, 1, rad, each axis.
    gyro_bias, gyro_scale, gyro_misalignment : float
        rad/s, 1, rad, each axis.
    accelerometer_bias_of_run, gyro_bias_of_run : float
        Change of the biases from run to run about the common ones, m/s^2 and rad/s.
    skew : float
        Delay of the end of the accelerometers' sample after the gyros', s; 0: known exactly.
    expected_skew : float
        Expected value of that delay, s.
    quadratic : float
        Quadratic term of an accelerometer, 1/(m/s^2).
    arm : float
        A direction of the lever arms with a larger sigma is unobservable, m: a drawing is as accurate.
    covariance : ndarray, shape (24, 24), or None
        Covariance of the errors `SHARED`, SI, in place of the first six; None: those six.
    """

    accelerometer_bias: float = 50.0 * UG
    accelerometer_scale: float = 20.0 * PPM
    accelerometer_misalignment: float = 100.0 * URAD
    gyro_bias: float = 0.01 * DEG_PER_H
    gyro_scale: float = 5.0 * PPM
    gyro_misalignment: float = 100.0 * URAD
    accelerometer_bias_of_run: float = 30.0 * UG
    gyro_bias_of_run: float = 0.01 * DEG_PER_H
    skew: float = 0.5e-3
    expected_skew: float = 0.0
    quadratic: float = 50.0 * UG / STANDARD_GRAVITY**2
    arm: float = 3.0 * MM
    covariance: Array | None = None

    @property
    def shared_covariance(self) -> Array:
        """Covariance of the errors `SHARED`, SI, shape (24, 24)."""
        if self.covariance is not None:
            return self.covariance
        off = ~np.eye(3, dtype=bool)
        sigma = [
            np.full(3, self.accelerometer_bias),
            np.where(off, self.accelerometer_misalignment, self.accelerometer_scale).ravel(),
            np.full(3, self.gyro_bias),
            np.where(off, self.gyro_misalignment, self.gyro_scale).ravel(),
        ]
        return np.diag(np.concatenate(sigma) ** 2)


AGEING: Final = Priors(
    accelerometer_bias=3.0 * UG,
    accelerometer_scale=2.0 * PPM,
    accelerometer_misalignment=3.0 * URAD,
    gyro_bias=0.002 * DEG_PER_H,
    gyro_scale=1.0 * PPM,
    gyro_misalignment=3.0 * URAD,
)
"""Change of a unit since its calibration, added to the covariance of the certificate."""


def certified_priors(calibration: Calibration, priors: Priors | None = None) -> Priors:
    """Return the priors with what the certificate of a unit states.

    Parameters
    ----------
    calibration : Calibration
        Its `skew_ms` is the expected skew. The covariance in it (`provenance.sensors`) replaces the given
        priors of the numbers that it names.
    priors : Priors, optional
        Of everything else.

    Returns
    -------
    Priors
    """
    priors = replace(priors or Priors(), expected_skew=(calibration.skew_ms or 0.0) * 1e-3)
    sensors = calibration.sensors
    if sensors is None or sensors.covariance is None:
        return priors
    names, matrix = sensors.covariance.names, sensors.covariance.matrix
    J = np.array([_error(calibration, name) for name in names]).T
    own = np.diag(priors.shared_covariance).copy()
    for stem, rows in _GROUPS.items():
        if any(name.startswith(stem) for name in names):
            own[rows] = 0.0
    covariance = J @ matrix @ J.T + np.diag(own) + AGEING.shared_covariance
    if "skew_ms" in names:
        k = names.index("skew_ms")
        priors = replace(priors, skew=float(np.sqrt(matrix[k, k])) * 1e-3)
    return replace(priors, covariance=covariance)


_ONES: Final = (1.0, 1.0, 1.0)
_DIAGONAL: Final = np.array([0, 4, 8])
_OFF_DIAGONAL: Final = np.array([1, 2, 3, 5, 6, 7])
_GROUPS: Final = {
    "accelerometer.bias_ug": np.arange(3),
    "accelerometer.scale": 3 + _DIAGONAL,
    "accelerometer.C_ba": 3 + _OFF_DIAGONAL,
    "gyro.bias_deg_per_h": 12 + np.arange(3),
    "gyro.scale": 15 + _DIAGONAL,
    "gyro.C_bg": 15 + _OFF_DIAGONAL,
}
"""Beginning of the paths in a certificate, and the errors of `SHARED` that these numbers cause."""


def _error(calibration: Calibration, name: str) -> Array:
    """Return the errors `SHARED` that one number of the certificate causes, per unit in which it is stated.

    With delta = used - true, `dA = dC_ba A - C_ba diag(dK / K) A`, `b_a = -C_ba (db + b dK / K)`,
    `dG = dC_bg G + C_bg diag(dk / k) G` and `b_g = -dbeta`, where A and G are the inverse matrices. Other
    numbers, such as the skew or those per kelvin, cause none.
    """
    gyro, accelerometer = calibration.gyro, calibration.accelerometer
    C_ba, C_bg = np.array(accelerometer.C_ba), np.array(gyro.C_bg)
    A, G = np.linalg.inv(C_ba), np.linalg.inv(C_bg)
    b_a, dA, b_g, dG = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
    path, *at = re.findall(r"[^\[\]]+", name)
    match path, *map(int, at):
        case "accelerometer.bias_ug", i:
            b_a = -C_ba[:, i] * UG
        case "accelerometer.scale_pulse_per_m_s" | "accelerometer.scale", i:
            K = (accelerometer.scale_pulse_per_m_s or accelerometer.scale or _ONES)[i]
            dA = -np.outer(C_ba[:, i], A[i]) / K
            b_a = -C_ba[:, i] * accelerometer.bias_ug[i] * UG / K
        case "accelerometer.C_ba", i, j:
            dA[i] = A[j]
        case "gyro.bias_deg_per_h", i:
            b_g[i] = -DEG_PER_H
        case "gyro.scale_arcsec_per_pulse" | "gyro.scale", i:
            dG = np.outer(C_bg[:, i], G[i]) / (gyro.scale_arcsec_per_pulse or gyro.scale or _ONES)[i]
        case "gyro.C_bg", i, j:
            dG[i] = G[j]
    return np.concatenate([b_a, dA.ravel(), b_g, dG.ravel()])
