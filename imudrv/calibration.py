"""Calibration certificate of one unit, as a file and in SI.

Fields have the names and units of the file; properties give them as arrays in SI.
"""

import json
import os
from typing import Annotated, Final, Literal, Self, TypeAlias

import numpy as np
from pydantic import AfterValidator, JsonValue, ValidationError, model_validator
from pydantic import Field as Key

from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.files.model import Matrix3, Model, UtcTime
from imudrv.files.settings_file import SettingsFile, read_file, write
from imudrv.imu.coefficients import Coefficients, TemperatureTerms
from imudrv.sensor_calibration import Noise, SensorsProvenance, number_paths
from imudrv.units import ARCSEC, DEG_PER_H, MM, MS, PPM, STANDARD_GRAVITY, UG

NORM_TOLERANCE: Final = 0.1
"""Largest deviation from 1 of the length of a sensing axis, a row of the inverse of an axes matrix."""
MIN_DETERMINANT: Final = 0.3
"""Smallest determinant of the sensing axes: they may be any that span space, but not mirrored."""
GAUGE_TOLERANCE_MM: Final = 1e-5
"""Largest deviation from the stated gauge: ten times the rounding to six decimals."""
COVARIANCE_TOLERANCE_MM2: Final = 5e-6
"""Largest asymmetry and negative eigenvalue of a covariance: nine entries, each rounded to six decimals."""
_NONE: Final = (0.0, 0.0, 0.0)

MAX_PROVENANCE: Final = 1 << 18
"""Largest provenance, characters of JSON."""
PROVENANCE_SENSORS: Final = "sensors"
"""Key in the provenance: how the sensors were calibrated, see `SensorsProvenance`."""

Row9: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]
Matrix9: TypeAlias = tuple[Row9, Row9, Row9, Row9, Row9, Row9, Row9, Row9, Row9]


def _axes(matrix: Matrix3) -> Matrix3:
    C = np.array(matrix)
    with np.errstate(over="ignore", invalid="ignore"):
        determinant = float(np.linalg.det(C))
    if not 1e-6 < abs(determinant) < 1e6:
        raise ValueError(f"expected three independent axes, got a matrix of determinant {determinant:.3g}")
    sensing = np.linalg.inv(C)  # rows: the sensing axes
    norms = np.linalg.norm(sensing, axis=1)
    worst = norms[np.argmax(np.abs(norms - 1.0))]
    if abs(worst - 1.0) > NORM_TOLERANCE:
        raise ValueError(
            f"expected rows of the inverse, the sensing axes, of a length within {NORM_TOLERANCE:g} of 1, "
            f"got one of {worst:.4g}; scale belongs to the scale factors"
        )
    determinant = float(np.linalg.det(sensing))
    if abs(determinant) < MIN_DETERMINANT:
        raise ValueError(
            "expected three independent sensing axes, determinant of the inverse >= "
            f"{MIN_DETERMINANT:g}, got {determinant:.3g}"
        )
    if determinant < 0.0:
        raise ValueError(
            f"expected right-handed axes, determinant > 0, got {determinant:.3g}: a mirror image; for a "
            "reversed sensor set sign: -1 in the profile, for two exchanged ones exchange their axis there"
        )
    return matrix


def _covariance(rows: Matrix9) -> Matrix9:
    P = np.array(rows)
    with np.errstate(over="ignore"):
        asymmetry = float(np.max(np.abs(P - P.T)))
    if asymmetry > COVARIANCE_TOLERANCE_MM2:
        raise ValueError(
            f"expected a symmetric matrix, got entries that differ by {asymmetry:.3g} from their mirror"
        )
    least = float(np.linalg.eigvalsh(P)[0])
    if least < -COVARIANCE_TOLERANCE_MM2:
        raise ValueError(
            f"expected no negative variance in any direction, got an eigenvalue of {least:.3g} mm^2"
        )
    return rows


def _serial_number(text: str) -> str:
    if not text.strip() or text != text.strip() or not text.isprintable():
        raise ValueError(f"expected printable text that neither begins nor ends with a space, got {text!r}")
    return text


def _provenance(values: dict[str, JsonValue]) -> dict[str, JsonValue]:
    try:
        size = len(json.dumps(values, allow_nan=False))
    except ValueError:
        raise ValueError("expected finite numbers, got NaN or infinity") from None
    if size > MAX_PROVENANCE:
        raise ValueError(f"expected at most {MAX_PROVENANCE} characters, got {size}")
    if (sensors := values.get(PROVENANCE_SENSORS)) is not None:
        try:
            _sensors_provenance(sensors)
        except ValidationError as error:
            first = error.errors()[0]
            path = ".".join(map(str, (PROVENANCE_SENSORS, *first["loc"])))
            raise ValueError(f"{path}: {first['msg'].removeprefix('Value error, ')}") from None
    return values


