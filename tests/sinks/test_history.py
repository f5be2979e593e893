"""The history: from any of its samples on, everything that is needed to decode them is there."""

import tracemalloc
from itertools import pairwise

import numpy as np
import pytest

from imudrv import profiles
from imudrv.imu.sequence import SequenceTracker
from imudrv.records import INCREMENTS, PULSES, Arrival, Records
from imudrv.sinks.base import Batch
from imudrv.sinks.history import MAX_BYTES, History, Moment
from imudrv.wire.datagram import SIZE
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.encode import CanEncoder, StreamEncoder
from imudrv.wire.layout import Layout

NO_INCREMENTS = np.zeros(0, INCREMENTS)


def wire(layout: Layout, first: int, count: int) -> bytes | Records:
    pulses = np.zeros(count, PULSES)
    pulses["counter"] = np.arange(first, first + count)
    pulses["temperature_degc"] = 35.0
    return CanEncoder(layout).encode(pulses) if layout.can else StreamEncoder(layout).encode(pulses).tobytes()


def filled(history: History, layout: Layout, data: bytes | Records, piece: int) -> None:
    """Fill a history as the service does, `piece` bytes or messages a read."""
    decoder, tracker = FrameDecoder(layout), SequenceTracker(layout)
    for at in range(0, len(data), piece):
        read = data[at : at + piece]
        history.arrived(Arrival(at, read))
        pulses = tracker.feed(decoder.feed(read, at))
        if len(pulses):
            history.publish(Batch(pulses, NO_INCREMENTS, bytes(SIZE * len(pulses))))


def decoded(layout: Layout, moments: list[Moment]) -> Records:
    decoder, tracker = FrameDecoder(layout), SequenceTracker(layout)
    pulses = [tracker.feed(decoder.feed(moment.arrival.data, moment.arrival.t_ns)) for moment in moments]
    return np.concatenate([*pulses, tracker.feed(decoder.close())])


@pytest.mark.parametrize("profile", ["imu50-rs422", "imu50-rs422-acc", "imu50-can", "imu50-canfd"])
@pytest.mark.parametrize("piece", [1, 7, 44, 45, 1000])
def test_from_any_sample_on_all_are_decoded_however_they_were_read(profile: str, piece: int) -> None:
    layout = profiles.load(profile).layout()
    history = History()
    filled(history, layout, wire(layout, 5000, 300), piece)
    for since in (5010, 5150, 5299):
        moments = history.since(since)
        counter = decoded(layout, moments)["counter"]
        assert counter[0] <= since
        assert counter[-1] == 5299
        assert (np.diff(counter) == 1).all()
        assert all(a.arrival.t_ns < b.arrival.t_ns for a, b in pairwise(moments))
        longest = max(moment.last - moment.first + 1 for moment in moments)
        assert counter[0] >= since - 3 * longest  # three reads that completed samples


def test_a_read_that_completes_no_sample_yet_is_kept_too() -> None:
    layout = profiles.load("imu50-rs422").layout()
    data = wire(layout, 0, 10)
    history = History()
    filled(history, layout, data[:-3], 44)
    assert b"".join(bytes(m.arrival.data) for m in history.since(8)).endswith(data[:-3][-41:])


@pytest.mark.parametrize(("profile", "piece"), [("imu50-rs422", 44), ("imu50-can", 1)])
def test_a_minute_at_1_khz_read_one_by_one_fits(profile: str, piece: int) -> None:
    layout = profiles.load(profile).layout()
    history = History()
    filled(history, layout, wire(layout, 0, 61_000), piece)
    assert any(moment.first == 1000 for moment in history.since(1000))


def test_the_memory_is_bounded_and_the_oldest_is_dropped() -> None:
    layout = profiles.load("imu50-can").layout()
    data = wire(layout, 0, 12_000)
    most = MAX_BYTES // 32
    tracemalloc.start()
    history = History(most)
    filled(history, layout, data, 1)
    used, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # The bound counts Python's objects roughly.
    assert 0.5 * most < used < 1.5 * most
    everything = history.since(0)
    assert everything[0].first > 0
    assert everything[-1].last == 11_999
    assert decoded(layout, everything)["counter"][-1] == 11_999


def test_after_a_restart_of_the_unit_the_newest_sample_of_a_number_is_meant() -> None:
    layout = profiles.load("imu50-rs422").layout()
    before, after = wire(layout, 0, 500), wire(layout, 0, 100)
    assert isinstance(before, bytes)
    assert isinstance(after, bytes)
    history = History()
    filled(history, layout, before + after, 44)
    assert history.since(50)[-1].last == 99
    assert len(history.since(50)) < 60
    across = [moment.last for moment in history.since(400) if moment.last >= 0]
    assert 400 in across
    assert across[-1] == 99


def test_a_cleared_history_starts_again() -> None:
    layout = profiles.load("imu50-rs422").layout()
    history = History()
    filled(history, layout, wire(layout, 0, 50), 44)
    history.clear()
    assert history.since(0) == []
    history.publish(Batch(np.zeros(3, PULSES), NO_INCREMENTS, b""))
    assert history.since(0) == []
