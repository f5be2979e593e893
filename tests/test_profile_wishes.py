"""Profiles that ask for what the format cannot say: place, expected, got, and the nearest thing."""

import copy
from typing import Any

import pytest

from imudrv.errors import FaultyFileError
from imudrv.files.settings_file import parse
from imudrv.profiles.schema import Profile

PROFILE: dict[str, Any] = {
    "format": "imu50-profile",
    "version": 2,
    "name": "unit",
    "transport": "serial",
    "line": {"baudrate": 921600},
    "sample_rate_hz": 1000,
    "byte_order": "little",
    "gyro": {"values": "rate", "unit": "deg/s", "per_count": 0.01},
    "accelerometer": {"values": "rate", "unit": "g", "per_count": 0.001},
    "messages": [
        {
            "sync": "AA 55",
            "length": 20,
            "constants": [],
            "fields": [
                {"name": "counter", "type": "u16", "offset": 2},
                {"name": "gyro", "axis": "x", "type": "i16", "offset": 4},
                {"name": "gyro", "axis": "y", "type": "i16", "offset": 6},
                {"name": "gyro", "axis": "z", "type": "i16", "offset": 8},
                {"name": "accelerometer", "axis": "x", "type": "i16", "offset": 10},
                {"name": "accelerometer", "axis": "y", "type": "i16", "offset": 12},
                {"name": "accelerometer", "axis": "z", "type": "i16", "offset": 14},
                {"name": "status", "type": "u16", "offset": 16},
            ],
            "checks": [{"kind": "crc", "width": 16, "polynomial": 0x1021, "covers": [[0, 17]], "offset": 18}],
        }
    ],
    "status_bits": [{"bit": 0, "name": "fault", "means": "fault"}],
}


def faults(path: str, value: object) -> tuple[str, ...]:
    """Faults of the profile with one value at a path such as ``messages.0.sync``."""
    document = copy.deepcopy(PROFILE)
    here: Any = document
    *way, last = [int(step) if step.isdigit() else step for step in path.split(".")]
    for step in way:
        here = here[step]
    here[last] = value
    with pytest.raises(FaultyFileError) as caught:
        parse(document, Profile, "unit.yaml")
    return caught.value.faults


def field(**keys: object) -> dict[str, object]:
    return {"type": "u16", "offset": 16, **keys}


MESSAGE = "messages.0"
FIELD = "messages.0.fields.1"
STATUS = "messages.0.fields.7"
CHECK = "messages.0.checks.0"
AT_FIELD = "messages[0].fields[1]"
AT_STATUS = "messages[0].fields[7]"
AT_CHECK = "messages[0].checks[0]"

