"""Counter and loss accounting: every number that the unit sent is counted exactly once, always."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imudrv.imu.conversion import MAX_INTERVAL_NS
from imudrv.imu.sequence import WINDOW, SampleCounts, SequenceTracker
from imudrv.profiles import load
from imudrv.records import FRAME, Flag, Records
from imudrv.wire.layout import Layout, SequenceKind
from imudrv.wire.layout import Sequence as Numbering

INCREMENTS = load("imu50-rs422").layout()
TOTALS = load("imu50-rs422-acc").layout()
TAU = 1_000_000


def with_counter(bits: int, layout: Layout = INCREMENTS) -> Layout:
    """A layout with another counter."""
    return replace(layout, sequence=Numbering(SequenceKind.COUNTER, bits))


def frames(counters: Sequence[int], **columns: object) -> Records:
    rows = np.zeros(len(counters), FRAME)
    rows["counter"] = counters
    rows["t_ns"] = 7_000 + np.arange(len(counters))
    for name, values in columns.items():
        rows[name] = values
    return rows


def run(
    counters: Sequence[int], layout: Layout = INCREMENTS, **columns: object
) -> tuple[Records, SampleCounts]:
    tracker = SequenceTracker(layout)
    pulses = tracker.feed(frames(counters, **columns))
    assert tracker.counts.closes
    return pulses, tracker.counts


def anomalies(counts: SampleCounts) -> dict[str, int]:
    """Counts other than 0, without those that every run has."""
    return {name: n for name, n in vars(counts).items() if n and name not in ("frames", "good", "expected")}


def totals(increments: list[list[int]]) -> np.ndarray:
    """Running totals as the wire has them."""
    return np.cumsum(increments, axis=0) % 2**16


def test_an_unbroken_run_is_passed_on_complete():
    pulses, counts = run([5, 6, 7], gyro=[[1, 2, 3]] * 3, accelerometer=[[4, 5, 6]] * 3)
    assert anomalies(counts) == {}
    assert (counts.frames, counts.good, counts.expected, counts.lost) == (3, 3, 3, 0)
    assert pulses["counter"].tolist() == [5, 6, 7]
    assert pulses["gyro"].tolist() == [[1, 2, 3]] * 3
    assert pulses["accelerometer"].tolist() == [[4, 5, 6]] * 3
    assert pulses["elapsed_ns"].tolist() == [TAU, 2 * TAU, 3 * TAU]
    assert pulses["interval_ns"].tolist() == [TAU] * 3
    assert pulses["arrival_ns"].tolist() == [7000, 7001, 7002]
    assert pulses["flags"].tolist() == [Flag.VALID] * 3


@pytest.mark.parametrize("bits", [8, 16, 32])
def test_the_counter_goes_across_its_wrap(bits):
    layout = with_counter(bits)
    top = 2**bits
    pulses, counts = run([top - 2, top - 1, 0, 1], layout)
    assert anomalies(counts) == {}
    assert pulses["counter"].tolist() == [top - 2, top - 1, top, top + 1]


@pytest.mark.parametrize("bits", [8, 16, 32])
def test_losses_across_the_wrap_are_counted(bits):
    layout = with_counter(bits)
    pulses, counts = run([2**bits - 1, 5], layout)
    assert anomalies(counts) == {"missing": 5}
    assert pulses["elapsed_ns"].tolist() == [TAU, 7 * TAU]


def test_a_counter_of_8_bits_goes_around_many_times():
    layout = with_counter(8)
    pulses, counts = run([i % 256 for i in range(1000)], layout)
    assert anomalies(counts) == {}
    assert pulses["counter"].tolist() == list(range(1000))


def test_lost_samples_are_counted_and_the_next_one_is_flagged():
    pulses, counts = run([1, 2, 6, 7])
    assert anomalies(counts) == {"missing": 3}
    assert (counts.expected, counts.good, counts.lost) == (7, 4, 3)
    assert ((pulses["flags"] & Flag.MISSING_BEFORE) != 0).tolist() == [False, False, True, False]
    assert pulses["interval_ns"].tolist() == [TAU] * 4
    assert pulses["elapsed_ns"].tolist() == [TAU, 2 * TAU, 6 * TAU, 7 * TAU]


def test_rejected_bytes_and_torn_pairs_explain_losses_but_never_more_than_there_are():
    _, counts = run([1, 6], damaged=[0, 2], torn=[0, 1])
    assert anomalies(counts) == {"torn": 1, "damaged": 2, "missing": 1}
    _, counts = run([1, 3], damaged=[0, 9], torn=[0, 9])
    assert anomalies(counts) == {"torn": 1}
    _, counts = run([1, 2], damaged=[0, 9], torn=[0, 9])
    assert anomalies(counts) == {}


def test_a_frame_after_a_later_one_is_out_of_order_and_no_longer_missing():
    pulses, counts = run([1, 2, 5, 4, 6])
    assert anomalies(counts) == {"out_of_order": 1, "missing": 1}
    assert pulses["counter"].tolist() == [1, 2, 5, 6]


def test_a_repeated_frame_is_a_duplicate():
    pulses, counts = run([1, 2, 2, 1, 3, 2])
    assert anomalies(counts) == {"duplicate": 3}
    assert pulses["counter"].tolist() == [1, 2, 3]


def test_a_repeated_frame_out_of_order_is_counted_out_of_order_once():
    _, counts = run([1, 5, 3, 3])
    assert anomalies(counts) == {"out_of_order": 1, "duplicate": 1, "missing": 2}


def test_a_frame_from_before_the_first_one_widens_what_was_expected():
    pulses, counts = run([10, 7, 8, 11])
    assert anomalies(counts) == {"out_of_order": 2, "missing": 1}
    assert counts.expected == 5
    assert pulses["counter"].tolist() == [10, 11]


def test_a_frame_out_of_order_takes_back_what_was_called_damaged_or_torn():
    _, counts = run([1, 3, 2], damaged=[0, 1, 0])
    assert anomalies(counts) == {"out_of_order": 1}
    _, counts = run([1, 3, 2], torn=[0, 1, 0])
    assert anomalies(counts) == {"out_of_order": 1}


def test_the_window_separates_out_of_order_from_a_restart():
    _, counts = run([1000, 1000 - WINDOW + 1])
    assert anomalies(counts) == {"out_of_order": 1, "missing": WINDOW - 2}
    pulses, counts = run([1000, 1000 - WINDOW, 1000 - WINDOW + 1])
    assert anomalies(counts) == {"restarts": 1}
    assert pulses["counter"].tolist() == [1000, 936, 937]


def test_a_frame_that_passed_its_check_by_chance_does_not_move_the_counter():
    counters = [10, 11, 642_782_990, 14, 15]
    pulses, counts = run(counters, damaged=[0, 0, 1, 0, 0])
    # Of 12 and 13 one was rejected before the frame with the invalid counter, the other is that frame.
    assert anomalies(counts) == {"invalid_counter": 1, "damaged": 2}
    assert pulses["counter"].tolist() == [10, 11, 14, 15]
    assert pulses["flags"].tolist() == [1, 1, Flag.VALID | Flag.MISSING_BEFORE, 1]


def test_two_frames_that_jump_and_do_not_agree_both_have_an_invalid_counter():
    _, counts = run([10, 2**31, 5000, 13])
    assert anomalies(counts) == {"invalid_counter": 2, "damaged": 2}


def test_a_jump_is_accepted_once_the_next_frame_agrees():
    tracker = SequenceTracker(INCREMENTS)
    assert len(tracker.feed(frames([10, 10 + WINDOW + 1]))) == 1
    assert tracker.counts.invalid_counter == 1
    pulses = tracker.feed(frames([10 + WINDOW + 3]))
    assert pulses["counter"].tolist() == [75, 77]
    assert anomalies(tracker.counts) == {"missing": WINDOW + 1}


def test_after_a_restart_time_continues_and_the_break_is_flagged():
    pulses, counts = run([1000, 1001, 0, 1])
    assert anomalies(counts) == {"restarts": 1}
    assert counts.expected == 4
    assert np.all(np.diff(pulses["elapsed_ns"]) == TAU)
    assert ((pulses["flags"] & Flag.MISSING_BEFORE) != 0).tolist() == [False, False, True, False]


def test_totals_begin_with_a_reference_and_give_differences_across_their_wrap():
    increments = [[65530, 0, 0], [10, -3, 7], [-20, 5, -7], [32767, -32768, 0]]
    pulses, counts = run([0, 1, 2, 3], TOTALS, gyro=totals(increments), accelerometer=totals(increments))
    assert anomalies(counts) == {"reference": 1}
    assert pulses["gyro"].tolist() == increments[1:]
    assert pulses["accelerometer"].tolist() == increments[1:]
    assert pulses["flags"].tolist() == [Flag.VALID] * 3
    assert pulses["elapsed_ns"].tolist() == [2 * TAU, 3 * TAU, 4 * TAU]


def test_totals_recover_a_gap_by_one_long_interval_that_holds_all_pulses():
    increments = [[9, 9, 9], [100, -50, 3], [101, -51, 4], [102, -52, 5], [103, -53, 6]]
    sent = totals(increments)
    pulses, counts = run([0, 1, 4], TOTALS, gyro=sent[[0, 1, 4]], accelerometer=sent[[0, 1, 4]])
    assert anomalies(counts) == {"reference": 1, "missing": 2, "recovered": 2}
    assert pulses["gyro"].tolist() == [[100, -50, 3], [306, -156, 15]]
    assert pulses["gyro"].sum(axis=0).tolist() == np.sum(increments[1:], axis=0).tolist()
    assert pulses["interval_ns"].tolist() == [TAU, 3 * TAU]
    assert pulses["flags"].tolist() == [Flag.VALID, Flag.VALID | Flag.LONG_INTERVAL]


def test_a_gap_in_totals_longer_than_a_datagram_can_carry_is_not_recovered():
    longest = MAX_INTERVAL_NS // TAU
    pulses, counts = run([0, longest, longest + 1], TOTALS)
    assert anomalies(counts) == {"reference": 1, "missing": longest - 1, "recovered": longest - 1}
    assert pulses["interval_ns"].tolist() == [longest * TAU, TAU]

    pulses, counts = run([0, longest + 1, longest + 2], TOTALS)
    assert anomalies(counts) == {"reference": 2, "missing": longest}
    assert pulses["interval_ns"].tolist() == [TAU]
    assert pulses["flags"].tolist() == [Flag.VALID | Flag.MISSING_BEFORE]
    assert pulses["elapsed_ns"].tolist() == [(longest + 3) * TAU]


def test_totals_need_a_new_reference_after_a_restart_and_the_break_is_flagged_even_across_a_gap():
    pulses, counts = run([1000, 1001, 0, 1], TOTALS, gyro=[[5] * 3, [6] * 3, [0] * 3, [2] * 3])
    assert anomalies(counts) == {"reference": 2, "restarts": 1}
    assert pulses["gyro"].tolist() == [[1] * 3, [2] * 3]
    assert pulses["flags"].tolist() == [Flag.VALID, Flag.VALID | Flag.MISSING_BEFORE]

    pulses, counts = run([1000, 1001, 0, 3], TOTALS)
    assert anomalies(counts) == {"reference": 2, "restarts": 1, "missing": 2, "recovered": 2}
    assert pulses["flags"][1] == Flag.VALID | Flag.LONG_INTERVAL | Flag.MISSING_BEFORE


def test_a_gap_in_which_the_totals_may_have_wrapped_is_not_valid():
    # 10 000 pulses a millisecond before a gap of four: the difference of 16 bits is not sure any more.
    sent = totals([[0] * 3, [10_000] * 3, [40_000] * 3])
    pulses, _ = run([0, 1, 5], TOTALS, gyro=sent)
    assert pulses["flags"].tolist() == [Flag.VALID, Flag.LONG_INTERVAL | Flag.SATURATED]


@pytest.mark.parametrize(
    ("status", "flags"),
    [
        (0, Flag.VALID),
        (1 << 0, Flag.VALID | Flag.WARM_UP),
        *((1 << bit, Flag.FAULT) for bit in (*range(1, 10), 15)),
        (1 << 10, Flag.SATURATED),
        (1 << 11, Flag.VALID),  # reserved
    ],
)
def test_status_bits_become_flags(status, flags):
    pulses, _ = run([1], status=status)
    assert pulses["flags"].tolist() == [flags]
    assert pulses["status"].tolist() == [status]


@pytest.mark.parametrize(("pulse", "saturated"), [(2**31 - 1, True), (-(2**31), True), (2**31 - 2, False)])
@pytest.mark.parametrize("sensor", ["gyro", "accelerometer"])
def test_a_count_at_the_end_of_its_width_is_saturated(sensor, pulse, saturated):
    pulses, _ = run([1], **{sensor: [[0, pulse, 0]]})
    assert pulses["flags"].tolist() == [Flag.SATURATED if saturated else Flag.VALID]
    assert pulses[sensor].tolist() == [[0, pulse, 0]]


def test_temperatures_are_in_degrees_and_unreceived_ones_are_unknown():
    counts = np.full((1, 6), np.nan)
    counts[0, :4] = [3512, np.nan, -5, 0]
    pulses, _ = run([1], temperature=counts)
    expected = [35.12, np.nan, -0.05, 0.0, np.nan, np.nan]
    assert np.array_equal(pulses["temperature_degc"][0], expected, equal_nan=True)


# Steps of the counter (on, doubled, a gap, back a little, back far, far ahead), damaged, torn.
STEPS = st.sampled_from([1, 1, 1, 1, 0, 2, 5, 63, 64, 65, -1, -3, -63, -64, -200, 300, 5000])
ARRIVALS = st.lists(st.tuples(STEPS, st.integers(0, 4), st.integers(0, 3)), min_size=1, max_size=60)


@given(st.integers(0, 2**32 - 1), ARRIVALS, st.sampled_from([8, 16, 32]), st.booleans(), st.integers(0, 60))
def test_the_counts_add_up_for_any_counters_and_any_batches(first, arrivals, bits, running, cut):
    layout = with_counter(bits, TOTALS if running else INCREMENTS)
    steps, damaged, torn = np.array(arrivals).T
    gyro = np.random.default_rng(first).integers(0, 100, (len(steps), 3))
    rows = frames((first + np.cumsum(steps)) % 2**bits, damaged=damaged, torn=torn, gyro=gyro)

    one_by_one = SequenceTracker(layout)
    pieces = []
    for i in range(len(rows)):
        pieces.append(one_by_one.feed(rows[i : i + 1]))
        assert one_by_one.counts.closes
        assert min(vars(one_by_one.counts).values()) >= 0
    single = np.concatenate(pieces)
    assert len(single) == one_by_one.counts.good
    assert np.all(np.diff(single["elapsed_ns"]) > 0)

    in_batches = SequenceTracker(layout)
    batches = np.concatenate([in_batches.feed(rows[:cut]), in_batches.feed(rows[cut:])])
    assert in_batches.counts == one_by_one.counts
    for name in single.dtype.names:
        assert np.array_equal(batches[name], single[name], equal_nan=name == "temperature_degc")
