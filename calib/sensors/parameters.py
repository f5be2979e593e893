"""Parameters of the sensors as the adjustment estimates them, and as the numbers of a certificate.

With nu and s, rates of the gyros and forces of the accelerometers at the nominal scale factors, rad/s, m/s^2:

    omega_b = W nu - beta                e = s - b                f_b = M (e - q e^2) - (size effect) - (skew)

W and M (3x3) hold scale and axes together; beta is in body axes, b and q on the sensing axes. The rows of
inv(W) have the lengths k0 / k_g and the directions of the gyros' axes, those of inv(M) the lengths K / K0 and
the directions of the accelerometers' axes. `q` is the quadratic term, s^2/m, or with `asymmetry` the relative
difference of the scales of positive and negative input, with |e| / 2 instead of e^2.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Final, Literal, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from imudrv.arrays import Array
from imudrv.calibration import Calibration, coefficients
from imudrv.profiles.schema import Profile
from imudrv.units import ARCSEC, DEG_PER_H, MM, PPM, STANDARD_GRAVITY, UG

Nonlinearity: TypeAlias = Literal["quadratic", "asymmetry"]

W, BETA, M, B, Q, R, SKEW = (
    slice(0, 9),
    slice(9, 12),
    slice(12, 21),
    slice(21, 24),
    slice(24, 27),
    slice(27, 36),
    slice(36, 37),
)
"""Columns of the parameters that a motion shows by itself: W and M by rows, R = (r_x, r_y, r_z)."""
BASE: Final = 37
"""Number of these columns."""
BETA_T, GYRO_SCALE_T, B_T, ACCELEROMETER_SCALE_T = (
    slice(37, 40),
    slice(40, 43),
    slice(43, 46),
    slice(46, 49),
)
"""Columns of the slopes per kelvin."""
GRAVITY, EARTH = slice(49, 50), slice(50, 52)
"""Columns of gravity, m/s^2, and of the Earth rate north and up, rad/s."""
COLUMNS: Final = 52
"""Number of columns of one unit at one site."""

UPPER: Final = (1, 2, 5)
"""Columns of W above the diagonal: zero where the body axes are put along the gyros."""

K2: Final = UG / STANDARD_GRAVITY**2
"""One ug/g^2, s^2/m."""

GYRO_SCALE_PRIOR: Final = 2000 * PPM
ACCELEROMETER_SCALE_PRIOR: Final = 5000 * PPM
AXIS_PRIOR: Final = 400 * ARCSEC
"""Uncertainty of what the rests and motions do not show (contract, 3.6), 1 sigma."""


def _zeros() -> Array:
    return np.zeros(3)


@dataclass(frozen=True)
class Slopes:
    """Change per kelvin: rad/s, relative, m/s^2 at nominal scale, relative."""

    beta: Array = field(default_factory=_zeros)
    gyro_scale: Array = field(default_factory=_zeros)
    b: Array = field(default_factory=_zeros)
    accelerometer_scale: Array = field(default_factory=_zeros)


@dataclass(frozen=True)
class Parameters:
    """Parameters of one unit, gravity and Earth rate of its site, SI.

    Attributes
    ----------
    W, M : ndarray, shape (3, 3)
    beta, b, q : ndarray, shape (3,)
    r_b : ndarray, shape (3, 3)
        Row i: sensing point of accelerometer i, m.
    skew_s : float
        Time by which an interval of the accelerometers ends later than that of the gyros.
    gravity : float
        m/s^2.
    earth : ndarray, shape (2,)
        Earth rate north and up, rad/s.
    slopes : Slopes
    nonlinearity : {'quadratic', 'asymmetry'}
        Meaning of `q`.
    """

    gravity: float
    earth: Array
    W: Array = field(default_factory=lambda: np.eye(3))
    beta: Array = field(default_factory=_zeros)
    M: Array = field(default_factory=lambda: np.eye(3))
    b: Array = field(default_factory=_zeros)
    q: Array = field(default_factory=_zeros)
    r_b: Array = field(default_factory=lambda: np.zeros((3, 3)))
    skew_s: float = 0.0
    slopes: Slopes = Slopes()
    nonlinearity: Nonlinearity = "quadratic"

    @property
    def f_n(self) -> Array:
        """Specific force at rest, east, north, up."""
        return np.array([0.0, 0.0, self.gravity])

    @property
    def omega_ie_n(self) -> Array:
        """Earth rate, east, north, up."""
        return np.array([0.0, *self.earth])

    @property
    def G(self) -> Array:
        """Directions of the gyros' axes in b, by rows."""
        return _directions(self.W)[0]

    @property
    def A(self) -> Array:
        """Directions of the accelerometers' axes in b, by rows."""
        return _directions(self.M)[0]

    def moved(self, step: Array) -> Self:
        """Return the parameters moved by a step, shape (COLUMNS,)."""
        slopes = self.slopes
        return replace(
            self,
            W=self.W + step[W].reshape(3, 3),
            beta=self.beta + step[BETA],
            M=self.M + step[M].reshape(3, 3),
            b=self.b + step[B],
            q=self.q + step[Q],
            r_b=self.r_b + step[R].reshape(3, 3),
            skew_s=self.skew_s + float(step[SKEW][0]),
            gravity=self.gravity + float(step[GRAVITY][0]),
            earth=self.earth + step[EARTH],
            slopes=Slopes(
                slopes.beta + step[BETA_T],
                slopes.gyro_scale + step[GYRO_SCALE_T],
                slopes.b + step[B_T],
                slopes.accelerometer_scale + step[ACCELEROMETER_SCALE_T],
            ),
        )

    def rotated(self, C: Array) -> Self:
        """Return the parameters in other body axes, of which `C` takes components from these."""
        return replace(
            self,
            W=C @ self.W,
            beta=C @ self.beta,
            M=C @ self.M,
            r_b=self.r_b @ C.T,
            slopes=replace(self.slopes, beta=C @ self.slopes.beta),
        )


