import os
import subprocess
import sys
from math import cos, pi, radians, sin, sqrt
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from size_effect import size_effect_increment

from imudrv.errors import InputError
from imudrv.nav.attitude import conjugate, product, quaternion_of_matrix, quaternion_of_vector, rotation, turn
from imudrv.nav.earth import EARTH_RATE, ECCENTRICITY_SQUARED, SEMI_MAJOR_AXIS, earth_rate_n, normal_gravity
from imudrv.nav.mechanisation import MEASUREMENT, NAVIGATION, Navigator, Place, body_step
from imudrv.records import INCREMENTS, Records
from imudrv.site import Site
from imudrv.units import MM, NS, UG, URAD

Array = NDArray[np.float64]

LATITUDE, LONGITUDE, HEIGHT = radians(28.2), radians(113.0), 60.0
SITE = Place(LATITUDE, LONGITUDE, HEIGHT)
GRAVITY = normal_gravity(LATITUDE, HEIGHT)
OMEGA_IE = np.array(earth_rate_n(LATITUDE))
TAU_NS = 1_000_000
Z_UP = np.eye(3)
X_UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
Y_UP = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
C_BA = np.eye(3) + 1e-3 * np.array([[0.0, 2.0, -1.0], [-0.6, 0.0, 0.4], [-0.7, 0.3, 0.0]])
R = np.array([[23.0, -11.0, -9.0], [-23.0, 29.0, -7.0], [-1.0, -18.0, 16.0]]) * MM


def records(dtheta_b: Array, dv_b: Array, interval_ns: ArrayLike = TAU_NS) -> Records:
    out = np.zeros(len(dtheta_b), INCREMENTS)
    out["counter"] = np.arange(len(out))
    out["interval_ns"] = interval_ns
    out["t_ns"] = np.cumsum(out["interval_ns"])
    out["dtheta_b"], out["dv_b"] = dtheta_b, dv_b
    return out


class Run(NamedTuple):
    """Exact integrals of a body that rests, turns about a fixed axis through its origin, and rests."""

    C_nb: Array
    increments: Records


def turning(
    C_nb: Array,
    angle: float,
    axis_n: ArrayLike = (0.0, 0.0, 1.0),
    *,
    rest_s: float = 0.5,
    turn_s: float = 2.5,
    r_b: Array | None = None,
    dG: Array | None = None,
    bias_b: ArrayLike = (0.0, 0.0, 0.0),
    tau_ns: int = TAU_NS,
) -> Run:
    """A turn with a quintic angle. With `r_b` the accelerometers sit there, on axes `C_BA`."""
    tau = tau_ns * NS
    x, w = np.polynomial.legendre.leggauss(4)
    before = np.arange(round((2 * rest_s + turn_s) / tau)) * tau
    t = (before[:, None] + 0.5 * tau * (1.0 + x)).ravel()
    u = np.clip((t - rest_s) / turn_s, 0.0, 1.0)
    unit = np.asarray(axis_n) / np.linalg.norm(axis_n)
    theta = angle * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    rate = np.outer(angle / turn_s * 30.0 * u * u * (1.0 - u) ** 2, unit)
    acceleration = np.outer(angle / turn_s**2 * 60.0 * u * (1.0 - u) * (1.0 - 2.0 * u), unit)
    C_bn = (Rotation.from_rotvec(np.outer(theta, unit)) * Rotation.from_matrix(C_nb)).inv()
    omega = C_bn.apply(rate + OMEGA_IE)
    omega_dot = C_bn.apply(acceleration - np.cross(rate, OMEGA_IE))
    f = C_bn.apply([0.0, 0.0, GRAVITY])
    if r_b is not None:
        felt = [f + np.cross(omega_dot, r) + np.cross(omega, np.cross(omega, r)) for r in r_b]
        f = np.stack([point @ a for point, a in zip(felt, np.linalg.inv(C_BA), strict=True)], axis=1) @ C_BA.T

    def integral(y: Array) -> Array:
        return 0.5 * tau * np.einsum("j,njk->nk", w, y.reshape(-1, 4, 3))

    dtheta = integral(omega)
    if dG is not None:
        dtheta = dtheta + dtheta @ dG.T
    return Run(C_nb, records(dtheta, integral(f) + np.asarray(bias_b) * tau, tau_ns))


