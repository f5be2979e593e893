"""Numbers of a message: any type, bits, byte order, offset and sign."""

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles import load
from imudrv.records import Flag, Records
from imudrv.wire.layout import (
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
    Values,
)
from imudrv.wire.stream import StreamDecoder

RS422 = load("imu50-rs422").layout()
LENGTH = 20
AXIS = Field(GYRO, 1, 1, 0, 8)
BODIES = st.binary(min_size=LENGTH - 1, max_size=LENGTH - 1)


def unit(*fields: Field, **changes: object) -> Layout:
    """A unit whose only message has these fields."""
    message = Message(LENGTH, fields, constants=((0, 0xAA),))
    return replace(RS422, messages=(message,), **changes)


def read(layout: Layout, body: bytes) -> Records:
    (frame,) = StreamDecoder(layout).feed(b"\xaa" + body).frames
    return frame


@st.composite
def whole_numbers(draw: st.DrawFn) -> Field:
    """Any whole number of a message, as an axis of the gyros."""
    size = draw(st.integers(1, 8))
    first = draw(st.integers(0, 8 * size - 1))
    last = draw(st.integers(first, 8 * size - 1))
    if draw(st.booleans()):
        first, last = 0, 8 * size - 1
    return Field(
        GYRO + draw(st.integers(0, 2)),
        draw(st.integers(1, LENGTH - size)),
        size,
        first,
        last - first + 1,
        signed=draw(st.booleans()),
        big_endian=draw(st.booleans()),
        zero=draw(st.sampled_from([0, 0, 1, -7, 32768])),
        sign=draw(st.sampled_from([1, -1])),
    )


@given(whole_numbers(), BODIES)
def test_a_whole_number_of_any_place_width_sign_and_byte_order_is_read(field: Field, body: bytes) -> None:
    word = int.from_bytes(
        (b"\xaa" + body)[field.offset :][: field.size], "big" if field.big_endian else "little"
    )
    number = word >> field.shift & ((1 << field.bits) - 1)
    if field.signed and number >> (field.bits - 1):
        number -= 1 << field.bits
    frame = read(unit(field), body)
    expected = field.sign * (number - field.zero)
    # 64 bits hold any number, those of unsigned ones modulo 2^64.
    assert (int(frame["gyro"][field.target - GYRO]) - expected) % 2**64 == 0


@given(whole_numbers(), BODIES, st.sampled_from([SEQUENCE, STATUS, TEMPERATURE + 5]))
def test_counter_status_and_temperature_are_read_as_any_number(
    field: Field, body: bytes, target: int
) -> None:
    field = field._replace(target=target, zero=0, sign=1, signed=False)
    if target == STATUS:
        field = field._replace(bits=min(field.bits, 32))
    frame = read(unit(field, AXIS), body)
    word = int.from_bytes(
        (b"\xaa" + body)[field.offset :][: field.size], "big" if field.big_endian else "little"
    )
    number = word >> field.shift & ((1 << field.bits) - 1)
    if target == SEQUENCE:
        assert int(frame["counter"]) % 2**64 == number
    elif target == STATUS:
        assert frame["status"] == number
    elif number < 2**63:
        assert frame["temperature"][5] == np.float32(number)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["f", "d"])
@given(x=st.floats(width=32))
def test_a_floating_point_number_is_read_to_the_bit(kind: str, order: str, x: float) -> None:
    size = struct.calcsize(kind)
    field = Field(GYRO, 3, size, 0, 8 * size, is_float=True, big_endian=order == ">")
    body = (b"12" + struct.pack(order + kind, x)).ljust(LENGTH - 1, b"\0")
    number = read(unit(field), body)["gyro"][:1].view(np.float64)[0]
    assert math.isnan(number) if math.isnan(x) else number == x


def test_fields_share_a_word_bit_by_bit() -> None:
    low = Field(GYRO, 1, 4, 0, 20, signed=True)
    high = Field(STATUS, 1, 4, 20, 12)
    frame = read(
        unit(low, high), ((0xABC << 20) | (2**20 - 3)).to_bytes(4, "little").ljust(LENGTH - 1, b"\0")
    )
    assert (frame["gyro"][0], frame["status"]) == (-3, 0xABC)


