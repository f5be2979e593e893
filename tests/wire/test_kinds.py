"""A sample in several messages of a byte stream: those that belong together are joined, the rest is named."""

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imudrv.files.settings_file import parse
from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles.schema import Profile
from imudrv.records import Flag, Reason
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.stream import Decoded, StreamDecoder

CHECK = {"kind": "sum", "width": 8, "covers": [[0, 4]], "offset": 5}
PARTS: list[dict[str, Any]] = [
    {
        "sync": f"AA {51 + k}",
        "length": 6,
        "fields": [{"name": name, "axis": axis, "type": "i16", "offset": 3}],
        "checks": [CHECK],
    }
    for k, (name, axis) in enumerate([("gyro", "x"), ("gyro", "y"), ("accelerometer", "x")])
]
PARTS[0]["fields"].append({"name": "counter", "type": "u8", "offset": 2})
SLOW = {
    "sync": "AA 60",
    "length": 6,
    "fields": [
        {"name": "temperature", "sensor": "gyro", "type": "i8", "offset": 2},
        {"name": "status", "type": "u16", "offset": 3},
    ],
    "checks": [CHECK],
}
SKIPPED = {"sync": "AA 70", "length": 6, "checks": [CHECK]}
LAYOUT = parse(
    {
        "format": "imu50-profile",
        "version": 2,
        "name": "several",
        "transport": "serial",
        "line": {"baudrate": 115200},
        "sample_rate_hz": 100,
        "byte_order": "little",
        "gyro": {"values": "increment", "unit": "pulse"},
        "accelerometer": {"values": "increment", "unit": "pulse"},
        "messages": [*PARTS, SLOW, SKIPPED],
    },
    Profile,
    "several",
).layout()


def message(kind: int, first: int = 0, number: int = 0) -> bytes:
    body = bytes([0xAA, kind, first]) + number.to_bytes(2, "little", signed=True)
    return body + bytes([sum(body) % 256])


def part(k: int, n: int) -> bytes:
    """Message k of sample n; its number gives both."""
    return message(0x51 + k, n % 256, 10 * n + k)


def sample(n: int) -> bytes:
    return b"".join(part(k, n) for k in range(3))


SLOW_BYTES, SKIPPED_BYTES = message(0x60, 25, 0x0102), message(0x70, 1, 2)


def decode(data: bytes, cuts: list[int] | None = None) -> tuple[Decoded, int]:
    """Everything of a stream fed in pieces, and the bytes of good messages that are no part of a sample."""
    decoder = StreamDecoder(LAYOUT)
    edges = [0, *sorted(cuts or []), len(data)]
    found = [decoder.feed(data[a:b], t_ns=7) for a, b in itertools.pairwise(edges)] + [decoder.close()]
    return Decoded(*(np.concatenate(rows) for rows in zip(*found, strict=True))), decoder.others


def test_messages_in_order_make_a_sample_of_all_their_numbers() -> None:
    found, others = decode(sample(1) + sample(2))
    assert found.frames["counter"].tolist() == [1, 2]
    assert found.frames["gyro"][:, :2].tolist() == [[10, 11], [20, 21]]
    assert found.frames["accelerometer"][:, 0].tolist() == [12, 22]
    assert found.frames["offset"].tolist() == [0, 18]
    assert (found.rejects.size, others) == (0, 0)


def test_other_messages_hold_for_the_samples_behind_them_and_unknown_ones_are_skipped() -> None:
    found, others = decode(sample(1) + SLOW_BYTES + sample(2) + SKIPPED_BYTES + sample(3))
    assert np.isnan(found.frames["temperature"][0, 0])
    assert found.frames["temperature"][1:, 0].tolist() == [25, 25]
    assert found.frames["status"].tolist() == [0, 0x0102, 0x0102]
    assert (found.rejects.size, others) == (0, 12)


TORN = {
    "one missing in the middle": (part(0, 1) + part(2, 1), [(0, 6), (6, 6)]),
    "the last one missing": (part(0, 1) + part(1, 1), [(0, 6), (6, 6)]),
    "the first one missing": (part(1, 1) + part(2, 1), [(0, 6), (6, 6)]),
    "in another order": (part(1, 1) + part(0, 1) + part(2, 1), [(0, 6), (6, 6), (12, 6)]),
    "one twice": (part(0, 1) + part(0, 1) + part(1, 1) + part(2, 1), [(0, 6)]),
    "another message between": (
        part(0, 1) + SKIPPED_BYTES + part(1, 1) + part(2, 1),
        [(0, 6), (12, 6), (18, 6)],
    ),
}


