from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients
from imudrv.nav.earth import earth_rate_n
from imudrv.sim.scenario import NOMINAL, Scenario
from imudrv.sim.unit import Chunk, draw_true_unit, simulate
from imudrv.units import ARCSEC, DEG, DEG_PER_H, DEG_PER_SQRT_H, PPM, STANDARD_GRAVITY, UG, URAD
from imudrv.wire.layout import Layout

Make = Callable[..., Scenario]

MS = 1_000_000
LAYOUT = profiles.load("imu50-rs422").layout()
STATUS_WARM_UP, STATUS_OVERFLOW = 1 << 0, 1 << 10  # ICD, section 2
REST = {"rest": {"duration_s": 2.0}}
TURN = {"rotate": {"angle_deg": 90.0, "duration_s": 1.5, "axis_tilt_mrad": [3.0, 0.0]}}
ROCK = {
    "rock": {
        "duration_s": 3.0,
        "band_hz": [0.5, 3.0],
        "rate_rms_deg_per_s": [40, 40, 40],
        "sway_mm": [5, 5, 5],
    }
}
FINE = {
    "format": "imu50-calibration",
    "version": 1,
    "serial_number": "fine",
    "created": "2026-01-01T00:00:00Z",
    "gyro": {
        "scale_arcsec_per_pulse": [0.001, 0.002, 0.0015],
        "bias_deg_per_h": [10.0, -20.0, 30.0],
        "C_bg": [[1.0, 0.001, -0.002], [0.0005, 1.0, 0.001], [-0.001, 0.002, 1.0]],
    },
    "accelerometer": {
        "scale_pulse_per_m_s": [2e6, 3e6, 1e6],
        "bias_ug": [1000.0, -2000.0, 500.0],
        "C_ba": [[1.0, 0.002, -0.001], [-0.0006, 1.0, 0.0004], [-0.0007, 0.0003, 1.0]],
    },
    "size_effect": {
        "r_mm": {"x": [24.0, -11.0, -9.0], "y": [-23.0, 29.0, -7.0], "z": [-1.0, -18.0, 16.0]},
        "gauge": "centroid",
    },
    "temperature": {
        "reference_degc": 35.0,
        "range_degc": [10.0, 60.0],
        "gyro_bias_deg_per_h_per_k": [1.0, 2.0, -1.0],
        "gyro_scale_ppm_per_k": [10.0, -20.0, 30.0],
        "accelerometer_bias_ug_per_k": [100.0, 200.0, -100.0],
        "accelerometer_scale_ppm_per_k": [-10.0, 20.0, 40.0],
    },
}


NOT_LINEAR = {"quadratic_ug_per_g2": [30.0, -50.0, 20.0], "asymmetry_ppm": [-40.0, 10.0, 60.0]}


def run(scenario: Scenario, interval_ns: int = MS, chunk: int = 65_536) -> Chunk:
    chunks = list(simulate(scenario, replace(LAYOUT, interval=Fraction(interval_ns)), chunk))
    return Chunk(np.concatenate([c.pulses for c in chunks]), np.concatenate([c.truth for c in chunks]))


def run_as(layout: Layout, scenario: Scenario) -> Chunk:
    (chunk,) = simulate(scenario, layout)
    return chunk


def size_effect(unit: Coefficients, got: Chunk) -> np.ndarray:
    """Integral of `a_i . Omega r_i` by the formula of the compensation, from true rates."""
    tau = 1e-3
    w1 = got.truth["omega_ib_b"]
    w0 = np.concatenate([w1[:1], w1[:-1]])
    wm = got.truth["dtheta_b"] / tau
    A = np.linalg.inv(unit.C_ba)
    out = np.empty((w1.shape[0], 3))
    for i, r in enumerate(unit.r_b):
        centripetal = sum(k * np.cross(w, np.cross(w, r)) for k, w in ((1, w0), (4, wm), (1, w1)))
        out[:, i] = (np.cross(w1 - w0, r) + tau / 6 * centripetal) @ A[i]
    return out