def _sensors_provenance(document: JsonValue) -> SensorsProvenance:
    return SensorsProvenance.model_validate_json(json.dumps(document))


def _range(limits: tuple[float, float]) -> tuple[float, float]:
    if not limits[0] < limits[1]:
        raise ValueError(f"expected the lower temperature first, got {list(limits)}")
    return limits


# Wide enough for any unit of the kind, narrow enough to catch another unit of measure.
GyroScale = Annotated[float, Key(gt=1e-9, le=1e4)]
AccelerometerScale = Annotated[float, Key(gt=1e-9, le=1e9)]
Scale = Annotated[float, Key(ge=0.5, le=2.0)]
GyroBias = Annotated[float, Key(ge=-3600, le=3600)]
AccelerometerBias = Annotated[float, Key(ge=-1e5, le=1e5)]
GyroBiasSlope = Annotated[float, Key(ge=-100, le=100)]
AccelerometerBiasSlope = Annotated[float, Key(ge=-1e4, le=1e4)]
ScaleSlope = Annotated[float, Key(ge=-1e3, le=1e3)]
Quadratic = Annotated[float, Key(ge=-1e4, le=1e4)]
Asymmetry = Annotated[float, Key(ge=-1e4, le=1e4)]
Skew = Annotated[float, Key(ge=-100, le=100)]
Celsius = Annotated[float, Key(ge=-100, le=200)]
Arm = Annotated[float, Key(ge=-1000, le=1000)]
Axes = Annotated[Matrix3, AfterValidator(_axes)]
SerialNumber = Annotated[str, Key(max_length=64), AfterValidator(_serial_number)]
# Base64 in its one canonical form: no other text means the same bytes.
Base64Of32Bytes = Annotated[str, Key(pattern=r"^[A-Za-z0-9+/]{42}[AEIMQUYcgkosw048]=$")]
Base64Of64Bytes = Annotated[str, Key(pattern=r"^[A-Za-z0-9+/]{85}[AQgw]==$")]


def _array(values: object, unit: float = 1.0) -> Array:
    """Make a read-only array of `values`, multiplied by their unit."""
    array = np.array(values, dtype=np.float64) * unit
    array.flags.writeable = False
    return array


class Gyro(Model):
    """The gyros: ``dtheta_b = C_bg @ (scale * N) - bias * tau``.

    N are pulses, or angles of a unit that sends them in angular units; then the scale is about 1.
    `frame`: the body axes are put along the gyros (X along gyro X, Y in the plane of gyros X and Y), or along
    the normals of the faces that the unit stands on.
    """

    scale_arcsec_per_pulse: tuple[GyroScale, GyroScale, GyroScale] | None = None
    scale: tuple[Scale, Scale, Scale] | None = None
    bias_deg_per_h: tuple[GyroBias, GyroBias, GyroBias]
    C_bg: Axes
    frame: Literal["gyro", "faces"] | None = None

    @model_validator(mode="after")
    def _has_one_scale(self) -> Self:
        _require_one(self.scale_arcsec_per_pulse, "scale_arcsec_per_pulse", self.scale)
        return self


class Accelerometer(Model):
    """The accelerometers: ``dv_b = C_ba @ (N / scale - bias * tau)``.

    N are pulses, or velocities of a unit that sends them in units of velocity; then the scale is about 1.
    `quadratic_ug_per_g2`, and `asymmetry_ppm`, the difference of the scales of positive and negative input,
    are on the sensing axes.
    """

    scale_pulse_per_m_s: tuple[AccelerometerScale, AccelerometerScale, AccelerometerScale] | None = None
    scale: tuple[Scale, Scale, Scale] | None = None
    bias_ug: tuple[AccelerometerBias, AccelerometerBias, AccelerometerBias]
    C_ba: Axes
    quadratic_ug_per_g2: tuple[Quadratic, Quadratic, Quadratic] | None = None
    asymmetry_ppm: tuple[Asymmetry, Asymmetry, Asymmetry] | None = None

    @model_validator(mode="after")
    def _has_one_scale(self) -> Self:
        _require_one(self.scale_pulse_per_m_s, "scale_pulse_per_m_s", self.scale)
        return self