def navigated(run: Run, C_nb: Array | None = None, **options: Any) -> Records:
    q_nb = quaternion_of_matrix(run.C_nb if C_nb is None else C_nb)
    return Navigator(SITE, q_nb, **options).feed(run.increments)


def at_rest(n: int, C_nb: Array, tau_ns: int) -> Records:
    tau = tau_ns * NS
    return records(
        np.tile(C_nb.T @ OMEGA_IE * tau, (n, 1)), np.tile(C_nb.T @ [0.0, 0.0, GRAVITY * tau], (n, 1)), tau_ns
    )


# --- navigation ---


@pytest.mark.parametrize("C_nb", [Z_UP, rotation((1.0, 2.0, 3.0), 0.7)])
def test_an_hour_at_rest_stays_at_rest(C_nb: Array) -> None:
    rows = Navigator(SITE, quaternion_of_matrix(C_nb), every=1000).feed(at_rest(360_000, C_nb, 10_000_000))
    # Left out is g zeta^2, at 10 ms up to 5e-12 m/s^2. The vertical channel is unstable: an hour makes of it
    # sinh(k t) / k = 1.5e5 s times as much velocity, and cosh(k t) / k^2 = 9e7 s^2 times height, k^2 = 2 g /
    # R.
    np.testing.assert_allclose(rows["v_n"], 0.0, atol=8e-7)
    np.testing.assert_allclose(rows["height_m"], HEIGHT, atol=5e-4)
    np.testing.assert_allclose(rows["latitude_rad"], LATITUDE, atol=1e-12)  # 6 um
    np.testing.assert_allclose(rows["longitude_rad"], LONGITUDE, atol=1e-12)


def test_an_error_of_velocity_swings_with_schulers_period() -> None:
    tau_ns = 100_000_000
    rows = Navigator(SITE, (1.0, 0.0, 0.0, 0.0), (0.0, 0.1, 0.0), every=10).feed(
        at_rest(60_000, Z_UP, tau_ns)
    )
    speed = rows["v_n"][:, 1]
    k = int(np.flatnonzero(speed < 0.0)[0])
    quarter = (
        (rows["t_ns"][k - 1] * speed[k] - rows["t_ns"][k] * speed[k - 1]) / (speed[k] - speed[k - 1]) * NS
    )
    period = 2.0 * pi * sqrt(6.36e6 / GRAVITY)  # 84.4 min; the meridian's radius at this latitude is 6.35e6 m
    # the Earth's rotation turns the swing: (EARTH_RATE / Schuler's rate)^2 = 0.35 %
    assert 4.0 * quarter == pytest.approx(period, rel=5e-3)
    assert period == pytest.approx(84.4 * 60.0, rel=2e-3)


def place_e(latitude: Array, longitude: Array, height: Array) -> Array:
    """Earth-fixed coordinates, from the definition of the ellipsoid."""
    N = SEMI_MAJOR_AXIS / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    across = (N + height) * np.cos(latitude)
    return np.stack(
        [
            across * np.cos(longitude),
            across * np.sin(longitude),
            (N * (1.0 - ECCENTRICITY_SQUARED) + height) * np.sin(latitude),
        ],
        axis=-1,
    )


def axes_en(latitude: Array, longitude: Array) -> Array:
    """C_en: its columns are east, north and up in Earth-fixed axes."""
    s, c, S, C = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    zero = np.zeros_like(s)
    east, north = np.stack([-S, C, zero], -1), np.stack([-s * C, -s * S, c], -1)
    return np.stack([east, north, np.stack([c * C, c * S, s], -1)], axis=-1)