def test_pulses_converted_by_the_calibration_are_the_truth(scenario: Make) -> None:
    hot = {"start_degc": 40.0, "slope_k_per_h": 900.0}
    calibration = {**FINE, "accelerometer": {**FINE["accelerometer"], **NOT_LINEAR}}
    got = run(
        scenario(
            REST,
            TURN,
            ROCK,
            REST,
            unit={"calibration": calibration, "temperature": hot},
            start={"pivot_offset_mm": [40, 30, 20]},
        )
    )
    unit = draw_true_unit(scenario(REST, unit={"calibration": FINE}), LAYOUT)
    tau, warmer = 1e-3, got.pulses["temperature_degc"][:, :1] - 35.0
    k_g = np.array([0.001, 0.002, 0.0015]) * ARCSEC * (1 + warmer * np.array([10, -20, 30]) * PPM)
    b_g = (np.array([10, -20, 30]) + warmer * np.array([1, 2, -1])) * DEG_PER_H
    dtheta_b = (k_g * got.pulses["gyro"]) @ np.array(FINE["gyro"]["C_bg"]).T - b_g * tau
    K = np.array([2e6, 3e6, 1e6]) * (1 + warmer * np.array([-10, 20, 40]) * PPM)
    b = (np.array([1000, -2000, 500]) + warmer * np.array([100, 200, -100])) * UG
    e = got.pulses["accelerometer"] / K - b * tau
    square = np.array([30, -50, 20]) * UG / STANDARD_GRAVITY**2 * e**2 / tau
    dv_a = e - square - 0.5 * np.array([-40, 10, 60]) * PPM * np.abs(e) - size_effect(unit, got)
    dv_b = dv_a @ np.array(FINE["accelerometer"]["C_ba"]).T
    # half a pulse at each end of a sum: of 0.002 arcsec and 1e-6 m/s, mixed a little by the axes
    angle, speed = 2 * 0.002 * ARCSEC, 2e-6
    assert np.abs(np.cumsum(dtheta_b - got.truth["dtheta_b"], axis=0)).max() < angle
    # and Simpson's rule of 10 rad/s^2 at 20/s over 3 s: 0.03 m * tau^4 / 2880 * 10 * (40/s)^4 = 3e-13
    assert np.abs(np.cumsum(dv_b - got.truth["dv_b"], axis=0)).max() < speed


def test_the_fraction_of_a_pulse_is_never_lost(scenario: Make) -> None:
    coarse = scenario(REST, TURN, REST)
    got, unit = run(coarse), draw_true_unit(coarse, LAYOUT)
    total = np.cumsum(got.pulses["gyro"], axis=0)
    exact = np.cumsum(got.truth["dtheta_b"] / unit.gyro_scale, axis=0)
    assert (
        np.abs(total - exact).max() <= 0.5 + 1e-6
    )  # sums of 5500 numbers of 600 pulses: 5500 * 600 * 1e-16 * 600
    assert np.abs(total - exact).max() > 0.4


def test_any_chunk_gives_the_same_bits(scenario: Make) -> None:
    everything = scenario(
        {"rest": {"duration_s": 0.1}},
        {"rotate": {"angle_deg": 10.0, "duration_s": 0.5}},
        {"rock": {"duration_s": 0.4, "band_hz": [5, 9], "rate_rms_deg_per_s": [40, 40, 40], "ramp_s": 0.1}},
        unit={
            "noise": {"arw_deg_per_sqrt_h": 0.01, "vrw_m_s_per_sqrt_h": 0.01},
            "dither": {
                "amplitude_arcsec": [150, 150, 150],
                "frequency_hz": [390, 400, 410],
                "in_increments": 0.5,
                "case_reaction": 0.01,
            },
            "residuals": {"gyro_bias_deg_per_h": 1.0},
            "accelerometer_skew_s": -0.0013,
            "temperature": {"settles_at_degc": 50.0, "time_constant_s": 1.0},
            "warm_up_s": 0.3,
        },
        faults={"counter_jumps": [{"at_s": 0.2, "by": 5}]},
    )
    whole = run(everything)
    for size in (1, 7, 64, 999):
        cut = run(everything, chunk=size)
        np.testing.assert_array_equal(cut.pulses, whole.pulses)
        np.testing.assert_array_equal(cut.truth, whole.truth)