def _require_one(of_pulses: object, name: str, scale: object) -> None:
    if (of_pulses is None) == (scale is None):
        came = "neither" if scale is None else "both"
        raise ValueError(
            f"expected {name} for a unit that sends pulses, or scale (three numbers about 1) for one that "
            f"sends other units, got {came}"
        )


class SensingPoints(Model):
    """Sensing point of each accelerometer from the origin of b, mm, body axes."""

    x: tuple[Arm, Arm, Arm]
    y: tuple[Arm, Arm, Arm]
    z: tuple[Arm, Arm, Arm]

    @property
    def r_m(self) -> Array:
        """The points, m, shape (3, 3): row i is that of accelerometer i, body axes."""
        return _array([self.x, self.y, self.z], MM)


class SizeEffect(Model):
    """Sensing points of the accelerometers, and the gauge that they are in."""

    r_mm: SensingPoints
    gauge: Literal["centroid", "x", "y", "z", "given"]
    covariance_mm2: Annotated[Matrix9, AfterValidator(_covariance)] | None = None

    @model_validator(mode="after")
    def _origin_fits_the_gauge(self) -> Self:
        origin = {
            "centroid": self.r_m.sum(axis=0) / MM,
            "x": self.r_mm.x,
            "y": self.r_mm.y,
            "z": self.r_mm.z,
            "given": np.zeros(3),
        }[self.gauge]
        if np.max(np.abs(origin)) > GAUGE_TOLERANCE_MM:
            zero = "r_x + r_y + r_z" if self.gauge == "centroid" else f"r_{self.gauge}"
            raise ValueError(
                f"expected {zero} = 0 in the gauge {self.gauge}, got {np.round(origin, 6).tolist()} mm; "
                "move the three points together, or name the gauge that they are in"
            )
        return self

    @property
    def r_m(self) -> Array:
        """Sensing points, m, shape (3, 3): row i is that of accelerometer i, body axes."""
        return self.r_mm.r_m

    @property
    def covariance_m2(self) -> Array | None:
        """Covariance of (r_x, r_y, r_z), m^2, shape (9, 9), in the gauge; None where it is not known."""
        return None if self.covariance_mm2 is None else _array(self.covariance_mm2, MM * MM)


class Temperature(Model):
    """Change of biases and scale factors per kelvin from the reference temperature, and range of validity."""

    reference_degc: Celsius
    range_degc: Annotated[tuple[Celsius, Celsius], AfterValidator(_range)]
    gyro_bias_deg_per_h_per_k: tuple[GyroBiasSlope, GyroBiasSlope, GyroBiasSlope]
    gyro_scale_ppm_per_k: tuple[ScaleSlope, ScaleSlope, ScaleSlope]
    accelerometer_bias_ug_per_k: tuple[AccelerometerBiasSlope, AccelerometerBiasSlope, AccelerometerBiasSlope]
    accelerometer_scale_ppm_per_k: tuple[ScaleSlope, ScaleSlope, ScaleSlope]


class Signature(Model):
    """An Ed25519 signature and the public key that it belongs to; see `calib.signing`."""

    public_key: Base64Of32Bytes
    ed25519: Base64Of64Bytes


class Calibration(Model):
    """The certificate of one unit.

    Without `size_effect` the size effect is not compensated; without `temperature` nothing depends on the
    temperature. `skew_ms`: time by which the samples of the accelerometers end later than those of the gyros.
    `provenance` describes how the calibration was made; it is preserved unchanged. Its `sensors` is a
    `SensorsProvenance`; the covariance there names numbers of this certificate. `signature` belongs to the
    bytes of one file: it is the last key there, and no copy of the model is written with it.
    """

    format: Literal["imu50-calibration"]
    version: Literal[1]
    serial_number: SerialNumber
    created: UtcTime
    gyro: Gyro
    accelerometer: Accelerometer
    size_effect: SizeEffect | None = None
    temperature: Temperature | None = None
    skew_ms: Skew | None = None
    noise: Noise | None = None
    provenance: Annotated[dict[str, JsonValue], AfterValidator(_provenance)] | None = None
    signature: Annotated[Signature | None, Key(exclude=True)] = None

    @model_validator(mode="after")
    def _covariance_names_numbers(self) -> Self:
        covariance = None if self.sensors is None else self.sensors.covariance
        if covariance is None:
            return self
        sections = {"gyro", "accelerometer", "size_effect", "temperature", "skew_ms"}
        document = self.model_dump(include=sections, exclude={"size_effect": {"covariance_mm2"}})
        if unknown := set(covariance.names) - set(number_paths(document)):
            raise ValueError(
                f"provenance.{PROVENANCE_SENSORS}.covariance.names: expected numbers of this certificate, "
                f"such as gyro.bias_deg_per_h[0], got {', '.join(sorted(unknown))}"
            )
        return self

    @property
    def sensors(self) -> SensorsProvenance | None:
        """How the sensors were calibrated; None where it is not known."""
        document = (self.provenance or {}).get(PROVENANCE_SENSORS)
        return None if document is None else _sensors_provenance(document)

    def without_size_effect(self) -> Self:
        """Return the same calibration without the sensing points."""
        return self.model_copy(update={"size_effect": None})

    def without_skew(self) -> Self:
        """Return the same calibration without the skew."""
        return self.model_copy(update={"skew_ms": None})