def test_status_fields_follow_each_other_in_the_word() -> None:
    fields = (Field(STATUS, 1, 1, 0, 8), Field(STATUS, 5, 2, 0, 16, big_endian=True, place=8))
    frame = read(unit(*fields, AXIS), bytes([0x11, 0, 0, 0, 0x22, 0x33]).ljust(LENGTH - 1, b"\0"))
    assert frame["status"] == 0x223311


def floating(values: Values) -> Layout:
    """A unit with gyros of f32, one of them alone."""
    axis = Field(GYRO, 5, 4, 0, 32, is_float=True)
    return unit(
        axis,
        Field(SEQUENCE, 1, 4, 0, 32),
        sequence=Sequence(SequenceKind.COUNTER, 32),
        gyro=Sensor(values, in_pulses=False, axes=(axis, None, None)),
        accelerometer=Sensor(in_pulses=False),
    )


@pytest.mark.parametrize("values", Values)
@pytest.mark.parametrize("x", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_not_valid(values: Values, x: float) -> None:
    layout = floating(values)
    wire = b"".join(
        (b"\xaa" + struct.pack("<If", k, x if k == 3 else 1.0)).ljust(LENGTH, b"\0") for k in range(6)
    )
    samples = SequenceTracker(layout).feed(StreamDecoder(layout).feed(wire).frames)
    is_valid = {int(s["counter"]): bool(s["flags"] & Flag.VALID) for s in samples}
    # The difference to a total that is not finite is none either.
    bad = {3, 4} if values is Values.TOTAL else {3}
    assert is_valid == {k: k not in bad for k in is_valid}
    assert bad <= is_valid.keys()
    assert np.isnan(samples["gyro"][:, 1:]).all()
    assert np.isnan(samples["accelerometer"]).all()


def test_axes_of_different_widths_are_saturated_each_at_its_own_end() -> None:
    axes = (
        Field(GYRO, 5, 1, 0, 8, True),
        Field(GYRO + 1, 6, 2, 0, 16, True),
        Field(GYRO + 2, 8, 3, 0, 24, True),
    )
    layout = unit(
        Field(SEQUENCE, 1, 4, 0, 32), *axes, gyro=Sensor(axes=axes), accelerometer=Sensor(in_pulses=False)
    )

    def flags(x: int, y: int, z: int) -> int:
        numbers = struct.pack("<Ibh", 7, x, y) + z.to_bytes(3, "little", signed=True)
        frames = StreamDecoder(layout).feed((b"\xaa" + numbers).ljust(LENGTH, b"\0")).frames
        return int(SequenceTracker(layout).feed(frames)["flags"][0])

    assert flags(126, 32766, 2**23 - 2) == Flag.VALID
    for numbers in ((127, 0, 0), (-128, 0, 0), (0, 32767, 0), (0, 0, 2**23 - 1), (0, 0, -(2**23))):
        assert flags(*numbers) == Flag.SATURATED
    assert flags(0, 127, 32767) == Flag.VALID


def test_a_counter_of_64_bits_goes_on_beyond_half_of_its_range() -> None:
    layout = replace(floating(Values.RATE), sequence=Sequence(SequenceKind.COUNTER, 64))
    (message,) = layout.messages
    wide = (Field(GYRO, 9, 4, 0, 32, is_float=True), Field(SEQUENCE, 1, 8, 0, 64))
    layout = replace(layout, messages=(message._replace(fields=wide),))
    counters = [(2**63 - 2 + k) % 2**64 for k in (0, 1, 2, 3, 7)] + [2**63 + 6]
    wire = b"".join((b"\xaa" + struct.pack("<Qf", c, 1.0)).ljust(LENGTH, b"\0") for c in counters)
    tracker = SequenceTracker(layout)
    tracker.feed(StreamDecoder(layout).feed(wire).frames)
    assert (tracker.counts.good, tracker.counts.missing, tracker.counts.restarts) == (6, 3, 0)
