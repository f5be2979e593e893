"""Keys of a certificate that the calibration of the sensors adds: noise, and how the sensors were calibrated.

A covariance belongs to the numbers of one certificate: it names each of them by its path in the file, such as
`gyro.C_bg[1][0]`, and is in the units of the file.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field as Key
from pydantic import model_validator

from imudrv.arrays import Array
from imudrv.files.model import Model

MOST_PARAMETERS: Final = 64
"""Most parameters of a covariance: a certificate with every key has 58."""
COVARIANCE_TOLERANCE: Final = 1e-6
"""Largest negative eigenvalue of the correlation matrix: numbers are rounded to six digits at least."""

Name = Annotated[str, Key(min_length=1, max_length=120)]
Digest = Annotated[str, Key(pattern=r"^[0-9a-f]{64}$")]
Amount = Annotated[float, Key(ge=0, le=1e9)]
Coefficient = tuple[Amount, Amount, Amount] | None
Celsius = Annotated[float, Key(ge=-100, le=200)]
Seconds = Annotated[float, Key(ge=0, le=1e7)]


class GyroNoise(Model):
    """Allan coefficients of the gyros X, Y, Z; None: not observable."""

    quantisation_arcsec: Coefficient = None
    angle_random_walk_deg_per_sqrt_h: Coefficient = None
    bias_instability_deg_per_h: Coefficient = None
    rate_random_walk_deg_per_h_per_sqrt_h: Coefficient = None
    rate_ramp_deg_per_h_per_h: Coefficient = None


class AccelerometerNoise(Model):
    """Allan coefficients of the accelerometers X, Y, Z; None: not observable."""

    quantisation_mm_per_s: Coefficient = None
    velocity_random_walk_ug_per_sqrt_hz: Coefficient = None
    bias_instability_ug: Coefficient = None
    acceleration_random_walk_ug_per_sqrt_h: Coefficient = None
    acceleration_ramp_ug_per_h: Coefficient = None


class Noise(Model):
    """Noise of the unit, as a long rest shows it."""

    gyro: GyroNoise = GyroNoise()
    accelerometer: AccelerometerNoise = AccelerometerNoise()


class CapturedFile(Model):
    """A capture and the SHA-256 of its content."""

    name: Name
    sha256: Digest


class CalibrationRest(Model):
    """A rest, with the pose and the mean temperature of the unit in it."""

    pose: Name
    start_s: Seconds
    duration_s: Seconds
    temperature_degc: Celsius | None = None


class Wander(Model):
    """Change of the biases from rest to rest, 1 sigma."""

    gyro_deg_per_h: Amount
    accelerometer_ug: Amount


class Gravity(Model):
    """Gravity of the site, m/s^2, with its 1 sigma."""

    m_s2: Annotated[float, Key(ge=9.7, le=9.9)]
    source: Literal["measured", "normal"]
    sigma_m_s2: Annotated[float, Key(ge=0, le=0.1)]


class Covariance(Model):
    """Covariance of numbers of the certificate; singular where a gauge or a row of length 1 makes it so.

    Attributes
    ----------
    names : tuple of str
        Path of each number, such as `accelerometer.bias_ug[2]`.
    lower_triangle : tuple of tuple of float
        Row k has k + 1 numbers, in the units of the file.
    """

    names: Annotated[tuple[Name, ...], Key(min_length=1, max_length=MOST_PARAMETERS)]
    lower_triangle: Annotated[tuple[tuple[float, ...], ...], Key(max_length=MOST_PARAMETERS)]

    @model_validator(mode="after")
    def _is_one(self) -> Self:
        if twice := [name for name, n in Counter(self.names).items() if n > 1]:
            raise ValueError(f"expected each name once, got {', '.join(twice)} again")
        lengths, expected = [len(row) for row in self.lower_triangle], list(range(1, len(self.names) + 1))
        if lengths != expected:
            raise ValueError(
                f"expected a lower triangle with rows of 1 to {len(self.names)} numbers, one row a name, got "
                f"rows of {', '.join(map(str, lengths)) or 'none'}"
            )
        variance = np.diag(self.matrix)
        if variance.min() < 0.0:
            raise ValueError(
                f"expected no negative variance, got {variance.min():.3g} of "
                f"{self.names[int(variance.argmin())]}"
            )
        sigma = np.sqrt(np.where(variance > 0.0, variance, 1.0))
        with np.errstate(over="ignore"):
            correlation = self.matrix / sigma / sigma[:, None]
        if not np.abs(correlation).max() <= 1.0 + COVARIANCE_TOLERANCE:
            i, j = np.unravel_index(int(np.abs(correlation).argmax()), correlation.shape)
            raise ValueError(
                f"expected correlations of at most 1, got {correlation[i, j]:.3g} of {self.names[i]} and "
                f"{self.names[j]}"
            )
        least = float(np.linalg.eigvalsh(correlation)[0])
        if least < -COVARIANCE_TOLERANCE * len(self.names):
            raise ValueError(
                f"expected no negative variance in any direction, got an eigenvalue of {least:.3g} of the "
                "correlation matrix"
            )
        return self

    @property
    def matrix(self) -> Array:
        """The whole matrix, shape (n, n), in the units of the file."""
        n = len(self.names)
        lower = np.zeros((n, n))
        lower[np.tril_indices(n)] = np.concatenate(self.lower_triangle)
        matrix: Array = lower + np.tril(lower, -1).T
        return matrix


class SensorsProvenance(Model):
    """How the sensors were calibrated: `provenance.sensors`.

    Attributes
    ----------
    not_observable : tuple of str
        Paths of the numbers that the rests and motions do not determine.
    """

    software: Name | None = None
    captures: Annotated[tuple[CapturedFile, ...], Key(max_length=1000)] = ()
    procedure: Name | None = None
    rests: Annotated[tuple[CalibrationRest, ...], Key(max_length=1000)] = ()
    chi_square: Amount | None = None
    degrees_of_freedom: Annotated[int, Key(ge=0, le=10**9)] | None = None
    wander: Wander | None = None
    gravity: Gravity | None = None
    not_observable: Annotated[tuple[Name, ...], Key(max_length=MOST_PARAMETERS)] = ()
    covariance: Covariance | None = None


def number_paths(section: object, path: str = "") -> Iterator[str]:
    """Yield the path of each number in a part of a file, `bias_ug[0]` or `C_bg[1][0]`."""
    if isinstance(section, Mapping):
        for key, value in section.items():
            yield from number_paths(value, f"{path}.{key}" if path else str(key))
    elif isinstance(section, list | tuple):
        for k, value in enumerate(section):
            yield from number_paths(value, f"{path}[{k}]")
    elif isinstance(section, float):
        yield path