def test_noise_is_a_random_walk_of_the_stated_size(scenario: Make) -> None:
    noise = {"arw_deg_per_sqrt_h": 0.3, "vrw_m_s_per_sqrt_h": 0.6}
    noisy = scenario({"rest": {"duration_s": 100.0}}, unit={"calibration": FINE, "noise": noise})
    pulses, unit = run(noisy).pulses, draw_true_unit(noisy, LAYOUT)
    gyro = pulses["gyro"] * unit.gyro_scale
    speed = pulses["accelerometer"] / unit.accelerometer_scale
    for samples in (1, 100):
        n = pulses.size // samples
        angles = gyro[: n * samples].reshape(n, samples, 3).sum(axis=1)
        speeds = speed[: n * samples].reshape(n, samples, 3).sum(axis=1)
        root = np.sqrt(samples * 1e-3)
        # four sigma of a deviation from n values: 4 / sqrt(2 n)
        tolerance = 4.0 / np.sqrt(2 * n)
        np.testing.assert_allclose(angles.std(axis=0), 0.3 * DEG_PER_SQRT_H * root, rtol=tolerance)
        np.testing.assert_allclose(speeds.std(axis=0), 0.6 / 60.0 * root, rtol=tolerance)


def test_dither_of_the_case_rectifies_to_minus_half_its_rate_squared(scenario: Make) -> None:
    dither = {
        "amplitude_arcsec": [1000.0, 0.0, 0.0],
        "frequency_hz": [400.0, 400.0, 400.0],
        "case_reaction": 0.1,
    }
    shaking = scenario(
        {"rest": {"duration_s": 1.0}}, unit={"calibration": {**FINE, "temperature": None}, "dither": dither}
    )
    still = scenario({"rest": {"duration_s": 1.0}}, unit={"calibration": {**FINE, "temperature": None}})
    unit = draw_true_unit(still, LAYOUT)
    change = (run(shaking).pulses["accelerometer"] - run(still).pulses["accelerometer"]).sum(
        axis=0
    ) / unit.accelerometer_scale
    rate = 100.0 * ARCSEC * 2 * np.pi * 400.0
    u = np.linalg.inv(unit.C_bg)[0]
    u = u / np.linalg.norm(u)
    across = unit.r_b - np.outer(unit.r_b @ u, u)
    expected = -0.5 * rate**2 * np.einsum("ij,ij->i", np.linalg.inv(unit.C_ba), across)
    # whole cycles in a second; two pulses of 1e-6 m/s; gravity is seen to first order of 5e-4 rad only
    np.testing.assert_allclose(change, expected, atol=2e-6)
    assert np.abs(expected).max() > 0.01


def test_dither_left_in_the_increments_turns_nothing(scenario: Make) -> None:
    dither = {
        "amplitude_arcsec": [150.0, 0.0, 0.0],
        "frequency_hz": [400.0, 400.0, 400.0],
        "in_increments": 0.5,
    }
    dithered = scenario(REST, unit={"dither": dither})
    got, plain = run(dithered), run(scenario(REST))
    np.testing.assert_array_equal(got.truth, plain.truth)
    np.testing.assert_array_equal(got.pulses["accelerometer"], plain.pulses["accelerometer"])
    total = np.cumsum(got.pulses["gyro"] - plain.pulses["gyro"], axis=0) * 0.5  # arcsec
    # 75 arcsec at five phases span 1 + cos 36 deg to 2 cos 18 deg of it; a pulse of rounding on either side
    assert 1.809 * 75.0 - 1.0 <= np.ptp(total[:, 0]) <= 1.903 * 75.0 + 1.0
    assert np.abs(total[:, 1:]).max() <= 1.0


@pytest.mark.parametrize("skew_s", [0.001, 0.0004, -0.002, -0.0007])
def test_skewed_accelerometers_are_sampled_later(scenario: Make, skew_s: float) -> None:
    moving = ({"rest": {"duration_s": 0.1}}, ROCK, {"rest": {"duration_s": 0.1}})
    plain = run(scenario(*moving, unit={"calibration": {**FINE, "temperature": None}}))
    skewed = run(
        scenario(*moving, unit={"calibration": {**FINE, "temperature": None}, "accelerometer_skew_s": skew_s})
    )
    np.testing.assert_array_equal(skewed.pulses["gyro"], plain.pulses["gyro"])
    # two rules exact to 1e-15, of g tau = 0.01 m/s
    np.testing.assert_allclose(skewed.truth["dv_b"], plain.truth["dv_b"], atol=1e-16)
    np.testing.assert_array_equal(skewed.truth["C_nb"], plain.truth["C_nb"])
    t = plain.truth["t_s"]
    begin = 50  # at rest: the sums begin alike
    for axis in range(3):
        from_rest = np.cumsum(plain.pulses["accelerometer"][begin:, axis])
        shifted = np.cumsum(skewed.pulses["accelerometer"][begin:, axis])
        at_rest = from_rest[9] / 10 / 1e-3 * skew_s  # what rest brings in the time of the skew
        expected = np.interp(t[begin:] + skew_s, t[begin:], from_rest) - at_rest
        inside = slice(10, -10)
        # pulses at the ends, and the interpolation: tau^2 / 8 * K * 200 m/s^3
        assert np.abs(shifted[inside] - expected[inside]).max() < 4.0 + 1e-6 / 8 * 3e6 * 200


