import re
from math import atan2, cos, radians, sin
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from imudrv.errors import InputError
from imudrv.nav.alignment import Aligned, Alignment
from imudrv.nav.attitude import rotation
from imudrv.nav.earth import earth_rate_n
from imudrv.records import INCREMENTS, Records
from imudrv.units import ARCSEC, DEG, DEG_PER_H, DEG_PER_SQRT_H, NS, UG

Array = NDArray[np.float64]

LATITUDE = radians(28.2)
GRAVITY = 9.7918
OMEGA_IE = np.array(earth_rate_n(LATITUDE))
GYRO_BIAS, ACCELEROMETER_BIAS = 0.005 * DEG_PER_H, 30.0 * UG
ARW, VRW = 0.002 * DEG_PER_SQRT_H, 5e-5  # rad/sqrt(s), m/s/sqrt(s)
GYRO_PULSE, ACCELEROMETER_PULSE = 0.5 * ARCSEC, 1.0 / 2000.0
TAU_NS = 10_000_000


def standing(
    C_nb: Array,
    duration_s: float = 370.0,
    seed: int | None = None,
    *,
    biased: bool = True,
    swing_rad: float = 0.0,
) -> tuple[Records, Array]:
    """Increments of a unit at rest, of a seed with noise, bias and pulses, and its attitude at the end.

    With `swing_rad` it swings about the body's X axis, 0.4 times a second.
    """
    tau, n = TAU_NS * NS, round(duration_s / (TAU_NS * NS))
    t = np.arange(n + 1) * tau
    angle = swing_rad * np.sin(2.0 * np.pi * 0.4 * t)
    swing = Rotation.from_rotvec(np.outer(angle, [1.0, 0.0, 0.0]))
    C_bn = (Rotation.from_matrix(C_nb) * swing).inv()
    # trapezoidal: 1e-2 s of 2.5 rad/s, (0.025)^2 / 12 of the swing's part
    dtheta = 0.5 * tau * (C_bn[:-1].apply(OMEGA_IE) + C_bn[1:].apply(OMEGA_IE))
    dtheta[:, 0] += np.diff(angle)
    up = C_bn.apply([0.0, 0.0, GRAVITY])
    dv = 0.5 * tau * (up[:-1] + up[1:])
    if seed is not None:
        rng = np.random.default_rng(seed)
        biases = rng.normal(size=(2, 3)) * biased
        dtheta = dtheta + GYRO_BIAS * biases[0] * tau + ARW * np.sqrt(tau) * rng.normal(size=(n, 3))
        dv = dv + ACCELEROMETER_BIAS * biases[1] * tau + VRW * np.sqrt(tau) * rng.normal(size=(n, 3))
        dtheta = np.diff(np.rint(np.cumsum(dtheta, axis=0) / GYRO_PULSE), axis=0, prepend=0.0) * GYRO_PULSE
        dv = (
            np.diff(np.rint(np.cumsum(dv, axis=0) / ACCELEROMETER_PULSE), axis=0, prepend=0.0)
            * ACCELEROMETER_PULSE
        )
    out = np.zeros(n, INCREMENTS)
    out["counter"], out["interval_ns"] = np.arange(n), TAU_NS
    out["t_ns"] = (np.arange(n) + 1) * TAU_NS
    out["dtheta_b"], out["dv_b"] = dtheta, dv
    return out, C_bn[-1].inv().as_matrix()


def aligned(increments: Records, **options: Any) -> Aligned:
    alignment = Alignment(LATITUDE, GYRO_BIAS, ACCELEROMETER_BIAS, **options)
    alignment.feed(increments)
    return alignment.result()


def error_n(result: Aligned, C_nb: Array) -> Array:
    """Rotation vector from the true to the found attitude, in n."""
    found = Rotation.from_quat(np.roll(result.q_nb, -1))
    return (found * Rotation.from_matrix(C_nb).inv()).as_rotvec()


ATTITUDES = [
    np.eye(3),
    rotation((0, 0, 1), 2.5),
    rotation((1.0, 2.0, 3.0), 1.7),
    rotation((1, 1, 1), -2 * np.pi / 3),
]


