"""Profiles as data: the shipped ones against the ICD, invented ones without code, all faults at once."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from imudrv import profiles
from imudrv.errors import FaultyFileError, InputError
from imudrv.imu.sequence import SequenceTracker
from imudrv.records import PULSES, Flag, Records
from imudrv.wire.encode import StreamEncoder
from imudrv.wire.layout import Layout
from imudrv.wire.stream import StreamDecoder

WORKED_FRAME = bytes.fromhex(
    "eb905026 40e20100 00000000 ffffffff 00000000 00000000 01000000 14000000 b80d a70d ad0d a00d 0100 7569"
)


def stream_profile(**changes: object) -> dict[str, object]:
    """A small serial profile of another laboratory, to be changed."""
    document: dict[str, object] = {
        "format": "imu50-profile",
        "version": 2,
        "name": "another",
        "transport": "serial",
        "line": {"baudrate": 230400, "parity": "even"},
        "sample_rate_hz": 400,
        "byte_order": "big",
        "gyro": {"values": "increment", "unit": "pulse"},
        "accelerometer": {"values": "increment", "unit": "pulse"},
        "nominal": {"gyro_arcsec_per_pulse": 1.0, "accelerometer_pulse_per_m_s": 1000.0},
        "messages": [message(3, "i24", "u8", {"kind": "sum", "width": 16})],
    }
    return document | changes


def message(sync_bytes: int, pulse: str, counter: str, check: dict[str, object] | None) -> dict[str, object]:
    """One message: sync, counter, a gap, six pulse fields in reverse, a temperature, the check."""
    width = int(pulse[1:]) // 8
    fields: list[dict[str, object]] = [{"name": "counter", "type": counter, "offset": sync_bytes}]
    at = sync_bytes + int(counter[1:]) // 8 + 2
    for name in ("accelerometer", "gyro"):
        for axis in "zyx":
            fields.append({"name": name, "axis": axis, "type": pulse, "offset": at})
            at += width
    fields.append(
        {"name": "temperature", "sensor": "gyro", "type": "i8", "offset": at, "degc_per_count": 0.5}
    )
    at += 1
    made: dict[str, object] = {"sync": "AA 55 0D"[: 3 * sync_bytes - 1], "fields": fields}
    if check:
        size = int(str(check["width"])) // 8
        made["checks"] = [{"covers": [[0, at - 1]], "offset": at, **check}]
        at += size
    return made | {"length": at}


INVENTED = {
    "400 Hz, big-endian, 24-bit pulses, 8-bit counter, 16-bit sum": stream_profile(),
    "200 Hz, 16-bit pulses, 16-bit counter, CRC-32": stream_profile(
        sample_rate_hz=200,
        byte_order="little",
        messages=[
            message(
                1,
                "i16",
                "u16",
                {
                    "kind": "crc",
                    "width": 32,
                    "polynomial": 0x04C11DB7,
                    "init": 0xFFFFFFFF,
                    "reflected": True,
                    "xor_out": 0xFFFFFFFF,
                },
            )
        ],
    ),
    "2 kHz, totals of 32 bits, 24-bit counter, 8-bit sum": stream_profile(
        sample_rate_hz=2000,
        gyro={"values": "total", "unit": "pulse"},
        accelerometer={"values": "total", "unit": "pulse"},
        messages=[message(2, "u32", "u24", {"kind": "sum", "width": 8})],
    ),
    "100 Hz, 8-bit pulses, 32-bit counter, no check": stream_profile(
        sample_rate_hz=100, messages=[message(3, "i8", "u32", None)]
    ),
}


def written(folder: Path, document: dict[str, object]) -> str:
    path = folder / "unit.yaml"
    path.write_text(json.dumps(document))  # JSON is YAML
    return str(path)


def some_pulses(layout: Layout, count: int, first: int) -> Records:
    """Random pulses inside the widths, totals' increments inside half of theirs."""
    rng = np.random.default_rng(7)
    limit = min(layout.pulse_limit - 1, 2**20)
    pulses = np.zeros(count, PULSES)
    pulses["counter"] = first + np.arange(count)
    pulses["gyro"] = rng.integers(-limit, limit, (count, 3))
    pulses["accelerometer"] = rng.integers(-limit, limit, (count, 3))
    pulses["temperature_degc"][:, 0] = rng.integers(-100, 100, count) * 0.5
    return pulses


def test_the_worked_frame_of_the_icd_decodes_to_its_numbers() -> None:
    decoder = StreamDecoder(profiles.load("imu50-rs422").layout())
    (frame,) = decoder.feed(WORKED_FRAME).frames
    assert frame["counter"] == 123456
    assert frame["gyro"].tolist() == [0, -1, 0]
    assert frame["accelerometer"].tolist() == [0, 1, 20]
    assert frame["temperature"][:4].tolist() == [3512, 3495, 3501, 3488]
    assert frame["status"] == 1


