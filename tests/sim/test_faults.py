from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imudrv.records import MESSAGE
from imudrv.sim.faults import Damage, Kind, MessageFaults, StreamFaults
from imudrv.sim.scenario import Faults, Scenario

HEADER = b"\xeb\x90"
LENGTH = 44
KINDS = [(LENGTH, HEADER)]
STREAM_RATES = {
    "bit_flips": 0.05,
    "bytes_lost": 0.06,
    "bytes_inserted": 0.07,
    "false_sync_inside": 0.08,
    "frame_lost": 0.04,
    "bytes_between": 0.03,
    "false_sync_between": 0.02,
    "frame_doubled": 0.09,
}
HITS = {Kind.BIT_FLIPS, Kind.BYTES_LOST, Kind.BYTES_INSERTED, Kind.FALSE_SYNC_INSIDE, Kind.LOST, Kind.SILENCE}
Make = Callable[..., Scenario]


@pytest.fixture
def faults(scenario: Make) -> Callable[..., Faults]:
    return lambda **keys: scenario({"rest": {"duration_s": 1.0}}, faults=keys).faults


def frames_of(n: int, seed: int = 1) -> np.ndarray:
    """Random frames with the header and a number, so that no two are alike."""
    frames = np.random.default_rng(seed).integers(0, 256, (n, LENGTH), np.uint8)
    frames[:, :2] = np.frombuffer(HEADER, np.uint8)
    frames[:, 4:8] = np.arange(n, dtype="<u4").view(np.uint8).reshape(n, 4)
    return frames


def times(n: int) -> np.ndarray:
    return (np.arange(n, dtype=np.int64) + 1) * 1_000_000


def send(line: StreamFaults, n: int) -> tuple[np.ndarray, bytes, Damage]:
    frames = frames_of(n)
    return frames, *line.apply(frames, times(n))


def test_a_quiet_line_changes_nothing(faults: Callable[..., Faults]) -> None:
    frames, stream, damage = send(StreamFaults(faults(), KINDS, 1), 100)
    assert stream == frames.tobytes()
    assert not damage.hit.any()
    assert not damage.kind.any()


def test_every_kind_of_fault_occurs_at_its_rate(faults: Callable[..., Faults]) -> None:
    n = 20_000
    _, _, damage = send(StreamFaults(faults(stream=STREAM_RATES), KINDS, 1), n)
    for kind, rate in zip(list(Kind)[1:9], STREAM_RATES.values(), strict=True):
        sigma = np.sqrt(rate * (1 - rate) / n)
        assert np.mean(damage.kind == kind) == pytest.approx(rate, abs=4 * sigma), kind  # four sigma
    np.testing.assert_array_equal(damage.hit, np.isin(damage.kind, list(HITS)))


def test_frames_that_are_not_hit_arrive_and_the_others_do_not(faults: Callable[..., Faults]) -> None:
    frames, stream, damage = send(StreamFaults(faults(stream=STREAM_RATES), KINDS, 3), 3000)
    at = 0
    for frame, hit, kind in zip(frames, damage.hit, damage.kind, strict=True):
        found = stream.find(frame.tobytes(), at)
        if hit:
            # the number inside keeps frames apart, so it is nowhere
            assert found < 0
        else:
            assert found >= at, Kind(kind)
            at = found + LENGTH


@pytest.mark.parametrize(
    ("key", "shortest", "longest"),
    [
        ("bit_flips", LENGTH, LENGTH),
        ("bytes_lost", LENGTH - 12, LENGTH - 1),
        ("bytes_inserted", LENGTH + 1, LENGTH + 12),
        ("false_sync_inside", LENGTH + 2, LENGTH + 2),
        ("frame_lost", 0, 0),
        ("bytes_between", LENGTH + 1, LENGTH + 12),
        ("false_sync_between", LENGTH + 2, LENGTH + 2),
        ("frame_doubled", 2 * LENGTH, 2 * LENGTH),
    ],
)
def test_each_kind_does_what_its_name_says(
    faults: Callable[..., Faults], key: str, shortest: int, longest: int
) -> None:
    line = StreamFaults(faults(stream={key: 1.0}), KINDS, 5)
    for frame in frames_of(200):
        stream, damage = line.apply(frame[None], times(1))
        assert shortest <= len(stream) <= longest
        assert stream != frame.tobytes()
        assert damage.hit[0] == (frame.tobytes() not in stream)
        if key == "bit_flips":
            flipped = np.unpackbits(np.frombuffer(stream, np.uint8) ^ frame).sum()
            assert 1 <= flipped <= 3
        if key == "bytes_between":
            assert stream.endswith(frame.tobytes())
        if key == "false_sync_between":
            assert stream == HEADER + frame.tobytes()