@pytest.mark.parametrize("C_nb", ATTITUDES)
def test_exact_increments_give_the_exact_attitude(C_nb: Array) -> None:
    increments, at_end = standing(C_nb, 120.0)
    # g (Earth's rate * 1 s)^2 / 24 within the filter's seconds makes 2e-10 rad; the heading divides it by
    # 6e-5 rad/s * 120 s
    np.testing.assert_allclose(error_n(aligned(increments, duration_s=120.0), at_end), 0.0, atol=1e-7)


def test_the_attitude_is_that_of_the_last_sample() -> None:
    increments, _ = standing(np.eye(3), 61.25)
    increments["counter"] += 1000
    result = aligned(increments, duration_s=100.0)
    assert (result.counter, result.t_ns, result.duration_s) == (
        1000 + 6124,
        61_250_000_000,
        pytest.approx(61.25),
    )


def test_errors_are_as_large_as_predicted() -> None:
    z = []
    for seed in range(40):
        C_nb = rotation(np.random.default_rng(seed).normal(size=3), 2.0)
        increments, at_end = standing(C_nb, seed=seed)
        result = aligned(increments)
        assert result.motion is None
        sigma = np.array([result.level_sigma_rad, result.level_sigma_rad, result.heading_sigma_rad])
        z.append(error_n(result, at_end) / sigma)
    assert np.abs(z).max() < 4.0  # of 120 normal numbers one in 130 such runs
    low, high = chi2.ppf([0.005, 0.995], 40) / 40
    east, north, heading = np.mean(np.square(z), axis=0)
    assert low < east < high
    assert low < north < high
    assert (
        low / 2.0 < heading < high
    )  # predicted cautiously: the random walk of velocity counts as one of tilt
    assert result.level_sigma_rad == pytest.approx(ACCELEROMETER_BIAS / GRAVITY, rel=0.2)
    # gyro bias alone: 0.005 deg/h / (15.04 deg/h cos 28.2 deg) = 0.38 mrad; the random walk of 370 s adds 0.5
    # mrad
    assert 0.38e-3 < result.heading_sigma_rad < 1.0e-3


def test_the_noise_in_the_data_predicts_the_error_without_biases() -> None:
    z, headings = [], []
    for seed in range(100, 130):
        increments, at_end = standing(rotation((1.0, 2.0, 3.0), 1.7), seed=seed, biased=False)
        alignment = Alignment(LATITUDE, 0.0, 0.0)
        alignment.feed(increments)
        result = alignment.result()
        z.append(error_n(result, at_end)[2] / result.heading_sigma_rad)
        headings.append(result.heading_sigma_rad)
    # The best that a random walk of tilt allows is ARW / sqrt(370 s) / (Earth rate cos latitude) = 0.47 mrad.
    best = ARW / np.sqrt(370.0) / OMEGA_IE[1]
    # A filter that does not know the rate at the start pays 10 % more, and velocity's random walk counts as
    # tilt's.
    assert best < np.median(headings) < 1.5 * best
    assert chi2.ppf(0.005, 30) / 30 / 2.0 < np.mean(np.square(z)) < chi2.ppf(0.995, 30) / 30


def test_a_level_unit_whose_pulses_hardly_change_is_not_predicted_too_well() -> None:
    # X and Y count a pulse now and then, so that their rounding is no white noise
    z = []
    for seed in range(100, 112):
        increments, at_end = standing(np.eye(3), seed=seed, biased=False)
        alignment = Alignment(LATITUDE, 0.0, 0.0)
        alignment.feed(increments)
        result = alignment.result()
        z.append(error_n(result, at_end)[2] / result.heading_sigma_rad)
    assert np.mean(np.square(z)) < chi2.ppf(0.995, 12) / 12


def test_sigma_decreases_with_time() -> None:
    increments, _ = standing(np.eye(3), seed=1)
    alignment = Alignment(LATITUDE, GYRO_BIAS, ACCELEROMETER_BIAS)
    sigmas = []
    for part in np.split(increments, [6_000, 12_000, 24_000]):
        alignment.feed(part)
        sigmas.append(alignment.result().heading_sigma_rad)
    assert sigmas[0] > 1.5 * sigmas[-1]  # from 60 s to 370 s: the random walk's part by sqrt(6)
    assert alignment.done