def read_calibration(path: str | os.PathLike[str], unit: str | None = None) -> Calibration:
    """Read a calibration, and check that it belongs to the unit.

    Parameters
    ----------
    path : path-like
        The file.
    unit : str, optional
        Serial number that is required; any if absent.

    Returns
    -------
    Calibration

    Raises
    ------
    InputError
        The file cannot be read, has faults, or is the certificate of another unit.
    """
    return read_calibration_file(path, unit).model


def read_calibration_file(path: str | os.PathLike[str], unit: str | None = None) -> SettingsFile[Calibration]:
    """Read a calibration together with its content and SHA-256; see `read_calibration`.

    Parameters
    ----------
    path : path-like
        The file.
    unit : str, optional
        Serial number that is required; any if absent.

    Returns
    -------
    SettingsFile of Calibration
    """
    file = read_file(path, Calibration)
    require_unit(file.model, unit, os.fspath(path))
    return file


def require_unit(calibration: Calibration, unit: str | None, name: str) -> None:
    """Check that a calibration belongs to the unit.

    Parameters
    ----------
    calibration : Calibration
        The certificate.
    unit : str or None
        Serial number that is required; None: any.
    name : str
        Name of the certificate in the message.

    Raises
    ------
    InputError
        It is the certificate of another unit.
    """
    if unit is not None and unit != calibration.serial_number:
        raise InputError(
            f"{name}: expected the calibration of unit {unit!r}, "
            f"got that of {calibration.serial_number!r}; give the connected unit's file, or connect that unit"
        )


def write_calibration(path: str | os.PathLike[str], calibration: Calibration) -> None:
    """Write a calibration, unsigned; an existing file is kept under a name with its time.

    Parameters
    ----------
    path : path-like
        The file.
    calibration : Calibration
        The certificate; `read_calibration` returns the same bits.

    Raises
    ------
    InputError
        It cannot be written.
    """
    write(path, calibration)


def coefficients(calibration: Calibration) -> Coefficients:
    """Convert a calibration into the form that the compensation reads.

    Parameters
    ----------
    calibration : Calibration
        The certificate.

    Returns
    -------
    Coefficients
        SI.
    """
    gyro, accelerometer, terms = calibration.gyro, calibration.accelerometer, calibration.temperature
    return Coefficients(
        gyro_scale=_array(gyro.scale_arcsec_per_pulse or gyro.scale, ARCSEC if gyro.scale is None else 1.0),
        gyro_bias=_array(gyro.bias_deg_per_h, DEG_PER_H),
        C_bg=_array(gyro.C_bg),
        accelerometer_scale=_array(accelerometer.scale_pulse_per_m_s or accelerometer.scale),
        accelerometer_bias=_array(accelerometer.bias_ug, UG),
        C_ba=_array(accelerometer.C_ba),
        r_b=calibration.size_effect.r_m if calibration.size_effect else None,
        temperature=TemperatureTerms(
            terms.reference_degc,
            *terms.range_degc,
            gyro_bias=_array(terms.gyro_bias_deg_per_h_per_k, DEG_PER_H),
            gyro_scale=_array(terms.gyro_scale_ppm_per_k, PPM),
            accelerometer_bias=_array(terms.accelerometer_bias_ug_per_k, UG),
            accelerometer_scale=_array(terms.accelerometer_scale_ppm_per_k, PPM),
        )
        if terms
        else None,
        quadratic=_array(accelerometer.quadratic_ug_per_g2 or _NONE, UG / STANDARD_GRAVITY**2),
        asymmetry=_array(accelerometer.asymmetry_ppm or _NONE, PPM),
        skew_s=(calibration.skew_ms or 0.0) * MS,
        gyro_in_pulses=gyro.scale is None,
        accelerometer_in_pulses=accelerometer.scale is None,
    )