@pytest.mark.parametrize(("north_m", "east_m"), [(0.0, 60e3), (60e3, 0.0), (-40e3, 50e3)])
def test_a_flight_along_a_great_circle_and_back_closes(north_m: float, east_m: float) -> None:
    # The truth knows nothing of local level equations: the way in Earth-fixed coordinates, twice
    # differentiated.
    tau_ns, leg_s = 50_000_000, 600.0
    tau = tau_ns * NS

    def way(t: Array) -> tuple[Array, Array, Array]:
        u = np.clip(t / leg_s, 0.0, 2.0)
        u = 1.0 - np.abs(1.0 - u)
        s = u**5 * (
            126.0 + u * (-420.0 + u * (540.0 + u * (-315.0 + 70.0 * u)))
        )  # four derivatives zero at both ends
        start = axes_en(np.array(LATITUDE), np.array(LONGITUDE))
        arc = np.hypot(north_m, east_m) / 6.371e6
        ahead = (start[:, 0] * east_m + start[:, 1] * north_m) / np.hypot(north_m, east_m)
        on_sphere = np.outer(np.cos(arc * s), start[:, 2]) + np.outer(np.sin(arc * s), ahead)
        return np.arcsin(on_sphere[:, 2]), np.arctan2(on_sphere[:, 1], on_sphere[:, 0]), HEIGHT + 500.0 * s

    def force_n(t: Array) -> Array:
        h = 1.0  # rounding 3e-9 m/s^2, left out h^4 times the sixth derivative, under 1e-9 m/s^2
        p = {k: place_e(*way(t + k * h)) for k in (-2, -1, 0, 1, 2)}
        velocity = (8.0 * (p[1] - p[-1]) - (p[2] - p[-2])) / (12.0 * h)
        acceleration = (16.0 * (p[1] + p[-1]) - (p[2] + p[-2]) - 30.0 * p[0]) / (12.0 * h * h)
        omega_e = np.array([0.0, 0.0, EARTH_RATE])
        latitude, longitude, height = way(t)
        gravity = np.array(
            [normal_gravity(a, b) for a, b in zip(latitude.tolist(), height.tolist(), strict=True)]
        )
        C_en = axes_en(latitude, longitude)
        f_e = acceleration + 2.0 * np.cross(omega_e, velocity) + gravity[:, None] * C_en[:, :, 2]
        return np.einsum("nij,ni->nj", C_en, f_e)

    ends = np.arange(round(2.0 * leg_s / tau) + 1) * tau
    latitude, longitude, _ = way(ends)
    C_in = Rotation.from_rotvec(np.outer(EARTH_RATE * ends, [0.0, 0.0, 1.0])) * Rotation.from_matrix(
        axes_en(latitude, longitude)
    )
    C_nb = Rotation.from_matrix(rotation((1.0, 2.0, 3.0), 0.7))
    # the body keeps its attitude to n, which turns at most 2e-4 rad/s: force and rate are all but
    # constant
    dtheta = ((C_in[:-1] * C_nb).inv() * (C_in[1:] * C_nb)).as_rotvec()
    x, w = np.polynomial.legendre.leggauss(2)
    dv = sum(
        0.5 * tau * wk * force_n(ends[:-1] + 0.5 * tau * (1.0 + xk)) for xk, wk in zip(x, w, strict=True)
    )
    run = records(dtheta, C_nb.inv().apply(dv), tau_ns)
    rows = Navigator(SITE, quaternion_of_matrix(C_nb.as_matrix())).feed(run)

    apart = place_e(rows["latitude_rad"], rows["longitude_rad"], rows["height_m"]) - place_e(*way(ends[1:]))
    # The Earth's rate is that of an interval's beginning, so T / 2 = 25 ms late: at 250 m/s 7e-11 rad/s,
    # which the way back makes good; until then 4e-8 rad, 4e-7 m/s^2, and 0.1 m in ten minutes (in the unit's
    # 1 ms 2 mm).
    assert np.abs(apart).max() < 0.1
    assert np.abs(rows["v_n"][-1]).max() < 5e-4
    assert np.hypot(*(rows["v_n"][:, :2].T)).max() > 150.0  # it did fly


def test_measured_gravity_is_an_offset_that_keeps_the_fall_with_height() -> None:
    measured = GRAVITY + 5e-4
    up = records(np.tile(OMEGA_IE * 1e-3, (1000, 1)), np.tile([0.0, 0.0, measured * 1e-3], (1000, 1)))
    still = Navigator(SITE._replace(gravity_m_s2=measured), (1, 0, 0, 0)).feed(up)
    np.testing.assert_allclose(still["v_n"], 0.0, atol=1e-10)  # rounding
    for speed in (100.0, 1.0):
        high = Navigator(SITE._replace(gravity_m_s2=measured), (1, 0, 0, 0), (0.0, 0.0, speed)).feed(up)
        # rising for a second, gravity falls by 3.086e-6 / s^2 times the height: 1.5e-4 m/s in all at 100 m/s;
        # computed a centimetre after the other it lags by half a centimetre, of 0.5 m on the average
        expected = 3.086e-6 * speed / 2.0
        assert high["v_n"][-1, 2] - speed == pytest.approx(expected, rel=0.01 + 0.005 / (0.5 * speed))


