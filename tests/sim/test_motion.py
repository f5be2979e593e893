from collections.abc import Callable
from itertools import pairwise
from math import cos, pi
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.integrate import quad

from imudrv.nav.attitude import rotation
from imudrv.nav.earth import earth_rate_n
from imudrv.sim.integrate import Body, Dithering, Integrals, Motion, Shaking
from imudrv.sim.path import cycles_at, split_cycles, start_attitude
from imudrv.sim.scenario import Scenario, Start
from imudrv.units import ARCSEC, DEG, NS, STANDARD_GRAVITY

Make = Callable[..., Scenario]

GRAVITY = 9.79
OMEGA_IE_N = np.array(earth_rate_n(0.49))
ROCK = {
    "rock": {
        "duration_s": 4.0,
        "band_hz": [0.5, 3.0],
        "rate_rms_deg_per_s": [50, 30, 40],
        "sway_mm": [5, 10, 15],
    }
}
WOBBLE = {
    "rotate": {"angle_deg": 180.0, "duration_s": 2.5, "wobble_deg": 2.0, "wobble_hz": 3.0},
}
TURN = {"rotate": {"angle_deg": 180.0, "duration_s": 2.5, "axis_tilt_mrad": [3.0, -2.0]}}
REST = {"rest": {"duration_s": 0.5}}
STILL = Shaking((0.0, 0.0, 0.0), 0.0, np.zeros(2))


