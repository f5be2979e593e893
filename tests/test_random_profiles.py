"""Any valid profile: what a unit sends is decoded again, and no input is lost without a reason."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from profile_strategy import profiles

from imudrv.files import settings_file
from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles.schema import Profile
from imudrv.records import FRAME, MESSAGE, REJECT, Flag, Records
from imudrv.wire.can import CanAssembler
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.encode import CanEncoder, StreamEncoder
from imudrv.wire.layout import Layout, SequenceKind, Values
from imudrv.wire.stream import StreamDecoder
from tools.fuzz.sent import samples

SEEDS = st.integers(0, 2**32 - 1)
CUTS = st.lists(st.integers(0, 4000), max_size=6)
ANY_PROFILE = settings(
    max_examples=250, suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large]
)


def layout_of(document: dict[str, Any]) -> Layout:
    return settings_file.parse(document, Profile, "random profile").layout()


def on_the_wire(layout: Layout, sent: Records) -> np.ndarray:
    """Bytes of a stream, or messages."""
    if layout.can:
        return CanEncoder(layout).encode(sent)
    return StreamEncoder(layout).encode(sent).reshape(-1)


def decoded(layout: Layout, wire: np.ndarray, cuts: Sequence[int]) -> tuple[Records, Records]:
    """Frames and rejects of a stream or of messages in pieces; every byte or message is accounted for."""
    decoder = CanAssembler(layout) if layout.can else StreamDecoder(layout)
    parts = [message.length for message in layout.messages if message.is_part]
    size = len(parts) if layout.can else sum(parts)
    frames, rejects = [np.zeros(0, FRAME)], [np.zeros(0, REJECT)]
    for piece in np.split(wire, sorted(min(cut, len(wire)) for cut in cuts)):
        found = decoder.feed(piece)
        frames.append(found.frames)
        rejects.append(found.rejects)
    found = decoder.close()
    frames.append(found.frames)
    rejects.append(found.rejects)
    others = decoder.slow + decoder.foreign if isinstance(decoder, CanAssembler) else decoder.others
    assert decoder.pending == 0
    assert len(wire) == size * sum(map(len, frames)) + sum(int(r["length"].sum()) for r in rejects) + others
    return np.concatenate(frames), np.concatenate(rejects)


@ANY_PROFILE
@given(profiles(), SEEDS, st.lists(st.integers(0, 1000), max_size=40), st.integers(0, 40))
def test_reads_at_once_give_the_bits_of_read_by_read(
    document: dict[str, Any], seed: int, cuts: list[int], first: int
) -> None:
    layout, rng = layout_of(document), np.random.default_rng(seed)
    wire = on_the_wire(layout, samples(rng, layout, 20, first=seed % 70_000)).copy()
    if not layout.can:
        at = rng.integers(0, len(wire), 2)
        wire[at] = rng.integers(0, 256, 2)
    ends = np.array([*sorted(min(cut, len(wire)) for cut in cuts), len(wire)])
    times = np.cumsum(rng.integers(1, 10**7, len(ends)))
    singly, at_once = FrameDecoder(layout), FrameDecoder(layout)
    data = [wire[a:b] if layout.can else wire[a:b].tobytes() for a, b in pairwise([0, *ends.tolist()])]
    one = np.concatenate([singly.feed(read, int(t_ns)) for read, t_ns in zip(data, times, strict=True)])
    first = min(first, len(ends))
    cut = int(ends[first - 1]) if first else 0
    other = [
        at_once.feed_reads(wire[:cut], ends[:first], times[:first]),
        at_once.feed_reads(wire[cut:], ends[first:] - cut, times[first:]),
    ]
    assert same(np.concatenate(other), one)
    assert at_once.rejected == singly.rejected
    assert same(at_once.close(), singly.close())


def same(one: Records, other: Records) -> bool:
    """Whether records have the same bits in every column."""
    assert one.dtype.names is not None
    return len(one) == len(other) and all(one[n].tobytes() == other[n].tobytes() for n in one.dtype.names)


@ANY_PROFILE
@given(profiles(), SEEDS, CUTS)
def test_what_a_unit_of_any_profile_sends_is_decoded_to_the_same_samples(
    document: dict[str, Any], seed: int, cuts: list[int]
) -> None:
    layout = layout_of(document)
    sent = samples(np.random.default_rng(seed), layout, 60, first=seed % 300)
    frames, rejects = decoded(layout, on_the_wire(layout, sent), cuts)
    tracker = SequenceTracker(layout)
    got = np.concatenate([tracker.feed(frames[:7]), tracker.feed(frames[7:])])
    is_total = any(s.values is Values.TOTAL for s in layout.sensors if any(s.axes))
    assert rejects.size == 0
    assert tracker.counts.closes
    assert len(got) == len(sent) - is_total
    sent = sent[is_total:]
    numbering = sent["counter"] if layout.sequence.kind is SequenceKind.COUNTER else np.arange(len(sent))
    assert np.array_equal(np.diff(got["counter"]), np.diff(numbering))
    assert np.array_equal(got["interval_ns"], sent["interval_ns"])
    for name, sensor in (("gyro", layout.gyro), ("accelerometer", layout.accelerometer)):
        for axis, field in enumerate(sensor.axes):
            if field is None:
                assert np.isnan(got[name][:, axis]).all()
                continue
            # Half a count; of float64 a few bits are lost in its units, of float32 24 bits are left.
            count = sensor.per_count[axis]
            if sensor.values is Values.RATE:
                count *= layout.interval_ns * 1e-9
            assert got[name][:, axis] == pytest.approx(sent[name][:, axis], rel=1e-6, abs=0.5 * count)
    temperatures = got["temperature_degc"][:, : len(layout.temperature_names)]
    assert np.nanmax(abs(temperatures - 35.0), initial=0.0) < 1e-5
    faults = Flag.FAULT | Flag.SATURATED
    assert set((got["flags"] & ~(Flag.VALID | faults | Flag.WARM_UP)).tolist()) <= {0}
    if not document.get("status_bits"):
        assert set(got["flags"].tolist()) == {int(Flag.VALID)}


@ANY_PROFILE
@given(profiles(), SEEDS, CUTS, st.binary(max_size=40), st.booleans())
def test_damaged_input_of_any_profile_is_accounted_for_and_the_same_in_any_pieces(
    document: dict[str, Any], seed: int, cuts: list[int], noise: bytes, has_times: bool
) -> None:
    layout, rng = layout_of(document), np.random.default_rng(seed)
    wire = on_the_wire(layout, samples(rng, layout, 30, first=seed % 70_000)).copy()
    if layout.can:
        wire = damaged_messages(rng, wire)
    else:
        at = rng.integers(0, len(wire), 3)
        wire[at] = rng.integers(0, 256, 3)
        wire = np.insert(np.delete(wire, at[0] + 1), at[1] // 2, np.frombuffer(noise, np.uint8))
    frames, rejects = decoded(layout, wire, [])
    in_pieces = decoded(layout, wire, cuts)
    assert same(in_pieces[0], frames)
    assert same(in_pieces[1], rejects)
    frames["t_ns"] = 5_000_000_000 + np.arange(len(frames)) * layout.interval_ns if has_times else 0
    whole, pieces = SequenceTracker(layout), SequenceTracker(layout)
    got = np.concatenate([whole.feed(frames)])
    assert same(np.concatenate([pieces.feed(frame) for frame in np.split(frames, len(frames))] or [got]), got)
    assert whole.counts.closes
    assert whole.counts == pieces.counts
    assert whole.counts.good == len(got)
    assert min(vars(whole.counts).values()) >= 0


def damaged_messages(rng: np.random.Generator, messages: Records) -> Records:
    """Messages with some lost, doubled, interchanged, shortened or changed."""
    messages = messages[np.sort(rng.integers(0, len(messages), len(messages)))]
    messages["data"][rng.integers(0, len(messages), 2), rng.integers(0, 8, 2)] ^= 1
    messages["length"][rng.integers(0, len(messages))] = rng.integers(0, 65)
    one, other = rng.integers(0, len(messages), 2)
    messages[[one, other]] = messages[[other, one]]
    return messages


@ANY_PROFILE
@given(profiles(), st.binary(max_size=600), CUTS)
def test_any_bytes_are_accounted_for_with_any_profile(
    document: dict[str, Any], data: bytes, cuts: list[int]
) -> None:
    layout = layout_of(document)
    if layout.can:
        wire = np.zeros(len(data) // 12, MESSAGE)
        rows = np.frombuffer(data, np.uint8)[: 12 * len(wire)].reshape(-1, 12)
        wire["id"] = np.array([message.can_id for message in layout.messages])[
            rows[:, 0] % len(layout.messages)
        ]
        wire["length"], wire["t_ns"] = rows[:, 1] % 65, rows[:, 2].astype(np.int64) << 24
        wire["data"][:, :9] = rows[:, 3:]
    else:
        wire = np.frombuffer(data, np.uint8)
    frames, rejects = decoded(layout, wire, [])
    in_pieces = decoded(layout, wire, cuts)
    assert same(in_pieces[0], frames)
    assert same(in_pieces[1], rejects)
    tracker = SequenceTracker(layout)
    tracker.feed(frames)
    assert tracker.counts.closes
