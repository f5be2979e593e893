"""The dither's formulas against direct simulation, and against what the compensation really does."""

import json
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import simpson

from calib.dither.spectrum import Dither, compensated, gain, sensing_directions, size_effect
from calib.dither.text import dither_text
from imudrv import profiles
from imudrv.calibration import Calibration
from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import NAMES, rate_filter
from imudrv.records import PULSES, Flag
from imudrv.sim.scenario import NOMINAL
from imudrv.units import ARCSEC, MM, UG

Array = NDArray[np.float64]

TAU_NS = 1_000_000
TAU = 1e-3
STEP = 2e-5  # 50 kHz
PERIOD = 0.2  # in which 400, 405 and 395 Hz all go round a whole number of times

MISALIGNED = np.array([[0.9995, 0.0121, -0.0213], [-0.0108, 1.0004, 0.0117], [0.0211, -0.0119, 1.0002]])
R_B = np.array([[24.0, -11.0, -9.0], [-23.0, 29.0, -7.0], [-1.0, -18.0, 16.0]]) * MM
ALIGNED = np.eye(3)
ONE = ([150.0, 0.0, 0.0], [400.0, 405.0, 395.0])
THREE = ([150.0, 100.0, 180.0], [400.0, 405.0, 395.0])
EQUAL = ([150.0, 100.0, 180.0], [400.0, 400.0, 400.0])
PHASES = [0.4, -1.1, 2.3]
FILTERS = {name: rate_filter(name, TAU_NS) for name in NAMES}


def dither(kind: tuple[list[float], list[float]], C_bg: Array = ALIGNED) -> Dither:
    amplitude, frequency = kind
    return Dither(C_bg.T, np.array(amplitude) * ARCSEC, np.array(frequency), np.array(PHASES))


def force_of(d: Dither, C_ba: Array, t: Array) -> Array:
    """Omega r along each accelerometer at times, plainly, shape (n, 3)."""
    W = 2.0 * np.pi * d.frequency_hz
    psi = np.multiply.outer(t, W) + d.phase_rad
    omega = (d.amplitude_rad * W * np.cos(psi)) @ d.axes_b
    omega_dot = (-d.amplitude_rad * W**2 * np.sin(psi)) @ d.axes_b
    a = np.linalg.inv(C_ba)
    return np.stack(
        [
            (np.cross(omega_dot, r) + np.cross(omega, np.cross(omega, r))) @ a_i
            for a_i, r in zip(a, R_B, strict=True)
        ],
        axis=-1,
    )


CASES = pytest.mark.parametrize(
    ("kind", "C_ba", "C_bg"),
    [
        (ONE, ALIGNED, ALIGNED),
        (ONE, MISALIGNED, MISALIGNED.T),
        (THREE, ALIGNED, ALIGNED),
        (THREE, MISALIGNED, MISALIGNED.T),
        (EQUAL, MISALIGNED, MISALIGNED.T),
    ],
    ids=["one gyro", "one, misaligned", "three", "three, misaligned", "three of one frequency"],
)


@CASES
def test_mean_and_lines_are_those_of_a_simulation_at_50_khz(kind, C_ba, C_bg):
    d = dither(kind, C_bg)
    lines = size_effect(d, C_ba, R_B)
    t = STEP * np.arange(round(PERIOD / STEP))
    force = force_of(d, C_ba, t)
    # Whole periods of lines far below 25 kHz: sums are integrals, to rounding of the 100 m/s^2 there are.
    largest = np.abs(force).max()
    np.testing.assert_allclose(lines.mean, force.mean(axis=0), rtol=1e-6, atol=1e-12 * largest)
    np.testing.assert_allclose(lines.at(t), force, rtol=1e-6, atol=1e-11 * largest)
    spectrum = np.fft.rfft(force, axis=0) / len(t)
    spectrum[1:] *= 2.0
    at = np.rint(lines.frequency_hz * PERIOD).astype(int)
    np.testing.assert_allclose(lines.phasor, spectrum[at], rtol=1e-6, atol=1e-12 * largest)
    spectrum[at] = 0.0
    assert np.abs(spectrum).max() < 1e-11 * largest  # there are no other lines


@CASES
def test_increments_are_integrals_of_a_simulation_at_50_khz(kind, C_ba, C_bg):
    d = dither(kind, C_bg)
    edges = TAU * np.arange(round(PERIOD / TAU) + 1)
    integrals = np.array(
        [
            simpson(force_of(d, C_ba, np.linspace(a, b, round(TAU / STEP) + 1)), dx=STEP, axis=0)
            for a, b in pairwise(edges)
        ]
    )
    lines = size_effect(d, C_ba, R_B).averaged(TAU)
    middles = edges[:-1] + 0.5 * TAU
    # Simpson's rule of 400 Hz at 50 kHz is good to (0.05)^4 / 180 = 4e-8, of 800 Hz to 6e-7.
    scale = np.abs(integrals).max()
    np.testing.assert_allclose(TAU * lines.at(middles), integrals, rtol=0.0, atol=1e-6 * scale)
    # The aliases have the same values at the samples.
    aliases = lines.aliased(TAU)
    assert aliases.frequency_hz.max() <= 500.0
    np.testing.assert_allclose(aliases.at(middles), lines.at(middles), rtol=0.0, atol=1e-9 * scale / TAU)