@pytest.mark.parametrize("name", TORN)
def test_a_torn_sample_is_given_up_and_its_messages_are_rejected(name: str) -> None:
    data, torn = TORN[name]
    found, _ = decode(sample(0) + data + sample(2))
    shifted = [(offset + 18, length, Reason.TORN) for offset, length in torn]
    assert found.rejects.tolist() == shifted
    is_whole = name == "one twice"
    assert found.frames["counter"].tolist() == ([0, 1, 2] if is_whole else [0, 2])
    assert found.frames["torn"][1] >= 1
    counts = SequenceTracker(LAYOUT)
    counts.feed(found.frames)
    assert (counts.counts.torn, counts.counts.good) == ((0, 3) if is_whole else (1, 2))


def test_noise_between_the_messages_of_a_sample_tears_it() -> None:
    found, _ = decode(sample(0) + part(0, 1) + b"\x00" + part(1, 1) + part(2, 1) + sample(2))
    assert found.frames["counter"].tolist() == [0, 2]
    assert sorted(found.rejects.tolist()) == [
        (18, 6, Reason.TORN),
        (24, 1, Reason.NO_SYNC),
        (25, 6, Reason.TORN),
        (31, 6, Reason.TORN),
    ]


def test_whichever_messages_are_lost_a_frame_is_of_one_sample() -> None:
    sent = [part(k, n) for n in (1, 2) for k in range(3)]
    for lost in itertools.chain.from_iterable(itertools.combinations(range(6), n) for n in range(7)):
        if lost in ((1, 2, 3), (2, 3, 4)):
            continue  # what is left is in order: without a number in each message this cannot show
        data = b"".join(m for k, m in enumerate(sent) if k not in lost)
        frames = decode(sample(0) + data + sample(3))[0].frames
        first = frames["gyro"][:, 0] // 10
        assert np.array_equal(frames["gyro"][:, 1] // 10, first)
        assert np.array_equal(frames["accelerometer"][:, 0] // 10, first)
        whole = [n for n in (1, 2) if not {3 * n - 3, 3 * n - 2, 3 * n - 1} & set(lost)]
        assert first.tolist() == [0, *whole, 3]


PIECES = st.one_of(
    st.integers(0, 5).map(sample),
    st.tuples(st.integers(0, 2), st.integers(0, 5)).map(lambda p: part(*p)),
    st.sampled_from(
        [SLOW_BYTES, SKIPPED_BYTES, b"\xaa", b"\xaa\x51", part(0, 1)[:4], part(1, 1)[:-1] + b"\0"]
    ),
    st.binary(max_size=8),
)


@given(st.lists(PIECES, max_size=14).map(b"".join), st.lists(st.integers(0, 200), max_size=8))
def test_any_pieces_of_a_stream_give_the_same_and_every_byte_is_accounted_for(
    data: bytes, cuts: list[int]
) -> None:
    whole, others = decode(data)
    pieces, pieces_others = decode(data, [min(cut, len(data)) for cut in cuts])
    for one, other in zip(whole, pieces, strict=True):
        assert all(one[name].tobytes() == other[name].tobytes() for name in one.dtype.names or ())
    assert others == pieces_others
    rejects = [(int(r["offset"]), int(r["length"])) for r in whole.rejects]
    taken = sorted([*rejects, *((int(at), 18) for at in whole.frames["offset"])])
    assert all(a + size <= b for (a, size), (b, _) in itertools.pairwise(taken))
    assert sum(size for _, size in taken) + others == len(data)


def test_the_counter_of_the_first_message_numbers_the_samples() -> None:
    decoder, tracker = FrameDecoder(LAYOUT), SequenceTracker(LAYOUT)
    numbers = [*range(250, 260), *range(263, 270)]
    samples = tracker.feed(decoder.feed(b"".join(map(sample, numbers))))
    assert np.flatnonzero(samples["flags"] & Flag.MISSING_BEFORE).tolist() == [10]
    assert samples["counter"].tolist() == numbers
    assert tracker.counts.missing == 3
