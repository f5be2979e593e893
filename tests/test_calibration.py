import copy
import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from samples import CERTIFICATE

from imudrv.calibration import Calibration, coefficients, read_calibration, write_calibration
from imudrv.errors import FaultyFileError, InputError
from imudrv.files.settings_file import kind, parse, read, write
from imudrv.nav.earth import normal_gravity
from imudrv.site import Site

# The example of the files' specification.
EXAMPLE = f"""{CERTIFICATE}\
size_effect:
  r_mm: {{x: [0, 0, 0], y: [0, 0, 0], z: [0, 0, 0]}}
  gauge: centroid
temperature:
  reference_degc: 35.0
  range_degc: [10.0, 60.0]
  gyro_bias_deg_per_h_per_k: [0.0, 0.0, 0.0]
  gyro_scale_ppm_per_k: [0.0, 0.0, 0.0]
  accelerometer_bias_ug_per_k: [0.0, 0.0, 0.0]
  accelerometer_scale_ppm_per_k: [0.0, 0.0, 0.0]
"""

DOCUMENT: dict[str, Any] = {
    "format": "imu50-calibration",
    "version": 1,
    "serial_number": "50-0017",
    "created": "2026-11-22T10:00:00Z",
    "gyro": {
        "scale_arcsec_per_pulse": [0.5, 1.0, 2.0],
        "bias_deg_per_h": [1.0, -2.0, 0.5],
        "C_bg": [[1.0, 0.001, 0.0], [0.0, 1.0, 0.002], [0.003, 0.0, 1.0]],
    },
    "accelerometer": {
        "scale_pulse_per_m_s": [2000.0, 2100.0, 1900.0],
        "bias_ug": [100.0, -50.0, 0.0],
        "C_ba": [[1.0, 0.004, 0.0], [0.0, 1.0, 0.005], [0.006, 0.0, 1.0]],
    },
    "size_effect": {
        "r_mm": {"x": [24.0, -11.0, 1.0], "y": [-30.0, 20.0, 3.0], "z": [6.0, -9.0, -4.0]},
        "gauge": "centroid",
    },
    "temperature": {
        "reference_degc": 35.0,
        "range_degc": [10.0, 60.0],
        "gyro_bias_deg_per_h_per_k": [0.01, 0.02, 0.03],
        "gyro_scale_ppm_per_k": [1.0, 2.0, 3.0],
        "accelerometer_bias_ug_per_k": [10.0, 20.0, 30.0],
        "accelerometer_scale_ppm_per_k": [4.0, 5.0, 6.0],
    },
}


def changed(path: str, value: Any) -> dict[str, Any]:
    """The document with one value changed; None takes it away."""
    document = copy.deepcopy(DOCUMENT)
    *sections, key = path.split(".")
    section = document
    for name in sections:
        section = section[name]
    if value is None:
        del section[key]
    else:
        section[key] = value
    return document


def calibration(document: dict[str, Any] = DOCUMENT) -> Calibration:
    return parse(document, Calibration, "cal.yaml")


def fault(document: dict[str, Any]) -> str:
    with pytest.raises(FaultyFileError) as caught:
        calibration(document)
    (only,) = caught.value.faults
    return only


# SI


def test_the_example_of_the_specification_reads(tmp_path: Path) -> None:
    file = tmp_path / "cal.yaml"
    file.write_text(EXAMPLE)
    example = read_calibration(file, unit="50-0017")
    assert example.serial_number == "50-0017"
    assert example.created.isoformat() == "2026-11-22T10:00:00+00:00"
    assert kind(file) == "imu50-calibration"


def test_a_turn_of_the_gyro_is_its_pulses_times_its_scale() -> None:
    # 1 296 000 arcsec are a full turn; three roundings: of the unit, of the product, of the sum.
    scale = coefficients(calibration()).gyro_scale
    assert scale * np.array([2 * 1_296_000, 1_296_000, 648_000]) == pytest.approx(2 * math.pi, rel=1e-15)


