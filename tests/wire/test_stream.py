"""The stream decoder: finds every good frame, whatever is between, and accounts for every byte."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles import load
from imudrv.records import Reason
from imudrv.sim.faults import Kind, StreamFaults
from imudrv.sim.scenario import Faults, StreamRates
from imudrv.wire.stream import Decoded, StreamDecoder

RS422 = load("imu50-rs422").layout()
LENGTH = 44
HEADER = bytes.fromhex("eb 90 50 26")

# ICD, section 2: counter 123456, gyro (0, -1, 0), accelerometer (0, 1, 20), 35.12 34.95 35.01 34.88 degC.
WORKED = bytes.fromhex(
    "eb 90 50 26 40 e2 01 00 00 00 00 00 ff ff ff ff 00 00 00 00 00 00 00 00 01 00 00 00 14 00 00 00"
    "b8 0d a7 0d ad 0d a0 0d 01 00 75 69"
)
DAMAGED = WORKED[:30] + b"\xff" + WORKED[31:]

NO_SYNC, CHECK_FAILED, UNFINISHED = Reason.NO_SYNC, Reason.CHECK_FAILED, Reason.UNFINISHED

# Bytes; offsets of the good frames; rejects as (offset, length, reason), those of `close` too.
TABLE = {
    "nothing": (b"", [], []),
    "one frame": (WORKED, [0], []),
    "two frames": (WORKED + WORKED, [0, 44], []),
    "noise before": (b"\x00\x01\x02" + WORKED, [3], [(0, 3, NO_SYNC)]),
    "noise between": (WORKED + b"\xeb\xeb" + WORKED, [0, 46], [(44, 2, NO_SYNC)]),
    "noise behind": (WORKED + b"\x90\x50", [0], [(44, 2, NO_SYNC)]),
    "a frame that begins": (WORKED + HEADER + b"\x01", [0], [(44, 5, UNFINISHED)]),
    "half a sync": (WORKED + b"\xeb", [0], [(44, 1, UNFINISHED)]),
    "a damaged frame": (DAMAGED + WORKED, [44], [(0, 44, CHECK_FAILED)]),
    "two damaged frames": (DAMAGED * 2 + WORKED, [88], [(0, 44, CHECK_FAILED), (44, 44, CHECK_FAILED)]),
    "a false header before a frame": (HEADER + WORKED, [4], [(0, 4, CHECK_FAILED)]),
    "noise, then a false header": (b"\x00" + HEADER + WORKED, [5], [(0, 1, NO_SYNC), (1, 4, CHECK_FAILED)]),
    "a frame inside a damaged one": (WORKED[:20] + WORKED, [20], [(0, 20, CHECK_FAILED)]),
    "a foreign id": (b"\xeb\x90\x51\x26" + WORKED[4:], [], [(0, 44, NO_SYNC)]),
    "a foreign length": (b"\xeb\x90\x50\x27" + WORKED[4:], [], [(0, 44, NO_SYNC)]),
}


def decode(data: bytes, cuts: list[int] | None = None, close: bool = True) -> Decoded:
    """Everything of a stream fed in pieces."""
    decoder = StreamDecoder(RS422)
    edges = [0, *sorted(cuts or []), len(data)]
    pieces = [decoder.feed(data[a:b]) for a, b in itertools.pairwise(edges)]
    if close:
        pieces.append(decoder.close())
    frames = np.concatenate([p.frames for p in pieces])
    return Decoded(frames, np.concatenate([p.rejects for p in pieces]))


def same(a: Decoded, b: Decoded) -> bool:
    return np.array_equal(a.frames, b.frames) and np.array_equal(a.rejects, b.rejects)


def test_the_worked_frame_of_the_icd_decodes():
    (frame,) = decode(WORKED).frames
    assert frame["counter"] == 123456
    assert frame["gyro"].tolist() == [0, -1, 0]
    assert frame["accelerometer"].tolist() == [0, 1, 20]
    assert frame["temperature"].tolist()[:4] == [3512, 3495, 3501, 3488]
    assert frame["status"] == 1
    assert frame["damaged"] == 0


# An open end continues with the bytes after it.
CLOSED = [name for name, (data, _, bad) in TABLE.items() if not bad or sum(bad[-1][:2]) < len(data)]


def assert_found(found, offsets, rejects, shift=0):
    assert (found.frames["offset"] - shift).tolist() == offsets
    assert [(r["offset"] - shift, r["length"], r["reason"]) for r in found.rejects] == rejects


@pytest.mark.parametrize("name", TABLE)
def test_bytes_give_these_frames_and_rejects_whole_and_byte_by_byte(name):
    data, offsets, rejects = TABLE[name]
    assert_found(decode(data), offsets, rejects)
    assert_found(decode(data, list(range(len(data)))), offsets, rejects)


@pytest.mark.parametrize("name", CLOSED)
def test_bytes_between_other_frames_give_the_same(name):
    data, offsets, rejects = TABLE[name]
    found = decode(WORKED + data + WORKED + HEADER)
    tail = (len(data) + LENGTH, len(HEADER), UNFINISHED)
    assert_found(found, [-LENGTH, *offsets, len(data)], [*rejects, tail], shift=LENGTH)


def test_a_frame_carries_the_time_of_the_bytes_that_completed_it():
    decoder = StreamDecoder(RS422)
    decoder.feed(WORKED[:20], 1)
    assert decoder.feed(WORKED[20:] + WORKED + WORKED[:1], 2).frames["t_ns"].tolist() == [2, 2]
    assert decoder.feed(WORKED[1:], 3).frames["t_ns"].tolist() == [3]


def test_reads_at_once_have_the_time_of_the_read_that_completed_each_frame():
    decoder = StreamDecoder(RS422)
    data = np.frombuffer(b"\x00" + WORKED * 3 + WORKED[:10], np.uint8)
    ends, times = np.array([20, 44, 44, 45, 133, 143]), np.array([1, 2, 3, 4, 5, 6])
    assert decoder.feed_reads(data, ends, times).frames["t_ns"].tolist() == [4, 5, 5]
    more = np.frombuffer(WORKED[10:], np.uint8)
    assert decoder.feed_reads(more, np.array([34]), np.array([7])).frames["t_ns"].tolist() == [7]


def test_reads_whose_ends_are_not_those_of_the_data_are_refused():
    with pytest.raises(ValueError, match="the last end 44"):
        StreamDecoder(RS422).feed_reads(np.frombuffer(WORKED, np.uint8), np.array([43]), np.array([1]))


def test_more_rejects_than_fit_in_one_scan_end_a_read_at_its_end_too():
    data = np.frombuffer(DAMAGED * 3000 + WORKED, np.uint8)
    ends = np.arange(1, 3002) * LENGTH
    found = StreamDecoder(RS422).feed_reads(data, ends, ends)
    assert found.rejects["offset"].tolist() == list(range(0, 3000 * LENGTH, LENGTH))
    assert found.frames["t_ns"].tolist() == [3001 * LENGTH]


def test_a_frame_has_the_number_of_frame_lengths_rejected_before_it():
    data = WORKED + DAMAGED + DAMAGED[:30] + WORKED + WORKED + b"\x00" + WORKED
    assert decode(data).frames["damaged"].tolist() == [0, 2, 0, 1]


def test_more_rejects_than_fit_in_one_scan_are_all_returned():
    found = decode(DAMAGED * 3000 + WORKED)
    assert found.rejects["offset"].tolist() == list(range(0, 3000 * LENGTH, LENGTH))
    assert found.frames["damaged"].tolist() == [3000]


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_a_reference_capture_decodes_to_every_frame_and_its_counts_add_up(reference, axis):
    data = (reference / f"{axis}_up.raw").read_bytes()
    found = decode(data)
    assert len(found.frames) == 74_500
    assert len(found.rejects) == 0
    tracker = SequenceTracker(RS422)
    pulses = tracker.feed(found.frames)
    counts = tracker.counts
    assert (counts.good, counts.expected, counts.frames, counts.lost) == (74_500, 74_500, 74_500, 0)
    assert counts.closes
    assert np.all(np.diff(pulses["counter"]) == 1)
    assert np.all(np.diff(pulses["elapsed_ns"]) == 1_000_000)


def test_the_reference_capture_with_x_up_contains_a_wrap_of_the_counter(reference):
    counters = decode((reference / "x_up.raw").read_bytes()).frames["counter"]
    (wrap,) = np.flatnonzero(np.diff(counters) != 1)
    assert (counters[wrap], counters[wrap + 1]) == (2**32 - 1, 0)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_damage_loses_exactly_the_damaged_frames_in_any_chunks(reference, axis):
    raw = (reference / f"{axis}_up.raw").read_bytes()
    frames = np.frombuffer(raw, np.uint8).reshape(-1, LENGTH)
    kinds = StreamRates.model_fields
    line = StreamFaults(
        Faults(stream=StreamRates(**dict.fromkeys(kinds, 0.02 / len(kinds)))), [(LENGTH, HEADER)], seed=11
    )
    data, damage = line.apply(frames, np.arange(len(frames)))
    # Losses are counted between the first and the last frame: no counter shows those outside.
    assert not damage.hit[[0, -1]].any()
    assert len(np.unique(damage.kind)) == len(kinds) + 1
    copies = np.where(damage.hit, 0, np.where(damage.kind == Kind.DOUBLED, 2, 1))
    expected = np.repeat(decode(raw).frames["counter"], copies)

    whole = decode(data)
    assert np.array_equal(whole.frames["counter"], expected)
    tracker = SequenceTracker(RS422)
    tracker.feed(whole.frames)
    counts = tracker.counts
    assert counts.closes
    assert counts.good == len(frames) - damage.hit.sum()
    assert counts.missing + counts.damaged == damage.hit.sum()
    assert counts.duplicate == np.count_nonzero(damage.kind == Kind.DOUBLED)

    random = np.random.default_rng(12)
    for _ in range(50 if axis == "x" else 5):
        cuts = random.integers(0, len(data), random.integers(1, 200)).tolist()
        assert same(decode(data, cuts), whole)


# Good frames, damaged ones, what looks like a beginning, and noise, in any order.
PIECES = st.sampled_from(
    [WORKED, DAMAGED, HEADER, WORKED[:-1], WORKED[1:], b"\xeb", b"\xeb\x90"]
) | st.binary(max_size=100)


@given(st.lists(PIECES, max_size=12).map(b"".join), st.data())
def test_any_bytes_in_any_chunks_give_the_same_items_and_every_byte_is_accounted_for(data, draw):
    cuts = draw.draw(st.lists(st.integers(0, len(data)), max_size=10))
    whole = decode(data)
    assert same(decode(data, cuts), whole)

    stretches = [(f["offset"], LENGTH) for f in whole.frames] + [
        (r["offset"], r["length"]) for r in whole.rejects
    ]
    end = 0
    for offset, length in sorted(stretches):
        assert offset == end
        assert length > 0
        end = offset + length
    assert end == len(data)

    decoder = StreamDecoder(RS422)
    for a, b in itertools.pairwise([0, *sorted(cuts), len(data)]):
        decoder.feed(data[a:b])
        assert decoder.pending < LENGTH
        assert decoder.bytes_fed == b
    # Whatever came before, a good frame behind enough bytes to end any false beginning is found.
    assert len(decoder.feed(bytes(LENGTH) + WORKED).frames) >= 1


def test_what_is_kept_between_two_feeds_is_less_than_a_frame():
    decoder = StreamDecoder(RS422)
    for _ in range(100):
        decoder.feed(HEADER * 11 + b"\xeb")
        assert decoder.pending < LENGTH


def test_bytes_bytearray_memoryview_and_array_are_the_same_to_the_decoder():
    for data in (WORKED, bytearray(WORKED), memoryview(WORKED), np.frombuffer(WORKED, np.uint8)):
        assert StreamDecoder(RS422).feed(data).frames["counter"].tolist() == [123456]