def a_body(
    interval_ns: int = 1_000_000,
    arm: ArrayLike = (0, 0, 0),
    r_b: Any = None,
    amplitude_rad: Any = (0, 0, 0),
    earth: bool = True,
    motor: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Body:
    hz = np.array([400.0, 390.0, 410.0])
    x, y, z = np.asarray(arm, np.float64).tolist()
    east, north, up = OMEGA_IE_N.tolist()
    return Body(
        interval_s=interval_ns * NS,
        gravity=GRAVITY,
        omega_ie_n=(east, north, up) if earth else (0.0, 0.0, 0.0),
        motor=Shaking(motor, 2 * pi * 25.0, split_cycles(25.0, interval_ns * NS)) if any(motor) else STILL,
        pivot_to_origin_b=(x, y, z),
        A=np.eye(3),
        r_b=np.zeros((3, 3)) if r_b is None else np.array(r_b, np.float64),
        case=Dithering(
            np.eye(3),
            np.array(amplitude_rad, np.float64),
            2 * pi * hz,
            split_cycles(hz, interval_ns * NS),
            np.array([0.1, 0.4, 0.8]),
        ),
    )


def run(scenario: Scenario, interval_ns: int = 1_000_000, **body: Any) -> Integrals:
    motion = Motion(scenario, a_body(interval_ns, **body))
    return motion.integrals(0, motion.samples)


def velocity_n(integrals: Integrals, C_nb0: np.ndarray, interval_s: float) -> np.ndarray:
    """Integral of `C_nb f_b - (0, 0, g)` up to each interval's end, by the trapezoidal attitude."""
    before = np.concatenate([C_nb0[None], integrals.C_nb[:-1]])
    middle = 0.5 * (before + integrals.C_nb)
    return np.cumsum(np.einsum("nij,nj->ni", middle, integrals.dv_b) - [0, 0, GRAVITY * interval_s], axis=0)


@pytest.mark.parametrize(
    ("pose", "X", "Y", "Z"),
    [
        ("z_up", (1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ("x_up", (0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ("y_up", (0, 1, 0), (0, 0, 1), (1, 0, 0)),
    ],
)
def test_poses_are_those_of_the_bench_procedure(pose: str, X: ArrayLike, Y: ArrayLike, Z: ArrayLike) -> None:
    np.testing.assert_array_equal(
        start_attitude(Start.model_validate({"pose": pose})), np.transpose([X, Y, Z])
    )


def test_heading_is_clockwise_and_the_tilt_leans_east_and_north() -> None:
    C_nb = start_attitude(Start(heading_deg=90.0, tilt_mrad=(2.0, -1.0)))
    # leaning by milliradians: the second order is 2.5e-6
    np.testing.assert_allclose(C_nb[:, 1], [1, 0, -2e-3], atol=5e-6)
    np.testing.assert_allclose(C_nb[:, 2], [2e-3, -1e-3, 1], atol=5e-6)


def test_at_rest_the_sensors_feel_the_earth_rate_and_gravity(scenario: Make) -> None:
    still = scenario(REST, start={"pose": "x_up", "heading_deg": 33.0, "tilt_mrad": [5.0, 3.0]})
    got = run(still)
    C_bn = start_attitude(still.start).T
    # one product and one sum of rounded numbers
    np.testing.assert_allclose(got.dtheta_b, np.tile(1e-3 * C_bn @ OMEGA_IE_N, (500, 1)), rtol=1e-13)
    np.testing.assert_allclose(got.dv_b, np.tile(1e-3 * C_bn @ [0, 0, GRAVITY], (500, 1)), rtol=1e-13)
    np.testing.assert_array_equal(got.dv_b, got.late)


def test_a_turn_ends_at_rest_at_exactly_its_angle(scenario: Make) -> None:
    turn = {"rotate": {"angle_deg": -135.0, "duration_s": 1.0, "axis_n": [1, 2, -1]}}
    got = run(scenario(turn, REST))
    # roundings of three rotations
    np.testing.assert_allclose(got.C_nb[999], rotation([1, 2, -1], -135.0 * DEG), atol=1e-15)
    np.testing.assert_allclose(got.omega_ib_b[999], got.C_nb[999].T @ OMEGA_IE_N, atol=1e-17)
    np.testing.assert_allclose(got.omega_ib_b[1400], got.omega_ib_b[999], atol=1e-17)


def test_a_turn_wobbles_by_its_angle_and_ends_where_one_without_ends(scenario: Make) -> None:
    got, smooth = run(scenario(WOBBLE)), run(scenario({"rotate": {"angle_deg": 180.0, "duration_s": 2.5}}))
    np.testing.assert_allclose(got.C_nb[-1], smooth.C_nb[-1], atol=1e-15)
    np.testing.assert_allclose(got.omega_ib_b[-1], smooth.omega_ib_b[-1], atol=1e-16)
    off = np.arccos(np.clip(got.C_nb[:, 2, 2], -1.0, 1.0)) / DEG
    # two elementary rotations of 2 deg, a quarter cycle apart: a cone of 2 deg, to the second order
    np.testing.assert_allclose(off[700:1800], 2.0, atol=2e-3)
    assert off[-1] < 1e-6


def test_a_motor_shakes_the_pivot_at_rest_and_in_a_turn(scenario: Make) -> None:
    amplitude = (0.01, 0.02, -0.03)
    for motion in (REST, TURN):
        still, shaken = run(scenario(motion)), run(scenario(motion), motor=amplitude)
        f_n = np.einsum("nij,nj->ni", still.C_nb, shaken.dv_b - still.dv_b) / 1e-3
        t = 1e-3 * (np.arange(len(f_n)) + 0.5)
        # a mean over 1 ms is the middle but for (2 pi 25 Hz 1 ms)^2 / 24 = 1e-3; 1.4 rad/s turns 0.7 mrad
        expected = np.outer(np.sin(2 * pi * 25.0 * t), amplitude)
        np.testing.assert_allclose(f_n, expected, atol=0.03 * 2e-3)


def test_rocking_ends_at_rest_where_it_began(scenario: Make) -> None:
    got = run(scenario(ROCK, start={"heading_deg": 20.0}))
    np.testing.assert_allclose(got.C_nb[-1], start_attitude(Start(heading_deg=20.0)), atol=1e-15)
    np.testing.assert_allclose(got.omega_ib_b[-1], got.C_nb[-1].T @ OMEGA_IE_N, atol=1e-17)
    assert np.abs(got.omega_ib_b).max() > 1.0


@pytest.mark.parametrize("motion", [ROCK, TURN, WOBBLE], ids=["rock", "turn", "wobble"])
def test_the_rate_is_the_derivative_of_the_attitude(scenario: Make, motion: dict[str, Any]) -> None:
    h = 1e-4
    got = run(scenario(motion), interval_ns=100_000)
    C_nb_dot = (got.C_nb[:-4] - 8 * got.C_nb[1:-3] + 8 * got.C_nb[3:-1] - got.C_nb[4:]) / (12 * h)
    skew = np.einsum("nji,njk->nik", got.C_nb[2:-2], C_nb_dot)
    omega_nb_b = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    omega_ib_b = omega_nb_b + np.einsum("nji,j->ni", got.C_nb[2:-2], OMEGA_IE_N)
    # fourth-order difference of 1 rad at 3 Hz: h^4 (20/s)^5 / 30 = 1e-11; rounding 5e-15 rad / h = 5e-11
    np.testing.assert_allclose(got.omega_ib_b[2:-2], omega_ib_b, atol=1e-10)
    # increments over two intervals are the rate's integral: Simpson's h^5 (20/s)^4 / 90 = 2e-17, and rounding
    two = got.dtheta_b[1:-1:2] + got.dtheta_b[2::2]
    ends = got.omega_ib_b[:-2:2] + 4 * got.omega_ib_b[1:-1:2] + got.omega_ib_b[2::2]
    np.testing.assert_allclose(two, h / 3 * ends, atol=2e-16)


@pytest.mark.parametrize("amplitude", [0.0, 100 * ARCSEC], ids=["no dither", "dither"])
@pytest.mark.parametrize("motion", [ROCK, TURN, WOBBLE], ids=["rock", "turn", "wobble"])
def test_the_arms_feel_omega_dot_and_omega_squared(
    scenario: Make, motion: dict[str, Any], amplitude: float
) -> None:
    h = 2e-5
    shaken = scenario(motion)

    def felt(r_b: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        body = a_body(
            20_000,
            arm=(0.05, -0.02, 0.03),
            r_b=r_b,
            amplitude_rad=[amplitude, 0.5 * amplitude, 0.8 * amplitude],
        )
        plan = Motion(shaken, body)
        got = plan.integrals(plan.samples // 2, plan.samples // 2 + 1000)
        return (got.late - got.dv_b)[1:], got.omega_ib_b

    # x, y, z feel -omega_dot of z, x, y on these arms, +omega_dot of y, z, x on those, and products of omega
    (minus, omega), (plus, _), (along, _) = (
        felt([[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
        felt([[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
        felt(np.eye(3)),
    )
    minus, plus = minus[:, [1, 2, 0]], plus[:, [2, 0, 1]]
    # the tangential part telescopes, but for rounding of dv and the Earth's rate under dither squared
    np.testing.assert_allclose(0.5 * (plus - minus), np.diff(omega, axis=0), atol=1e-14 + h * 1e-7)
    w = omega.T

    def mean(product: np.ndarray) -> np.ndarray:
        return h / 2 * (product[:-1] + product[1:])

    # trapezoid: h^3 / 12 times (1.2 rad/s)^2 (5000/s)^2 with dither, 10 (rad/s)^2 (20/s)^2 without
    tolerance = h**3 / 12 * (4e7 if amplitude else 4e3)
    products = np.stack([mean(w[1] * w[2]), mean(w[2] * w[0]), mean(w[0] * w[1])], axis=1)
    np.testing.assert_allclose(0.5 * (plus + minus), products, atol=tolerance)
    squares = -np.stack(
        [mean(w[1] ** 2 + w[2] ** 2), mean(w[2] ** 2 + w[0] ** 2), mean(w[0] ** 2 + w[1] ** 2)], axis=1
    )
    np.testing.assert_allclose(along, squares, atol=2 * tolerance)


def test_a_turn_from_rest_to_rest_leaves_no_velocity(scenario: Make) -> None:
    arm = np.array([0.06, 0.02, -0.03])
    turn = scenario(TURN)
    got = run(turn, interval_ns=100_000, arm=arm)
    C_nb0 = start_attitude(turn.start)
    v_n = velocity_n(got, C_nb0, 1e-4)
    coriolis = 2.0 * np.cross(OMEGA_IE_N, got.C_nb @ arm - C_nb0 @ arm)
    # trapezoidal attitude: h^2 / 12 * g * 4 rad/s^2 * 4e-3 tilt * 2.5 s = 3e-10
    np.testing.assert_allclose(v_n[-1], coriolis[-1], atol=2e-9)
    # and in between the origin circles the pivot
    k = 9000
    omega_nb_b = got.omega_ib_b[k] - got.C_nb[k].T @ OMEGA_IE_N
    v_here = got.C_nb[k] @ np.cross(omega_nb_b, arm)
    assert np.linalg.norm(v_here) > 0.05
    np.testing.assert_allclose(v_n[k], v_here + coriolis[k], atol=2e-9)


@pytest.mark.parametrize(
    "motion",
    [
        ROCK,
        {
            "vibrate": {
                "duration_s": 2.0,
                "band_hz": [20, 100],
                "g_rms": [1, 2, 3],
                "rate_rms_deg_per_s": [1, 1, 1],
            }
        },
    ],
)
def test_shaking_leaves_the_pivot_at_rest_where_it_was(scenario: Make, motion: dict[str, Any]) -> None:
    h = 2e-5
    got = run(scenario(motion), interval_ns=20_000)
    v_n = velocity_n(got, np.eye(3), h)
    way = h * np.sum(v_n, axis=0)
    # trapezoidal attitude, h^2 / 12 * 30 m/s^2 * (0.06 rad/s at 600/s, or 1 rad/s at 20/s) * 4 s at worst
    assert np.abs(v_n).max() > 0.05
    np.testing.assert_allclose(v_n[-1], 0.0, atol=1e-7)
    np.testing.assert_allclose(way, 0.0, atol=4e-7)


def test_a_moving_pivot_feels_coriolis(scenario: Make) -> None:
    sway = scenario({"rock": {**ROCK["rock"], "rate_rms_deg_per_s": [0, 0, 0]}})
    h = 1e-3
    turning = velocity_n(run(sway), np.eye(3), h)
    still = velocity_n(run(sway, earth=False), np.eye(3), h)
    way = h * (np.cumsum(still, axis=0) - 0.5 * still)
    coriolis = 2.0 * np.cross(OMEGA_IE_N, way)
    assert np.abs(coriolis).max() > 1e-6
    # the way by trapezoids: h^2 / 12 * 0.5 m/s * 20/s * 4 s = 3e-6 m at worst, seen at 1.5e-4 rad/s
    np.testing.assert_allclose(turning - still, coriolis, atol=5e-10)


def test_integrals_of_dither_and_turn_agree_with_adaptive_quadrature(scenario: Make) -> None:
    # about the vertical and without the Earth everything has one axis: omega = turn' + A W cos
    amplitude, hz, r = 150 * ARCSEC, 410.0, 0.03
    turn = scenario({"rotate": {"angle_deg": 180.0, "duration_s": 2.0}})
    body = a_body(
        2_500_000, r_b=[[r, 0, 0], [r, 0, 0], [0, 0, 0]], amplitude_rad=[0, 0, amplitude], earth=False
    )
    got = Motion(turn, body).integrals(300, 305)

    def omega(t: float) -> float:
        u = t / 2.0
        return pi / 2.0 * 30 * u**2 * (1 - u) ** 2 + amplitude * 2 * pi * hz * cos(2 * pi * (hz * t + 0.8))

    for k, (dtheta, late) in enumerate(zip(got.dtheta_b, got.late, strict=True)):
        begin, end = (300 + k) * 2.5e-3, (301 + k) * 2.5e-3
        angle = quad(omega, begin, end, epsabs=1e-15, epsrel=1e-13)[0]
        centripetal = quad(lambda t: -r * omega(t) ** 2, begin, end, epsabs=1e-16, epsrel=1e-13)[0]
        # 1e-12 of the increment's size: the phase of 300 cycles is rounded to 3e-13
        assert dtheta[2] == pytest.approx(angle, abs=1e-12 * 2.4 * 2.5e-3)
        assert late[0] == pytest.approx(centripetal, abs=1e-12 * 0.3 * 2.5e-3)
        assert late[1] == pytest.approx(r * (omega(end) - omega(begin)), abs=1e-12 * 0.1)


def spectrum(x: np.ndarray, interval_s: float) -> tuple[np.ndarray, np.ndarray]:
    window = np.hanning(x.shape[0])[:, None]
    return np.fft.rfftfreq(x.shape[0], interval_s), np.abs(np.fft.rfft(x * window, axis=0)) ** 2


def test_rocking_has_the_rms_and_the_band_that_were_asked_for(scenario: Make) -> None:
    rms = np.array([2.0, 3.0, 1.0])
    rock = {"rock": {"duration_s": 122.0, "band_hz": [1.0, 3.0], "rate_rms_deg_per_s": rms.tolist()}}
    rates = run(scenario(rock), interval_ns=10_000_000, earth=False).omega_ib_b[100:-100] / DEG
    # 120 s do not average the beats of lines 0.06 Hz apart wholly; angles of 0.5 deg couple the axes by 1 %
    np.testing.assert_allclose(rates.std(axis=0), rms, rtol=0.05)
    hz, power = spectrum(rates, 0.01)
    inside = (hz > 0.9) & (hz < 3.1)
    assert np.all(power[~inside].sum(axis=0) < 1e-3 * power.sum(axis=0))
    assert np.all(power[(hz > 1.0) & (hz < 2.0)].sum(axis=0) > 0.3 * power.sum(axis=0))  # flat: a half


def test_rocking_keeps_to_the_peak(scenario: Make) -> None:
    rock = {"rock": {**ROCK["rock"], "rate_rms_deg_per_s": [50, 0, 0], "rate_peak_deg_per_s": 60.0}}
    rates = run(scenario(rock), earth=False).omega_ib_b / DEG
    # one axis alone turns, so its rate is the body's; a few roundings
    assert np.abs(rates).max() == pytest.approx(60.0, rel=1e-12)


def test_vibration_has_the_rms_and_the_band_that_were_asked_for(scenario: Make) -> None:
    vibrate = {"vibrate": {"duration_s": 12.0, "band_hz": [20, 300], "g_rms": [0, 1, 3]}}
    got = run(scenario(vibrate), interval_ns=200_000)
    f = (got.dv_b[5000:-5000] / 2e-4 - [0, 0, GRAVITY]) / STANDARD_GRAVITY
    # 10 s of lines 9 Hz apart; a mean over 0.2 ms loses 0.3 % at 300 Hz; Coriolis is 1e-5 g
    np.testing.assert_allclose(f.std(axis=0), [0, 1, 3], rtol=0.01, atol=1e-4)
    hz, power = spectrum(f[:, 1:], 2e-4)
    assert np.all(power[(hz < 19) | (hz > 301)].sum(axis=0) < 1e-3 * power.sum(axis=0))


def test_any_range_gives_the_same_bits(scenario: Make) -> None:
    mixed = scenario(REST, TURN, ROCK, REST)
    motion = Motion(mixed, a_body(arm=(0.1, 0, 0), r_b=np.eye(3), amplitude_rad=[1e-6, 2e-6, 3e-6]), 3e-4)
    whole = motion.integrals(-5, motion.samples + 5)
    cuts = [-5, 0, 3, 499, 501, 2999, 3000, 4567, motion.samples + 1, motion.samples + 5]
    parts = [motion.integrals(a, b) for a, b in pairwise(cuts)]
    for k, name in enumerate(Integrals._fields):
        np.testing.assert_array_equal(np.concatenate([p[k] for p in parts]), whole[k], err_msg=name)


def test_early_and_late_parts_make_the_whole(scenario: Make) -> None:
    rock = scenario(ROCK)
    whole = Motion(rock, a_body()).integrals(1000, 1100)
    parts = Motion(rock, a_body(), 3e-4).integrals(1000, 1100)
    assert not whole.early.any()
    # two rules exact to 1e-15 of g tau = 0.01 m/s
    np.testing.assert_allclose(parts.early + parts.late, whole.late, atol=1e-16)
    # 0.3 of the interval, while the force changes by 1 m/s^2 * 20/s * 1 ms = 2 %
    np.testing.assert_allclose(parts.early, 0.3 * whole.late, atol=0.01 * 1e-2)


def test_durations_are_rounded_to_whole_intervals(scenario: Make) -> None:
    motion = Motion(
        scenario({"rest": {"duration_s": 1e-5}}, {"rest": {"duration_s": 0.0126}}),
        a_body(2_500_000),
    )
    assert motion.samples == 1 + 5


def test_the_seed_decides_the_rocking(scenario: Make) -> None:
    one, same, other = (run(scenario(ROCK, seed=s)).dtheta_b for s in (1, 1, 2))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 1e-5


def test_dither_stays_in_phase_for_days() -> None:
    interval = 86_400_000
    # 391 Hz: 391 cycles a thousand samples, so a whole number after a day, and 0.391 one sample later
    cycles = split_cycles(391.0, 1e-3)
    # the frequency itself is rounded to 1e-16 of 34 million cycles
    assert (cycles_at(cycles, interval) + 0.5) % 1.0 == pytest.approx(0.5, abs=1e-8)
    step = cycles_at(cycles, interval + 1) - cycles_at(cycles, interval)
    assert step % 1.0 == pytest.approx(0.391, abs=1e-14)