def test_a_bias_is_in_si() -> None:
    got = coefficients(calibration())
    # 15.041067 deg/h is the Earth's rate, 7.2921151e-5 rad/s: given to 8 digits.
    assert got.gyro_bias * 15.041067 == pytest.approx([7.2921151e-5, -14.5842302e-5, 3.64605755e-5], rel=3e-8)
    # 1 ug is 9.80665e-6 m/s^2 by definition; two roundings.
    assert got.accelerometer_bias == pytest.approx([9.80665e-4, -4.903325e-4, 0.0], rel=5e-16)


def test_the_axes_keep_their_rows() -> None:
    got = coefficients(calibration())
    assert got.C_bg[0, 1] == 0.001
    assert got.C_bg[2, 0] == 0.003
    assert got.C_ba[1, 2] == 0.005
    assert got.C_ba[2, 0] == 0.006
    assert got.accelerometer_scale.tolist() == [2000.0, 2100.0, 1900.0]


def test_row_i_of_r_is_accelerometer_i() -> None:
    size_effect = calibration().size_effect
    assert size_effect is not None
    # One rounding in mm -> m.
    assert size_effect.r_m[1] == pytest.approx([-0.030, 0.020, 0.003], rel=5e-16)
    assert size_effect.covariance_m2 is None


def test_the_covariance_is_in_square_metres() -> None:
    rows = np.diag(np.arange(1.0, 10.0)).tolist()
    size_effect = calibration(changed("size_effect.covariance_mm2", rows)).size_effect
    assert size_effect is not None
    assert size_effect.covariance_m2 is not None
    # Roundings of mm^2 and of the product.
    assert np.diag(size_effect.covariance_m2) == pytest.approx(np.arange(1.0, 10.0) * 1e-6, rel=5e-16)


def test_temperature_terms_are_in_si_per_kelvin() -> None:
    terms = coefficients(calibration()).temperature
    assert terms is not None
    # A few roundings of the units.
    assert terms.gyro_bias == pytest.approx(np.radians([0.01, 0.02, 0.03]) / 3600, rel=1e-15)
    assert terms.gyro_scale == pytest.approx([1e-6, 2e-6, 3e-6], rel=1e-15)
    assert terms.accelerometer_bias == pytest.approx([9.80665e-5, 19.6133e-5, 29.41995e-5], rel=1e-15)
    assert terms.accelerometer_scale == pytest.approx([4e-6, 5e-6, 6e-6], rel=1e-15)


