"""The shipped DBC against cantools: other tools read our messages as the same numbers."""

from importlib import resources

import cantools
import numpy as np
import pytest

from imudrv.profiles import load
from imudrv.records import PULSES
from imudrv.wire.encode import CanEncoder

SENSORS = ("Gyro", "AccelerometerX", "AccelerometerY", "AccelerometerZ")


@pytest.fixture(scope="module")
def database():
    with resources.as_file(resources.files("imudrv.profiles") / "imu50.dbc") as path:
        return cantools.database.load_file(path)


def extreme_samples(limit: int) -> np.ndarray:
    pulses = np.zeros(3, PULSES)
    pulses["counter"] = (2**32 - 1, 0, 123_500)  # the first is no multiple of 100
    pulses["gyro"] = [(-limit - 1, limit, 0), (1, -1, 2), (300, -300, 7)]
    pulses["accelerometer"] = [(limit, 0, -limit - 1), (-2, 1, -1), (0, 1, 20)]
    pulses["temperature_degc"][:, :4] = [
        (35.12, 34.95, 35.01, 34.88),
        (-40, 85, 0, -0.01),
        (327.67, -327.68, 1, 2),
    ]
    pulses["status"] = (0, 0x8401, 0xFFFF)
    return pulses


def decoded(database, messages):
    for message in messages:
        data = bytes(message["data"][: message["length"]])
        yield int(message["id"]), database.decode_message(int(message["id"]), data)


def vector(values, name):
    return [values[name + axis] for axis in "XYZ"]


def assert_temperatures(values, sample):
    # cantools multiplies counts by 0.01 in floating point: a few units in the last place of 328.
    assert [values[f"Temperature{s}"] for s in SENSORS] == pytest.approx(
        sample["temperature_degc"][:4].tolist(), abs=1e-12
    )


def test_the_lengths_and_kinds_of_frame_are_those_of_the_profiles(database):
    for name in ("imu50-can", "imu50-canfd"):
        layout = load(name).layout()
        for kind in layout.messages:
            message = database.get_message_by_frame_id(kind.can_id)
            assert (message.length, message.is_fd) == (kind.length, layout.fd)
            assert message.cycle_time == kind.every * layout.interval_ns // 1_000_000
    assert len(database.messages) == 5


def test_every_field_of_the_profiles_has_its_signal(database):
    for name in ("imu50-can", "imu50-canfd"):
        for kind in load(name).layout().messages:
            message = database.get_message_by_frame_id(kind.can_id)
            signals = {(s.start, s.length, s.is_signed) for s in message.signals if s.name != "Check"}
            assert signals == {(8 * f.offset, f.bits, f.signed) for f in kind.fields}
            for signal in message.signals:
                lowest = -(1 << (signal.length - 1)) if signal.is_signed else 0
                limits = (lowest * signal.scale, (lowest + (1 << signal.length) - 1) * signal.scale)
                assert (signal.minimum, signal.maximum) == pytest.approx(limits, rel=1e-12)
                assert signal.byte_order == "little_endian"


def test_classic_messages_read_as_what_was_sent(database):
    pulses = extreme_samples(32767)
    read = list(decoded(database, CanEncoder(load("imu50-can").layout()).encode(pulses)))
    kinds = [0x150, 0x151] + [0x150, 0x151, 0x152, 0x153] * 2
    assert [identifier for identifier, _ in read] == kinds
    rows = [0, 0, 1, 1, 1, 1, 2, 2, 2, 2]
    for (identifier, values), row in zip(read, rows, strict=True):
        sample = pulses[row]
        if identifier == 0x150:
            assert vector(values, "Gyro") == sample["gyro"].tolist()
            assert values["CounterLow"] == sample["counter"] % 65536
        elif identifier == 0x151:
            assert vector(values, "Accelerometer") == sample["accelerometer"].tolist()
            assert values["CounterLow"] == sample["counter"] % 65536
        elif identifier == 0x152:
            assert_temperatures(values, sample)
        else:
            assert values == {"Counter": sample["counter"], "Status": sample["status"]}


def test_fd_messages_read_as_what_was_sent(database):
    pulses = extreme_samples(2**31 - 1)
    messages = CanEncoder(load("imu50-canfd").layout()).encode(pulses)
    for sample, message, (_, values) in zip(pulses, messages, decoded(database, messages), strict=True):
        assert values["Counter"] == sample["counter"]
        assert vector(values, "Gyro") == sample["gyro"].tolist()
        assert vector(values, "Accelerometer") == sample["accelerometer"].tolist()
        assert_temperatures(values, sample)
        assert values["Status"] == sample["status"]
        assert values["Check"] == int.from_bytes(message["data"][38:40].tobytes(), "little")
