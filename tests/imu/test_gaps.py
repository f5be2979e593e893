"""Gaps by counters, time stamps and times of arrival: each found, flagged, and of the right length."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from imudrv.imu.arrivals import KEPT
from imudrv.imu.sequence import SampleCounts, SequenceTracker
from imudrv.profiles import load
from imudrv.records import FRAME, Flag, Records
from imudrv.wire.layout import Layout, Sensor, SequenceKind, Values
from imudrv.wire.layout import Sequence as Numbering

RS422 = load("imu50-rs422").layout()
MS = 1_000_000
START = 1_700_000_000 * 1000 * MS
"""Any time but 0, which means that it is not known."""
SILENCES = range(1, 1001)

Timing = Callable[[np.ndarray, int], np.ndarray]


def layout(
    kind: SequenceKind, bits: int = 64, step: Fraction | int = 1, rate: Fraction | int = 1000
) -> Layout:
    return replace(RS422, sequence=Numbering(kind, bits, Fraction(step)), interval=Fraction(10**9) / rate)


def one_a_read(n: np.ndarray, interval_ns: int) -> np.ndarray:
    return START + n * interval_ns


def in_bursts(n: np.ndarray, interval_ns: int) -> np.ndarray:
    """A USB converter hands on what it has every 16 ms."""
    return -(-one_a_read(n, interval_ns) // (16 * MS)) * 16 * MS


def with_jitter(n: np.ndarray, interval_ns: int) -> np.ndarray:
    late = np.random.default_rng(4).exponential(0.3 * MS, n.size).astype(np.int64)
    return np.maximum.accumulate(one_a_read(n, interval_ns) + late)


def stalled(n: np.ndarray, interval_ns: int) -> np.ndarray:
    """The reader pauses for 250 ms from sample 100 on, and then has everything at once."""
    times = one_a_read(n, interval_ns)
    begin = times[0] + 100 * interval_ns
    return np.where((times >= begin) & (times < begin + 250 * MS), begin + 250 * MS, times)


TIMINGS = {"one a read": one_a_read, "USB": in_bursts, "jitter": with_jitter, "stall": stalled}


def frames(numbers: Sequence[int] | np.ndarray, times: np.ndarray | int, unit: Layout) -> Records:
    rows = np.zeros(len(numbers), FRAME)
    ticks = [round(int(n) * unit.sequence.step) % (1 << unit.sequence.bits) for n in numbers]
    if unit.sequence.kind is not SequenceKind.NONE:
        rows["counter"] = np.array(ticks, np.uint64).view(np.int64)
    rows["t_ns"] = times
    return rows


def tracked(unit: Layout, rows: Records) -> tuple[Records, SampleCounts]:
    """Samples and counts of frames that come read by read."""
    tracker = SequenceTracker(unit)
    edges = np.flatnonzero(np.diff(rows["t_ns"])) + 1
    out = np.concatenate([tracker.feed(read) for read in np.split(rows, edges)])
    assert tracker.counts.closes
    return out, tracker.counts


def with_silence(silence: int, before: int = 150, after: int = 450) -> np.ndarray:
    return np.array([*range(before), *range(before + silence, before + silence + after)])


def flagged(samples: Records, flag: Flag) -> list[int]:
    return np.flatnonzero(samples["flags"] & flag).tolist()


@pytest.mark.parametrize("timing", TIMINGS.values(), ids=TIMINGS)
def test_each_silence_of_a_unit_with_a_counter_of_8_bits_is_found_with_its_length(timing: Timing) -> None:
    unit = layout(SequenceKind.COUNTER, 8)
    for silence in SILENCES:
        numbers = with_silence(silence)
        samples, counts = tracked(unit, frames(numbers, timing(numbers, MS), unit))
        assert (silence, counts.missing, counts.good) == (silence, silence, len(numbers))
        # After a pause of the reader, up to 32 reads do not show whether a whole round is missing as well.
        if timing is stalled:
            assert 1 <= len(flagged(samples, Flag.MISSING_BEFORE)) <= 2
        else:
            assert flagged(samples, Flag.MISSING_BEFORE) == [150]
        assert flagged(samples, Flag.GAP_BY_HOST_TIME) == flagged(samples, Flag.MISSING_BEFORE)
        assert samples["counter"][-1] - samples["counter"][0] == numbers[-1]
        assert samples["elapsed_ns"][-1] == (numbers[-1] + 1) * MS
        assert set(samples["interval_ns"].tolist()) == {MS}


@pytest.mark.parametrize("timing", TIMINGS.values(), ids=TIMINGS)
@pytest.mark.parametrize(("bits", "rate"), [(8, 1000), (7, 400), (4, 50)])
def test_without_a_loss_there_is_no_gap(bits: int, rate: int, timing: Timing) -> None:
    unit = layout(SequenceKind.COUNTER, bits, rate=rate)
    numbers = np.arange(3000)
    samples, counts = tracked(unit, frames(numbers, timing(numbers, unit.interval_ns), unit))
    assert (counts.good, counts.lost, counts.duplicate) == (3000, 0, 0)
    assert set(samples["flags"].tolist()) == {int(Flag.VALID)}
    assert np.array_equal(samples["counter"], numbers)


@pytest.mark.parametrize(("bits", "rate"), [(7, 400), (4, 50)])
def test_silences_of_narrower_counters_are_found(bits: int, rate: int) -> None:
    unit = layout(SequenceKind.COUNTER, bits, rate=rate)
    for silence in (*range(1, 40), 100, 126, 127, 128, 129, 300):
        numbers = with_silence(silence)
        _, counts = tracked(unit, frames(numbers, in_bursts(numbers, unit.interval_ns), unit))
        assert (silence, counts.missing, counts.good) == (silence, silence, len(numbers))


def test_a_capture_without_times_flags_each_gap_as_of_unknown_length_and_drops_nothing() -> None:
    unit = layout(SequenceKind.COUNTER, 8)
    for silence in SILENCES:
        numbers = with_silence(silence)
        samples, counts = tracked(unit, frames(numbers, 0, unit))
        is_visible = silence % 256 != 0
        assert (silence, counts.good) == (silence, len(numbers))
        assert (silence, counts.missing, counts.unknown_gaps) == (silence, silence % 256, is_visible)
        assert flagged(samples, Flag.GAP_LENGTH_UNKNOWN) == [150] * is_visible
        assert flagged(samples, Flag.MISSING_BEFORE) == [150] * is_visible
        assert flagged(samples, Flag.GAP_BY_HOST_TIME) == []


NUMBERINGS = {
    "us, 5 ms": layout(SequenceKind.TIME, 32, 5000, 200),
    "float64 seconds": layout(SequenceKind.TIME, 64, 10_000_000, 100),
    "ms, 2.5 ms": layout(SequenceKind.TIME, 32, Fraction(5, 2), 400),
    "us, 819.2 Hz": layout(SequenceKind.TIME, 32, Fraction(10**6 * 5, 4096), Fraction(4096, 5)),
    "counter of 64 bits": layout(SequenceKind.COUNTER, 64),
    "counter of 32 bits, step 10": layout(SequenceKind.COUNTER, 32, 10),
}


@pytest.mark.parametrize("has_times", [False, True])
@pytest.mark.parametrize("unit", NUMBERINGS.values(), ids=NUMBERINGS)
def test_a_wide_number_tells_its_gaps_alone_across_its_wrap(unit: Layout, has_times: bool) -> None:
    span = int((1 << min(unit.sequence.bits, 62)) / unit.sequence.step)
    for silence in (1, 2, 5, 63, 500):
        numbers = span - 300 + with_silence(silence)
        times = one_a_read(numbers - numbers[0], unit.interval_ns) if has_times else 0
        samples, counts = tracked(unit, frames(numbers, times, unit))
        assert (counts.missing, counts.good, counts.duplicate, counts.restarts) == (silence, 600, 0, 0)
        assert flagged(samples, Flag.MISSING_BEFORE) == [150]
        assert not flagged(samples, Flag.GAP_BY_HOST_TIME | Flag.GAP_LENGTH_UNKNOWN)
        assert samples["elapsed_ns"][-1] == int((600 + silence) * unit.interval)


def test_a_narrow_counter_with_a_step_goes_across_its_wrap() -> None:
    unit = layout(SequenceKind.COUNTER, 8, 10, 100)
    for silence in (0, 1, 5, 12, 20, 24, 30, 200):
        numbers = with_silence(silence)
        samples, counts = tracked(unit, frames(numbers, one_a_read(numbers, unit.interval_ns), unit))
        assert (silence, counts.missing, counts.good) == (silence, silence, 600)
        assert np.array_equal(np.diff(samples["counter"]), 10 * np.diff(numbers))


@pytest.mark.parametrize("bits", [8, 16])
def test_a_time_stamp_that_soon_begins_anew_drops_nothing(bits: int) -> None:
    # 16 bits of microseconds at 200 Hz begin anew after 13 samples.
    unit = layout(SequenceKind.TIME, bits, 5000 if bits == 16 else 5, 200)
    for silence in (0, 1, 6, 7, 12, 13, 14, 51, 200):
        numbers = with_silence(silence)
        _, counts = tracked(unit, frames(numbers, one_a_read(numbers, unit.interval_ns), unit))
        assert (silence, counts.missing, counts.good) == (silence, silence, 600)
        _, counts = tracked(unit, frames(numbers, 0, unit))
        assert (silence, counts.good) == (silence, 600)


@pytest.mark.parametrize("timing", TIMINGS.values(), ids=TIMINGS)
def test_without_a_number_jitter_is_no_gap(timing: Timing) -> None:
    unit = layout(SequenceKind.NONE, rate=250)
    numbers = np.arange(5001)  # the last one ends a burst
    samples, counts = tracked(unit, frames(numbers, timing(numbers, unit.interval_ns), unit))
    assert (counts.good, counts.lost) == (5001, 0)
    assert set(samples["flags"].tolist()) == {int(Flag.VALID)}
    assert np.array_equal(samples["counter"], numbers)


@pytest.mark.parametrize("timing", [one_a_read, with_jitter])
def test_without_a_number_a_gap_is_found_from_host_time(timing: Timing) -> None:
    unit = layout(SequenceKind.NONE, rate=250)
    for silence in (*range(1, 20), 50, 300, 1000):
        numbers = with_silence(silence)
        samples, counts = tracked(unit, frames(numbers, timing(numbers, unit.interval_ns), unit))
        assert (silence, counts.missing, counts.good) == (silence, silence, 600)
        (place,) = flagged(samples, Flag.GAP_BY_HOST_TIME)
        assert flagged(samples, Flag.MISSING_BEFORE) == [place]
        # Jitter above a quarter of an interval hides the place; the least late arrival shows the gap then.
        assert place == 150 if timing is one_a_read else 150 <= place < 150 + 2 * KEPT


@pytest.mark.parametrize("jitter_s", [3e-4, 1e-3])
def test_jitter_of_an_interval_and_more_makes_no_gap_and_hides_none(jitter_s: float) -> None:
    unit = layout(SequenceKind.NONE, rate=1000)
    for lost in (0, 1, 5):
        numbers = np.delete(np.arange(5000), slice(2500, 2500 + lost))
        late = np.random.default_rng(lost).exponential(jitter_s * 1e9, len(numbers))
        times = np.maximum.accumulate(one_a_read(numbers, unit.interval_ns) + late.astype(np.int64))
        _, counts = tracked(unit, frames(numbers, times, unit))
        assert (lost, counts.missing, counts.good) == (lost, lost, len(numbers))


@pytest.mark.parametrize("rate", [Fraction(4096, 5), Fraction(300), Fraction(600), Fraction(1000, 3)])
def test_intervals_of_any_rate_add_up_without_drift(rate: Fraction) -> None:
    unit = layout(SequenceKind.COUNTER, 32, rate=rate)
    samples, _ = tracked(unit, frames(np.arange(20_000), 0, unit))
    exact = [int(k * unit.interval) for k in range(1, 20_001)]
    assert samples["elapsed_ns"].tolist() == exact
    assert np.cumsum(samples["interval_ns"]).tolist() == exact
    assert np.ptp(samples["interval_ns"]) <= 1


def rates(unit: Layout) -> Layout:
    """The same unit with gyros that send rad/s, a thousandth a count."""
    return replace(
        unit, gyro=Sensor(Values.RATE, in_pulses=False, axes=unit.gyro.axes, per_count=(1e-3, 1e-3, 1e-3))
    )


def test_a_rate_is_multiplied_by_the_interval_of_its_own_sample_never_by_that_of_a_gap() -> None:
    unit = rates(layout(SequenceKind.COUNTER, 32, rate=300))
    numbers = with_silence(40)
    rows = frames(numbers, 0, unit)
    rows["gyro"] = 2000
    samples, counts = tracked(unit, rows)
    assert counts.missing == 40
    assert np.ptp(samples["interval_ns"]) <= 1
    expected = np.repeat(samples["interval_ns"][:, None], 3, axis=1) * 2.0e-9
    np.testing.assert_allclose(samples["gyro"], expected, rtol=1e-15)