def test_a_certificate_cannot_be_changed_through_its_arrays() -> None:
    got = calibration()
    assert got.size_effect is not None
    for array in (
        coefficients(got).C_bg,
        coefficients(got).gyro_bias,
        got.size_effect.r_m,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_the_compensation_gets_what_the_certificate_says() -> None:
    got, c = calibration(), coefficients(calibration())
    assert got.size_effect is not None
    assert c.r_b is not None
    assert c.temperature is not None
    np.testing.assert_array_equal(c.r_b, got.size_effect.r_m)
    np.testing.assert_array_equal(c.C_bg, got.gyro.C_bg)
    np.testing.assert_array_equal(c.C_ba, got.accelerometer.C_ba)
    assert (c.temperature.reference_degc, c.temperature.low_degc, c.temperature.high_degc) == (
        35.0,
        10.0,
        60.0,
    )
    bare = changed("size_effect", None)
    del bare["temperature"]
    assert coefficients(calibration(bare)).r_b is None
    assert coefficients(calibration(bare)).temperature is None


# What is refused


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("serial_number", 50017, "serial_number: expected text, got 50017; put it in quotes"),
        ("serial_number", " ", "serial_number: expected printable text"),
        ("serial_number", "", "serial_number: expected printable text"),
        ("serial_number", "50-0017 ", "serial_number: expected printable text"),
        ("serial_number", "50\x1b[31m", "serial_number: expected printable text"),
        ("serial_number", "5" * 65, "serial_number: expected text of at most 64 characters"),
        ("created", "2026-11-22T10:00:00", "created: expected a time in the way of"),
        ("gyro.scale_arcsec_per_pulse", [0.5, -0.5, 0.5], "gyro.scale_arcsec_per_pulse[1]: expected more"),
        ("gyro.scale_arcsec_per_pulse", [0.5, 0.5], "gyro.scale_arcsec_per_pulse: expected 3 numbers, got 2"),
        ("accelerometer.scale_pulse_per_m_s", [0, 1, 1], "accelerometer.scale_pulse_per_m_s[0]: expected mo"),
        ("gyro.bias_deg_per_h", [0, 0, 5000], "gyro.bias_deg_per_h[2]: expected at most 3600"),
        ("accelerometer.bias_ug", [-2e5, 0, 0], "accelerometer.bias_ug[0]: expected at least -100000"),
        (
            "gyro.C_bg",
            [[1.2, 0, 0], [0, 1, 0], [0, 0, 1]],
            "gyro.C_bg: expected rows of the inverse, the sensing axes, of a length within 0.1 of 1",
        ),
        (
            "gyro.C_bg",
            [[0, 0, 0]] * 3,
            "gyro.C_bg: expected three independent axes, got a matrix of determinant 0",
        ),
        ("size_effect.gauge", "middle", "size_effect.gauge: expected 'centroid', 'x', 'y', 'z' or 'given'"),
        ("size_effect.r_mm.x", [1001, 0, 0], "size_effect.r_mm.x[0]: expected at most 1000"),
        ("size_effect.r_mm.z", None, "size_effect.r_mm.z: missing; add it"),
        ("size_effect.covariance_mm2", [[1.0]], "size_effect.covariance_mm2[0]: expected 9 numbers, got 1"),
        ("temperature.range_degc", [60, 10], "temperature.range_degc: expected the lower temperature first"),
        ("temperature.gyro_scale_ppm_per_k", None, "temperature.gyro_scale_ppm_per_k: missing; add it"),
        ("provenance", ["a"], "provenance: expected a mapping (key: value), got a list of 1"),
        ("provenance", {"sigma": math.nan}, "provenance: expected finite numbers, got NaN or infinity"),
        ("provenance", {"log": "x" * 300_000}, "provenance: expected at most 262144 characters, got 300011"),
        (
            "gyro.temperature",
            {},
            "gyro.temperature: unknown key; known are C_bg, bias_deg_per_h, frame, scale",
        ),
    ],
)
def test_a_fault_names_its_place(path: str, value: Any, words: str) -> None:
    document = changed(path, value)
    with pytest.raises(FaultyFileError) as caught:
        calibration(document)
    assert caught.value.faults[0].startswith(words)


