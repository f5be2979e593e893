"""Each fault of a profile file is reported with its place, what was expected and what came."""

import copy
from typing import Any

import pytest

from imudrv.errors import FaultyFileError
from imudrv.files.settings_file import parse
from imudrv.profiles.schema import Profile

ABSENT = object()

SERIAL: dict[str, Any] = {
    "format": "imu50-profile",
    "version": 2,
    "name": "unit",
    "transport": "serial",
    "line": {"baudrate": 921600},
    "sample_rate_hz": 200,
    "byte_order": "little",
    "gyro": {"values": "rate", "unit": "deg/s", "per_count": 0.01},
    "messages": [
        {
            "sync": "AA 55",
            "length": 20,
            "fields": [
                {"name": "gyro", "axis": "x", "type": "i16", "offset": 2},
                {"name": "counter", "type": "u8", "offset": 4},
                {"name": "status", "type": "u16", "offset": 5},
                {"name": "temperature", "sensor": "gyro", "type": "i16", "offset": 7},
            ],
            "checks": [{"kind": "sum", "width": 16, "covers": [[0, 15]], "offset": 18}],
        }
    ],
    "status_bits": [{"bit": 3, "name": "overheated", "means": "fault"}],
}
TIMED: dict[str, Any] = copy.deepcopy(SERIAL)
TIMED["messages"][0]["fields"][1] = {"name": "time", "type": "u32", "offset": 9, "unit": "us"}
CAN: dict[str, Any] = SERIAL | {
    "transport": "can",
    "line": {"bitrate": 1_000_000},
    "messages": [
        {"id": 0x150, "length": 8, "fields": [{"name": "gyro", "axis": "x", "type": "i16", "offset": 2}]},
        {"id": 0x151, "length": 8, "fields": [{"name": "status", "type": "u16", "offset": 5}], "every": 5},
    ],
}
PULSES: dict[str, Any] = SERIAL | {
    "gyro": {"values": "increment", "unit": "pulse"},
    "nominal": {"gyro_arcsec_per_pulse": 1.0},
}
FIELD = "messages.0.fields.0"
COUNTER = "messages.0.fields.1"
STATUS = "messages.0.fields.2"
TEMPERATURE = "messages.0.fields.3"
CHECK = "messages.0.checks.0"


def changed(document: dict[str, Any], place: str, value: object) -> dict[str, Any]:
    """A copy with another value at a place; with ABSENT without it."""
    document = copy.deepcopy(document)
    here: Any = document
    *way, last = [int(step) if step.isdigit() else step for step in place.split(".")]
    for step in way:
        here = here[step]
    if value is ABSENT:
        del here[last]
    else:
        here[last] = value
    return document


@pytest.mark.parametrize("document", [SERIAL, TIMED, CAN, PULSES])
def test_the_profiles_of_these_tests_have_no_fault(document: dict[str, Any]) -> None:
    parse(document, Profile, "unit.yaml").layout()