@pytest.mark.parametrize("x", [0.02, 0.1, 0.4])
def test_coning_is_removed_but_for_the_known_fourth_order_rest(x: float) -> None:
    # A cone of half-angle a at rate w: q = (cos a/2, sin a/2 cos wt, sin a/2 sin wt, 0); its increments in
    # closed form.
    a, w = 1e-3, 2.0 * pi * 50.0
    T = x / w
    t = np.arange(2001) * T
    rate = np.stack([sin(a) * np.cos(w * t), sin(a) * np.sin(w * t), -2.0 * sin(a / 2) ** 2 * w * t], axis=1)
    dtheta = np.diff(rate, axis=0)
    q = (cos(a / 2), sin(a / 2), 0.0, 0.0)
    before = np.array([sin(a) * cos(-x), sin(a) * sin(-x), 2.0 * sin(a / 2) ** 2 * x])
    last = tuple((rate[0] - before).tolist())
    for angle in map(tuple, dtheta.tolist()):
        phi, _ = body_step(T, angle, (0.0, 0.0, 0.0), T, last, (0.0, 0.0, 0.0))
        q, last = product(q, quaternion_of_vector(phi)), angle
    truth = (cos(a / 2), sin(a / 2) * cos(w * t[-1]), sin(a / 2) * sin(w * t[-1]), 0.0)
    drift = 2.0 * product(conjugate(truth), q)[3] / t[-1]
    # exact a^2 (x - sin x) / 2 an interval, the algorithm a^2 (1 - cos x) sin x / 6: the rest is a^2 w x^4 /
    # 60, to a relative x^2 / 4; rounding leaves 1e-13 rad in t
    assert drift == pytest.approx(-a * a * w * x**4 / 60.0, rel=0.02 + x * x / 4, abs=2e-13 / t[-1])


@pytest.mark.parametrize("samples_a_swing", [16, 60])
def test_sculling_is_removed_but_for_the_known_fourth_order_rest(samples_a_swing: int) -> None:
    # The angle A sin wt about X and the force F sin wt along Y: on the average A F / 2 along Z.
    A, F, w = 1e-4, 1.0, 2.0 * pi * 50.0
    x = 2.0 * pi / samples_a_swing
    T = x / w
    n = 40 * samples_a_swing
    t = np.arange(-1, n + 1) * T
    dtheta, dv = np.diff(A * np.sin(w * t)), np.diff(-F / w * np.cos(w * t))
    q = (1.0, 0.0, 0.0, 0.0)
    total = 0.0
    for k in range(1, n + 1):
        now, last = (float(dtheta[k]), 0.0, 0.0), (float(dtheta[k - 1]), 0.0, 0.0)
        phi, gained = body_step(T, now, (0.0, float(dv[k]), 0.0), T, last, (0.0, float(dv[k - 1]), 0.0))
        total += turn(q, gained)[2]
        q = product(q, quaternion_of_vector(phi))
    # as of the coning, x^4 / 30 of A F / 2 is left, to a relative x^2 / 4; A^2 / 8 = 1e-9 is that of a sine
    # for its angle
    left = total / (n * T) / (0.5 * A * F) - 1.0
    assert left == pytest.approx(-(x**4) / 30.0, rel=0.02 + x * x / 4.0, abs=5e-9)


def test_a_fast_turn_with_gravity_across_the_axis_leaves_nothing() -> None:
    # What is left is of third order in the angle of an interval: (4.7e-3)^3 g / 24 for 2.5 s, a quarter of it
    # at a time.
    run = turning(rotation((1.0, 0.3, 0.2), 0.4), pi, (1.0, 0.2, 0.1), turn_s=2.5)
    rows = navigated(run)
    np.testing.assert_allclose(rows["v_n"], 0.0, atol=1e-7)
    turned = rotation((1.0, 0.2, 0.1), pi) @ run.C_nb
    np.testing.assert_allclose(np.abs(rows["q_nb"][-1] @ quaternion_of_matrix(turned)), 1.0, atol=1e-13)


