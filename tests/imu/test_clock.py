"""The clock model against units whose true clock is known, received through bad timers and busy hosts."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from imudrv.imu.clock import SLEW, STALL_EDGES_S, ClockModel
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.envelope import MAX_SKEW
from imudrv.profiles import load
from imudrv.records import INCREMENTS, PULSES, Flag, Records, Timebase

TAU = 1_000_000
BEGIN = 1_700_000_000_000_000_000
MS = 1_000_000
S = 1000 * MS
LOCK = 10_000
"""Samples before the lock: 10 s."""

Times = NDArray[np.int64]


def samples(count: int, first: int = 1) -> Records:
    pulses = np.zeros(count, PULSES)
    pulses["counter"] = first + np.arange(count)
    pulses["elapsed_ns"] = pulses["counter"] * TAU
    pulses["interval_ns"] = TAU
    return pulses


def truth(pulses: Records, skew_ppm: float) -> Times:
    elapsed = pulses["elapsed_ns"]
    return BEGIN + elapsed + np.rint(elapsed * skew_ppm * 1e-6).astype(np.int64)


def received(true: Times, rng: np.random.Generator, jitter_ns: float = 100e3) -> Records:
    """Samples that arrive each on its own, late by an exponential delay."""
    pulses = samples(len(true))
    late = rng.exponential(jitter_ns, len(true)).astype(np.int64)
    pulses["arrival_ns"] = np.maximum.accumulate(true + late)
    return pulses


def through_a_latency_timer(true: Times, rng: np.random.Generator) -> Times:
    """An FTDI adapter: all of 16 ms arrive together, 50 us or so after the tick."""
    period = 16 * MS
    phase = int(rng.integers(period))
    tick = -((phase - (true - BEGIN)) // period)
    late = rng.exponential(50e3, int(np.ptp(tick)) + 1).astype(np.int64)
    return BEGIN + phase + tick * period + late[tick - tick[0]]


def past_stalls(arrival: Times, rng: np.random.Generator, each_s: float = 4.0) -> Times:
    """Hold up what comes while the host stalls for 30 to 130 ms."""
    held = arrival.copy()
    at = int(arrival[0])
    while at < arrival[-1]:
        at += int(rng.exponential(each_s) * S)
        end = at + int(rng.uniform(30, 130) * MS)
        a, b = np.searchsorted(arrival, [at, end])
        held[a:b] = np.maximum(held[a:b], end)
    return np.maximum.accumulate(held)


def stamped(clock: ClockModel, pulses: Records) -> tuple[Times, NDArray[np.bool_]]:
    stamps = clock.feed(pulses)
    return stamps["t_ns"], stamps["locked"]


def slopes(stamps: Times) -> NDArray[np.float64]:
    """Of the stamps of unbroken samples, less one."""
    return np.diff(stamps) / TAU - 1.0


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("skew_ppm", [30.0, -30.0])
def test_stamps_stay_within_0_3_ms_behind_a_latency_timer_and_a_host_that_stalls(
    skew_ppm: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    pulses = samples(300_000)
    true = truth(pulses, skew_ppm)
    pulses["arrival_ns"] = past_stalls(through_a_latency_timer(true, rng), rng)
    clock = ClockModel(TAU)
    stamps, locked = stamped(clock, pulses)
    assert np.flatnonzero(locked)[0] == LOCK
    assert locked[LOCK:].all()
    error = stamps - true
    # The newest sample of a burst is up to 1 ms old, and how old drifts with the skew, 33 s for the whole of
    # it: before the window has seen that, the line is off by an even spread of 1 ms, 0.29 ms std.
    assert error[LOCK:].std() < 0.3 * MS
    # Later the window of 90 s has two newest samples of no age in it; what is left is the timer's own
    # lateness, of whose 16 in 0.25 s the least counts: 3 us, times a few for the line through the extremes.
    assert error[120_000:].std() < 0.02 * MS
    assert abs(error[120_000:].mean()) < 0.03 * MS
    # The two lie at least 33 s apart; each is found to a bin of 0.25 s, in which age drifts by 7.5 us.
    assert clock.report.skew_ppm == pytest.approx(skew_ppm, abs=2 * 7.5 / 33)
    slope = slopes(stamps[LOCK:])
    # 1 ns of rounding is 1e-6 of the interval; 60 ppm is what the line may be wrong by while it is young.
    assert np.abs(slope - skew_ppm * 1e-6).max() <= SLEW + 60e-6 + 1e-6


def test_pure_jitter_leaves_a_microsecond() -> None:
    rng = np.random.default_rng(1)
    true = truth(samples(120_000), 30.0)
    clock = ClockModel(TAU)
    stamps, locked = stamped(clock, received(true, rng))
    assert locked[LOCK:].all()
    # The least of 250 delays of 100 us is 0.4 us.
    assert np.abs(stamps - true)[LOCK:].max() < 2_000
    # 0.4 us over the half of the window, 45 s: 0.01 ppm.
    assert clock.report.skew_ppm == pytest.approx(30.0, abs=0.03)
    assert clock.report.floor_s == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("skew_ppm", [-100.0, 0.0, 100.0])
def test_on_a_perfect_line_stamps_and_skew_are_exact(skew_ppm: float) -> None:
    pulses = samples(30_000)
    pulses["arrival_ns"] = truth(pulses, skew_ppm)
    clock = ClockModel(TAU)
    stamps, _ = stamped(clock, pulses)
    # Slewed from the plain offset to the line at the lock; afterwards rounding alone.
    assert np.abs(stamps - pulses["arrival_ns"])[LOCK:].max() <= 1
    assert clock.report.skew_ppm == pytest.approx(skew_ppm, abs=1e-3)  # 1 ns in a second
    assert clock.report.worst_s <= 2e-9


def test_a_skew_that_no_clock_has_is_not_locked() -> None:
    pulses = samples(30_000)
    pulses["arrival_ns"] = truth(pulses, 1.2e6 * MAX_SKEW)
    clock = ClockModel(TAU)
    _, locked = stamped(clock, pulses)
    assert not locked.any()
    assert clock.report.skew_ppm is None
    assert clock.report.floor_s is None
    assert sum(clock.report.stalls) == 0


def test_the_time_on_the_wire_is_subtracted() -> None:
    pulses = samples(15_000)
    pulses["arrival_ns"] = truth(pulses, 0.0) + 477_000
    clock = ClockModel(TAU, transmission_ns=477_000)
    stamps, _ = stamped(clock, pulses)
    np.testing.assert_array_equal(stamps, truth(pulses, 0.0))
    assert clock.report.floor_s == pytest.approx(477e-6)


def test_before_the_lock_stamps_follow_the_least_delay() -> None:
    pulses = samples(1000)
    true = truth(pulses, 0.0)
    pulses["arrival_ns"] = np.maximum(true, BEGIN + 101 * MS)  # a backlog of 100 ms when the port was opened
    stamps, locked = stamped(ClockModel(TAU), pulses)
    assert not locked.any()
    # What is ahead advances by a hundredth of an interval: 1 ms while the backlog shrinks, gone 2 ms later.
    np.testing.assert_array_equal(stamps[103:], true[103:])
    assert np.diff(stamps).min() == TAU // 100


@pytest.mark.parametrize("old", [1, 100, 4_000, 60_000])
@pytest.mark.parametrize("gap_s", [0, 60, 3600])
def test_after_old_samples_from_a_buffer_the_stamps_are_soon_right(old: int, gap_s: int) -> None:
    pulses = samples(old + 15_000)
    pulses["counter"][old:] += 1000 * gap_s
    pulses["elapsed_ns"][old:] += gap_s * S
    pulses["arrival_ns"] = truth(pulses, 20.0)
    pulses["arrival_ns"][:old] = pulses["arrival_ns"][old]  # a serial server sends all that it kept at once
    stamps, locked = stamped(ClockModel(TAU), pulses)
    ahead = stamps - pulses["arrival_ns"]
    # The old ones cannot be right, but each must be later than the one before: by a hundredth of an interval.
    must = TAU // 100 * np.arange(len(pulses))
    assert (ahead[: old + 1] <= must[: old + 1]).all()
    assert np.diff(stamps).min() > 0
    # The host catches up 0.99 ms a sample. Until there is a line, 20 ppm are missed, 0.2 ms of 10 s.
    assert np.abs(ahead[old + old // 98 + 2 :]).max() < 0.21 * MS
    # Only what came after the buffer shows the clock: locked after 10 s of that, and the bin it began in.
    assert not locked[: old + LOCK - 250].any()
    assert locked[old + LOCK + 250 :].all()
    assert np.abs(ahead[-1000:]).max() < 2_000  # as with pure jitter


def test_a_better_fit_is_approached_slowly() -> None:
    pulses = samples(40_000)
    true = truth(pulses, 0.0)
    arrival = true + 2 * MS
    arrival[25_000:] -= 2 * MS  # a host that has become quick; nothing distinguishes that from a better line
    pulses["arrival_ns"] = arrival
    stamps, locked = stamped(ClockModel(TAU), pulses)
    assert locked[LOCK:].all()
    slope = slopes(stamps[LOCK:])
    assert slope.min() < -0.9 * SLEW
    assert slope.min() >= -SLEW - MAX_SKEW


@pytest.mark.parametrize("step_s", [0.006, 1.0, 3600.0])
def test_a_host_clock_that_steps_back_restarts_the_fit(step_s: float) -> None:
    pulses = samples(60_000)
    pulses["arrival_ns"] = truth(pulses, 0.0)
    pulses["arrival_ns"][30_000:] -= round(step_s * S)
    stamps, locked = stamped(ClockModel(TAU), pulses)
    assert locked[29_999]
    assert not locked[30_000:40_000].any()
    assert np.diff(stamps).min() == TAU // 100
    # The stamps wait for as long as the step; an hour is not over here.
    assert locked[40_001:].all() == (step_s < 30.0)
    if step_s < 30.0:
        np.testing.assert_array_equal(stamps[40_001:], pulses["arrival_ns"][40_001:])


def test_a_host_clock_that_steps_back_before_the_lock_delays_it_by_no_more_than_that() -> None:
    pulses = samples(30_000)
    pulses["arrival_ns"] = truth(pulses, 0.0)
    pulses["arrival_ns"][5_000:] -= 100 * MS
    stamps, locked = stamped(ClockModel(TAU), pulses)
    assert np.flatnonzero(locked)[0] == 5_000 + LOCK
    np.testing.assert_array_equal(stamps[5_200:], pulses["arrival_ns"][5_200:])


def test_a_host_clock_that_steps_forward_is_followed_after_ten_seconds() -> None:
    pulses = samples(60_000)
    pulses["arrival_ns"] = truth(pulses, 0.0)
    pulses["arrival_ns"][30_000:] += S
    stamps, locked = stamped(ClockModel(TAU), pulses)
    # Nothing distinguishes it from a stall before all of 40 bins were late.
    assert locked[LOCK:40_000].all()
    assert not locked[40_250:50_000].any()
    np.testing.assert_array_equal(stamps[40_250:], pulses["arrival_ns"][40_250:])
    assert locked[50_250:].all()


@pytest.mark.parametrize(
    ("slew", "seconds", "worst_ms"),
    [
        (0.083, 12, 872),  # a host that becomes fast looks like a stall, until all samples of 10 s were late
        (-0.083, 12, 6),  # one that becomes slow is noticed when arrivals are 5 ms early
        (500e-6, 200, 25),  # 20 ms late are allowed, in the worst bin of 10 s
    ],
)
def test_stamps_are_right_within_ten_seconds_after_ntp_has_slewed_the_host(
    slew: float, seconds: int, worst_ms: int
) -> None:
    begin, end = 60_000, 60_000 + 1000 * seconds
    true = truth(samples(end + 40_000), 20.0)
    true += np.rint(slew * TAU * np.clip(np.arange(len(true)) - begin, 0, end - begin)).astype(np.int64)
    stamps, locked = stamped(ClockModel(TAU), received(true, np.random.default_rng(9)))
    assert np.abs(stamps - true)[LOCK:].max() < worst_ms * MS
    assert np.abs(stamps - true)[end + LOCK :].max() < 0.25 * MS  # 20 ppm of 10 s without a line
    assert locked[end + 2 * LOCK :].all()
    assert np.abs(stamps - true)[end + 2 * LOCK + 1000 :].max() < 0.05 * MS


def test_a_restart_of_the_unit_restarts_the_fit() -> None:
    before, after = samples(20_000, first=500_000), samples(20_000)
    after["elapsed_ns"] += before["elapsed_ns"][-1]  # as the tracker counts on
    before["arrival_ns"] = BEGIN + TAU * np.arange(20_000)
    after["arrival_ns"] = before["arrival_ns"][-1] + 3 * S + TAU * np.arange(20_000)
    stamps, locked = stamped(ClockModel(TAU), np.concatenate([before, after]))
    assert locked[LOCK:20_000].all()
    assert not locked[20_000 : 20_000 + LOCK].any()
    np.testing.assert_array_equal(stamps[20_000:], after["arrival_ns"])
    assert locked[20_000 + LOCK :].all()


def test_a_jump_of_the_counter_without_elapsed_time_restarts_the_fit() -> None:
    pulses = samples(20_000)
    pulses["arrival_ns"] = truth(pulses, 0.0)
    pulses["counter"][15_000:] += 7  # without elapsed time
    _, locked = stamped(ClockModel(TAU), pulses)
    assert locked[14_999]
    assert not locked[15_000:].any()


def test_a_repeated_sample_restarts_the_fit_and_stamps_still_increase() -> None:
    pulses = samples(12_000)
    pulses["arrival_ns"] = truth(pulses, 0.0)
    stamps, locked = stamped(ClockModel(TAU), np.insert(pulses, 11_000, pulses[11_000]))
    assert locked[LOCK:11_001].all()
    assert not locked[11_001:].any()
    assert np.diff(stamps).min() > 0


def test_a_host_clock_that_was_suspended_during_a_gap_restarts_the_fit() -> None:
    pulses = samples(60_000)
    pulses["arrival_ns"] = truth(pulses, 0.0)
    pulses = np.concatenate([pulses[:20_000], pulses[40_000:]])
    pulses["arrival_ns"][20_000:] -= 15 * S  # of 20 s that the unit counted the host knows 5
    stamps, locked = stamped(ClockModel(TAU), pulses)
    assert locked[LOCK:20_000].all()
    assert not locked[20_000:30_000].any()
    # The gap is longer than what the stamps would be ahead after it, so none of them is.
    assert locked[30_001:].all()
    np.testing.assert_array_equal(stamps, pulses["arrival_ns"])


def test_a_gap_that_the_counter_knows_keeps_the_lock() -> None:
    pulses = samples(70_000)
    pulses["arrival_ns"] = truth(pulses, 50.0)
    pulses = np.concatenate([pulses[:20_000], pulses[50_000:]])
    stamps, locked = stamped(ClockModel(TAU), pulses)
    assert locked[LOCK:].all()
    assert np.abs(stamps - pulses["arrival_ns"])[LOCK:].max() <= 1


def test_a_gap_longer_than_the_window_restarts_the_fit() -> None:
    pulses = samples(140_000)
    pulses["arrival_ns"] = truth(pulses, 50.0)
    pulses = np.concatenate([pulses[:20_000], pulses[120_000:]])
    stamps, locked = stamped(ClockModel(TAU), pulses)
    assert locked[19_999]
    assert not locked[20_000:30_000].any()
    assert locked[30_001:].all()
    assert np.diff(stamps).min() > 0


def test_the_lock_is_given_up_when_too_little_of_the_window_is_left() -> None:
    pulses = samples(120_000)
    pulses["arrival_ns"] = truth(pulses, 0.0)
    pulses = np.concatenate([pulses[:12_000], pulses[95_000:]])  # 83 s gone: of 12 s of data 5 s are left
    stamps, locked = stamped(ClockModel(TAU), pulses)
    assert locked[11_999]
    assert not locked[12_000:22_000].any()
    np.testing.assert_array_equal(stamps, pulses["arrival_ns"])


def test_delays_are_counted_in_the_bucket_they_belong_to() -> None:
    pulses = samples(20_000)
    pulses["arrival_ns"] = truth(pulses, 0.0)
    delays_ms = [0.5, 1.5, 1.6, 3, 7, 15, 30, 31, 32, 70, 150, 300, 700]
    for k, delay in enumerate(delays_ms):
        pulses["arrival_ns"][12_000 + 500 * k] += round(delay * MS)
    clock = ClockModel(TAU)
    # Arrivals keep their order: what comes after a late one waits with it.
    arrival = np.maximum.accumulate(pulses["arrival_ns"])
    pulses["arrival_ns"] = arrival
    _, locked = stamped(clock, pulses)
    report = clock.report
    assert locked[LOCK:].all()
    assert sum(report.stalls) == locked.sum()
    delay_s = (arrival - truth(pulses, 0.0))[LOCK:] / S
    expected = np.bincount(np.digitize(delay_s, STALL_EDGES_S), minlength=len(STALL_EDGES_S) + 1)
    assert expected.min() > 0
    assert list(report.stalls) == expected.tolist()
    assert report.worst_s == pytest.approx(0.7)


def stream(seed: int) -> Records:
    """40 s at 100 Hz with all that goes wrong: few samples, so that many examples can be tried."""
    rng = np.random.default_rng(seed)
    pulses = samples(4_000)
    pulses["elapsed_ns"] *= 10
    pulses["arrival_ns"] = past_stalls(through_a_latency_timer(truth(pulses, 80.0), rng), rng, 1.0)
    pulses["counter"][3_000:] -= 2_500
    keep = rng.random(len(pulses)) < 0.98
    return pulses[keep]


@given(seed=st.integers(0, 3), cuts=st.lists(st.integers(0, 4_000), max_size=30))
@settings(deadline=None, max_examples=50)
def test_any_pieces_give_the_same_bits(seed: int, cuts: list[int]) -> None:
    pulses = stream(seed)
    whole = ClockModel(10 * TAU)
    stamps, locked = stamped(whole, pulses)
    assert 0 < locked.sum() < len(locked)
    clock = ClockModel(10 * TAU)
    edges = [0, *sorted(min(c, len(pulses)) for c in cuts), len(pulses)]
    pieces = [stamped(clock, pulses[a:b]) for a, b in pairwise(edges)]
    np.testing.assert_array_equal(np.concatenate([p[0] for p in pieces]), stamps)
    np.testing.assert_array_equal(np.concatenate([p[1] for p in pieces]), locked)
    assert clock.report == whole.report


def test_one_by_one_gives_the_same_bits() -> None:
    pulses = stream(7)
    stamps, _ = stamped(ClockModel(10 * TAU), pulses)
    clock = ClockModel(10 * TAU)
    assert [int(clock.feed(pulses[k : k + 1])["t_ns"][0]) for k in range(len(pulses))] == stamps.tolist()


@given(
    steps=st.lists(st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(-70, 20_000)), max_size=40),
    lead=st.integers(0, 1200),
)
@settings(deadline=None, max_examples=300)
def test_stamps_increase_strictly_whatever_arrives(steps: list[tuple[int, int]], lead: int) -> None:
    pulses = samples(lead + len(steps))
    pulses["elapsed_ns"] *= 10
    pulses["arrival_ns"] = truth(pulses, 0.0)
    for k, (arrival, ahead) in enumerate(steps, start=lead):
        pulses["arrival_ns"][k] = arrival
        pulses["counter"][k:] += ahead
        if ahead > 0:
            pulses["elapsed_ns"][k:] += 10 * TAU * ahead
    stamps, _ = stamped(ClockModel(10 * TAU), pulses)
    assert np.all(np.diff(stamps) > 0)


@given(delays_ms=st.lists(st.floats(0, 400), min_size=1, max_size=60))
@settings(deadline=None, max_examples=100)
def test_locked_stamps_keep_to_the_slew_whatever_the_delays(delays_ms: list[float]) -> None:
    pulses = samples(3_000)
    pulses["elapsed_ns"] *= 10
    true = truth(pulses, 0.0)
    late = np.rint(np.interp(np.arange(3_000), np.linspace(0, 3_000, len(delays_ms)), delays_ms) * MS)
    pulses["arrival_ns"] = np.maximum.accumulate(true + late.astype(np.int64))
    stamps, locked = stamped(ClockModel(10 * TAU), pulses)
    both = locked[1:] & locked[:-1]
    slope = np.diff(stamps) / (10 * TAU) - 1.0
    assert np.all(np.abs(slope[both]) <= MAX_SKEW + SLEW + 1e-7)  # rounding: 1 ns in 10 ms


def test_ten_hours_need_no_more_memory_than_a_minute_and_stay_locked() -> None:
    clock = ClockModel(TAU)
    rng = np.random.default_rng(2)
    chunk = 100_000
    late = rng.exponential(100e3, chunk).astype(np.int64)
    sizes = []
    for k in range(360):
        pulses = samples(chunk, first=1 + k * chunk)
        pulses["arrival_ns"] = np.maximum.accumulate(truth(pulses, 12.0) + late)
        stamps, locked = stamped(clock, pulses)
        sizes.append(sum(a.nbytes for a in vars(clock).values() if isinstance(a, np.ndarray)))
        assert locked[0] == (k > 0)
    assert np.abs(stamps - truth(pulses, 12.0)).max() < 2_000
    assert max(sizes[10:]) == max(sizes[:10])
    assert clock.report.skew_ppm == pytest.approx(12.0, abs=0.03)


def on_the_arrivals_scale(count: int, seed: int) -> Records:
    return received(truth(samples(count), 20.0), np.random.default_rng(seed))


@pytest.mark.parametrize("offset_ns", [3600 * S, -3600 * S, 12 * MS])
def test_stamps_step_with_the_host_s_clock_at_once_and_the_lock_is_kept(offset_ns: int) -> None:
    pulses = on_the_arrivals_scale(40_000, 5)
    steady, _ = stamped(ClockModel(TAU), pulses)
    clock = ClockModel(TAU)
    before = clock.feed(pulses[:25_000]).copy()
    clock.follow(Timebase(offset_ns))
    after = clock.feed(pulses[25_000:])
    np.testing.assert_array_equal(before["t_ns"], steady[:25_000])
    np.testing.assert_array_equal(after["t_ns"], steady[25_000:] + offset_ns)
    assert after["locked"].all()
    assert np.flatnonzero(after["stepped"]).tolist() == [0]
    assert not before["stepped"].any()
    assert clock.report.steps == 1


def test_a_timebase_from_before_the_first_sample_is_no_step() -> None:
    pulses = on_the_arrivals_scale(100, 7)
    steady, _ = stamped(ClockModel(TAU), pulses)
    clock = ClockModel(TAU)
    clock.follow(Timebase(5 * S, 3 * S))
    stamps = clock.feed(pulses)
    np.testing.assert_array_equal(stamps["t_ns"], steady + 5 * S)
    assert not stamps["stepped"].any()
    assert clock.report.steps == 0


@pytest.mark.parametrize("error_ns", [-400 * MS, -3 * MS, 0, 15 * MS, 400 * MS])
def test_after_a_suspend_a_new_line_begins_whatever_the_hardware_clock_was_wrong_by(error_ns: int) -> None:
    pulses = on_the_arrivals_scale(60_000, 8)
    pulses = np.concatenate([pulses[:20_000], pulses[32_000:]])  # the unit ran on for 12 s
    pulses["arrival_ns"][20_000:] += error_ns
    clock = ClockModel(TAU)
    before = clock.feed(pulses[:20_000])
    clock.follow(Timebase(0, 12 * S + error_ns))
    stamps = np.concatenate([before, clock.feed(pulses[20_000:])])
    assert np.flatnonzero(stamps["stepped"]).tolist() == [20_000]
    assert stamps["locked"][LOCK:20_000].all()
    assert not stamps["locked"][20_000:30_000].any()
    # The new line is level at first: 20 ppm of 10 s, and delays of 0.1 ms that a quarter of a second levels.
    late = pulses["arrival_ns"] - stamps["t_ns"]
    assert np.abs(late[20_250:30_000] - late[19_000:20_000].mean()).max() < 5 * MS
    error = stamps["t_ns"] - error_ns - truth(samples(60_000), 20.0)[32_000 - 20_000 :]
    assert np.abs(error[20_250:30_000]).max() < 0.25 * MS
    assert stamps["locked"][30_000:].all()
    assert np.abs(error[31_500:]).max() < 2_000  # after slewing 0.2 ms at 200 ppm: 1 s


COEFFICIENTS = Coefficients(
    gyro_scale=np.full(3, 1e-6),
    gyro_bias=np.zeros(3),
    C_bg=np.eye(3),
    accelerometer_scale=np.full(3, 2000.0),
    accelerometer_bias=np.zeros(3),
    C_ba=np.eye(3),
    r_b=np.full((3, 3), 0.01),
)


@given(cuts=st.lists(st.integers(0, 11_000), max_size=20))
@settings(deadline=None, max_examples=25)
def test_delayed_increments_get_the_stamps_of_their_samples(cuts: list[int]) -> None:
    layout = load("imu50-rs422").layout()
    true = truth(samples(11_000), 20.0)
    pulses = received(true, np.random.default_rng(3))
    pulses = np.delete(pulses, [5_000, 5_001, 7_000])
    pulses["flags"][5_000] = Flag.MISSING_BEFORE
    stamps, locked = stamped(ClockModel(TAU), pulses)
    clock = ClockModel(TAU)
    compensator = Compensator(COEFFICIENTS, layout, "dither")
    edges = [0, *sorted(min(c, len(pulses)) for c in cuts), len(pulses)]
    out = []
    for a, b in pairwise(edges):
        clock.feed(pulses[a:b])
        out.append(clock.stamp(compensator.feed(pulses[a:b])))
    out.append(clock.stamp(compensator.close()))
    increments = np.concatenate(out)
    np.testing.assert_array_equal(increments["counter"], pulses["counter"])
    np.testing.assert_array_equal(increments["t_ns"], stamps)
    np.testing.assert_array_equal((increments["flags"] & Flag.CLOCK_UNLOCKED) == 0, locked)


def test_samples_that_never_came_out_are_passed_over() -> None:
    pulses = received(truth(samples(100), 0.0), np.random.default_rng(4))
    clock = ClockModel(TAU)
    stamps, _ = stamped(clock, pulses)
    increments = np.zeros(2, INCREMENTS)
    increments["t_ns"] = pulses["elapsed_ns"][[40, 99]]
    assert clock.stamp(increments)["t_ns"].tolist() == stamps[[40, 99]].tolist()


def test_the_flag_of_a_step_moves_to_the_next_sample_that_comes_out() -> None:
    pulses = on_the_arrivals_scale(100, 4)
    clock = ClockModel(TAU)
    clock.feed(pulses[:50])
    clock.follow(Timebase(S))
    clock.feed(pulses[50:])
    increments = np.zeros(3, INCREMENTS)
    increments["t_ns"] = pulses["elapsed_ns"][[40, 60, 61]]
    stamped = clock.stamp(increments)
    assert (stamped["flags"] & Flag.CLOCK_STEPPED != 0).tolist() == [False, True, False]


def test_an_increment_that_no_sample_belongs_to_is_refused() -> None:
    clock = ClockModel(TAU)
    clock.feed(received(truth(samples(10), 0.0), np.random.default_rng(4)))
    increments = np.zeros(1, INCREMENTS)
    increments["t_ns"] = 11 * TAU
    with pytest.raises(ValueError, match="increments of the samples fed"):
        clock.stamp(increments)