def test_the_profiles_of_the_icd_ship_with_its_line_and_rate() -> None:
    assert set(profiles.OWN) <= set(profiles.shipped())
    lines = {name: profiles.load(name).line for name in profiles.OWN}
    assert {name: line.model_dump(exclude_none=True) for name, line in lines.items()} == {
        "imu50-rs422": {"baudrate": 921600, "bytesize": 8, "parity": "none", "stopbits": 1},
        "imu50-rs422-acc": {"baudrate": 460800, "bytesize": 8, "parity": "none", "stopbits": 1},
        "imu50-can": {"bitrate": 1_000_000},
        "imu50-canfd": {"bitrate": 1_000_000, "data_bitrate": 5_000_000},
    }
    assert {profiles.load(name).layout().interval_ns for name in lines} == {1_000_000}


@pytest.mark.parametrize("document", INVENTED.values(), ids=INVENTED.keys())
def test_an_invented_profile_works_by_path_without_code(document: dict[str, object], tmp_path: Path) -> None:
    layout = profiles.load(written(tmp_path, document)).layout()
    span = 1 << layout.sequence.bits
    sent = some_pulses(layout, 3000, first=span - 1000)  # across the counter's wrap
    wire = StreamEncoder(layout).encode(sent).tobytes()
    decoder, tracker = StreamDecoder(layout), SequenceTracker(layout)
    noise = b"\xaa\x55\x00\x0d"
    found = [
        tracker.feed(decoder.feed(piece).frames) for piece in (noise + wire[:1111], wire[1111:], b"tail")
    ]
    got = np.concatenate(found)
    lost = 1 if layout.totals else 0  # the first total only gives the starting point
    for name in ("gyro", "accelerometer"):
        np.testing.assert_array_equal(got[name], sent[name][lost:])
    np.testing.assert_array_equal(np.diff(got["counter"]), 1)
    np.testing.assert_array_equal(got["temperature_degc"][:, 0], sent["temperature_degc"][lost:, 0])
    assert np.isnan(got["temperature_degc"][:, 1:]).all()
    assert set(got["interval_ns"]) == {layout.interval_ns}
    assert set(got["flags"]) == {int(Flag.VALID)}
    assert tracker.counts.closes


@pytest.mark.parametrize("document", INVENTED.values(), ids=INVENTED.keys())
def test_a_profile_of_version_1_means_the_same(document: dict[str, Any], tmp_path: Path) -> None:
    one = {key: value for key, value in document.items() if key not in ("gyro", "accelerometer")}
    one |= {"version": 1, "counts": document["gyro"]["values"], "messages": []}
    for message in document["messages"]:
        parts = {key: value for key, value in message.items() if key != "checks"}
        for check in message.get("checks", []):
            ((first, last),) = check["covers"]
            parts["check"] = {k: v for k, v in check.items() if k != "covers"} | {
                "first": first,
                "last": last,
            }
        one["messages"].append(parts)
    assert profiles.load(written(tmp_path, one)) == profiles.load(written(tmp_path, document))


def test_all_faults_of_a_profile_are_reported_at_once(tmp_path: Path) -> None:
    document = stream_profile(byte_order="middle", sample_rate_hz=0, colour="red")
    with pytest.raises(FaultyFileError) as caught:
        profiles.load(written(tmp_path, document))
    message = " ".join(caught.value.faults)
    assert all(place in message for place in ("byte_order", "sample_rate_hz", "colour"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"messages": [message(3, "u24", "u8", None)]}, "expected a signed type"),
        ({"transport": "can"}, "bitrate"),
        ({"messages": [message(3, "i24", "u8", None) | {"length": 10}]}, "within 10 bytes"),
        ({"messages": [message(3, "i24", "u8", None) | {"sync": "AA 55 0D 01"}]}, "inside sync"),
        ({"messages": [message(3, "i24", "i8", None)]}, "unsigned"),
        ({"sample_rate_hz": [1, 2]}, "sample_rate_hz: expected 1 to 100000, got 0.5"),
        ({"messages": [message(3, "i24", "u8", {"kind": "crc", "width": 16})]}, "polynomial"),
        (
            {
                "messages": [
                    message(3, "i24", "u8", {"kind": "sum", "width": 8, "offset": 5, "covers": [[0, 9]]})
                ]
            },
            "inside",
        ),
        ({"status_bits": [{"bit": 1, "name": "a", "means": "fault"}] * 2}, "each bit once"),
    ],
)
def test_an_invalid_profile_is_refused_with_the_reason(
    change: dict[str, object], said: str, tmp_path: Path
) -> None:
    with pytest.raises(FaultyFileError, match=said):
        profiles.load(written(tmp_path, stream_profile(**change)))


@pytest.mark.parametrize("name", profiles.shipped())
def test_a_shipped_profile_is_of_its_name_and_says_where_it_is_from(name: str) -> None:
    assert profiles.load(name).name == name
    comment = profiles.content(name).decode().partition("format:")[0]
    assert comment.startswith("# ")
    assert "ICD" in comment if name in profiles.OWN else "Not tried on hardware" in comment


def test_an_unknown_profile_names_the_shipped_ones() -> None:
    with pytest.raises(InputError, match=r"imu50-rs422-acc.*imudrv profiles"):
        profiles.load("imu51")