WISHES = [
    # Frames
    (
        "transport",
        "ascii",
        "transport: expected 'serial' or 'can', got text 'ascii'",
        "not to text such as NMEA",
    ),
    (f"{MESSAGE}.delimiter", ",", "messages[0].delimiter: unknown key", "not to text such as NMEA"),
    (
        f"{MESSAGE}.sync",
        "$PASHR",
        "messages[0].sync: expected bytes in hexadecimal",
        "as in EB 90, got text '$PASHR'",
    ),
    (
        f"{MESSAGE}.sync",
        "0xAA55",
        "messages[0].sync: expected bytes in hexadecimal",
        "as in EB 90, got text '0xAA55'",
    ),
    (f"{MESSAGE}.sync", 0xAA55, "messages[0].sync: expected text, got 43605", "hexadecimal, as in EB 90"),
    (
        f"{MESSAGE}.length",
        "variable",
        "messages[0].length: expected a whole number, got text",
        "each length as a mess",
    ),
    (
        f"{MESSAGE}.length",
        {"offset": 2},
        "messages[0].length: expected a whole number, got a mapping",
        "'constants'",
    ),
    (
        f"{MESSAGE}.length_field",
        {},
        "messages[0].length_field: unknown key",
        "each length as a message of its own",
    ),
    ("framing", "slip", "framing: unknown key", "socket://HOST:PORT"),
    (f"{MESSAGE}.escape", "7D", "messages[0].escape: unknown key", "stuffed bytes (SLIP, COBS, DLE) cannot"),
    (
        f"{MESSAGE}.constants",
        {"2": 0x50},
        "messages[0].constants: expected a list, got a mapping",
        "[{offset: 2,",
    ),
    ("start_command", "3F", "start_command: unknown key", "set the unit to send by itself"),
    ("transport", "tcp", "transport: expected 'serial' or 'can', got text 'tcp'", "socket://HOST:PORT"),
    ("transport", "RS-422", "transport: expected 'serial' or 'can', got text 'RS-422'", "write serial"),
    (
        "transport",
        "canfd",
        "transport: expected 'serial' or 'can', got text 'canfd'",
        "data_bitrate in 'line'",
    ),
    # Quantities that are not used
    (f"{FIELD}.name", "quaternion", f"{AT_FIELD}.name: expected 'counter', 'time',", "leave it out"),
    (f"{FIELD}.name", "magnetometer", f"{AT_FIELD}.name: expected 'counter', 'time',", "leave it out"),
    ("magnetometer", {}, "magnetometer: unknown key", "leave it out"),
    (
        f"{FIELD}.axis",
        "w",
        f"{AT_FIELD}.axis: expected 'x', 'y' or 'z', got text 'w'",
        "leave other numbers out",
    ),
    (f"{FIELD}.name", "timestamp", f"{AT_FIELD}.name: expected 'counter', 'time',", "did you mean time?"),
    (f"{FIELD}.name", "packet_no", f"{AT_FIELD}.name: expected 'counter', 'time',", "did you mean counter?"),
    (
        f"{FIELD}.name",
        "accel",
        f"{AT_FIELD}.name: expected 'counter', 'time',",
        "did you mean accelerometer?",
    ),
    (f"{FIELD}.name", "gyro_x", f"{AT_FIELD}.name: expected 'counter', 'time',", "{name: gyro, axis: x}"),
    (f"{FIELD}.name", "length", f"{AT_FIELD}.name: expected 'counter', 'time',", "each length as a message"),
    # Scales and units
    ("gyro.scale", "1/65536", "gyro.scale: unknown key", "1.52587890625e-05 for 1/65536"),
    (
        "gyro.per_count",
        "1/65536",
        "gyro.per_count: expected a number, got text '1/65536'",
        "1.52587890625e-05",
    ),
    ("gyro.per_count", [1, 65536], "gyro.per_count: expected a number, got a list of 2", "1.52587890625e-05"),
    ("gyro.per_count", "2**-16", "gyro.per_count: expected a number, got text '2**-16'", "write the number"),
    ("gyro.per_count", -0.01, "gyro.per_count: expected more than 0.0, got -0.01", "sign: -1 in its field"),
    ("accelerometer.unit", "mg", "accelerometer.unit: expected 'pulse', 'rad',", "0.001 for 1 mg"),
    ("accelerometer.unit", "m/s2", "accelerometer.unit: expected 'pulse', 'rad',", "write m/s^2"),
    ("accelerometer.unit", "ft/s^2", "accelerometer.unit: expected 'pulse', 'rad',", "0.3048 for 1 ft/s"),
    ("gyro.unit", "mrad/s", "gyro.unit: expected 'pulse', 'rad',", "0.001 for 1 mrad"),
    ("gyro.unit", "dps", "gyro.unit: expected 'pulse', 'rad',", "write deg/s"),
    ("gyro.unit", "LSB", "gyro.unit: expected 'pulse', 'rad',", "unit of the vendor's table"),
    ("gyro.unit", "m/s", "gyro.unit: expected rad/s or deg/s or deg/h for values: rate", "got m/s"),
    (
        "gyro.values",
        "delta",
        "gyro.values: expected 'increment', 'total' or 'rate', got text 'delta'",
        "increment",
    ),
    ("gyro.bias", 0.1, "gyro.bias: unknown key", "calibration file"),
    ("gyro.range", 300, "gyro.range: unknown key", "status bits"),
    (
        STATUS,
        field(name="temperature", sensor="gyro", unit="degF"),
        f"{AT_STATUS}.unit: expected 's', 'ms', 'us' or 'ns', got text 'degF'",
        "degc_per_count: 0.55556, degc_at_zero: -17.778",
    ),
    (
        STATUS,
        field(name="temperature", sensor="gyro", per_count=0.01),
        f"{AT_STATUS}: expected 'per_count' with gyro and accelerometer only",
        "degc_per_count",
    ),
    (
        STATUS,
        field(name="temperature", sensor="gyro", zero=400),
        f"{AT_STATUS}: expected 'zero' and 'sign' with gyro and accelerometer only",
        "degc_at_zero",
    ),
    (
        STATUS,
        field(name="temperature", sensor="board"),
        f"{AT_STATUS}.sensor: expected 'gyro',",
        "write electronics for any other",
    ),
    # Numbers
    (f"{FIELD}.type", "u128", f"{AT_FIELD}.type: expected 'u8',", "take the 64 bits that matter"),
    (f"{FIELD}.type", "i12", f"{AT_FIELD}.type: expected 'u8',", "bits: [0, 11]"),
    (f"{FIELD}.type", "f16", f"{AT_FIELD}.type: expected 'u8',", "it cannot be described"),
    (f"{FIELD}.type", "double", f"{AT_FIELD}.type: expected 'u8',", "write f64"),
    (f"{FIELD}.type", "float", f"{AT_FIELD}.type: expected 'u8',", "write f32"),
    (f"{FIELD}.type", "int16_t", f"{AT_FIELD}.type: expected 'u8',", "write i16"),
    (f"{FIELD}.type", "i16be", f"{AT_FIELD}.type: expected 'u8',", "byte_order: little or big"),
    (f"{FIELD}.type", "u16", "gyro.x: expected a signed type for values: rate, got u16", "zero: 32768"),
    (
        f"{FIELD}.byte_order",
        "big.LITTLE",
        f"{AT_FIELD}.byte_order: expected 'little' or 'big'",
        "swapped words cannot",
    ),
    (
        "byte_order",
        "mixed",
        "byte_order: expected 'little' or 'big', got text 'mixed'",
        "in each field that differs",
    ),
    ("byte_order", "motorola", "byte_order: expected 'little' or 'big', got text 'motorola'", "write big"),
    (
        f"{FIELD}.bits",
        [10, 20],
        f"{AT_FIELD}: expected bits: [first, last] from 0 to 15 of i16, got [10, 20]",
        "holds",
    ),
    (
        f"{FIELD}.bits",
        [[0, 3], [8, 9]],
        f"{AT_FIELD}.bits[0]: expected a whole number, got a list",
        "lowest piece",
    ),
    (f"{FIELD}.bits", 7, f"{AT_FIELD}.bits: expected a list, got 7", "as in [7, 7]"),
    (f"{FIELD}.offset", 2.5, f"{AT_FIELD}.offset: expected a whole number, got 2.5", "bits: [first, last]"),
    (
        f"{FIELD}.offset",
        "0x04",
        f"{AT_FIELD}.offset: expected a whole number, got text '0x04'",
        "leave out the quotes",
    ),
    (
        f"{FIELD}.only_while",
        {"type": "u8", "offset": 3, "equals": 1},
        f"{AT_FIELD}: expected 'only_while'",
        "messages",
    ),
    # Counter and time
    (
        STATUS,
        field(name="counter"),
        "messages[0]: expected at most one counter or time, got more",
        "the lowest is eno",
    ),
    (STATUS, field(name="time", unit="us"), "counter, time: expected one of them", "leave one out"),
    (
        "messages.0.fields.0.step",
        0.5,
        "messages[0].fields[0]: expected a whole number as the step",
        "leave it out",
    ),
    (
        "messages.0.fields.0.step",
        -1,
        "messages[0].fields[0].step: expected more than 0.0, got -1",
        "goes down",
    ),
    (
        "messages.0.fields.0",
        field(name="time", unit="min"),
        "messages[0].fields[0].unit: expected 's', 'ms'",
        "finer",
    ),
    (
        "messages.0.fields.0",
        {"name": "time", "type": "u32", "offset": 0, "unit": "s"},
        "messages[0]: expected fields apart",
        "got time at offset 0 inside sync",
    ),
    # Checks
    (f"{CHECK}.width", 64, f"{AT_CHECK}.width: expected at most 32, got 64", "leave it out"),
    (
        f"{CHECK}.kind",
        "crc64",
        f"{AT_CHECK}.kind: expected 'crc', 'sum', 'xor' or 'fletcher'",
        "leave it out",
    ),
    (f"{CHECK}.kind", "md5", f"{AT_CHECK}.kind: expected 'crc', 'sum', 'xor' or 'fletcher'", "leave it out"),
    (
        f"{CHECK}.kind",
        "crc16-ccitt",
        f"{AT_CHECK}.kind: expected 'crc',",
        "width, polynomial, init, reflected",
    ),
    (f"{CHECK}.kind", "checksum", f"{AT_CHECK}.kind: expected 'crc',", "write sum"),
    (f"{CHECK}.poly", 0x1021, f"{AT_CHECK}.poly: unknown key", "polynomial"),
    (f"{CHECK}.refin", True, f"{AT_CHECK}.refin: unknown key", "reflected"),
    (f"{CHECK}.first", 0, f"{AT_CHECK}.first: unknown key", "covers: [[first, last]]"),
    (
        f"{CHECK}.polynomial",
        0x11021,
        f"{AT_CHECK}: expected polynomial, init and xor_out of 16 bits",
        "highest term",
    ),
    (f"{CHECK}.covers", [0, 17], f"{AT_CHECK}.covers[0]: expected a list, got 0", "[[2, 41]]"),
    ("messages.0.checks", None, "messages[0].checks: expected a list, got nothing", "leave the key out"),
    # Rate and line
    (
        "sample_rate_hz",
        "1 kHz",
        "sample_rate_hz: expected a number or a list, got text '1 kHz'",
        "as in 1000",
    ),
    (
        "sample_rate_hz",
        "4096/5",
        "sample_rate_hz: expected a number or a list, got text '4096/5'",
        "as in [4096, 5]",
    ),
    (
        "sample_rate_hz",
        [819.2, 1],
        "sample_rate_hz[0]: expected a whole number, got 819.2",
        "as in [4096, 5]",
    ),
    (
        "line",
        "115200 8N1",
        "line: expected a mapping (key: value), got text '115200 8N1'",
        "{baudrate: 115200, par",
    ),
    (
        "line.baudrate",
        "115200 8N1",
        "line.baudrate: expected a whole number, got text",
        "{baudrate: 115200, par",
    ),
    (
        "line.baudrate",
        "115200",
        "line.baudrate: expected a whole number, got text '115200'",
        "leave out the quotes",
    ),
    (
        "line.parity",
        "N",
        "line.parity: expected 'none', 'even', 'odd', 'mark' or 'space', got text 'N'",
        "write none",
    ),
    ("line.stopbits", 1.5, "line.stopbits: expected 1 or 2, got 1.5", "write 2"),
    # Status bits
    ("status_bits.0.means", "error", "status_bits[0].means: expected 'fault',", "write fault"),
    ("status_bits.0.means", "ok", "status_bits[0].means: expected 'fault',", "when: clear"),
    ("status_bits.0.value", 0, "status_bits[0].value: unknown key", "when: clear"),
    ("status_bits.0.when", 0, "status_bits[0].when: expected 'set' or 'clear', got 0", "write clear"),
    (
        "status_bits.0.bit",
        20,
        "status_bits: expected bits below 16, the width of the status fields",
        "got 20",
    ),
]


