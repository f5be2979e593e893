"""Compensation against the formulas written plainly and motions with a known answer, in any pieces."""

import itertools
import os
import pickle
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from realtime import DEADLINE_S

from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients, TemperatureTerms
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import NAMES, RateFilter, RateFilterName, rate_filter
from imudrv.profiles import load
from imudrv.records import INCREMENTS, PULSES, Flag, Records
from imudrv.units import ARCSEC, DEG_PER_H, PPM, STANDARD_GRAVITY, UG

RS422 = load("imu50-rs422").layout()
TOTALS = load("imu50-rs422-acc").layout()
TAU_NS = RS422.interval_ns
TAU = 1e-3
FILTERS = {name: rate_filter(name, TAU_NS) for name in NAMES}

C_BA = np.array([[0.9995, 0.0021, -0.0013], [-0.0008, 1.0004, 0.0017], [0.0011, -0.0019, 1.0002]])
CALIBRATION = Coefficients(
    gyro_scale=np.array([0.45, 0.76, 0.85]) * ARCSEC,
    gyro_bias=np.array([20.0, -30.0, 10.0]) * DEG_PER_H,
    C_bg=C_BA.T,
    accelerometer_scale=np.array([2382.0, 1731.0, 1643.0]),
    accelerometer_bias=np.array([800.0, -1900.0, 400.0]) * UG,
    C_ba=C_BA,
    r_b=np.array([[0.024, -0.011, -0.009], [-0.023, 0.029, -0.007], [-0.001, -0.018, 0.016]]),
    temperature=TemperatureTerms(
        reference_degc=35.0,
        low_degc=10.0,
        high_degc=60.0,
        gyro_bias=np.array([1.0, -2.0, 3.0]) * DEG_PER_H,
        gyro_scale=np.array([20.0, -30.0, 40.0]) * PPM,
        accelerometer_bias=np.array([100.0, -200.0, 150.0]) * UG,
        accelerometer_scale=np.array([200.0, -300.0, 100.0]) * PPM,
    ),
)
# No more than scale: the formulas of the size effect are alone.
IDEAL = Coefficients(
    gyro_scale=np.full(3, 1e-12),
    gyro_bias=np.zeros(3),
    C_bg=np.eye(3),
    accelerometer_scale=np.full(3, 1e12),
    accelerometer_bias=np.zeros(3),
    C_ba=C_BA,
    r_b=CALIBRATION.r_b,
)


def some_pulses(n: int = 400) -> Records:
    """Fierce motion with gaps, bridged intervals short and long, and changing temperatures."""
    random = np.random.default_rng(21)
    steps = np.ones(n, np.int64)
    steps[[2, 60, 61, 200, 290]] = [2, 3, 2, 40, 5]
    pulses = np.zeros(n, PULSES)
    pulses["counter"] = np.cumsum(steps)
    pulses["interval_ns"] = TAU_NS * steps
    pulses["elapsed_ns"] = np.cumsum(pulses["interval_ns"])
    # 5 rad/s in all axes, so that the size effect is no small part of the velocity.
    t = 1e-9 * pulses["elapsed_ns"][:, None]
    rate = 5.0 * np.sin(2.0 * np.pi * np.array([3.0, 4.1, 2.7]) * t + [0.0, 1.0, 2.0])
    noise = random.integers(-3, 4, (n, 3))
    pulses["gyro"] = np.rint(rate * TAU * steps[:, None] / CALIBRATION.gyro_scale) + noise
    pulses["accelerometer"] = random.integers(-9, 10, (n, 3))
    pulses["temperature_degc"] = np.nan
    pulses["temperature_degc"][:, :4] = 35.0 + 0.01 * np.cumsum(random.integers(-40, 41, (n, 4)), axis=0)
    pulses["temperature_degc"][345:350, 1] = 9.0
    pulses["temperature_degc"][350:360, 0] = 61.0
    pulses["temperature_degc"][360:365, 2] = np.nan
    pulses["flags"] = np.where(steps > 1, Flag.VALID | Flag.LONG_INTERVAL, Flag.VALID)
    pulses["flags"][[150, 152, 155, 300]] = Flag.VALID | Flag.MISSING_BEFORE
    return pulses


