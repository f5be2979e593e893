"""The encoders: the ICD's worked frame, and everything sent comes back through the decoders."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from imudrv.errors import InputError
from imudrv.profiles import load
from imudrv.records import PULSES
from imudrv.wire.can import CanAssembler
from imudrv.wire.encode import CanEncoder, StreamEncoder
from imudrv.wire.layout import (
    GYRO,
    SEQUENCE,
    STATUS,
    TEMPERATURE,
    Check,
    CheckKind,
    Field,
    Layout,
    Message,
    Sensor,
    Sequence,
    SequenceKind,
)
from imudrv.wire.stream import StreamDecoder

RS422 = load("imu50-rs422").layout()
TOTALS = load("imu50-rs422-acc").layout()
CAN = load("imu50-can").layout()
CANFD = load("imu50-canfd").layout()


def big(target: int, offset: int, bits: int, signed: bool) -> Field:
    """A big-endian number of whole bytes."""
    return Field(target, offset, bits // 8, 0, bits, signed, big_endian=True)


GX, GY, GZ, AX, AY, AZ = (big(GYRO + axis, 4 + 3 * axis, 24, True) for axis in range(6))

# A unit of another laboratory: other widths, order, sync and check than any shipped profile has.
STRANGE = Layout(
    name="strange",
    can=False,
    fd=False,
    interval=Fraction(2_500_000),
    sequence=Sequence(SequenceKind.COUNTER, 8),
    gyro=Sensor(axes=(GX, GY, GZ)),
    accelerometer=Sensor(axes=(AX, AY, AZ)),
    messages=(
        Message(
            26,
            (
                big(SEQUENCE, 3, 8, False),
                *(GX, GY, GZ, AX, AY, AZ),
                big(TEMPERATURE, 22, 8, False),
                big(STATUS, 23, 16, False),
            ),
            constants=((0, 0xAA), (1, 0x55), (2, 0x01)),
            checks=(Check(CheckKind.SUM, 8, ((2, 25),), 25),),
        ),
    ),
    temperature_names=("gyro",),
    degc_per_count=(0.5,),
    degc_at_zero=(-40.0,),
)

# ICD, section 2.
WORKED = bytes.fromhex(
    "eb 90 50 26 40 e2 01 00 00 00 00 00 ff ff ff ff 00 00 00 00 00 00 00 00 01 00 00 00 14 00 00 00"
    "b8 0d a7 0d ad 0d a0 0d 01 00 75 69"
)


def samples(n: int = 1, first: int = 123456, limit: int = 127) -> np.ndarray:
    random = np.random.default_rng(n)
    pulses = np.zeros(n, PULSES)
    pulses["counter"] = first + np.arange(n)
    pulses["arrival_ns"] = 1_000_000 * pulses["counter"]
    for sensor in ("gyro", "accelerometer"):
        pulses[sensor] = random.integers(-limit - 1, limit + 1, (n, 3))
    pulses["temperature_degc"] = 35.0
    pulses["status"] = random.integers(0, 1 << 16, n)
    return pulses


def worked_sample() -> np.ndarray:
    pulses = samples()
    pulses["gyro"] = (0, -1, 0)
    pulses["accelerometer"] = (0, 1, 20)
    pulses["temperature_degc"][0, :4] = (35.12, 34.95, 35.01, 34.88)
    pulses["status"] = 1
    return pulses


def test_the_worked_frame_of_the_icd_is_encoded_byte_for_byte():
    (row,) = StreamEncoder(RS422).encode(worked_sample())
    assert row.tobytes() == WORKED


def test_the_can_fd_message_holds_the_worked_frames_payload_and_check():
    (message,) = CanEncoder(CANFD).encode(worked_sample())
    assert (message["id"], message["length"], message["fd"]) == (0x158, 48, 1)
    # The check covers the same bytes as on the serial line: 50 26 and the payload.
    assert message["data"].tobytes() == (WORKED[4:44] + bytes(8)).ljust(64, b"\0")


def test_classic_can_messages_are_those_of_the_icd():
    pulses = worked_sample()
    pulses["counter"] = 123_500
    messages = CanEncoder(CAN).encode(pulses)
    assert [(m["id"], m["length"], m["fd"]) for m in messages] == [(0x150 + i, 8, 0) for i in range(4)]
    assert [bytes(m["data"][:8]).hex() for m in messages] == [
        "0000ffff00006ce2",
        "0000010014006ce2",
        "b80da70dad0da00d",
        "6ce2010001000000",
    ]
    assert not messages["data"][:, 8:].any()


@pytest.mark.parametrize("layout", [RS422, STRANGE], ids=lambda layout: layout.name)
def test_what_a_stream_carries_is_decoded_to_the_same_numbers(layout):
    pulses = samples(1000, limit=layout.pulse_limit)
    frames, rejects = StreamDecoder(layout).feed(StreamEncoder(layout).encode(pulses).tobytes())
    assert rejects.size == 0
    assert np.array_equal(frames["counter"], pulses["counter"] % 2**layout.sequence.bits)
    for name in ("gyro", "accelerometer", "status"):
        assert np.array_equal(frames[name], pulses[name])
    for channel, (scale, origin) in enumerate(zip(layout.degc_per_count, layout.degc_at_zero, strict=True)):
        # Both are multiples of the resolution away from 35 degC; only the multiplication rounds.
        assert frames["temperature"][:, channel] * scale + origin == pytest.approx(35.0, abs=1e-12)


@pytest.mark.parametrize("layout", [CAN, CANFD], ids=lambda layout: layout.name)
def test_what_can_carries_is_assembled_to_the_same_numbers(layout):
    pulses = samples(1000, limit=layout.pulse_limit)
    frames, rejects = CanAssembler(layout).feed(CanEncoder(layout).encode(pulses))
    assert rejects.size == 0
    for name in ("counter", "gyro", "accelerometer"):
        assert np.array_equal(frames[name], pulses[name])
    assert np.array_equal(frames["t_ns"], pulses["arrival_ns"])


def test_totals_add_up_across_calls_and_wrap():
    pulses = samples(3000, limit=32767)
    encoder = StreamEncoder(TOTALS, totals=(1, 2, 3, 4, 5, 65535))
    rows = np.concatenate([encoder.encode(piece) for piece in np.split(pulses, [1, 7, 1000])])
    frames, rejects = StreamDecoder(TOTALS).feed(rows.tobytes())
    assert rejects.size == 0
    for name, start in (("gyro", (1, 2, 3)), ("accelerometer", (4, 5, 65535))):
        totals = np.array(start) + np.cumsum(pulses[name], axis=0)
        assert np.array_equal(frames[name], totals % 65536)


def test_a_refused_sample_does_not_change_the_totals():
    encoder = StreamEncoder(TOTALS)
    wild = samples()
    wild["gyro"] = 40_000
    with pytest.raises(InputError):
        encoder.encode(wild)
    assert np.array_equal(encoder.encode(worked_sample()), StreamEncoder(TOTALS).encode(worked_sample()))


def test_slow_messages_go_with_multiples_of_the_counter_in_any_pieces():
    pulses = samples(350)
    encoder = CanEncoder(CAN)
    messages = np.concatenate([encoder.encode(piece) for piece in np.split(pulses, [1, 44, 45, 300])])
    assert np.array_equal(messages, CanEncoder(CAN).encode(pulses))
    expected = [
        (counter * 1_000_000, 0x150 + kind)
        for counter in pulses["counter"].tolist()
        for kind in range(4 if counter % 100 == 0 else 2)
    ]
    assert messages[["t_ns", "id"]].tolist() == expected


@pytest.mark.parametrize("layout", [RS422, CAN], ids=lambda layout: layout.name)
def test_no_samples_make_no_output(layout):
    encoder = CanEncoder(layout) if layout.can else StreamEncoder(layout)
    assert len(encoder.encode(samples(0))) == 0


@pytest.mark.parametrize("value", [-(2**15) - 1, 2**15])
@pytest.mark.parametrize("layout", [TOTALS, CAN], ids=lambda layout: layout.name)
def test_pulses_that_do_not_fit_are_refused_by_axis_value_and_limit(layout, value):
    pulses = samples(3)
    pulses["accelerometer"][1, 2] = value
    encoder = CanEncoder(layout) if layout.can else StreamEncoder(layout)
    with pytest.raises(
        InputError,
        match=r"sample 123457, accelerometer z: expected -32768 to 32767, "
        rf"the 16 bits of profile {layout.name}, got {value}; use a",
    ):
        encoder.encode(pulses)


def test_a_status_that_does_not_fit_is_refused():
    pulses = samples()
    pulses["status"] = 1 << 16
    with pytest.raises(InputError, match="status: expected 0 to 65535"):
        StreamEncoder(RS422).encode(pulses)


def test_temperatures_are_rounded_and_clipped_and_unknown_ones_are_zero_counts():
    pulses = samples(6)
    pulses["temperature_degc"][:, 0] = (35.124, 35.126, 1e9, -1e9, np.nan, np.inf)
    frames, _ = StreamDecoder(RS422).feed(StreamEncoder(RS422).encode(pulses).tobytes())
    assert frames["temperature"][:, 0].tolist() == [3512, 3513, 32767, -32768, 0, 32767]


def test_a_counter_goes_out_modulo_its_width():
    pulses = samples(3, first=2**32 - 1)
    frames, _ = StreamDecoder(RS422).feed(StreamEncoder(RS422).encode(pulses).tobytes())
    assert frames["counter"].tolist() == [2**32 - 1, 0, 1]


def test_byte_order_reverses_the_bytes_of_each_number():
    (message,) = RS422.messages
    reversed_fields = tuple(field._replace(big_endian=True) for field in message.fields)
    turned = replace(RS422, messages=(message._replace(fields=reversed_fields),))
    (little,) = StreamEncoder(RS422).encode(samples())
    (big,) = StreamEncoder(turned).encode(samples())
    for field in RS422.messages[0].fields:
        span = slice(field.offset, field.offset + field.bits // 8)
        assert np.array_equal(little[span][::-1], big[span])