def test_intervals_may_differ() -> None:
    run = turning(X_UP, pi, (0.1, 0.0, 1.0)).increments
    cuts = np.cumsum(np.random.default_rng(3).integers(1, 5, len(run)))
    cuts = np.concatenate([[0], cuts[cuts < len(run)]])
    long = np.zeros(len(cuts), INCREMENTS)
    for name in ("interval_ns", "dtheta_b", "dv_b"):
        long[name] = np.add.reduceat(run[name], cuts, axis=0)
    long["t_ns"] = np.cumsum(long["interval_ns"])
    rows = Navigator(SITE, quaternion_of_matrix(X_UP), C_ba=C_BA).feed(long)
    fine = Navigator(SITE, quaternion_of_matrix(X_UP), C_ba=C_BA).feed(run)
    # 4 ms at 2.4 rad/s turn 0.01 rad; third order in it, 1e-6 g / 24, for a second
    np.testing.assert_allclose(rows["v_n"][-1], fine["v_n"][-1], atol=2e-6)
    # the rule for rates leaves 16 ms^3 of the third derivative, the mid attitude (0.01 rad)^2 / 24 of 7 m/s a
    # metre
    np.testing.assert_allclose(rows["H"][-1], fine["H"][-1], atol=1e-4)
    np.testing.assert_allclose(rows["Q"][-1], fine["Q"][-1], atol=1e-4)


# --- one code for live and offline ---


def noisy(n: int) -> Records:
    rng = np.random.default_rng(11)
    rows = records(rng.normal(0.0, 2e-3, (n, 3)), rng.normal(0.0, 1e-2, (n, 3)))
    rows["interval_ns"] = (
        rng.choice([1, 1, 1, 2, 40], n) * TAU_NS
    )  # 40 ms turn far enough for the exact branches
    rows["dtheta_b"] *= (rows["interval_ns"] / TAU_NS)[:, None]
    rows["flags"] = rng.integers(0, 4, n)
    return rows


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 400), max_size=8), st.sampled_from([1, 3, 50]), st.booleans())
def test_any_chunks_give_the_same_bits(cuts: list[int], every: int, matrices: bool) -> None:
    increments = noisy(400)
    options: dict[str, Any] = {"every": every, "C_ba": C_BA if matrices else None}
    q = np.array([0.5, 0.5, 0.5, 0.5])
    whole = Navigator(SITE, q, **options)
    expected = whole.feed(increments)
    parts = Navigator(SITE, q, **options)
    got = np.concatenate([parts.feed(chunk) for chunk in np.split(increments, sorted(cuts))])
    assert got.tobytes() == expected.tobytes()
    assert parts.latest.tobytes() == whole.latest.tobytes()
    assert len(expected) == 400 // every
    if every == 1:
        assert expected["v_n"][-1].tobytes() == whole.latest["v_n"].tobytes()


def test_one_by_one_is_the_batch() -> None:
    increments = noisy(200)
    one, batch = (Navigator(SITE, (1, 0, 0, 0), C_ba=C_BA) for _ in range(2))
    live = np.concatenate([one.feed(increments[k : k + 1]) for k in range(200)])
    assert live.tobytes() == batch.feed(increments).tobytes()


def test_the_interpreter_gives_the_same_bits() -> None:
    program = (
        "import sys, numpy as np\n"
        "from imudrv.nav.mechanisation import Navigator, Place\n"
        "from imudrv.records import INCREMENTS\n"
        "rows = np.frombuffer(sys.stdin.buffer.read(), INCREMENTS)\n"
        "out = Navigator(Place(0.5, 1.9, 60.0), (1, 0, 0, 0), C_ba=np.eye(3) + 1e-3).feed(rows)\n"
        "sys.stdout.buffer.write(out.tobytes())\n"
    )
    increments = noisy(60)
    plain = subprocess.run(
        [sys.executable, "-c", program],
        input=increments.tobytes(),
        stdout=subprocess.PIPE,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        check=True,
    )
    compiled = Navigator(Place(0.5, 1.9, 60.0), (1, 0, 0, 0), C_ba=np.eye(3) + 1e-3).feed(increments)
    assert plain.stdout == compiled.tobytes()


