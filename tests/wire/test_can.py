"""The CAN assembler: samples from messages, whatever the bus does to them."""

import struct
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from imudrv.profiles import load
from imudrv.records import EXTENDED, FRAME, MESSAGE, PULSES, REJECT, Reason
from imudrv.wire.can import LATE, OPEN_SAMPLES, CanAssembler
from imudrv.wire.encode import CanEncoder
from imudrv.wire.layout import (
    ACCELEROMETER,
    GYRO,
    SEQUENCE,
    STATUS,
    TEMPERATURE,
    Field,
    Layout,
    Message,
    Sensor,
    Sequence,
    SequenceKind,
)

CAN = load("imu50-can").layout()
CANFD = load("imu50-canfd").layout()

# The same unit with slow messages at each third sample: a full counter is waited for 6 samples.
QUICK = replace(CAN, messages=tuple(m._replace(every=3) if m.every > 1 else m for m in CAN.messages))
HOLD = 6


def big(target: int, offset: int, bits: int, signed: bool) -> Field:
    """A big-endian number of whole bytes."""
    return Field(target, offset, bits // 8, 0, bits, signed, big_endian=True)


X, Y, Z = (big(GYRO + i, 2 * i, 16, True) for i in range(3))
A, B, C = (big(ACCELEROMETER + i, 2 * i, 16, True) for i in range(3))

# Three messages a sample, big-endian, 8-bit counter, no full counter, a constant byte, a 29-bit identifier.
STRANGE = Layout(
    name="strange",
    can=True,
    fd=False,
    interval=Fraction(2_500_000),
    sequence=Sequence(SequenceKind.COUNTER, 8),
    gyro=Sensor(axes=(X, Y, Z)),
    accelerometer=Sensor(axes=(A, B, C)),
    messages=(
        Message(8, (big(TEMPERATURE, 0, 16, True), big(STATUS, 2, 32, False)), can_id=0x10, every=10),
        Message(8, (X, Y, Z, big(SEQUENCE, 7, 8, False)), can_id=0x20),
        Message(8, (A, B, C, big(SEQUENCE, 7, 8, False)), can_id=0x30),
        Message(3, (big(SEQUENCE, 1, 8, False),), constants=((0, 0xA5),), can_id=EXTENDED | 0x18FF0001),
    ),
    temperature_names=("gyro",),
    degc_per_count=(0.01,),
    degc_at_zero=(0.0,),
)


def message(identifier: int, data: bytes, t_ns: int = 0) -> np.ndarray:
    one = np.zeros(1, MESSAGE)
    one["id"], one["length"], one["t_ns"] = identifier, len(data), t_ns
    one["data"][0, : len(data)] = list(data)
    return one


def gyro(counter: int) -> np.ndarray:
    return message(0x150, struct.pack("<3hH", 1, -2, counter % 100, counter % 65536), t_ns=1000 * counter)


def accelerometer(counter: int) -> np.ndarray:
    data = struct.pack("<3hH", -3, 4, counter % 100, counter % 65536)
    return message(0x151, data, t_ns=1000 * counter + 1)


def sample(counter: int) -> np.ndarray:
    return np.concatenate([gyro(counter), accelerometer(counter)])


def temperatures(*counts: int) -> np.ndarray:
    return message(0x152, struct.pack("<4h", *counts))


def status(counter: int, word: int = 0) -> np.ndarray:
    return message(0x153, struct.pack("<IHH", counter, word, 0))


def pulses(n: int, first: int) -> np.ndarray:
    random = np.random.default_rng(n)
    made = np.zeros(n, PULSES)
    made["counter"] = (first + np.arange(n)) % 2**32
    made["arrival_ns"] = 1_000_000 * np.arange(n)
    made["gyro"] = random.integers(-32768, 32768, (n, 3))
    made["accelerometer"] = random.integers(-32768, 32768, (n, 3))
    made["temperature_degc"] = 35.12
    made["status"] = 0x8001
    return made


def fed(assembler: CanAssembler, *pieces: np.ndarray):
    """Frames and rejects that come of feeding the pieces, one call each."""
    return joined([assembler.feed(piece) for piece in pieces])


def joined(found):
    frames = [np.zeros(0, FRAME), *(f for f, _ in found)]
    rejects = [np.zeros(0, REJECT), *(r for _, r in found)]
    return np.concatenate(frames), np.concatenate(rejects)


def same(one, other) -> bool:
    """Whether frames have the same bits in every column; NaN, a temperature that did not come, among them."""
    return all(one[name].tobytes() == other[name].tobytes() for name in FRAME.names)


def counters(frames) -> list[int]:
    return frames["counter"].tolist()


@pytest.mark.parametrize("layout", [CAN, CANFD, STRANGE], ids=lambda layout: layout.name)
def test_what_was_sent_is_decoded(layout):
    sent = pulses(700, first=2**32 - 350)
    frames, rejects = fed(CanAssembler(layout), *np.array_split(CanEncoder(layout).encode(sent), 11))
    assert rejects.size == 0
    assert counters(frames) == (sent["counter"] % 2**layout.sequence.bits).tolist()
    for name in ("gyro", "accelerometer"):
        assert np.array_equal(frames[name], sent[name])
    assert np.array_equal(frames["t_ns"], sent["arrival_ns"])
    assert not frames["damaged"].any()
    assert not frames["torn"].any()
    channels = len(layout.temperature_names)
    assert (frames["temperature"][-1, :channels] == 3512).all()
    assert frames["status"][-1] == 0x8001


def test_the_bytes_of_the_icd_are_read():
    frames, _ = fed(
        CanAssembler(CAN),
        message(0x150, bytes.fromhex("0000 ffff 0200 40e2")),
        message(0x151, bytes.fromhex("0000 0100 1400 40e2"), t_ns=7),
        message(0x152, bytes.fromhex("b80d a70d ad0d a00d")),
        message(0x153, bytes.fromhex("40e20100 0100 0000")),
    )
    (frame,) = frames
    assert (frame["counter"], frame["offset"], frame["t_ns"]) == (123456, 1, 7)
    assert frame["gyro"].tolist() == [0, -1, 2]
    assert frame["accelerometer"].tolist() == [0, 1, 20]


def test_temperatures_and_status_are_valid_from_their_message_on():
    frames, _ = fed(
        CanAssembler(CAN), sample(1), status(1, 5), sample(2), temperatures(1, -2, 3, 4), sample(3), sample(4)
    )
    assert np.isnan(frames["temperature"][:2]).all()
    assert frames["temperature"][2:, :4].tolist() == [[1, -2, 3, 4], [1, -2, 3, 4]]
    assert frames["status"].tolist() == [0, 5, 5, 5]


def test_samples_are_held_until_the_full_counter_arrives():
    assembler = CanAssembler(CAN)
    before, _ = fed(assembler, *(sample(c) for c in range(65530, 65540)))
    assert before.size == 0
    assert assembler.pending == 20
    frames, _ = fed(assembler, status(3 * 65536 + 3))
    # 65539 is 3 modulo 65536: the full counter belongs to the last of them.
    assert counters(frames) == list(range(2 * 65536 + 65530, 3 * 65536 + 4))
    assert frames["offset"].tolist() == list(range(1, 20, 2))
    assert (assembler.pending, assembler.counter_disagreements) == (0, 0)


def test_a_full_counter_belongs_to_the_sample_with_its_low_bits():
    assembler = CanAssembler(CAN)
    frames, _ = fed(assembler, sample(100), sample(101), sample(102), status(5 * 65536 + 100), sample(103))
    assert counters(frames) == [5 * 65536 + c for c in (100, 101, 102, 103)]


def test_a_full_counter_before_any_sample_counts():
    frames, rejects = fed(CanAssembler(CAN), status(7 * 65536 - 1), sample(65535), sample(0))
    assert counters(frames) == [7 * 65536 - 1, 7 * 65536]
    assert rejects.size == 0


def test_without_a_full_counter_samples_go_out_counted_from_the_first_ones_own():
    assembler = CanAssembler(QUICK)
    first = 65533
    held, _ = fed(assembler, *(sample(first + i) for i in range(HOLD)))
    assert held.size == 0
    released, _ = fed(assembler, sample(first + HOLD))
    assert counters(released) == list(range(first, first + HOLD + 1))
    assert counters(fed(assembler, sample(first + HOLD + 1))[0]) == [first + HOLD + 1]


def test_a_full_counter_that_disagrees_is_used_from_then_on_and_counted():
    assembler = CanAssembler(CAN)
    frames, _ = fed(assembler, sample(10), status(10), sample(11), status(4 * 65536 + 11), sample(12))
    assert counters(frames) == [10, 11, 4 * 65536 + 12]
    assert assembler.counter_disagreements == 1
    frames, _ = fed(assembler, status(4 * 65536 + 12), sample(13))
    assert counters(frames) == [4 * 65536 + 13]
    assert assembler.counter_disagreements == 1


def test_the_full_counter_wraps():
    frames, _ = fed(
        CanAssembler(CAN), sample(2**32 - 1), status(2**32 - 1), sample(2**32), status(0), sample(1)
    )
    assert counters(frames) == [2**32 - 1, 0, 1]


def test_a_torn_sample_is_a_reject_and_counted_in_the_next_frame():
    frames, rejects = fed(CanAssembler(CAN), status(0), sample(1), gyro(2), sample(3), sample(4))
    assert counters(frames) == [1, 3, 4]
    assert frames["torn"].tolist() == [0, 1, 0]
    assert rejects.tolist() == [(3, 1, Reason.TORN)]


def test_interleaved_neighbours_are_separated():
    # Four open at once, each complete in its turn.
    halves = [gyro(c) for c in range(4)] + [accelerometer(c) for c in range(4)]
    frames, rejects = fed(CanAssembler(CAN), status(0), *halves)
    assert counters(frames) == [0, 1, 2, 3]
    assert frames["gyro"][:, 2].tolist() == frames["accelerometer"][:, 2].tolist() == [0, 1, 2, 3]
    assert rejects.size == 0


def test_one_open_sample_too_many_abandons_the_first():
    halves = [gyro(c) for c in range(OPEN_SAMPLES + 1)] + [
        accelerometer(c) for c in range(1, OPEN_SAMPLES + 1)
    ]
    frames, rejects = fed(CanAssembler(CAN), status(0), *halves)
    assert counters(frames) == [1, 2, 3, 4]
    assert frames["torn"].tolist() == [1, 0, 0, 0]
    assert rejects.tolist() == [(1, 1, Reason.TORN)]


def test_a_doubled_message_is_stale_in_an_open_sample_and_in_a_complete_one():
    frames, rejects = fed(
        CanAssembler(CAN),
        status(0),
        gyro(1),
        gyro(1),
        accelerometer(1),
        accelerometer(1),
        sample(2),
        sample(1),
    )
    assert counters(frames) == [1, 2]
    assert rejects.tolist() == [(i, 1, Reason.STALE) for i in (2, 4, 7, 8)]


def test_a_message_a_little_behind_is_stale_and_one_far_behind_is_a_restart():
    newest = 100_000
    assembler = CanAssembler(CAN)
    fed(assembler, sample(newest), status(newest, 9), temperatures(1, 2, 3, 4), gyro(newest + 1))
    frames, rejects = fed(assembler, sample(newest - LATE))
    assert frames.size == 0
    assert rejects["reason"].tolist() == [Reason.STALE] * 2
    frames, rejects = fed(
        assembler, sample(newest - LATE - 1), status(newest - LATE - 1), sample(newest - LATE)
    )
    assert counters(frames) == [newest - LATE - 1, newest - LATE]
    assert rejects.tolist() == [(4, 1, Reason.TORN)]
    assert frames["torn"].tolist() == [1, 0]
    # What the unit said before its restart no longer holds.
    assert frames["status"][0] == 0
    assert np.isnan(frames["temperature"]).all()
    assert assembler.counter_disagreements == 0


def test_a_restart_releases_held_samples():
    assembler = CanAssembler(CAN)
    frames, _ = fed(assembler, sample(5000), sample(5001), gyro(0))
    assert counters(frames) == [5000, 5001]
    frames, _ = fed(assembler, accelerometer(0), status(65536))
    assert counters(frames) == [65536]


def test_a_gap_is_no_restart():
    frames, rejects = fed(CanAssembler(CAN), status(0), sample(1), sample(30_000))
    assert counters(frames) == [1, 30_000]
    assert rejects.size == 0


def test_foreign_messages_are_counted_and_make_no_item():
    assembler = CanAssembler(CAN)
    foreign = np.concatenate([message(0x7FF, b"\0" * 8), message(0x158, b"\0" * 48)])
    frames, rejects = fed(assembler, status(0), foreign, gyro(1), foreign, accelerometer(1))
    assert assembler.foreign == 4
    assert (frames["offset"].tolist(), rejects.size) == ([6], 0)


def test_a_wrong_length_is_a_reject_and_damages_the_next_frame():
    short = message(0x150, b"\0" * 7)
    frames, rejects = fed(CanAssembler(CAN), status(0), short, accelerometer(1), sample(2), sample(3))
    assert rejects.tolist() == [(1, 1, Reason.WRONG_LENGTH), (2, 1, Reason.TORN)]
    assert frames["damaged"].tolist() == [1, 0]
    assert frames["torn"].tolist() == [1, 0]


@pytest.mark.parametrize("length", [0, 64, 65, 255])
def test_no_length_reads_beyond_the_data(length):
    odd = gyro(1)
    odd["length"] = length
    _, rejects = fed(CanAssembler(CAN), odd)
    assert rejects.tolist() == [(0, 1, Reason.WRONG_LENGTH)]


def test_each_flipped_bit_of_an_fd_message_fails_its_check():
    messages = CanEncoder(CANFD).encode(pulses(2, first=5))
    bits = 8 * 40  # payload and check; the zeros behind are not covered
    damaged = np.repeat(messages[:1], bits)
    for bit in range(bits):
        damaged["data"][bit, bit // 8] ^= 1 << bit % 8
    frames, rejects = fed(CanAssembler(CANFD), damaged, messages[1:])
    assert rejects.tolist() == [(bit, 1, Reason.CHECK_FAILED) for bit in range(bits)]
    assert frames["damaged"].tolist() == [bits]


def test_a_wrong_constant_fails_the_check():
    messages = CanEncoder(STRANGE).encode(pulses(1, first=1))
    messages["data"][2, 0] ^= 1
    _, rejects = fed(CanAssembler(STRANGE), messages)
    assert rejects.tolist() == [(2, 1, Reason.CHECK_FAILED)]


def test_the_end_releases_held_samples_and_counts_open_ones_as_torn():
    assembler = CanAssembler(CAN)
    fed(assembler, sample(7), accelerometer(9), gyro(8))
    frames, rejects = assembler.close()
    assert counters(frames) == [7]
    assert rejects.tolist() == [(2, 1, Reason.TORN), (3, 1, Reason.TORN)]
    assert assembler.pending == 0
    frames, rejects = assembler.close()
    assert (frames.size, rejects.size) == (0, 0)


COUNTERS = st.one_of(st.integers(0, 12), st.integers(65530, 65540), st.integers(0, 2**17))
SMALL = st.integers(0, 8)
MESSAGES = st.one_of(
    COUNTERS.map(sample),
    COUNTERS.map(gyro),
    COUNTERS.map(accelerometer),
    SMALL.map(sample),
    SMALL.map(gyro),
    SMALL.map(accelerometer),
    COUNTERS.map(status),
    st.just(temperatures(1, 2, 3, 4)),
    st.just(message(0x20, b"")),
    st.tuples(st.sampled_from([0x150, 0x151, 0x152, 0x153]), st.binary(max_size=9)).map(
        lambda m: message(*m)
    ),
)


@settings(deadline=None, max_examples=200)
@given(st.lists(MESSAGES, max_size=25), st.lists(st.integers(0, 60), max_size=6))
def test_any_messages_in_any_pieces_give_the_same_items_and_each_is_counted_once(groups, cuts):
    messages = np.concatenate([np.zeros(0, MESSAGE), *groups])
    whole = CanAssembler(QUICK)
    frames, rejects = joined([whole.feed(messages), whole.close()])

    cut = CanAssembler(QUICK)
    found = []
    n_frames = n_rejects = fed_so_far = 0
    for piece in np.split(messages, sorted(min(c, messages.size) for c in cuts)):
        found.append(cut.feed(piece))
        fed_so_far += piece.size
        n_frames += found[-1].frames.size
        n_rejects += found[-1].rejects.size
        assert cut.messages_fed == fed_so_far
        assert fed_so_far == 2 * n_frames + n_rejects + cut.slow + cut.foreign + cut.pending
        # Bounded: open halves, and two messages a held sample.
        assert cut.pending <= OPEN_SAMPLES + 2 * HOLD
    found.append(cut.close())
    cut_frames, cut_rejects = joined(found)

    assert same(cut_frames, frames)
    assert np.array_equal(cut_rejects, rejects)
    assert messages.size == 2 * frames.size + rejects.size + whole.slow + whole.foreign
    ends = frames["offset"].tolist() + rejects["offset"].tolist()
    assert len(set(ends)) == len(ends)
    assert all(0 <= end < messages.size for end in ends)
    assert (frames["counter"] % 65536 == low_bits_of(messages, frames)).all()
    assert frames["torn"].sum() <= (rejects["reason"] == Reason.TORN).sum()
    assert set(rejects["reason"]) <= {Reason.TORN, Reason.STALE, Reason.WRONG_LENGTH}


def low_bits_of(messages, frames):
    """Counters on the wire of the messages that completed the frames."""
    return messages["data"][frames["offset"]][:, 6:8].copy().view("<u2")[:, 0]