def test_pieces_give_the_same_bits_and_the_remainder_is_returned() -> None:
    increments, _ = standing(rotation((1, 2, 3), 1.0), 70.0, seed=2)
    whole, pieces = (Alignment(LATITUDE, GYRO_BIAS, ACCELEROMETER_BIAS, 60.0) for _ in range(2))
    rest = whole.feed(increments)
    assert rest["counter"].tolist() == list(range(6000, 7000))
    got = [pieces.feed(part) for part in np.split(increments, [1, 2, 17, 3001, 5999, 6000, 6500])]
    assert np.array_equal(np.concatenate(got), rest)
    assert pieces.result().q_nb.tobytes() == whole.result().q_nb.tobytes()


def test_swinging_about_a_fixed_attitude_does_not_disturb_heading() -> None:
    # 0.5 mrad at 0.4 Hz: mean rates over the window would be off by up to 0.5 mrad / 60 s = 8e-6 rad/s of
    # 6e-5
    swung, at_end = standing(np.eye(3), 121.9, swing_rad=0.5e-3)
    result = aligned(swung, duration_s=121.9)
    assert abs(error_n(result, at_end)[2]) < 1e-3
    naive = swung["dtheta_b"].mean(axis=0)
    assert abs(atan2(naive[0], naive[1])) > 5e-3  # and what that is without


@pytest.mark.parametrize("what", ["turn", "shift", "shake"])
def test_a_moved_platform_is_caught_with_time_and_size(what: str) -> None:
    increments, _ = standing(np.eye(3), 200.0, seed=3)
    if what == "turn":  # 1 mrad about the vertical in 2 s
        increments["dtheta_b"][10_000:10_200, 2] += 1e-3 / 200
    elif what == "shake":
        t = np.arange(500) * 0.01
        increments["dtheta_b"][10_000:10_500, 1] += 1e-5 * np.cos(2 * np.pi * 2.0 * t)
    else:  # pushed and stopped, 0.2 m/s
        increments["dv_b"][10_000:10_100, 0] += 2e-3
        increments["dv_b"][10_100:10_200, 0] -= 2e-3
    motion = aligned(increments, duration_s=200.0).motion
    expected = "specific force .* m/s\\^2 rms" if what == "shift" else "rate .* rad/s rms"
    assert motion is not None
    sentence = (
        rf"moved 100 to 105 s after the start: {expected}.*limit .*8 times the quietest fifth.*align again"
    )
    assert re.search(sentence, str(motion))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1.5, 0.0, 0.0), r"expected a latitude within 85 deg of the equator, got 85.9"),
        ((float("nan"), 0.0, 0.0), "latitude"),
        ((0.5, -1.0, 0.0), "expected the sigmas"),
        ((0.5, 0.0, float("inf")), "expected the sigmas"),
        ((0.5, 0.0, 0.0, 10.0), "expected a length of 30 to 7200 s, got 10 s"),
    ],
)
def test_invalid_settings_are_refused(arguments: tuple[float, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Alignment(*arguments)


def test_too_little_gravity_rotation_or_time_is_refused() -> None:
    increments, _ = standing(np.eye(3), 40.0)
    with pytest.raises(InputError, match="expected 30 s of samples at least, got 20 s; feed more"):
        aligned(increments[:2000])
    heavy = increments.copy()
    heavy["dv_b"] *= 1.1
    with pytest.raises(InputError, match=r"expected gravity, .* got 10.77"):
        aligned(heavy)
    turning = increments.copy()
    turning["dtheta_b"][:, 0] += 1e-3 * TAU_NS * NS
    with pytest.raises(
        InputError, match=r"expected the horizontal part of the Earth's rotation, 6.427e-05 rad/s"
    ):
        aligned(turning)


def test_heading_is_the_azimuth_of_the_body_y_axis() -> None:
    increments, _ = standing(rotation((0, 0, 1), -30.0 * DEG), 40.0)
    assert aligned(increments).heading_rad == pytest.approx(30.0 * DEG, abs=1e-6)
    assert sin(aligned(increments).heading_rad) == pytest.approx(cos(60.0 * DEG), abs=1e-6)