def test_too_many_pulses_are_clipped_and_flagged(scenario: Make) -> None:
    limits = {"gyro_pulses": 100, "accelerometer_pulses": 19}
    got = run(scenario(REST, TURN, unit={"saturation": limits}))
    free = run(scenario(REST, TURN))
    over = (np.abs(free.pulses["gyro"]) > 100).any(axis=1) | (np.abs(free.pulses["accelerometer"]) > 19).any(
        axis=1
    )
    assert 0 < over.sum() < over.size
    np.testing.assert_array_equal(got.pulses["status"], over * STATUS_OVERFLOW)
    np.testing.assert_array_equal(got.pulses["gyro"], np.clip(free.pulses["gyro"], -100, 100))
    np.testing.assert_array_equal(got.pulses["accelerometer"], np.clip(free.pulses["accelerometer"], -19, 19))


def test_the_temperature_slopes_and_settles(scenario: Make) -> None:
    course = {"start_degc": 20.0, "slope_k_per_h": 36.0, "settles_at_degc": 30.0, "time_constant_s": 2.0}
    pulses = run(scenario(REST, unit={"temperature": course})).pulses
    t = pulses["elapsed_ns"] * 1e-9
    expected = 20.0 + 0.01 * t + 10.0 * (1 - np.exp(-t / 2.0))
    np.testing.assert_allclose(
        pulses["temperature_degc"], np.tile(expected[:, None], 6), rtol=1e-14
    )  # one exp each


def test_the_counter_starts_and_jumps_where_it_should_and_warm_up_ends(scenario: Make) -> None:
    jumps = [{"at_s": 0.5, "by": 100}, {"at_s": 1.0, "by": -1000}]
    got = run(
        scenario(
            REST, start={"counter": 2**32 - 200}, faults={"counter_jumps": jumps}, unit={"warm_up_s": 0.25}
        )
    )
    counter = got.pulses["counter"]
    assert counter[0] == 2**32 - 200
    np.testing.assert_array_equal(np.flatnonzero(np.diff(counter) != 1), [499, 999])
    assert counter[500] - counter[499] == 101
    assert counter[1000] - counter[999] == -999
    np.testing.assert_array_equal(got.truth["counter"], counter)
    np.testing.assert_array_equal(got.pulses["status"] == STATUS_WARM_UP, np.arange(2000) < 250)


def test_a_unit_that_restarts_counts_from_zero_and_warms_up_again(scenario: Make) -> None:
    faults = {
        "restarts": [{"at_s": 0.6, "duration_s": 0.4}],
        "counter_jumps": [{"at_s": 0.5, "by": 100}, {"at_s": 1.5, "by": 10}],
    }
    got = run(scenario(REST, start={"counter": 5000}, faults=faults, unit={"warm_up_s": 0.25}))
    counter = got.pulses["counter"]
    assert counter[0] == 5000
    np.testing.assert_array_equal(counter[1000:1500], np.arange(500))
    np.testing.assert_array_equal(counter[1500:], np.arange(510, 1010))
    warm_up = np.flatnonzero(got.pulses["status"] == STATUS_WARM_UP)
    np.testing.assert_array_equal(warm_up, [*range(250), *range(1000, 1250)])