def test_the_profile_that_the_wishes_change_is_valid() -> None:
    parse(PROFILE, Profile, "unit.yaml")


@pytest.mark.parametrize(("path", "value", "words", "nearest"), WISHES)
def test_a_wish_is_answered_with_place_expected_got_and_the_nearest_thing(
    path: str, value: object, words: str, nearest: str
) -> None:
    (fault, *_) = (f for f in faults(path, value) if f.startswith(words))
    assert nearest in fault.removeprefix(words)
    assert fault.isprintable()


@pytest.mark.parametrize("value", [-7, "x" * 100_000, [["x"] * 1000] * 1000, {"a": {}}, True, "\x1b[0m\n"])
@pytest.mark.parametrize(
    "path", ["transport", "line", "gyro.unit", "gyro.per_count", f"{FIELD}.type", f"{CHECK}.kind"]
)
def test_any_value_has_a_short_message(path: str, value: object) -> None:
    for fault in faults(path, value):
        assert len(fault) < 400
        assert fault.isprintable()


@pytest.mark.parametrize("key", [".a" * 100_000, "x" * 100_000, "", "\x1b[0m", "length.scale"])
def test_any_unknown_key_has_a_short_message(key: str) -> None:
    with pytest.raises(FaultyFileError) as caught:
        parse(PROFILE | {key: 1}, Profile, "unit.yaml")
    (fault,) = caught.value.faults
    assert len(fault) < 400
    assert fault.isprintable()