@given(st.integers(0, 2**32))
def test_a_loss_that_the_next_header_would_heal_is_not_done(seed: int) -> None:
    # the frame ends as the next one begins: losing its last bytes would hit the next frame instead
    frame = np.full((1, 3), 0xEB, np.uint8)
    frame[0, 1] = 0x11
    faults = Faults.model_validate({"stream": {"bytes_lost": 1.0}})
    stream, damage = StreamFaults(faults, [(frame.size, b"\xeb")], seed).apply(frame, times(1))
    assert stream not in (b"\xeb\x11",)
    assert damage.hit[0] == (stream != frame.tobytes())


def test_a_frame_that_no_damage_can_harm_is_left_whole() -> None:
    frame = np.zeros((1, 4), np.uint8)
    faults = Faults.model_validate({"stream": {"false_sync_inside": 1.0}})
    stream, damage = StreamFaults(faults, [(frame.size, b"\0\0")], 1).apply(frame, times(1))
    assert stream == frame.tobytes()
    assert not damage.hit[0]
    assert damage.kind[0] == Kind.NONE


def test_in_a_silence_nothing_is_sent(faults: Callable[..., Faults]) -> None:
    quiet = faults(silences=[{"at_s": 0.05, "duration_s": 0.02}])
    frames, stream, damage = send(StreamFaults(quiet, KINDS, 1), 100)
    expected = np.zeros(100, np.bool_)
    expected[50:70] = True  # frame k is sent at k + 1 ms
    np.testing.assert_array_equal(damage.hit, expected)
    assert stream == frames[~expected].tobytes()


def test_the_same_seed_gives_the_same_faults_in_any_chunks(faults: Callable[..., Faults]) -> None:
    rates = faults(stream=STREAM_RATES)

    def in_chunks(seed: int, chunks: int) -> bytes:
        line = StreamFaults(rates, KINDS, seed)
        parts = np.array_split(frames_of(500), chunks)
        return b"".join(line.apply(part, times(len(part)))[0] for part in parts)

    assert in_chunks(1, 10) == in_chunks(1, 1) == in_chunks(1, 500)
    assert in_chunks(1, 10) != in_chunks(2, 10)


def test_the_sizes_cut_the_stream_into_what_arrives_of_each_frame(faults: Callable[..., Faults]) -> None:
    rates = faults(stream=STREAM_RATES, silences=[{"at_s": 0.1, "duration_s": 0.1}])
    frames, stream, damage = send(StreamFaults(rates, KINDS, 4), 500)
    assert damage.size.sum() == len(stream)
    ends = np.cumsum(damage.size)
    for frame, size, end, kind in zip(frames, damage.size, ends, damage.kind, strict=True):
        if kind == Kind.NONE:
            assert stream[end - size : end] == frame.tobytes()
        if kind in (Kind.SILENCE, Kind.LOST):
            assert size == 0


def test_a_cable_that_is_out_is_a_silence(faults: Callable[..., Faults]) -> None:
    span = [{"at_s": 0.05, "duration_s": 0.02}]
    for kind in (
        StreamFaults(faults(unplugs=span), KINDS, 1),
        StreamFaults(faults(silences=span), KINDS, 1),
    ):
        frames, stream, _ = send(kind, 100)
        assert stream == frames[:50].tobytes() + frames[70:].tobytes()


def messages_of(n: int) -> Any:
    messages = np.zeros(n, MESSAGE)
    messages["t_ns"] = times(n)
    messages["id"] = np.arange(n)
    return messages


def test_a_quiet_bus_changes_nothing(faults: Callable[..., Faults]) -> None:
    got, damage = MessageFaults(faults(), 1).apply(messages_of(50))
    np.testing.assert_array_equal(got, messages_of(50))
    assert not damage.hit.any()