def test_biases_step_where_they_should_and_by_their_amounts(scenario: Make) -> None:
    steps = [
        {"at_s": 0.5, "gyro_deg_per_h": [100.0, 0.0, -50.0], "accelerometer_ug": [0.0, 3e4, -1e4]},
        {"at_s": 1.0, "accelerometer_ug": [2e4, 0.0, 0.0]},
    ]
    plain, stepped = (
        run(scenario(REST, unit={"calibration": FINE, "bias_steps": some})).pulses for some in ([], steps)
    )

    def change(axis: str, part: slice) -> np.ndarray:
        return (stepped[axis][part] - plain[axis][part]).sum(axis=0)

    K, k_g = np.array([2e6, 3e6, 1e6]), np.array([0.001, 0.002, 0.0015]) * ARCSEC
    assert not change("gyro", slice(0, 500)).any()
    # a pulse of rounding at each end
    G = np.linalg.inv(FINE["gyro"]["C_bg"])
    expected = G @ (np.array([100.0, 0.0, -50.0]) * DEG_PER_H * 1.5) / k_g
    np.testing.assert_allclose(change("gyro", slice(500, 2000)), expected, atol=2)
    expected = np.array([2e4 * 1.0, 3e4 * 1.5, -1e4 * 1.5]) * UG * K
    np.testing.assert_allclose(change("accelerometer", slice(500, 2000)), expected, atol=2)


def test_a_unit_drifts_with_temperature_though_its_calibration_does_not_know(scenario: Make) -> None:
    slopes = {
        "gyro_bias_deg_per_h_per_k": 0.05,
        "gyro_scale_ppm_per_k": 2.0,
        "accelerometer_bias_ug_per_k": 30.0,
        "accelerometer_scale_ppm_per_k": 5.0,
    }
    drawn = [
        draw_true_unit(scenario(REST, seed=seed, unit={"residuals": slopes}), LAYOUT).temperature
        for seed in range(200)
    ]
    assert all(terms.reference_degc == 35.0 for terms in drawn)  # temperature.start_degc
    # 600 draws: four sigma of the standard deviation are 4 / sqrt(1200)
    assert np.std([t.gyro_bias for t in drawn]) == pytest.approx(0.05 * DEG_PER_H, rel=0.12)
    assert np.std([t.gyro_scale for t in drawn]) == pytest.approx(2.0 * PPM, rel=0.12)
    assert np.std([t.accelerometer_bias for t in drawn]) == pytest.approx(30.0 * UG, rel=0.12)
    assert np.std([t.accelerometer_scale for t in drawn]) == pytest.approx(5.0 * PPM, rel=0.12)
    assert draw_true_unit(scenario(REST), LAYOUT).temperature is None


def test_true_points_may_differ_from_those_of_the_calibration(scenario: Make) -> None:
    true = {"x": [1.0, 2.0, 3.0], "y": [4.0, 5.0, 6.0], "z": [7.0, 8.0, 9.0]}
    bare = {key: value for key, value in FINE.items() if key != "size_effect"}
    unit = draw_true_unit(scenario(REST, unit={"calibration": bare, "r_mm": true}), LAYOUT)
    np.testing.assert_allclose(unit.r_b, np.arange(1, 10).reshape(3, 3) * 1e-3, rtol=1e-15)


def test_the_seed_of_the_unit_draws_its_residuals_alone(scenario: Make) -> None:
    of_unit = {"seed": 11, "residuals": {"accelerometer_bias_ug": 50.0}}
    one, other = (draw_true_unit(scenario(REST, seed=s, unit=of_unit), LAYOUT) for s in (1, 2))
    np.testing.assert_array_equal(one.accelerometer_bias, other.accelerometer_bias)


def test_a_slower_unit_counts_the_same_motion(scenario: Make) -> None:
    fast, slow = run(scenario(REST, TURN)), run(scenario(REST, TURN), interval_ns=2_500_000)
    assert slow.pulses.size == 1400
    assert np.all(slow.pulses["interval_ns"] == 2_500_000)
    # a pulse of rounding on each side
    np.testing.assert_allclose(slow.pulses["gyro"].sum(axis=0), fast.pulses["gyro"].sum(axis=0), atol=1)
    np.testing.assert_allclose(slow.truth["C_nb"][-1], fast.truth["C_nb"][-1], atol=1e-15)