class NominalScales(NamedTuple):
    """Nominal scale factors of a unit; 1 where it sends no pulses."""

    gyro: float  # rad per pulse
    accelerometer: float  # pulses per m/s
    gyro_in_pulses: bool = True
    accelerometer_in_pulses: bool = True


def nominal_scales(profile: Profile, start: Calibration | None) -> NominalScales | None:
    """Return the scale factors that the parameters are relative to; None where none are known."""
    gyro, accelerometer = profile.layout().sensors
    stated = profile.nominal
    k0 = stated.gyro_arcsec_per_pulse if stated and gyro.in_pulses else None
    K0 = stated.accelerometer_pulse_per_m_s if stated and accelerometer.in_pulses else None
    known = coefficients(start) if start is not None else None
    if gyro.in_pulses and k0 is None and known is not None:
        k0 = float(known.gyro_scale.mean()) / ARCSEC
    if accelerometer.in_pulses and K0 is None and known is not None:
        K0 = float(known.accelerometer_scale.mean())
    if (gyro.in_pulses and k0 is None) or (accelerometer.in_pulses and K0 is None):
        return None
    return NominalScales(k0 * ARCSEC if k0 else 1.0, K0 or 1.0, gyro.in_pulses, accelerometer.in_pulses)


def _directions(matrix: Array) -> tuple[Array, Array]:
    """Return directions and lengths of the rows of the inverse."""
    rows = np.linalg.inv(matrix)
    lengths = np.linalg.norm(rows, axis=1)
    return rows / lengths[:, None], lengths


class Number(NamedTuple):
    """A number of the certificate."""

    path: str
    value: float  # in the unit of the file


def numbers(p: Parameters, nominal: NominalScales) -> list[Number]:
    """Return the numbers of the certificate that parameters are, in the units of the file.

    Parameters
    ----------
    p : Parameters
    nominal : NominalScales
        Scale factors that they are relative to.

    Returns
    -------
    list of Number
        In a fixed order.
    """
    return [Number(path, float(value)) for path, value in _numbers(p, nominal)]