X2 = {"name": "gyro", "axis": "x", "type": "i16", "offset": 12}
SPLIT = {"type": "u8", "offset": 11, "equals": 1}
CRC = {"kind": "crc", "width": 16, "covers": [[0, 15]], "offset": 18, "polynomial": 0x1021}
FLETCHER = {"kind": "fletcher", "width": 16, "covers": [[0, 15]], "offset": 18}
FAULTS: list[tuple[dict[str, Any], str, object, str]] = [
    # names and values, with the nearest
    (SERIAL, "gyro.units", "deg/s", "gyro.units: unknown key; did you mean unit?"),
    (SERIAL, f"{CHECK}.modul", 255, "messages[0].checks[0].modul: unknown key; did you mean modulo?"),
    (
        SERIAL,
        f"{FIELD}.colour",
        2,
        "messages[0].fields[0].colour: unknown key; known are axis, bits, byte_order, ",
    ),
    (SERIAL, "gyro.unit", "deg/sec", "got text 'deg/sec'; write deg/s"),
    (SERIAL, "gyro.unit", "furlong", "got text 'furlong'"),
    (SERIAL, f"{FIELD}.type", "int16", "got text 'int16'; write i16"),
    (SERIAL, f"{CHECK}.kind", "fletcher16", "got text 'fletcher16'; did you mean fletcher?"),
    (SERIAL, f"{FIELD}.name", "gyros", "got text 'gyros'; did you mean gyro?"),
    (
        SERIAL,
        "gyro.values",
        "totals",
        "expected 'increment', 'total' or 'rate', got text 'totals'; did you mean total?",
    ),
    # fields
    (SERIAL, f"{FIELD}.axis", ABSENT, "messages[0].fields[0]: expected 'axis' with gyro and accelerometer"),
    (SERIAL, f"{COUNTER}.axis", "x", "messages[0].fields[1]: expected 'axis' with gyro and accelerometer"),
    (SERIAL, f"{TEMPERATURE}.sensor", ABSENT, "fields[3]: expected 'sensor' with temperature"),
    (SERIAL, f"{FIELD}.unit", "ms", "fields[0]: expected 'unit' with time, and with no other field"),
    (TIMED, f"{COUNTER}.unit", ABSENT, "fields[1]: expected 'unit' with time"),
    (SERIAL, f"{FIELD}.step", 2, "fields[0]: expected 'step' with counter or time only"),
    (SERIAL, f"{COUNTER}.per_count", 2.0, "fields[1]: expected 'per_count' with gyro and accelerometer only"),
    (SERIAL, f"{COUNTER}.zero", 2, "fields[1]: expected 'zero' and 'sign' with gyro and accelerometer only"),
    (SERIAL, f"{COUNTER}.sign", -1, "fields[1]: expected 'zero' and 'sign' with gyro and accelerometer only"),
    (
        SERIAL,
        f"{FIELD}.only_while",
        SPLIT,
        "fields[0]: expected 'only_while' with temperature and status only",
    ),
    (SERIAL, f"{TEMPERATURE}.only_while", SPLIT | {"type": "i8"}, "expected an unsigned type, got i8"),
    (
        SERIAL,
        f"{TEMPERATURE}.only_while",
        SPLIT | {"bits": [3, 8]},
        "expected bits: [first, last] from 0 to 7 of u8",
    ),
    (SERIAL, f"{COUNTER}.type", "f32", "fields[1]: expected a whole number for counter, got f32"),
    (SERIAL, f"{COUNTER}.type", "i8", "fields[1]: expected an unsigned type for counter, got i8"),
    (SERIAL, f"{COUNTER}.step", 1.5, "fields[1]: expected a whole number as the step of a counter, got 1.5"),
    (
        SERIAL,
        FIELD,
        X2 | {"type": "f32", "bits": [0, 7]},
        "fields[0]: expected 'bits' of a whole number, got f32",
    ),
    (SERIAL, f"{FIELD}.bits", [3, 16], "expected bits: [first, last] from 0 to 15 of i16, got [3, 16]"),
    (SERIAL, f"{FIELD}.bits", [5, 4], "expected bits: [first, last] from 0 to 15 of i16, got [5, 4]"),
    # checks
    (SERIAL, f"{CHECK}.covers", [[5, 4]], "with first <= last, got 5 > 4"),
    (SERIAL, f"{CHECK}.covers", [[0, 18]], "expected a check outside of the bytes it covers, got one inside"),
    (SERIAL, f"{CHECK}.covers", [[0, 15]] * 5, "covers: expected at most 4"),
    (SERIAL, CHECK, CRC | {"covers": [[0, 25]], "offset": 16}, "got one inside"),
    (SERIAL, CHECK, CRC | {"covers": [[0, 1]], "polynomial": 0}, "expected the CRC's polynomial, got none"),
    (
        SERIAL,
        f"{CHECK}.polynomial",
        7,
        "expected 'polynomial' and 'reflected' with a crc only, got one with sum",
    ),
    (
        SERIAL,
        CHECK,
        CRC | {"word": 2},
        "expected 'word' and 'modulo' with sum or fletcher only, got one with crc",
    ),
    (SERIAL, CHECK, CRC | {"init": 0x10000}, "expected polynomial, init and xor_out of 16 bits, got more"),
    (
        SERIAL,
        CHECK,
        FLETCHER | {"width": 24},
        "expected a fletcher check of width 16 over bytes, or of width 32",
    ),
    (SERIAL, CHECK, FLETCHER | {"init": 1}, "expected a fletcher check without 'init' and 'complement'"),
    (SERIAL, CHECK, FLETCHER | {"kind": "xor"}, "expected an xor of bytes, width 8, got 16"),
    (
        SERIAL,
        CHECK,
        {"kind": "sum", "width": 16, "word": 2, "covers": [[0, 14]], "offset": 18},
        "expected whole 16-bit words, got 15 bytes from 0 to 14",
    ),
    (
        SERIAL,
        CHECK,
        {"kind": "sum", "width": 16, "word": 2, "covers": [[0, 15]], "offset": 18, "prefix": "AA"},
        "expected a prefix of at most 32 bytes, whole words, got 1 bytes",
    ),
    (
        SERIAL,
        f"{CHECK}.suffix",
        "AA" * 40,
        "expected a suffix of at most 32 bytes, whole words, got 40 bytes",
    ),
    # messages
    (SERIAL, f"{CHECK}.covers", [[0, 15], [20, 20]], "expected a check of bytes 0..19, got one up to 20"),
    (SERIAL, f"{FIELD}.offset", 1, "expected fields apart, got gyro.x at offset 1 inside sync"),
    (SERIAL, f"{FIELD}.offset", 6, "expected fields apart, got gyro.x at offset 6 inside status"),
    (SERIAL, f"{FIELD}.offset", 5, "expected fields apart, got status at offset 5 inside another field"),
    (SERIAL, f"{FIELD}.offset", 19, "expected fields apart, got gyro.x at offset 19 inside check"),
    (SERIAL, "messages.0.length", 19, "expected all within 19 bytes, got check ending at 20"),
    (
        SERIAL,
        "messages.0.fields",
        [
            X2 | {"bits": [0, 9], "byte_order": "big"},
            {"name": "counter", "type": "u16", "offset": 12, "bits": [10, 15]},
        ],
        "expected one byte order of the fields at offset 12, got two",
    ),
    (
        SERIAL,
        "messages",
        SERIAL["messages"] * 2,
        "messages[1]: expected another sync or constants than messages[0]",
    ),
    (CAN, "messages.1.id", 0x150, "messages[1]: expected another id or constants than messages[0] has"),
    # transport
    (SERIAL, "line", {"bitrate": 1_000_000}, "line: expected baudrate for a serial profile"),
    (CAN, "line", {"baudrate": 921600}, "line: expected bitrate for a CAN profile"),
    (SERIAL, "messages.0.sync", ABSENT, "messages[0].sync: expected the bytes that a message begins with"),
    (
        SERIAL,
        "messages.0.id",
        3,
        "messages[0]: expected no 'id', 'pgn', 'source' or 'extended' in a serial profile",
    ),
    (SERIAL, "messages.0.every", 2, "messages[0].every: expected none in a serial profile"),
    (CAN, "messages.0.id", ABSENT, "messages[0]: expected 'id', a CAN identifier, or 'pgn'"),
    (CAN, "messages.0.pgn", 0xFF00, "messages[0]: expected 'id', a CAN identifier, or 'pgn'"),
    (CAN, "messages.0.source", 3, "messages[0].source: expected with 'pgn' only; it is part of 'id'"),
    (
        CAN,
        "messages.0",
        CAN["messages"][0] | {"id": None, "pgn": 0xEF01},
        "expected 00 as the low byte of a group below F000, got EF01",
    ),
    (
        CAN,
        "messages.0",
        CAN["messages"][0] | {"id": 0x1234, "extended": True},
        "messages[0].extended: expected with an 'id' up to 0x7FF only",
    ),
    (CAN, "messages.0.sync", "AA", "messages[0].sync: expected none in a CAN profile"),
    (CAN, "messages.0.length", 12, "messages[0].length: expected a CAN data length up to 8, got 12"),
    # sensors
    (SERIAL, "gyro", ABSENT, "gyro, accelerometer: expected an entry of at least one of them"),
    (SERIAL, "gyro", ABSENT, "gyro: expected an entry that says what the numbers of its fields are"),
    (
        SERIAL,
        "accelerometer",
        {"values": "rate", "unit": "g"},
        "accelerometer: expected fields of it, or no entry",
    ),
    (CAN, "messages.0.every", 3, "gyro: expected all its fields in messages of every sample"),
    (SERIAL, TEMPERATURE, X2, "gyro: expected each axis once, got x, x"),
    (SERIAL, "gyro.unit", "deg", "gyro.unit: expected rad/s or deg/s or deg/h for values: rate, got deg"),
    (SERIAL, "gyro.unit", "g", "gyro.unit: expected rad/s or deg/s or deg/h for values: rate, got g"),
    (PULSES, f"{FIELD}.per_count", 2.0, "gyro: expected pulses as whole numbers without 'per_count'"),
    (SERIAL, f"{FIELD}.type", "u16", "gyro.x: expected a signed type for values: rate, got u16; "),
    (
        SERIAL,
        "nominal",
        {"gyro_arcsec_per_pulse": 1.0},
        "nominal: expected a scale of the gyro only where it sends pulses",
    ),
    # sequence
    (SERIAL, TEMPERATURE, TIMED["messages"][0]["fields"][1], "counter, time: expected one of them"),
    (
        SERIAL,
        TEMPERATURE,
        {"name": "counter", "type": "u8", "offset": 9},
        "messages[0]: expected at most one counter or time, got more",
    ),
    (
        CAN,
        "messages.1.fields.0",
        {"name": "counter", "type": "u8", "offset": 5},
        "counter: expected it in a message of every sample",
    ),
    (SERIAL, f"{COUNTER}.step", 256, "counter.step: expected less than 256, for it has 8 bits, got 256"),
    (
        TIMED,
        f"{COUNTER}.step",
        1000,
        "time.step: expected 5000 us for 200 samples/s, got 1000; change one of them",
    ),
    (
        changed(TIMED, "sample_rate_hz", 819.2),
        f"{COUNTER}.unit",
        "ms",
        "time.unit: expected a unit of which a sample takes 2 or more (or 1), got 1.2207 ms",
    ),
    # status, temperatures, rate
    (
        SERIAL,
        STATUS,
        {"name": "status", "type": "u40", "offset": 9},
        "status: expected at most 32 bits in all, got 40; take those of use",
    ),
    (
        SERIAL,
        "status_bits.0.bit",
        16,
        "status_bits: expected bits below 16, the width of the status fields, got 16",
    ),
    (SERIAL, "status_bits", SERIAL["status_bits"] * 2, "status_bits: expected each bit once, got one twice"),
    (
        SERIAL,
        STATUS,
        {"name": "temperature", "sensor": "gyro", "type": "i16", "offset": 12},
        "temperature: expected up to 6, each sensor once, got ['gyro', 'gyro']",
    ),
    (SERIAL, "sample_rate_hz", 0.5, "sample_rate_hz: expected at least 1"),
    (SERIAL, "sample_rate_hz", [1, 2], "sample_rate_hz: expected 1 to 100000, got 0.5"),
]


@pytest.mark.parametrize(("document", "place", "value", "said"), FAULTS)
def test_a_fault_is_reported_with_its_place_and_what_was_expected(
    document: dict[str, Any], place: str, value: object, said: str
) -> None:
    with pytest.raises(FaultyFileError) as caught:
        parse(changed(document, place, value), Profile, "unit.yaml")
    assert any(said in fault for fault in caught.value.faults), caught.value.faults