PULSES_OF_ALL_KINDS = some_pulses()


def compensate(pulses: Records, c: Coefficients, f: RateFilterName, cuts: list[int] | None = None) -> Records:
    compensator = Compensator(c, RS422, f)
    edges = [0, *sorted(cuts or []), len(pulses)]
    pieces = [compensator.feed(pulses[a:b]) for a, b in itertools.pairwise(edges)]
    return np.concatenate([*pieces, compensator.close()])


def same_bits(a: Records, b: Records) -> bool:
    """Compare all but the padding, which no one writes."""
    return len(a) == len(b) and all(a[name].tobytes() == b[name].tobytes() for name in INCREMENTS.names or ())


def cross_matrix(w: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def plainly(pulses: Records, c: Coefficients, f: RateFilter) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Section 1 of the mathematics in matrices: dtheta_b, dv_b, and where the size effect is in."""
    n = len(pulses)
    steps = pulses["interval_ns"] // TAU_NS
    T = TAU * steps
    dtheta_b, felt_a = np.zeros((n, 3)), np.zeros((n, 3))
    for i, p in enumerate(pulses):
        k_g, b_g, K, b_a = c.gyro_scale, c.gyro_bias, c.accelerometer_scale, c.accelerometer_bias
        if c.temperature:
            warmer = np.nan_to_num(p["temperature_degc"][:4] - c.temperature.reference_degc)
            k_g = k_g * (1.0 + c.temperature.gyro_scale * warmer[0])
            b_g = b_g + c.temperature.gyro_bias * warmer[0]
            K = K * (1.0 + c.temperature.accelerometer_scale * warmer[1:])
            b_a = b_a + c.temperature.accelerometer_bias * warmer[1:]
        dtheta_b[i] = c.C_bg @ (k_g * p["gyro"]) - b_g * T[i]
        felt_a[i] = p["accelerometer"] / K - b_a * T[i]

    dv_r, compensated = np.zeros((n, 3)), np.zeros(n, bool)
    begins = [0, *np.flatnonzero(pulses["flags"] & Flag.MISSING_BEFORE), n]
    for begin, stop in itertools.pairwise(begins):
        k = steps[begin:stop]
        parts = np.repeat(dtheta_b[begin:stop] / k[:, None], k, axis=0)
        ends = np.concatenate([[0], np.cumsum(k)])
        rates = {}
        for end in ends:
            window = parts[max(0, end + f.lag - len(f.taps)) : end + f.lag]
            if len(window) == len(f.taps) <= end + f.lag <= len(parts):
                rates[end] = f.taps @ window / TAU
        for i, (e0, e1) in zip(range(begin, stop), itertools.pairwise(ends), strict=True):
            if c.r_b is not None and e0 in rates and e1 in rates:
                from_ends = f.middle_from_ends and T[i] == TAU
                middle = 0.5 * (rates[e0] + rates[e1]) if from_ends else dtheta_b[i] / T[i]
                w0, wm, w1 = (cross_matrix(w) for w in (rates[e0], middle, rates[e1]))
                integral = w1 - w0 + T[i] / 6.0 * (w0 @ w0 + 4.0 * wm @ wm + w1 @ w1)
                dv_r[i] = [a @ integral @ r for a, r in zip(np.linalg.inv(c.C_ba), c.r_b, strict=True)]
                compensated[i] = True
    return dtheta_b, (felt_a - dv_r) @ c.C_ba.T, compensated


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    "calibration",
    [CALIBRATION, replace(CALIBRATION, temperature=None), replace(CALIBRATION, r_b=None)],
    ids=["all", "no temperature", "no size effect"],
)
def test_it_equals_the_plain_formulas(name, calibration):
    out = compensate(PULSES_OF_ALL_KINDS, calibration, name)
    dtheta_b, dv_b, compensated = plainly(PULSES_OF_ALL_KINDS, calibration, FILTERS[name])
    # Rounding: some fifty operations of 1e-16 of the largest term.
    assert np.abs(out["dtheta_b"] - dtheta_b).max() < 1e-12 * np.abs(dtheta_b).max()
    assert np.abs(out["dv_b"] - dv_b).max() < 1e-12 * np.abs(dv_b).max()
    assert ((out["flags"] & Flag.SIZE_EFFECT) != 0).tolist() == compensated.tolist()
    # The longest filter has four whole runs in these pulses, the longest of 148 samples.
    assert compensated.sum() > 200 or calibration.r_b is None


def test_the_size_effect_is_no_small_part_of_these_pulses():
    with_it = compensate(PULSES_OF_ALL_KINDS, CALIBRATION, "causal")
    without = compensate(PULSES_OF_ALL_KINDS, replace(CALIBRATION, r_b=None), "causal")
    assert np.std(with_it["dv_b"] - without["dv_b"]) > 0.1 * np.std(without["dv_b"])


@pytest.mark.parametrize("name", NAMES)
@given(cuts=st.lists(st.integers(0, len(PULSES_OF_ALL_KINDS)), max_size=30))
def test_any_pieces_give_the_same_bits(name, cuts):
    whole = compensate(PULSES_OF_ALL_KINDS, CALIBRATION, name)
    assert same_bits(compensate(PULSES_OF_ALL_KINDS, CALIBRATION, name, cuts), whole)


@pytest.mark.parametrize("name", NAMES)
def test_one_by_one_gives_the_same_bits(name):
    one_by_one = list(range(len(PULSES_OF_ALL_KINDS)))
    whole = compensate(PULSES_OF_ALL_KINDS, CALIBRATION, name)
    assert same_bits(compensate(PULSES_OF_ALL_KINDS, CALIBRATION, name, one_by_one), whole)


INTERPRETED = """
import pickle, sys
from numba.core import config
from imudrv.imu.compensation import Compensator
assert config.DISABLE_JIT, "expected uncompiled kernels"

calibration, layout, filters, pulses = pickle.load(sys.stdin.buffer)
answers = []
for rate_filter in filters:
    compensator = Compensator(calibration, layout, rate_filter)
    answers.append([compensator.feed(pulses), compensator.close()])
pickle.dump(answers, sys.stdout.buffer)
"""


def test_without_the_compiler_the_bits_are_the_same():
    question = (CALIBRATION, RS422, NAMES, PULSES_OF_ALL_KINDS)
    run = subprocess.run(
        [sys.executable, "-c", INTERPRETED],
        input=pickle.dumps(question),
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        check=False,
        timeout=DEADLINE_S,
    )
    assert run.returncode == 0, run.stderr.decode()
    for pieces, name in zip(pickle.loads(run.stdout), NAMES, strict=True):
        assert same_bits(np.concatenate(pieces), compensate(PULSES_OF_ALL_KINDS, CALIBRATION, name))


def rocking_about_a_fixed_axis(seconds: float, hz: float, amplitude: float) -> tuple[Records, np.ndarray]:
    """Pulses as fine as 1e-12 of a unit that rocks about its origin without gravity; what is felt."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    W = 2.0 * np.pi * hz
    edges = TAU * np.arange(round(seconds / TAU) + 1)
    rate = amplitude * np.cos(W * edges)
    angle = amplitude / W * np.sin(W * edges)
    rate_squared = amplitude**2 / 2.0 * (edges + np.sin(2.0 * W * edges) / (2.0 * W))  # integral of rate^2
    centripetal = cross_matrix(axis) @ cross_matrix(axis)
    assert IDEAL.r_b is not None
    a_b = np.linalg.inv(IDEAL.C_ba)
    per_rate = np.array([a @ np.cross(axis, r) for a, r in zip(a_b, IDEAL.r_b, strict=True)])
    per_rate_squared = np.array([a @ centripetal @ r for a, r in zip(a_b, IDEAL.r_b, strict=True)])
    felt_a = np.diff(rate)[:, None] * per_rate + np.diff(rate_squared)[:, None] * per_rate_squared
    pulses = np.zeros(len(felt_a), PULSES)
    pulses["interval_ns"] = TAU_NS
    pulses["gyro"] = np.rint(np.diff(angle)[:, None] * axis / IDEAL.gyro_scale)
    pulses["accelerometer"] = np.rint(felt_a * IDEAL.accelerometer_scale)
    return pulses, felt_a


@pytest.mark.parametrize("name", NAMES)
def test_rocking_about_the_origin_leaves_no_velocity(name):
    # 5 degrees at 3 Hz; all that the accelerometers feel is size effect, more than 1e-4 m/s a sample.
    pulses, felt_a = rocking_about_a_fixed_axis(2.0, 3.0, np.radians(5.0) * 2.0 * np.pi * 3.0)
    out = compensate(pulses, IDEAL, name)
    is_in = (out["flags"] & Flag.SIZE_EFFECT) != 0
    assert is_in.sum() > 1950
    assert np.abs(felt_a).max() > 1e-4
    assert np.abs(out["dv_b"][is_in]).max() < 1e-7


def test_the_tangential_part_telescopes():
    # Turned the other way round the centripetal part is the same: half the difference is the tangential one.
    random = np.random.default_rng(22)
    pulses = np.zeros(5000, PULSES)
    pulses["interval_ns"] = TAU_NS
    pulses["gyro"] = random.integers(-(10**9), 10**9, (5000, 3))  # noise of 1 rad/s
    opposite = pulses.copy()
    opposite["gyro"] *= -1
    one_way, other_way = (compensate(p, IDEAL, "causal")["dv_b"][3:] for p in (pulses, opposite))
    tangential_b = (other_way - one_way).sum(axis=0) / 2.0
    dtheta = 1e-12 * pulses["gyro"]
    begin, end = (FILTERS["causal"].taps @ dtheta[i - 2 : i + 1] / TAU for i in (2, 4999))
    assert IDEAL.r_b is not None
    per_accelerometer = [
        a @ np.cross(end - begin, r) for a, r in zip(np.linalg.inv(IDEAL.C_ba), IDEAL.r_b, strict=True)
    ]
    # Rounding: 5000 samples of about 1e-1 m/s, each to 1e-16.
    assert np.abs(tangential_b - IDEAL.C_ba @ per_accelerometer).max() < 1e-12


@pytest.mark.parametrize("name", NAMES)
def test_the_output_is_late_by_the_lag_and_the_end_brings_the_rest(name):
    compensator = Compensator(replace(CALIBRATION, temperature=None), RS422, name)
    lag = compensator.lag
    assert lag == FILTERS[name].lag
    out = compensator.feed(PULSES_OF_ALL_KINDS[155:185])
    rest = compensator.close()
    assert (len(out), len(rest)) == (30 - lag, lag)
    assert np.concatenate([out, rest])["counter"].tolist() == PULSES_OF_ALL_KINDS["counter"][155:185].tolist()
    assert not np.any(rest["flags"] & Flag.SIZE_EFFECT)


def test_without_sensing_points_nothing_waits():
    compensator = Compensator(replace(CALIBRATION, r_b=None), RS422, "dither")
    assert compensator.lag == 0
    out = compensator.feed(PULSES_OF_ALL_KINDS[:5])
    assert len(out) == 5
    assert not np.any(out["flags"] & Flag.SIZE_EFFECT)


def test_counter_time_and_flags_are_passed_through():
    pulses = PULSES_OF_ALL_KINDS.copy()
    pulses["flags"][[10, 11]] = Flag.FAULT | Flag.SATURATED | Flag.WARM_UP
    out = compensate(pulses, replace(CALIBRATION, temperature=None), "centred")
    assert out["counter"].tolist() == pulses["counter"].tolist()
    assert out["t_ns"].tolist() == pulses["elapsed_ns"].tolist()
    assert out["interval_ns"].tolist() == pulses["interval_ns"].tolist()
    assert (out["flags"] & ~np.uint32(Flag.SIZE_EFFECT)).tolist() == pulses["flags"].tolist()


def test_a_temperature_outside_the_calibrated_range_or_unknown_is_flagged():
    out = compensate(PULSES_OF_ALL_KINDS, CALIBRATION, "causal")
    flagged = np.flatnonzero(out["flags"] & Flag.TEMPERATURE_RANGE)
    assert flagged.tolist() == list(range(345, 365))  # too cold, too warm, not known


def test_a_profile_without_the_temperature_of_an_accelerometer_is_out_of_range():
    few = replace(RS422, temperature_names=("gyro",))
    out = Compensator(CALIBRATION, few, "causal").feed(PULSES_OF_ALL_KINDS[:5])
    assert np.all(out["flags"] & Flag.TEMPERATURE_RANGE)


def test_one_temperature_of_all_accelerometers_serves_each():
    pulses = PULSES_OF_ALL_KINDS.copy()
    pulses["temperature_degc"][:, 2:4] = pulses["temperature_degc"][:, 1:2]
    each = Compensator(CALIBRATION, RS422, "causal").feed(pulses)
    pulses["temperature_degc"][:, 2] = -273.0  # of the electronics: counts for nothing
    mean = Compensator(CALIBRATION, TOTALS, "causal").feed(pulses)
    assert same_bits(each, mean)


# Quadratic term, asymmetry and skew of the accelerometers

TERMS = {
    "quadratic": np.array([15.0, -40.0, 25.0]) * UG / STANDARD_GRAVITY**2,
    "asymmetry": np.array([-30.0, 20.0, 50.0]) * PPM,
}
PLAIN = replace(CALIBRATION, r_b=None, temperature=None)


def velocities(pulses: Records, c: Coefficients) -> np.ndarray:
    """Velocities on the sensing axes by the contract: N/K - b T - k2 f^2 T - |f| T / 2, then the skew."""
    T = 1e-9 * pulses["interval_ns"][:, None]
    e = pulses["accelerometer"] / c.accelerometer_scale - c.accelerometer_bias * T
    f = e / T
    e = e - c.quadratic * f**2 * T - 0.5 * c.asymmetry * np.abs(f) * T
    f = e / T
    out = e.copy()
    for i in range(1, len(pulses)):
        if not pulses["flags"][i] & Flag.MISSING_BEFORE:
            out[i if c.skew_s > 0 else i - 1] -= c.skew_s * (f[i] - f[i - 1])
    return out


@pytest.mark.parametrize(("skew_s", "name"), [(3e-4, "causal"), (3e-4, "dither"), (-4e-4, "centred")])
def test_the_terms_are_those_of_the_contract(skew_s, name):
    c = replace(PLAIN, **TERMS, skew_s=skew_s)
    expected = velocities(PULSES_OF_ALL_KINDS, c) @ c.C_ba.T
    got = compensate(PULSES_OF_ALL_KINDS, c, name)
    assert got["counter"].tolist() == PULSES_OF_ALL_KINDS["counter"].tolist()
    # Velocities of a pulse, 6e-4 m/s, rounded a few times.
    assert np.abs(got["dv_b"] - expected).max() < 1e-17
    assert np.abs(expected - velocities(PULSES_OF_ALL_KINDS, PLAIN) @ c.C_ba.T).max() > 1e-5


@pytest.mark.parametrize("skew_s", [2e-4, -2e-4])
@pytest.mark.parametrize("name", list(FILTERS))
@pytest.mark.parametrize("with_arms", [True, False])
def test_any_pieces_give_the_same_bits_with_all_terms(skew_s, name, with_arms):
    c = replace(CALIBRATION, **TERMS, skew_s=skew_s, r_b=CALIBRATION.r_b if with_arms else None)
    whole = compensate(PULSES_OF_ALL_KINDS, c, name)
    cuts = [1, 2, 3, 59, 60, 61, 62, 150, 151, 152, 153, 299, 300, 301]
    assert same_bits(compensate(PULSES_OF_ALL_KINDS, c, name, cuts), whole)
    assert same_bits(compensate(PULSES_OF_ALL_KINDS, c, name, list(range(1, 400))), whole)


@pytest.mark.parametrize("skew_s", [2e-4, -2e-4])
def test_the_size_effect_is_that_without_a_skew(skew_s):
    # It comes from the gyros: the skew moves what the accelerometers sense, and nothing else.
    skewed = replace(CALIBRATION, skew_s=skew_s)
    with_arms, bare = (
        compensate(PULSES_OF_ALL_KINDS, c, "centred") for c in (skewed, replace(skewed, r_b=None))
    )
    plain, plain_bare = (
        compensate(PULSES_OF_ALL_KINDS, c, "centred") for c in (CALIBRATION, replace(CALIBRATION, r_b=None))
    )
    difference = (with_arms["dv_b"] - bare["dv_b"]) - (plain["dv_b"] - plain_bare["dv_b"])
    assert np.abs(difference).max() < 1e-16  # rounding


@pytest.mark.parametrize("skew_s", [7e-4, -7e-4])
def test_the_part_of_the_skew_telescopes(skew_s):
    pulses = PULSES_OF_ALL_KINDS[:150]
    c = replace(PLAIN, skew_s=skew_s)
    skewed, plain = (compensate(pulses, one, "centred")["dv_b"].sum(axis=0) for one in (c, PLAIN))
    T = 1e-9 * pulses["interval_ns"][[0, -1], None]
    ends = pulses["accelerometer"][[0, -1]] / c.accelerometer_scale / T
    # 150 roundings of 1e-3 m/s
    assert np.abs(skewed - plain + c.C_ba @ (skew_s * (ends[1] - ends[0]))).max() < 1e-16


@pytest.mark.parametrize("skew_s", [1.5e-4, 6e-4, -6e-4])
def test_a_turn_in_gravity_loses_its_skew(skew_s):
    # Accelerometers that sample a turn of 3 rad/s late by the skew: what is left is of second order in it.
    n, tau = 2000, 1e-9 * TAU_NS
    t = tau * np.arange(n + 1)

    def sensed(late: float) -> np.ndarray:
        angle = 3.0 * (t + late)
        integral = STANDARD_GRAVITY / 3.0 * np.stack([-np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        return np.diff(np.rint(1e9 * integral), axis=0)

    pulses = np.zeros(n, PULSES)
    pulses["counter"], pulses["interval_ns"] = np.arange(n), TAU_NS
    fine = replace(PLAIN, accelerometer_scale=np.full(3, 1e9), accelerometer_bias=np.zeros(3), C_ba=np.eye(3))
    pulses["accelerometer"] = sensed(0.0)
    true = compensate(pulses, fine, "centred")["dv_b"]
    pulses["accelerometer"] = sensed(skew_s)
    left = compensate(pulses, replace(fine, skew_s=skew_s), "centred")["dv_b"] - true
    wrong = compensate(pulses, fine, "centred")["dv_b"] - true
    # f'' = 9 g; linear interpolation between intervals leaves |s| (tau - |s|) / 2 f'' tau, 1.1e-8 m/s
    assert np.abs(left[1:-1]).max() < 1.3e-8
    assert np.abs(wrong[1:-1]).max() > 400 * abs(skew_s) * 1e-8


def test_a_filter_without_lag_leaves_out_a_negative_skew_and_says_so():
    c = replace(CALIBRATION, skew_s=-3e-4)
    causal, centred = Compensator(c, RS422, "causal"), Compensator(c, RS422, "centred")
    assert (causal.leaves_out_skew, centred.leaves_out_skew) == (True, False)
    assert not Compensator(replace(c, skew_s=3e-4), RS422, "causal").leaves_out_skew
    assert same_bits(causal.feed(PULSES_OF_ALL_KINDS), compensate(PULSES_OF_ALL_KINDS, CALIBRATION, "causal"))


def test_a_negative_skew_without_arms_comes_one_sample_later():
    compensator = Compensator(replace(PLAIN, skew_s=-3e-4), RS422, "centred")
    assert compensator.lag == 1
    counts = [len(compensator.feed(PULSES_OF_ALL_KINDS[a:b])) for a, b in itertools.pairwise((0, 1, 5, 5, 9))]
    assert counts == [0, 4, 0, 4]
    assert len(compensator.close()) == 1


def test_a_skew_longer_than_an_interval_is_refused():
    words = r"skew_ms: expected at most a sample interval of .*, 1 ms, got 1\.2 ms"
    with pytest.raises(InputError, match=words):
        Compensator(replace(CALIBRATION, skew_s=1.2e-3), RS422)