def test_one_gyro_about_x_is_the_literature_and_its_mean_half_the_square_of_the_rate_times_the_arm():
    d = dither(ONE)
    A, W, phase = d.rate[0], 2.0 * np.pi * 400.0, PHASES[0]
    t = np.linspace(0.0, 0.01, 57)
    cos, sin = np.cos(W * t + phase), np.sin(W * t + phase)
    expected = np.stack(
        [
            0.0 * t,
            -(A**2) * cos**2 * R_B[1, 1] + A * W * sin * R_B[1, 2],
            -(A**2) * cos**2 * R_B[2, 2] - A * W * sin * R_B[2, 1],
        ],
        axis=-1,
    )
    lines = size_effect(d, ALIGNED, R_B)
    # rounding of 1e2 m/s^2 and of phases of 25 rad
    np.testing.assert_allclose(lines.at(t), expected, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(lines.mean, -0.5 * A**2 * np.array([0.0, R_B[1, 1], R_B[2, 2]]), rtol=1e-12)


def test_twice_400_hz_is_aliased_to_200_hz_and_differences_stay():
    lines = size_effect(dither(THREE), MISALIGNED, R_B).averaged(TAU).aliased(TAU)
    aliases = dict(zip(lines.names, lines.frequency_hz.tolist(), strict=True))
    assert {name: aliases[name] for name in ("Wx", "Wy", "Wz")} == {"Wx": 400.0, "Wy": 405.0, "Wz": 395.0}
    assert (aliases["2 Wx, Wy+Wz"], aliases["2 Wy"], aliases["2 Wz"]) == (200.0, 190.0, 210.0)
    assert (aliases["Wx+Wy"], aliases["Wx+Wz"]) == (195.0, 205.0)
    assert (aliases["Wx-Wy, Wx-Wz"], aliases["Wy-Wz"]) == (5.0, 10.0)
    assert len(aliases) == 11


def test_a_line_at_the_sample_rate_is_aliased_to_the_mean_but_is_not_in_increments():
    lines = size_effect(dither(([150.0, 0.0, 0.0], [500.0] * 3)), ALIGNED, R_B)
    rates = lines.aliased(TAU)
    assert abs(rates.mean[1]) != pytest.approx(abs(lines.mean[1]), rel=0.01)
    np.testing.assert_allclose(lines.averaged(TAU).aliased(TAU).mean, lines.mean, rtol=1e-12)


def subtracted(d: Dither, C_ba: Array, C_bg: Array, name: str) -> tuple[Array, Array]:
    """Middles of intervals, and what the compensator takes off each accelerometer there, m/s^2."""
    fine = 1e-13  # rad a pulse: rounding is 1e-9 of the dither
    c = Coefficients(
        gyro_scale=np.full(3, fine),
        gyro_bias=np.zeros(3),
        C_bg=C_bg,
        accelerometer_scale=np.ones(3),
        accelerometer_bias=np.zeros(3),
        C_ba=C_ba,
        r_b=R_B,
    )
    n = round(PERIOD / TAU) + 50
    angle_b = (
        d.amplitude_rad
        * np.sin(2.0 * np.pi * np.multiply.outer(TAU * np.arange(n + 1), d.frequency_hz) + d.phase_rad)
    ) @ d.axes_b
    pulses = np.zeros(n, PULSES)
    pulses["counter"] = np.arange(n)
    pulses["interval_ns"] = TAU_NS
    pulses["elapsed_ns"] = TAU_NS * np.arange(1, n + 1)
    pulses["flags"] = Flag.VALID
    pulses["gyro"] = np.diff(np.rint(np.linalg.solve(C_bg, angle_b.T).T / fine), axis=0)
    compensator = Compensator(c, profiles.load("imu50-rs422").layout(), name)
    got = compensator.feed(pulses)[25:]
    got = got[: round(PERIOD / TAU)]
    assert np.all(got["flags"] & Flag.SIZE_EFFECT)
    return got["t_ns"] * 1e-9 - 0.5 * TAU, -np.linalg.solve(C_ba, got["dv_b"].T).T / TAU


@CASES
@pytest.mark.parametrize("name", NAMES)
def test_the_compensator_subtracts_what_the_formula_gives(kind, C_ba, C_bg, name):
    d = dither(kind, C_bg)
    t, got = subtracted(d, C_ba, C_bg, name)
    lines = compensated(d, C_ba, R_B, FILTERS[name], TAU)
    # Pulses of 1e-13 rad in second differences on arms of 40 mm: 1e-8 m/s^2.
    np.testing.assert_allclose(lines.at(t), got, rtol=1e-6, atol=3e-8)
    np.testing.assert_allclose(lines.aliased(TAU).at(t), got, rtol=1e-6, atol=3e-8)
    np.testing.assert_allclose(lines.aliased(TAU).mean, got.mean(axis=0), rtol=1e-6, atol=1e-9)


def rectified_ug(name: str, arcsec: float, fraction: float = 1.0) -> float:
    """Mean that one gyro x puts on an accelerometer y with its arm of 30 mm along it."""
    d = dither(([fraction * arcsec, 0.0, 0.0], [400.0] * 3))
    arms = np.diag([30.0, 30.0, 30.0]) * MM
    return float(compensated(d, ALIGNED, arms, FILTERS[name], TAU).aliased(TAU).mean[1]) / UG


def test_raw_dither_through_causal_makes_milligs_and_the_case_reaction_less_than_a_microg():
    # - A^2/2 r at 100 and 180 arcsec is 2.27 and 7.36 mg; `causal` extrapolates and more than doubles it.
    half = [0.5 * (a * ARCSEC * 2.0 * np.pi * 400.0) ** 2 * 0.030 / UG for a in (100.0, 180.0)]
    assert half == pytest.approx([2271.0, 7358.0], abs=1.0)
    for arcsec, whole in zip((100.0, 180.0), half, strict=True):
        amplified = abs(gain(FILTERS["causal"], 400.0, TAU)) ** 2 / 3.0 + 2.0 / 3.0 * np.sinc(0.4) ** 2
        assert rectified_ug("causal", arcsec) == pytest.approx(-whole * amplified, rel=1e-9)
        assert abs(rectified_ug("causal", arcsec)) > 2000.0
        case = dither(([0.01 * arcsec, 0.0, 0.0], [400.0] * 3))
        true = size_effect(case, ALIGNED, np.diag([30.0] * 3) * MM).mean[1] / UG
        assert abs(true) < 1.0
        assert abs(rectified_ug("dither", arcsec, 0.01)) < abs(true)


@pytest.mark.parametrize("frequency_hz", [370.0, 385.0, 400.0, 415.0, 430.0])
def test_the_dither_filter_passes_less_than_a_microg_of_the_raw_dither(frequency_hz):
    d = dither(([180.0] * 3, [frequency_hz, 405.0, 395.0]))
    arms = np.full((3, 3), 30.0) * MM
    lines = compensated(d, ALIGNED, arms, FILTERS["dither"], TAU).aliased(TAU)
    assert np.abs(lines.mean).max() < 1e-6 * UG  # residual of squares: 20 mg times the square of 4e-9
    assert lines.amplitude.max() * TAU < 5e-9  # m/s a sample; of a tangential 1e-1
    _, got = subtracted(d, ALIGNED, ALIGNED, "dither")
    assert np.abs(got.mean(axis=0)).max() < 1e-2 * UG  # rounding of pulses of 1e-13 rad


def test_the_gyros_sense_along_the_rows_of_the_inverse_of_C_bg():
    axes_b = sensing_directions(MISALIGNED)
    np.testing.assert_allclose(np.linalg.norm(axes_b, axis=1), 1.0, rtol=1e-15)
    along = np.linalg.inv(MISALIGNED) @ axes_b.T
    np.testing.assert_allclose(np.diag(along), np.linalg.norm(np.linalg.inv(MISALIGNED), axis=1), rtol=1e-15)


def unit(r_mm: dict[str, list[float]] | None) -> Calibration:
    document = json.loads(NOMINAL.model_dump_json(exclude_none=True))
    document.pop("size_effect", None)
    if r_mm:
        document["size_effect"] = {"r_mm": r_mm, "gauge": "centroid"}
    return Calibration.model_validate_json(json.dumps(document))


def test_the_text_has_means_lines_aliases_and_what_each_filter_passes():
    calibration = unit({"x": [24, -11, -9], "y": [-23, 29, -7], "z": [-1, -18, 16]})
    text = dither_text(calibration, THREE[0], THREE[1], list(FILTERS.values()), TAU)
    words = [line.split() for line in text.splitlines()]
    (false_causal,) = (w for w in words if w[:1] == ["causal"])
    d = Dither(ALIGNED, np.array(THREE[0]) * ARCSEC, np.array(THREE[1]))
    expected = -compensated(d, ALIGNED, R_B, FILTERS["causal"], TAU).mean / UG
    np.testing.assert_allclose([float(w) for w in false_causal[3:6]], expected, rtol=5e-3)  # three digits
    assert "800 Hz   200 Hz        0.234" in text
    assert "the same frequency" not in text
    assert "the same frequency" in dither_text(calibration, *EQUAL, [], TAU)


def test_a_unit_without_arms_is_refused():
    with pytest.raises(InputError, match="expected a calibration with size_effect"):
        dither_text(unit(None), *THREE, [], TAU)