def test_rows_bear_the_samples_they_belong_to() -> None:
    increments = noisy(10)
    rows = Navigator(SITE, (1, 0, 0, 0), every=4).feed(increments)
    assert rows.dtype == NAVIGATION
    assert rows["counter"].tolist() == [3, 7]
    assert rows["t_ns"].tolist() == increments["t_ns"][[3, 7]].tolist()
    assert rows["flags"].tolist() == increments["flags"][[3, 7]].tolist()
    assert Navigator(SITE, (1, 0, 0, 0), C_ba=C_BA).feed(increments).dtype == MEASUREMENT


@pytest.mark.parametrize("gravity", [None, 9.795])
def test_navigation_from_a_site_starts_at_rest_at_its_place(gravity: float | None) -> None:
    site = Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0, gravity_m_s2=gravity)
    q = np.array([0.5, 0.5, 0.5, 0.5])
    options: dict[str, Any] = {"C_ba": C_BA, "every": 7}
    by_site = Navigator(site.place, q, **options)
    by_hand = Navigator(Place(site.latitude_rad, site.longitude_rad, 60.0, gravity), q, **options)
    assert not by_site.latest["v_n"].any()
    assert by_site.feed(noisy(50)).tobytes() == by_hand.feed(noisy(50)).tobytes()