@pytest.mark.parametrize(
    ("rate_hz", "type", "unit", "words"),
    [
        (1000, "u32", "s", "time.unit: expected a unit of which a sample takes 2 or more (or 1), got 0.001"),
        (
            [4096, 5],
            "u32",
            "ms",
            "time.unit: expected a unit of which a sample takes 2 or more (or 1), got 1.2207",
        ),
        (
            1000,
            "u16",
            "ns",
            "time: expected a number that begins anew after two samples or more, got 16 bits",
        ),
        (1000, "u8", "us", "time: expected a number that begins anew after two samples or more, got 8 bits"),
    ],
)
def test_a_time_that_cannot_number_the_samples_contradicts_the_rate(
    rate_hz: object, type: str, unit: str, words: str
) -> None:
    document = copy.deepcopy(PROFILE) | {"sample_rate_hz": rate_hz}
    message = document["messages"][0]
    message["fields"] = [{"name": "time", "type": type, "offset": 20, "unit": unit}, *message["fields"][1:]]
    message["length"] = 28
    with pytest.raises(FaultyFileError) as caught:
        parse(document, Profile, "unit.yaml")
    (fault,) = caught.value.faults
    assert fault.startswith(words)
    assert "leave the field out" in fault


@pytest.mark.parametrize(("rate_hz", "unit"), [(1000, "ms"), (400, "ms"), ([4096, 5], "us"), (1, "s")])
def test_a_time_of_few_ticks_numbers_the_samples(rate_hz: object, unit: str) -> None:
    document = copy.deepcopy(PROFILE) | {"sample_rate_hz": rate_hz}
    document["messages"][0]["fields"][0] = {"name": "time", "type": "u16", "offset": 2, "unit": unit}
    assert parse(document, Profile, "unit.yaml").layout().sequence.step > 0