def test_residuals_have_their_sigma_and_nothing_else_changes(scenario: Make) -> None:
    sigmas = {
        "gyro_bias_deg_per_h": 0.01,
        "gyro_scale_ppm": 5.0,
        "gyro_misalignment_urad": 30.0,
        "accelerometer_bias_ug": 50.0,
        "accelerometer_scale_ppm": 20.0,
        "accelerometer_misalignment_urad": 40.0,
    }
    units = [
        draw_true_unit(scenario(REST, seed=seed, unit={"residuals": sigmas}), LAYOUT) for seed in range(200)
    ]
    exact = draw_true_unit(scenario(REST), LAYOUT)

    def sigma(of: Callable[[Coefficients], Any]) -> float:
        return float(np.std([of(u) - of(exact) for u in units]))

    # 600 draws (1200 of the misalignments): four sigma are 4 / sqrt(1200)
    assert sigma(lambda u: u.gyro_bias) == pytest.approx(0.01 * DEG_PER_H, rel=0.12)
    assert sigma(lambda u: u.gyro_scale / exact.gyro_scale) == pytest.approx(5 * PPM, rel=0.12)
    assert sigma(lambda u: u.C_bg[~np.eye(3, dtype=bool)]) == pytest.approx(30 * URAD, rel=0.12)
    assert sigma(lambda u: u.accelerometer_bias) == pytest.approx(50 * UG, rel=0.12)
    assert sigma(lambda u: u.accelerometer_scale / exact.accelerometer_scale) == pytest.approx(
        20 * PPM, rel=0.12
    )
    assert sigma(lambda u: u.C_ba[~np.eye(3, dtype=bool)]) == pytest.approx(40 * URAD, rel=0.12)
    for u in units:
        np.testing.assert_array_equal(np.diag(u.C_ba), 1.0)
        np.testing.assert_array_equal(u.r_b, exact.r_b)


def test_without_a_calibration_the_unit_is_the_nominal_one(scenario: Make) -> None:
    unit = draw_true_unit(scenario(REST), LAYOUT)
    assert NOMINAL.size_effect is not None
    np.testing.assert_array_equal(unit.r_b, NOMINAL.size_effect.r_m)
    np.testing.assert_array_equal(unit.gyro_scale, np.full(3, 0.5 * ARCSEC))
    np.testing.assert_array_equal(unit.C_bg, np.eye(3))


def test_gravity_absent_from_the_site_is_the_normal_one(scenario: Make) -> None:
    got = run(scenario(REST, site={"latitude_deg": 90.0, "longitude_deg": 0.0, "height_m": 0.0}))
    assert got.truth["dv_b"][0, 2] == pytest.approx(9.8321849378e-3, rel=1e-10)  # the published digits
    east, north, up = earth_rate_n(90.0 * DEG)
    np.testing.assert_allclose(got.truth["omega_ib_b"][0], [east, north, up], atol=1e-19)


@pytest.mark.parametrize(
    ("interval_ns", "chunk", "message"),
    [(0, 1, "10 us to 1 s, got 0 ns"), (MS, 0, "at least one sample, got 0")],
)
def test_an_invalid_interval_or_chunk_is_refused(
    scenario: Make, interval_ns: int, chunk: int, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        next(simulate(scenario(REST), replace(LAYOUT, interval=Fraction(interval_ns)), chunk))


@pytest.mark.parametrize(("profile", "step"), [("ilabs-ga-200", 10), ("kvh1775", 1), ("hg4930", None)])
def test_counter_and_status_are_those_of_the_profile(scenario: Make, profile: str, step: int | None) -> None:
    layout = profiles.load(profile).layout()
    got = run_as(layout, scenario(REST, start={"counter": 1000}, unit={"warm_up_s": 0.25}))
    first = 0 if step is None else 1000  # samples without a number are counted from 0
    np.testing.assert_array_equal(
        got.pulses["counter"], first + (step or 1) * np.arange(len(got.pulses)), strict=False
    )
    # Bits that mean good are set, and no bit of a unit that has none for the warm-up changes.
    assert set(got.pulses["status"].tolist()) == {layout.status.inverted}


def test_an_axis_saturates_at_the_width_of_its_own_field(scenario: Make) -> None:
    layout = profiles.load("tamagawa-serial").layout()  # rates of 16 bits of 200 / 2^15 deg/s
    x, y, z = layout.gyro.axes
    assert x is not None
    narrow = layout.gyro._replace(axes=(x._replace(bits=15), y, z))
    layout = replace(layout, gyro=narrow)
    # The peak of minimum jerk is 1.875 times the mean: 675 deg/s.
    spin = {"rotate": {"angle_deg": 720.0, "duration_s": 2.0, "axis_n": [0.0, 0.0, 1.0]}}
    for pose, axis, limit in (("x_up", 0, 100.0), ("z_up", 2, 200.0)):
        rate = run_as(layout, scenario(spin, start={"pose": pose})).pulses["gyro"][:, axis]
        assert rate.max() == pytest.approx(limit * DEG * 0.005, rel=1e-4)  # less a count