@pytest.mark.parametrize(
    ("site", "q", "options", "message"),
    [
        (SITE, (1.0, 0.0, 0.0), {}, r"expected attitude q_nb as finite numbers of shape \(4,\)"),
        (SITE, (2.0, 0.0, 0.0, 0.0), {}, "expected q_nb of length 1 within 1e-6, got 2; normalise it"),
        (SITE, (np.nan, 0.0, 0.0, 0.0), {}, "finite"),
        (Place(1.55, 0.0, 0.0), (1, 0, 0, 0), {}, "expected a latitude of at most 1.5 rad, got 1.55"),
        (SITE, (1, 0, 0, 0), {"every": 0}, "expected a row every 1 or more samples, got 0"),
        (SITE, (1, 0, 0, 0), {"C_ba": np.eye(2)}, "expected C_ba"),
    ],
)
def test_an_invalid_start_is_refused(site: Any, q: Any, options: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Navigator(site, q, **options)


# --- the measurement matrices ---

RUNS = {
    "z": turning(rotation((1, 1, 0), 3e-3) @ Z_UP, pi),
    "x": turning(X_UP, pi, (0.003, 0.0, 1.0)),
    "y": turning(Y_UP, pi),
    "slanted": turning(rotation((1.0, 2.0, 3.0), 0.7), -pi, (0.3, -0.2, 1.0)),
}


@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("component", range(9))
def test_H_is_what_each_component_of_R_does_to_velocity(name: str, component: int) -> None:
    axis_n = {"x": (0.003, 0.0, 1.0), "slanted": (0.3, -0.2, 1.0)}.get(name, (0.0, 0.0, 1.0))
    run = RUNS[name]
    r = np.zeros(9)
    r[component] = 0.1
    off = turning(run.C_nb, -pi if name == "slanted" else pi, axis_n, r_b=r.reshape(3, 3))
    rows = navigated(run, C_ba=C_BA)
    found = (navigated(off)["v_n"] - rows["v_n"]) / 0.1
    # Of up to 4 m/s a metre. H leaves out gravity at the place in error (5 m of it * 1.5e-6 / s^2 * 1.5 s =
    # 1.1e-5), the attitude in the middle of an interval does 1e-6 ((2.4e-3 rad)^2 / 24 of 4 m/s).
    np.testing.assert_allclose(rows["H"][:, :, component], found, atol=1.4e-5)


def test_three_turns_show_six_of_nine() -> None:
    H = np.vstack([navigated(RUNS[name], C_ba=C_BA)["H"][-1] for name in "zxy"])
    s = np.linalg.svd(H, compute_uv=False)
    assert s[5] > 1.0  # m/s a metre: 8.8 / T for the horizontal components
    assert s[6] < 1e-4 * s[5]


def test_a_common_shift_of_the_sensing_points_leaves_no_velocity_at_rest() -> None:
    for name in "zxy":
        rows = navigated(RUNS[name], C_ba=C_BA)
        shifted = rows["H"][-1].reshape(3, 3, 3).sum(axis=1)
        # 8.8 / 2.5 m/s a metre each by itself. Left is the rest of the rule for the attitude, as above.
        np.testing.assert_allclose(shifted, 0.0, atol=1e-5)
        assert (
            np.abs(rows["H"][1750].reshape(3, 3, 3).sum(axis=1)).max() > 1.0
        )  # on the way it is a true velocity


def test_H_is_the_sum_of_the_readable_formula() -> None:
    run = RUNS["slanted"]
    rows = navigated(run, C_ba=C_BA)
    tau, dtheta = TAU_NS * NS, run.increments["dtheta_b"]
    rate0 = run.C_nb.T @ OMEGA_IE
    padded = np.vstack([rate0 * tau, rate0 * tau, dtheta])
    w1 = (11.0 * padded[2:] - 7.0 * padded[1:-1] + 2.0 * padded[:-2]) / (6.0 * tau)
    w0 = np.vstack([rate0, w1[:-1]])
    S = size_effect_increment(w0, w1, dtheta, np.full(len(dtheta), tau), C_BA)
    q = np.vstack([quaternion_of_matrix(run.C_nb), rows["q_nb"]])
    middle = Rotation.from_quat(np.roll(q[1:] + q[:-1], -1, axis=1)).as_matrix()
    H = np.zeros((3, 9))
    for step in middle @ S:
        H = H + step - 2.0 * tau * np.cross(OMEGA_IE, H, axisa=-1, axisb=0, axisc=0)
    np.testing.assert_allclose(rows["H"][-1], H, atol=1e-11)  # sums of 3500 terms of up to 7


def test_B_is_what_a_bias_of_the_accelerometers_does() -> None:
    run = RUNS["slanted"]
    bias = np.array([300.0, -200.0, 100.0]) * UG
    rows = navigated(run, C_ba=C_BA)
    biased = navigated(turning(run.C_nb, -pi, (0.3, -0.2, 1.0), bias_b=bias))
    # B leaves Coriolis' acceleration out: 1.5e-4 / s for 3.5 s, of 3.5 s
    np.testing.assert_allclose(
        rows["B"][-1] @ bias, biased["v_n"][-1] - rows["v_n"][-1], atol=5e-4 * 3.5 * 300.0 * UG
    )


@pytest.mark.parametrize("entry", range(9))
def test_P_and_Q_are_what_scale_and_misalignment_of_the_gyros_do(entry: int) -> None:
    run = RUNS["slanted"]
    vec = np.zeros(9)
    vec[entry] = 100.0 * URAD
    rows = navigated(run, C_ba=C_BA)
    wrong = navigated(turning(run.C_nb, -pi, (0.3, -0.2, 1.0), dG=vec.reshape(3, 3)))

    def attitude(r: Records) -> Rotation:
        return Rotation.from_quat(np.roll(r["q_nb"][-1], -1))

    phi = -(attitude(wrong) * attitude(rows).inv()).as_rotvec()  # C' = (I - [phi x]) C
    # second order, phi^2 = (3e-4)^2; the Earth's rotation in 3 s, 2e-4 of 3e-4
    np.testing.assert_allclose(phi, -rows["P"][-1] @ vec, atol=2e-7)
    f_n = np.array([0.0, 0.0, GRAVITY])
    # likewise, times g, over 2 s
    expected = np.cross(f_n, -rows["Q"][-1] @ vec)
    np.testing.assert_allclose((wrong["v_n"] - rows["v_n"])[-1], expected, atol=2e-7 * GRAVITY * 2.0)
    assert np.abs(rows["P"][-1] @ vec).max() > 5e-6  # seen at all


def test_a_tilt_at_the_start_drives_velocity_by_f_cross_phi() -> None:
    run = RUNS["z"]
    phi = np.array([50.0, -30.0, 80.0]) * URAD
    tilted = navigated(run, C_nb=rotation(phi, -float(np.linalg.norm(phi))) @ run.C_nb)
    t = run.increments["t_ns"][-1] * NS
    expected = np.cross([0.0, 0.0, GRAVITY], phi * t)
    # Earth's rotation turns phi by 7e-5 t, 1e-4 on the average
    np.testing.assert_allclose(tilted["v_n"][-1], expected, atol=3e-4 * GRAVITY * t * 100.0 * URAD)