def test_messages_are_lost_doubled_and_swapped_as_reported(faults: Callable[..., Faults]) -> None:
    n = 20_000
    sent = messages_of(n)
    got, damage = MessageFaults(faults(can={"lost": 0.05, "doubled": 0.1, "swapped": 0.05}), 1).apply(sent)
    np.testing.assert_array_equal(damage.hit, damage.kind == Kind.LOST)
    expected = []
    ids = sent["id"].tolist()
    for i in np.flatnonzero(damage.kind == Kind.SWAPPED).tolist():
        ids[i], ids[i + 1] = ids[i + 1], ids[i]
    for place, identifier in enumerate(ids):
        expected += [identifier] * {Kind.LOST: 0, Kind.DOUBLED: 2}.get(Kind(damage.kind[place]), 1)
    np.testing.assert_array_equal(got["id"], expected)
    assert np.all(np.diff(got["t_ns"]) >= 0)
    # four sigma; a swap needs a neighbour without a fault, which 80 % have
    for kind, rate in ((Kind.LOST, 0.05), (Kind.DOUBLED, 0.1), (Kind.SWAPPED, 0.05 * 0.8)):
        assert np.mean(damage.kind == kind) == pytest.approx(rate, abs=4 * np.sqrt(rate / n)), kind


def test_neighbours_swap_in_pairs_and_the_last_message_has_none(faults: Callable[..., Faults]) -> None:
    bus = MessageFaults(faults(can={"swapped": 1.0}), 1)
    got, damage = bus.apply(messages_of(3))
    np.testing.assert_array_equal(got["id"], [1, 0])
    np.testing.assert_array_equal(damage.kind, [Kind.SWAPPED, Kind.NONE])
    last, damage = bus.close()
    np.testing.assert_array_equal(last["id"], [2])
    np.testing.assert_array_equal(damage.kind, [Kind.NONE])


def test_a_bus_suffers_the_same_in_any_chunks(faults: Callable[..., Faults]) -> None:
    rates = faults(can={"lost": 0.1, "doubled": 0.1, "swapped": 0.5})

    def in_chunks(chunks: int) -> Any:
        bus = MessageFaults(rates, 1)
        parts = [bus.apply(part) for part in np.array_split(messages_of(500), chunks)]
        parts.append(bus.close())
        messages = np.concatenate([arrived for arrived, _ in parts])
        assert messages.size == sum(damage.size.sum() for _, damage in parts)
        return messages

    np.testing.assert_array_equal(in_chunks(10), in_chunks(1))
    np.testing.assert_array_equal(in_chunks(500), in_chunks(1))


def test_a_bus_falls_silent_too(faults: Callable[..., Faults]) -> None:
    got, damage = MessageFaults(faults(silences=[{"at_s": 0.0, "duration_s": 0.01}]), 1).apply(
        messages_of(30)
    )
    np.testing.assert_array_equal(got["id"], np.arange(10, 30))
    np.testing.assert_array_equal(damage.hit, np.arange(30) < 10)


def test_each_message_of_a_sample_has_its_own_faults(faults: Callable[..., Faults]) -> None:
    """Three messages a sample: rates are per message, and the bytes of the others are as they were."""
    kinds = [(11, b"\x55\x51"), (9, b"\x55\x52"), (5, b"\x56")]
    n = 2000
    rows = np.random.default_rng(1).integers(0, 256, (n, 25), np.uint8)
    t_ns = np.repeat(times(n), 3)
    whole = faults(stream={"frame_lost": 0.1})
    stream, damage = StreamFaults(whole, kinds, 5).apply(rows, t_ns)
    assert damage.hit.shape == (3 * n,)
    for k, (length, _) in enumerate(kinds):
        lost = damage.hit[k::3]
        assert abs(lost.mean() - 0.1) < 4 * np.sqrt(0.1 * 0.9 / n)  # four sigma
        np.testing.assert_array_equal(damage.size[k::3], np.where(lost, 0, length))
    starts = np.array([0, 11, 20])
    kept = [
        rows[i // 3, starts[i % 3] : starts[i % 3] + kinds[i % 3][0]].tobytes()
        for i in np.flatnonzero(~damage.hit)
    ]
    assert stream == b"".join(kept)
    # any pieces, the same faults
    line = StreamFaults(whole, kinds, 5)
    pieces = [line.apply(rows[a:b], t_ns[3 * a : 3 * b])[0] for a, b in ((0, 7), (7, 1000), (1000, n))]
    assert b"".join(pieces) == stream
