"""An open line is judged by the data that it delivers; the test sets the clock."""

import random
from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
import pytest

from imudrv.diagnosis import LineState, LineWatch, decode_traffic, explain
from imudrv.profiles import load
from imudrv.records import EXTENDED, MESSAGE
from imudrv.units import NS_PER_S

RS422 = load("imu50-rs422")
CAN = load("imu50-can")
STREAMING = LineState("streaming")
LENGTH = RS422.messages[0].length
TURN_NS = NS_PER_S // 100
STALL_S = 0.25
"""Arrivals may be late by this."""


def states(
    watch: LineWatch,
    rate_hz: float,
    seconds: float,
    *,
    begin_s: float = 0.0,
    stalls: Iterable[tuple[float, float]] = (),
) -> Iterator[tuple[float, LineState]]:
    """Time and state at each turn of a service whose unit sends good frames at a rate.

    `stalls`: begin and end, s; what was sent meanwhile arrives afterwards.
    """
    begin_ns, sent = round(begin_s * NS_PER_S), 0
    blocked = [range(round(a * NS_PER_S), round(b * NS_PER_S)) for a, b in stalls]
    for t_ns in range(begin_ns, begin_ns + round(seconds * NS_PER_S), TURN_NS):
        samples = int((t_ns - begin_ns) * rate_hz / NS_PER_S)
        if samples > sent and not any(t_ns in span for span in blocked):
            watch.arrived(bytes((samples - sent) * LENGTH), samples - sent, t_ns)
            sent = samples
        if t_ns % NS_PER_S == 0:
            watch.counted(sent, t_ns)
        yield t_ns / NS_PER_S, watch.state(t_ns)


def random_stalls(chance: random.Random) -> list[tuple[float, float]]:
    """One stall in each second of 20, most of them at the moment when the rate is measured."""
    begins = [second + chance.uniform(0.7, 1.0) for second in range(20)]
    return [(begin, begin + chance.uniform(0.0, STALL_S)) for begin in begins]


def test_data_without_a_sample_is_reported_within_two_seconds_with_its_amount() -> None:
    watch = LineWatch(RS422, True, 0)
    begin_ns = NS_PER_S // 2
    for t_ns in range(0, begin_ns, TURN_NS):
        watch.arrived(bytes(10 * LENGTH), 10, t_ns)
        assert watch.state(t_ns) == STREAMING
    found = {}
    for t_ns in range(begin_ns, begin_ns + 5 * NS_PER_S, TURN_NS):
        watch.arrived(bytes(113), 0, t_ns)
        found.setdefault(watch.state(t_ns), t_ns)
    good, unreadable = found  # the text stays the same
    assert (good, unreadable.name) == (STREAMING, "unreadable")
    assert found[unreadable] - begin_ns < 2 * NS_PER_S
    # 102 pieces in 1.01 s
    assert unreadable.trouble == "11.4 kB/s come, no frame of imu50-rs422"
    watch.arrived(bytes(20 * LENGTH), 20, t_ns)
    assert watch.state(t_ns) == STREAMING


def test_only_the_latest_data_is_kept_and_none_once_frames_come() -> None:
    watch = LineWatch(RS422, True, 0)
    for number in range(300):
        watch.arrived(bytes([number % 256]) * 1000, 0, number * TURN_NS)
    kept = watch.undecoded
    assert isinstance(kept, bytes)
    assert len(kept) in range(60_000, 1 << 16)
    assert kept[-1] == 299 % 256
    watch.arrived(bytes(1 << 20), 0, 300 * TURN_NS)
    assert len(watch.undecoded) == 1 << 16
    watch.arrived(bytes(1 << 16), 1000, 301 * TURN_NS)
    assert watch.undecoded == b""


def test_frames_that_are_right_by_chance_do_not_make_noise_a_stream() -> None:
    # An 8-bit sum after a sync of one byte is right once in 65 536 bytes of noise; here once in 22 000.
    watch = LineWatch(RS422, True, 0)
    names = []
    for turn in range(2000):
        watch.arrived(bytes(110), int(turn % 200 == 150), turn * TURN_NS)
        names.append(watch.state(turn * TURN_NS).name)
    first = names.index("unreadable")
    assert first * TURN_NS < 3 * NS_PER_S
    assert set(names[first:]) == {"unreadable"}


def test_on_can_messages_are_counted_and_held_samples_waited_for() -> None:
    held_ns = 2 * 100 * NS_PER_S // 1000  # until the full counter, which comes with each hundredth sample
    watch = LineWatch(load("imu50-can"), True, 0)
    watch.arrived(np.zeros(600, MESSAGE), 0, 0)
    watch.arrived(np.zeros(5, MESSAGE), 0, NS_PER_S + held_ns)
    assert watch.state(NS_PER_S + held_ns) == STREAMING
    watch.arrived(np.zeros(2, MESSAGE), 0, NS_PER_S + held_ns + TURN_NS)
    # 607 in 1.21 s
    assert watch.state(NS_PER_S + held_ns + TURN_NS).trouble == "502 messages/s come, no frame of imu50-can"