def _numbers(p: Parameters, nominal: NominalScales) -> Iterator[tuple[str, float]]:
    G, gyro_lengths = _directions(p.W)
    A, lengths = _directions(p.M)
    gyro_unit = ARCSEC if nominal.gyro_in_pulses else 1.0
    gyro_key = "scale_arcsec_per_pulse" if nominal.gyro_in_pulses else "scale"
    key = "scale_pulse_per_m_s" if nominal.accelerometer_in_pulses else "scale"
    yield from _row(f"gyro.{gyro_key}", nominal.gyro / gyro_lengths / gyro_unit)
    yield from _row("gyro.bias_deg_per_h", p.beta / DEG_PER_H)
    yield from _rows("gyro.C_bg", np.linalg.inv(G))
    yield from _row(f"accelerometer.{key}", nominal.accelerometer * lengths)
    yield from _row("accelerometer.bias_ug", p.b / lengths / UG)
    yield from _rows("accelerometer.C_ba", np.linalg.inv(A))
    if p.nonlinearity == "quadratic":
        yield from _row("accelerometer.quadratic_ug_per_g2", p.q * lengths / K2)
    else:
        yield from _row("accelerometer.asymmetry_ppm", p.q / PPM)
    for axis, r in zip("xyz", p.r_b / MM, strict=True):
        yield from _row(f"size_effect.r_mm.{axis}", r)
    yield "skew_ms", p.skew_s / 1e-3
    slopes = p.slopes
    yield from _row("temperature.gyro_bias_deg_per_h_per_k", slopes.beta / DEG_PER_H)
    yield from _row("temperature.gyro_scale_ppm_per_k", slopes.gyro_scale / PPM)
    yield from _row("temperature.accelerometer_bias_ug_per_k", slopes.b / lengths / UG)
    yield from _row("temperature.accelerometer_scale_ppm_per_k", slopes.accelerometer_scale / PPM)


def _row(path: str, values: NDArray[np.floating]) -> Iterator[tuple[str, float]]:
    for k, value in enumerate(values):
        yield f"{path}[{k}]", value


def _rows(path: str, matrix: NDArray[np.floating]) -> Iterator[tuple[str, float]]:
    for k, row in enumerate(matrix):
        yield from _row(f"{path}[{k}]", row)


def numbers_jacobian(p: Parameters, nominal: NominalScales) -> Array:
    """Return the derivative of `numbers` by the parameters, shape (numbers, COLUMNS), by differences."""
    columns = []
    for k in range(COLUMNS):
        step = np.zeros(COLUMNS)
        step[k] = _STEPS[k]
        ahead, behind = (
            np.array([n.value for n in numbers(p.moved(sign * step), nominal)]) for sign in (1.0, -1.0)
        )
        columns.append((ahead - behind) / (2.0 * _STEPS[k]))
    return np.stack(columns, axis=1)


def _steps() -> Array:
    """Return a step of each column: the functions are smooth, and linear in most."""
    steps = np.full(COLUMNS, 1e-5)
    steps[BETA], steps[B], steps[Q] = DEG_PER_H, 100 * UG, 10 * K2
    steps[BETA_T], steps[B_T] = DEG_PER_H, UG
    return steps


_STEPS: Final = _steps()


def start_parameters(
    gravity: float,
    earth: Array,
    nominal: NominalScales,
    start: Calibration | None,
    nonlinearity: Nonlinearity,
) -> Parameters:
    """Return the starting values: those of a certificate, or nominal scale factors and aligned axes."""
    if start is None:
        return Parameters(gravity, earth, nonlinearity=nonlinearity)
    c = coefficients(start)
    lengths = c.accelerometer_scale / nominal.accelerometer
    accelerometer, terms = start.accelerometer, c.temperature
    curved = (
        np.array(accelerometer.quadratic_ug_per_g2 or (0.0, 0.0, 0.0)) * K2 / lengths
        if nonlinearity == "quadratic"
        else np.array(accelerometer.asymmetry_ppm or (0.0, 0.0, 0.0)) * PPM
    )
    return Parameters(
        gravity,
        earth,
        W=c.C_bg * (c.gyro_scale / nominal.gyro),
        beta=np.array(c.gyro_bias),
        M=c.C_ba / lengths,
        b=c.accelerometer_bias * lengths,
        q=curved,
        r_b=np.zeros((3, 3)) if c.r_b is None else np.array(c.r_b),
        skew_s=(start.skew_ms or 0.0) * 1e-3,
        slopes=Slopes()
        if terms is None
        else Slopes(
            terms.gyro_bias, terms.gyro_scale, terms.accelerometer_bias * lengths, terms.accelerometer_scale
        ),
        nonlinearity=nonlinearity,
    )