def test_axes_exchanged_in_a_circle_are_another_laboratory_s_not_a_fault() -> None:
    turned = [[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]
    assert coefficients(calibration(changed("accelerometer.C_ba", turned))).C_ba.tolist() == turned


@pytest.mark.parametrize("place", ["gyro.C_bg", "accelerometer.C_ba"])
@pytest.mark.parametrize(
    "mirror",
    [
        [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]],
        [[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
    ],
)
def test_a_mirror_matrix_is_a_fault_that_belongs_into_the_profile(
    place: str, mirror: list[list[float]]
) -> None:
    words = fault(changed(place, mirror))
    assert words.startswith(f"{place}: expected right-handed axes, determinant > 0, got -1: a mirror image")
    assert "sign: -1" in words


def axes_at(degrees: float) -> list[list[float]]:
    """Matrix of three sensing axes on a cone: each is `degrees` off the cone's axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    sensing = [[s * math.cos(k * math.tau / 3.0), s * math.sin(k * math.tau / 3.0), c] for k in range(3)]
    matrix: list[list[float]] = np.linalg.inv(sensing).tolist()
    return matrix


def test_sensing_axes_may_be_any_that_span_space() -> None:
    # a cone of 45 deg: determinant 0.919; of 20 deg: 0.286
    content = changed("accelerometer.C_ba", axes_at(45.0))
    assert np.allclose(np.linalg.norm(np.linalg.inv(content["accelerometer"]["C_ba"]), axis=1), 1.0)
    parse(content, Calibration, "calibration")
    assert "expected three independent sensing axes, determinant of the inverse >= 0.3, got 0.286" in fault(
        changed("accelerometer.C_ba", axes_at(20.0))
    )


def test_sensing_axes_have_the_length_1() -> None:
    # the rows of the matrix itself are of length 1, 30 degrees from square: its inverse's are longer
    oblique = [[1.0, 0.0, 0.0], [0.5, math.sqrt(0.75), 0.0], [0.0, 0.0, 1.0]]
    assert "of a length within 0.1 of 1, got one of 1.291;" in fault(changed("gyro.C_bg", oblique))


def points(*rows: list[float], gauge: str) -> dict[str, Any]:
    return changed("size_effect", {"r_mm": dict(zip("xyz", rows, strict=True)), "gauge": gauge})


@pytest.mark.parametrize("gauge", ["centroid", "x", "y", "z"])
def test_each_gauge_has_its_origin(gauge: str) -> None:
    rows = np.array([[24.0, -11.0, 1.0], [-30.0, 20.0, 3.0], [7.0, -9.0, -4.0]])
    origin = rows.mean(axis=0) if gauge == "centroid" else rows["xyz".index(gauge)]
    # Rounded to six decimals, as people write files.
    calibration(points(*np.round(rows - origin, 6).tolist(), gauge=gauge))
    calibration(points(*rows.tolist(), gauge="given"))
    zero = "r_x + r_y + r_z" if gauge == "centroid" else f"r_{gauge}"
    # The tolerance is 1e-5 mm: once and three times 3e-6 are inside, 4e-5 is not.
    calibration(points(*(rows - origin + 3e-6).tolist(), gauge=gauge))
    words = fault(points(*(rows - origin + 4e-5).tolist(), gauge=gauge))
    assert words.startswith(f"size_effect: expected {zero} = 0 in the gauge {gauge}, got ")


def centred_covariance(sigma_mm: float) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Independent arms of `sigma_mm`, put into the gauge centroid: of rank 6."""
    project = np.eye(9) - np.kron(np.ones((3, 3)) / 3.0, np.eye(3))
    return sigma_mm**2 * project @ project.T


def test_a_covariance_of_rank_6_is_as_it_should_be() -> None:
    P = centred_covariance(0.03)
    assert np.linalg.matrix_rank(P) == 6
    calibration(changed("size_effect.covariance_mm2", P.tolist()))
    calibration(changed("size_effect.covariance_mm2", np.round(P, 6).tolist()))


def test_a_covariance_with_a_negative_variance_is_a_fault() -> None:
    P = centred_covariance(0.03) - np.diag([0.0] * 8 + [2e-4])
    words = fault(changed("size_effect.covariance_mm2", P.tolist()))
    assert words.startswith("size_effect.covariance_mm2: expected no negative variance in any direction")


def test_a_covariance_that_is_not_symmetric_is_a_fault() -> None:
    P = centred_covariance(0.03)
    P[0, 5] += 1e-4
    words = fault(changed("size_effect.covariance_mm2", P.tolist()))
    assert words.startswith(
        "size_effect.covariance_mm2: expected a symmetric matrix, got entries that differ by 0.0001"
    )


# Sensors

TRIANGLE = [[4e-4], [1e-4, 1e-4], [0.0, 0.0, 25.0]]
NAMES = ["gyro.bias_deg_per_h[0]", "gyro.C_bg[1][0]", "size_effect.r_mm.x[2]"]
SENSORS: dict[str, Any] = {
    "software": "imu50 0.2.0",
    "captures": [{"name": "faces.raw", "sha256": "0" * 64}],
    "procedure": "six-faces-turned",
    "rests": [{"pose": "z-up", "start_s": 0.0, "duration_s": 60.0, "temperature_degc": 35.0}],
    "chi_square": 63.0,
    "degrees_of_freedom": 60,
    "wander": {"gyro_deg_per_h": 0.002, "accelerometer_ug": 1.0},
    "gravity": {"m_s2": 9.7917, "source": "measured", "sigma_m_s2": 1e-5},
    "not_observable": ["accelerometer.asymmetry_ppm"],
    "covariance": {"names": NAMES, "lower_triangle": TRIANGLE},
}
NOISE = {
    "gyro": {
        "quantisation_arcsec": [0.1, 0.1, 0.1],
        "angle_random_walk_deg_per_sqrt_h": [0.002, 0.002, 0.002],
        "bias_instability_deg_per_h": None,
        "rate_random_walk_deg_per_h_per_sqrt_h": None,
        "rate_ramp_deg_per_h_per_h": None,
    },
    "accelerometer": {
        "quantisation_mm_per_s": [0.1, 0.1, 0.1],
        "velocity_random_walk_ug_per_sqrt_hz": [5.0, 5.0, 5.0],
        "bias_instability_ug": [1.0, 1.0, 1.0],
        "acceleration_random_walk_ug_per_sqrt_h": None,
        "acceleration_ramp_ug_per_h": None,
    },
}


def sensors(path: str, value: Any) -> dict[str, Any]:
    """The document with the provenance of its sensors, one value of it changed."""
    document = copy.deepcopy(SENSORS)
    *sections, key = path.split(".")
    section = document
    for name in sections:
        section = section[name]
    section[key] = value
    return changed("provenance", {"sensors": document}) if path else document


def test_a_certificate_with_every_key_of_the_sensors_is_read_back(tmp_path: Path) -> None:
    document = copy.deepcopy(DOCUMENT)
    document["gyro"]["frame"] = "faces"
    document["accelerometer"] |= {
        "quadratic_ug_per_g2": [10.0, -20.0, 30.0],
        "asymmetry_ppm": [1.0, 2.0, 3.0],
    }
    document |= {"skew_ms": 0.3, "noise": NOISE, "provenance": {"sensors": SENSORS}}
    whole = calibration(document)
    write_calibration(tmp_path / "cal.yaml", whole)
    assert read_calibration(tmp_path / "cal.yaml") == whole
    assert whole.noise is not None
    assert whole.noise.gyro.angle_random_walk_deg_per_sqrt_h == (0.002, 0.002, 0.002)
    assert whole.sensors is not None
    assert whole.sensors.covariance is not None
    np.testing.assert_array_equal(
        whole.sensors.covariance.matrix, [[4e-4, 1e-4, 0.0], [1e-4, 1e-4, 0.0], [0.0, 0.0, 25.0]]
    )
    assert calibration().sensors is None


def test_a_singular_covariance_is_as_it_should_be() -> None:
    # a row of length 1 and three arms with a common shift: rank 1 of 3, and a variance of zero
    singular = [[1.0], [1.0, 1.0], [0.0, 0.0, 0.0]]
    calibration(sensors("covariance.lower_triangle", singular))


@pytest.mark.parametrize(
    ("document", "words"),
    [
        (changed("skew_ms", 101.0), "skew_ms: expected at most 100"),
        (changed("gyro.frame", "case"), "gyro.frame: expected 'gyro' or 'faces', got text 'case'"),
        (changed("accelerometer.asymmetry_ppm", [1.0]), "accelerometer.asymmetry_ppm: expected 3 numbers"),
        (
            changed("accelerometer.quadratic_ug_per_g2", [0.0, 0.0, 2e4]),
            "accelerometer.quadratic_ug_per_g2[2]",
        ),
        (
            changed("noise", {"gyro": {"bias_instability_ug": [1, 1, 1]}}),
            "noise.gyro.bias_instability_ug: unk",
        ),
        (changed("noise", {"gyro": {"quantisation_arcsec": [-1, 1, 1]}}), "noise.gyro.quantisation_arcsec"),
        (
            sensors("covariance.names", ["gyro.bias_deg_per_h[3]", *NAMES[1:]]),
            "provenance.sensors.covariance.names: expected numbers of this certificate, such as "
            "gyro.bias_deg_per_h[0], got gyro.bias_deg_per_h[3]",
        ),
        (sensors("covariance.names", [NAMES[0]] * 3), "expected each name once"),
        (
            sensors("covariance.lower_triangle", [[1.0], [1.0, 1.0], [1.0]]),
            "expected a lower triangle with rows of 1 to 3 numbers, one row a name, got rows of 1, 2, 1",
        ),
        (
            sensors("covariance.lower_triangle", [[1.0], [0.0, -1.0], [0.0, 0.0, 1.0]]),
            "expected no negative variance, got -1 of gyro.C_bg[1][0]",
        ),
        (
            sensors("covariance.lower_triangle", [[1.0], [1.1, 1.0], [0.0, 0.0, 1.0]]),
            "expected correlations of at most 1, got 1.1",
        ),
        (
            sensors("covariance.lower_triangle", [[1.0], [0.9, 1.0], [-0.9, 0.9, 1.0]]),
            "expected no negative variance in any direction, got an eigenvalue of -0.8",
        ),
        (sensors("gravity.source", "guessed"), "provenance: sensors.gravity.source"),
        (sensors("captures", [{"name": "a", "sha256": "1234"}]), "provenance: sensors.captures.0.sha256"),
        (sensors("mean", 1.0), "provenance: sensors.mean"),
    ],
)
def test_a_fault_in_the_keys_of_the_sensors_is_named(document: dict[str, Any], words: str) -> None:
    assert words in fault(document)


def test_the_terms_of_the_sensors_are_compensated_in_si() -> None:
    terms = changed("accelerometer.quadratic_ug_per_g2", [10.0, 0.0, -20.0])
    terms["accelerometer"]["asymmetry_ppm"], terms["skew_ms"] = [0.0, 5.0, 0.0], 0.3
    c = coefficients(calibration(terms))
    g = 9.80665  # 10 ug/g^2: at 1 g 10 ug
    np.testing.assert_allclose(c.quadratic * g**2, np.array([10e-6, 0.0, -20e-6]) * g, rtol=1e-12)
    np.testing.assert_allclose(c.asymmetry, [0.0, 5e-6, 0.0], rtol=1e-12)
    assert c.skew_s == pytest.approx(3e-4, rel=1e-12)


def test_identification_begins_without_the_skew_that_it_estimates() -> None:
    with_skew = calibration(changed("skew_ms", 0.3))
    coefficients(with_skew.without_skew())
    assert with_skew.without_skew() == calibration()


# Files


def test_the_certificate_of_another_unit_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "cal.yaml"
    write_calibration(file, calibration())
    assert read_calibration(file).serial_number == "50-0017"
    assert read_calibration(file, unit="50-0017").serial_number == "50-0017"
    with pytest.raises(
        InputError, match=r"cal\.yaml: expected the calibration of unit '50-0018', got that of '50-0017'"
    ):
        read_calibration(file, unit="50-0018")


NUMBER = st.floats(-1.0, 1.0)
VECTOR = st.lists(NUMBER, min_size=3, max_size=3)
POSITIVE = st.lists(st.floats(1e-3, 1e3), min_size=3, max_size=3)
NEAR_IDENTITY = st.lists(st.floats(-0.02, 0.02), min_size=9, max_size=9).map(
    lambda e: (np.eye(3) + np.reshape(e, (3, 3))).tolist()
)


@settings(max_examples=50, deadline=None)
@given(
    VECTOR, POSITIVE, NEAR_IDENTITY, NEAR_IDENTITY, st.lists(VECTOR, min_size=3, max_size=3), st.booleans()
)
def test_a_certificate_is_read_back_bit_for_bit(
    bias: list[float],
    scale: list[float],
    C_bg: list[list[float]],
    C_ba: list[list[float]],
    r: list[list[float]],
    bare: bool,
) -> None:
    document = points(*r, gauge="given")
    document["gyro"] = {"scale_arcsec_per_pulse": scale, "bias_deg_per_h": bias, "C_bg": C_bg}
    document["accelerometer"] = {"scale_pulse_per_m_s": scale, "bias_ug": bias, "C_ba": C_ba}
    document["size_effect"]["covariance_mm2"] = centred_covariance(scale[0]).tolist()
    document["provenance"] = {
        "runs": ["z-up", 3, None],
        "sigma_mm": scale,
        "found": {"seed": 2**63, "at": "2026-11-22"},
    }
    if bare:
        del document["size_effect"], document["temperature"], document["provenance"]
    given_ = calibration(document)
    with tempfile.TemporaryDirectory() as folder:
        write_calibration(Path(folder) / "cal.yaml", given_)
        read_again = read_calibration(Path(folder) / "cal.yaml")
    assert read_again == given_
    # repr distinguishes -0.0 from 0.0, and 1 from 1.0, and is exact for floats.
    assert repr(read_again) == repr(given_)


def test_a_written_certificate_keeps_the_one_before(tmp_path: Path) -> None:
    write_calibration(tmp_path / "cal.yaml", calibration())
    write_calibration(tmp_path / "cal.yaml", calibration(changed("serial_number", "50-0018")))
    (kept,) = tmp_path.glob("cal.*Z.yaml")
    assert read_calibration(kept).serial_number == "50-0017"
    assert read_calibration(tmp_path / "cal.yaml").serial_number == "50-0018"


def test_without_its_size_effect_a_calibration_is_otherwise_the_same() -> None:
    whole = calibration()
    bare = whole.without_size_effect()
    assert whole.size_effect is not None
    assert bare.size_effect is None
    assert coefficients(bare).r_b is None
    assert bare.model_dump(exclude={"size_effect"}) == whole.model_dump(exclude={"size_effect"})


def test_the_supplied_calibration_and_site_read(reference: Path) -> None:
    supplied = read_calibration(reference / "calibration.yaml", unit="50-0017")
    assert supplied.gyro.scale_arcsec_per_pulse[0] == 0.44611747767685633
    assert supplied.size_effect is None
    assert read(reference / "site.yaml", Site).gravity_m_s2 == 9.791866064825728
    assert kind(reference / "site.yaml") == "imu50-site"


# Site

SITE = {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0}


def test_a_site_needs_neither_format_nor_gravity() -> None:
    site = parse(SITE, Site, "site.yaml")
    assert site.gravity_m_s2 is None
    # One rounding more than numpy's own conversion.
    assert site.latitude_rad == pytest.approx(np.radians(28.2), rel=5e-16)
    assert site.longitude_rad == pytest.approx(np.radians(113.0), rel=5e-16)
    assert parse({**SITE, "format": "imu50-site", "version": 1}, Site, "site.yaml") == site


def test_gravity_of_a_site_is_the_measured_one_or_the_normal_one() -> None:
    normal = parse(SITE, Site, "site.yaml")
    assert normal.gravity == normal_gravity(normal.latitude_rad, 60.0)
    assert parse({**SITE, "gravity_m_s2": 9.7917}, Site, "site.yaml").gravity == 9.7917


def test_a_written_site_says_that_it_is_one(tmp_path: Path) -> None:
    site = parse({**SITE, "gravity_m_s2": 9.7917}, Site, "site.yaml")
    write(tmp_path / "site.yaml", site)
    assert (
        (tmp_path / "site.yaml")
        .read_text()
        .startswith("format: imu50-site\nversion: 1\nlatitude_deg: 28.2\n")
    )
    assert read(tmp_path / "site.yaml", Site) == site


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("latitude_deg", 90.1, "latitude_deg: expected at most 90"),
        ("latitude_deg", -91, "latitude_deg: expected at least -90"),
        ("longitude_deg", 181, "longitude_deg: expected at most 180"),
        ("height_m", 60_000, "height_m: expected at most 9000"),
        ("gravity_m_s2", 979.17, "gravity_m_s2: expected at most 9.9, got 979.17"),
        ("gravity_m_s2", 1.0, "gravity_m_s2: expected at least 9.7, got 1"),
        ("version", 2, "version: expected 1, got 2"),
        ("latitude", 28, "latitude: unknown key; did you mean latitude_deg?"),
    ],
)
def test_an_impossible_site_is_refused(key: str, value: object, words: str) -> None:
    with pytest.raises(FaultyFileError) as caught:
        parse({**SITE, key: value}, Site, "site.yaml")
    (only,) = caught.value.faults
    assert only.startswith(words)