def test_a_few_bytes_before_a_silence_do_not_count_after_it() -> None:
    watch = LineWatch(RS422, True, 0)
    watch.arrived(bytes(3), 0, 0)
    assert watch.state(NS_PER_S).name == "silent"
    watch.arrived(bytes(LENGTH // 2), 0, 10 * NS_PER_S)
    assert watch.state(10 * NS_PER_S).name == "silent"
    watch.arrived(bytes(LENGTH - LENGTH // 2), 1, 10 * NS_PER_S + TURN_NS)
    assert watch.state(10 * NS_PER_S + TURN_NS) == STREAMING


def test_bytes_without_a_sample_do_not_end_a_silence() -> None:
    watch = LineWatch(RS422, True, 0)
    names = []
    for t_ns in range(0, 10 * NS_PER_S, 6 * NS_PER_S // 10):
        watch.arrived(bytes(50), 0, t_ns)
        names += [watch.state(t_ns).name, watch.state(t_ns + NS_PER_S // 2).name]
    assert set(names[1:]) == {"silent"}


def test_messages_are_counted_by_identifiers_as_the_bus_writes_them() -> None:
    messages = (CAN.messages[0].model_copy(update={"id": 0x18FF0150}), *CAN.messages[1:])
    profile = CAN.model_copy(update={"messages": messages})
    data = np.zeros(3, MESSAGE)
    data["id"] = EXTENDED | 0x18FF0150, EXTENDED | 0x151, 0x151
    text = explain(profile, decode_traffic(profile, data), 1.0)
    assert "by id: 18FF0150 1, 151 1, 152 0, 153 0" in text


@pytest.mark.parametrize("rate_hz", [1.0, 2.0, 10.0, 200.0, 1000.0])
def test_the_right_rate_is_no_trouble_however_the_machine_stalls(rate_hz: float) -> None:
    profile = RS422.model_copy(update={"sample_rate_hz": rate_hz})
    # Worst: what is late at the turn of a second grows, or shrinks, by the same amount for three seconds.
    growing = [(1.92, 2.01), (2.83, 3.01), (3.75, 4.01)]
    shrinking = [(0.75, 1.01), (1.83, 2.01), (2.92, 3.01)]
    slowly_growing = [(n + 1 - n * STALL_S / 6, n + 1.01) for n in range(1, 7)]
    chance = random.Random(1)
    for stalls in (growing, shrinking, slowly_growing, *(random_stalls(chance) for _ in range(20))):
        watch = LineWatch(profile, True, 0)
        assert {state for _, state in states(watch, rate_hz, 20.0, stalls=stalls)} == {STREAMING}


@pytest.mark.parametrize("rate_hz", [100.0, 200.0, 500.0, 900.0, 1100.0, 2000.0])
def test_a_wrong_rate_is_reported_within_five_seconds(rate_hz: float) -> None:
    troubles = [(t_s, s) for t_s, s in states(LineWatch(RS422, True, 0), rate_hz, 20.0) if s.trouble]
    first_s, state = troubles[0]
    assert first_s < 5.0
    assert state.name == "wrong rate"
    assert f"expected 1000 samples/s of imu50-rs422, the unit counts {rate_hz:.1f}" in state.trouble
    assert {other for _, other in troubles} == {state}


@pytest.mark.parametrize(("rate_hz", "most_s"), [(950.0, 8.0), (1050.0, 8.0), (975.0, 14.0), (1025.0, 14.0)])
def test_a_rate_that_is_a_few_percent_off_is_reported_after_more_time(rate_hz: float, most_s: float) -> None:
    found = list(states(LineWatch(RS422, True, 0), rate_hz, 40.0))
    first_s = next(t_s for t_s, state in found if state.trouble)
    assert first_s < most_s
    assert {state.name for t_s, state in found if t_s >= first_s} == {"wrong rate"}


@pytest.mark.parametrize("rate_hz", [200.0, 500.0, 800.0, 1300.0])
def test_a_wrong_rate_is_reported_once_however_the_machine_stalls(rate_hz: float) -> None:
    chance = random.Random(2)
    for _ in range(20):
        found = states(LineWatch(RS422, True, 0), rate_hz, 20.0, stalls=random_stalls(chance))
        changes = [after for (_, before), (_, after) in pairwise(found) if after != before]
        assert len(changes) == 1


def test_a_rate_that_is_right_again_is_no_trouble() -> None:
    watch = LineWatch(RS422, True, 0)
    assert [state for _, state in states(watch, 500.0, 6.0)][-1].trouble
    assert [state for _, state in states(watch, 1000.0, 6.0, begin_s=6.0)][-1] == STREAMING


def test_what_was_counted_before_a_silence_does_not_count_after_it() -> None:
    watch = LineWatch(RS422, True, 0)
    assert [state for _, state in states(watch, 500.0, 6.0)][-1].trouble
    assert watch.state(9 * NS_PER_S).name == "silent"
    after = [state for t_s, state in states(watch, 1000.0, 6.0, begin_s=9.0) if t_s > 9.1]
    assert set(after) == {STREAMING}


def test_a_burst_of_old_frames_and_a_jump_of_the_counter_do_not_change_the_rate() -> None:
    for at in (1, 2, 3, 7):
        watch = LineWatch(RS422, True, 0)
        expected = 0
        for second in range(10):
            expected += 1000 + (8000 if second == at else 0)
            watch.arrived(bytes(LENGTH), 1, second * NS_PER_S)
            watch.counted(expected, second * NS_PER_S)
            assert watch.state(second * NS_PER_S) == STREAMING


def test_the_rate_of_a_unit_that_does_not_send_at_its_own_pace_is_not_checked() -> None:
    assert {state for _, state in states(LineWatch(RS422, False, 0), 50_000.0, 10.0)} == {STREAMING}
