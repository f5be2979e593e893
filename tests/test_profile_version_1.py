"""Profiles of version 1, which users have, are read as they always were."""

import pytest

from imudrv import profiles
from imudrv.errors import FaultyFileError
from imudrv.files.settings_file import parse_text
from imudrv.profiles.schema import Profile

RS422 = """\
# 50-type unit over RS-422: increments, one frame a millisecond (ICD, section 2).
format: imu50-profile
version: 1
name: imu50-rs422
transport: serial
line: {baudrate: 921600}
sample_rate_hz: 1000
byte_order: little
counts: increment
nominal: {gyro_arcsec_per_pulse: 0.5, accelerometer_pulse_per_m_s: 2000.0}
messages:
  - sync: EB 90
    length: 44
    constants: [{offset: 2, value: 0x50}, {offset: 3, value: 38}]  # frame id, length of bytes 4..41
    fields:
      - {name: counter, type: u32, offset: 4}
      - {name: gyro, type: i32, offset: 8, axis: x}
      - {name: gyro, type: i32, offset: 12, axis: y}
      - {name: gyro, type: i32, offset: 16, axis: z}
      - {name: accelerometer, type: i32, offset: 20, axis: x}
      - {name: accelerometer, type: i32, offset: 24, axis: y}
      - {name: accelerometer, type: i32, offset: 28, axis: z}
      - {name: temperature, type: i16, offset: 32, sensor: gyro, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 34, sensor: accelerometer_x, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 36, sensor: accelerometer_y, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 38, sensor: accelerometer_z, degc_per_count: 0.01}
      - {name: status, type: u16, offset: 40}
    check: {kind: crc, width: 16, polynomial: 0x1021, init: 0xFFFF, first: 2, last: 41, offset: 42}
status_bits:
  - {bit: 0, name: warm-up, means: warm_up}
  - {bit: 1, name: gyro X fault, means: fault}
  - {bit: 2, name: gyro Y fault, means: fault}
  - {bit: 3, name: gyro Z fault, means: fault}
  - {bit: 4, name: accelerometer X fault, means: fault}
  - {bit: 5, name: accelerometer Y fault, means: fault}
  - {bit: 6, name: accelerometer Z fault, means: fault}
  - {bit: 7, name: dither fault, means: fault}
  - {bit: 8, name: over-temperature, means: fault}
  - {bit: 9, name: power, means: fault}
  - {bit: 10, name: pulse overflow, means: saturated}
  # In self-test the unit stimulates its own sensors: what it counts then is no motion.
  - {bit: 15, name: self-test running, means: fault}
"""

RS422_ACC = """\
# 50-type unit over RS-422: free-running totals modulo 65536 (ICD, section 3).
format: imu50-profile
version: 1
name: imu50-rs422-acc
transport: serial
line: {baudrate: 460800}
sample_rate_hz: 1000
byte_order: little
counts: total
nominal: {gyro_arcsec_per_pulse: 0.5, accelerometer_pulse_per_m_s: 2000.0}
messages:
  - sync: EB 90
    length: 30
    constants: [{offset: 2, value: 0x51}, {offset: 3, value: 24}]  # frame id, length of bytes 4..27
    fields:
      - {name: counter, type: u32, offset: 4}
      - {name: gyro, type: u16, offset: 8, axis: x}
      - {name: gyro, type: u16, offset: 10, axis: y}
      - {name: gyro, type: u16, offset: 12, axis: z}
      - {name: accelerometer, type: u16, offset: 14, axis: x}
      - {name: accelerometer, type: u16, offset: 16, axis: y}
      - {name: accelerometer, type: u16, offset: 18, axis: z}
      - {name: temperature, type: i16, offset: 20, sensor: gyro, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 22, sensor: accelerometer, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 24, sensor: electronics, degc_per_count: 0.01}
      - {name: status, type: u16, offset: 26}
    check: {kind: crc, width: 16, polynomial: 0x1021, init: 0xFFFF, first: 2, last: 27, offset: 28}
status_bits:
  - {bit: 0, name: warm-up, means: warm_up}
  - {bit: 1, name: gyro X fault, means: fault}
  - {bit: 2, name: gyro Y fault, means: fault}
  - {bit: 3, name: gyro Z fault, means: fault}
  - {bit: 4, name: accelerometer X fault, means: fault}
  - {bit: 5, name: accelerometer Y fault, means: fault}
  - {bit: 6, name: accelerometer Z fault, means: fault}
  - {bit: 7, name: dither fault, means: fault}
  - {bit: 8, name: over-temperature, means: fault}
  - {bit: 9, name: power, means: fault}
  - {bit: 10, name: pulse overflow, means: saturated}
  # In self-test the unit stimulates its own sensors: what it counts then is no motion.
  - {bit: 15, name: self-test running, means: fault}
"""

CAN = """\
# 50-type unit over classic CAN: two messages a sample (ICD, section 4).
format: imu50-profile
version: 1
name: imu50-can
transport: can
line: {bitrate: 1000000}
sample_rate_hz: 1000
byte_order: little
counts: increment
nominal: {gyro_arcsec_per_pulse: 0.5, accelerometer_pulse_per_m_s: 2000.0}
messages:
  - id: 0x150
    length: 8
    fields:
      - {name: gyro, type: i16, offset: 0, axis: x}
      - {name: gyro, type: i16, offset: 2, axis: y}
      - {name: gyro, type: i16, offset: 4, axis: z}
      - {name: counter, type: u16, offset: 6}
  - id: 0x151
    length: 8
    fields:
      - {name: accelerometer, type: i16, offset: 0, axis: x}
      - {name: accelerometer, type: i16, offset: 2, axis: y}
      - {name: accelerometer, type: i16, offset: 4, axis: z}
      - {name: counter, type: u16, offset: 6}
  - id: 0x152
    every: 100
    length: 8
    fields:
      - {name: temperature, type: i16, offset: 0, sensor: gyro, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 2, sensor: accelerometer_x, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 4, sensor: accelerometer_y, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 6, sensor: accelerometer_z, degc_per_count: 0.01}
  - id: 0x153
    every: 100
    length: 8
    fields:
      - {name: counter, type: u32, offset: 0}
      - {name: status, type: u16, offset: 4}
status_bits:
  - {bit: 0, name: warm-up, means: warm_up}
  - {bit: 1, name: gyro X fault, means: fault}
  - {bit: 2, name: gyro Y fault, means: fault}
  - {bit: 3, name: gyro Z fault, means: fault}
  - {bit: 4, name: accelerometer X fault, means: fault}
  - {bit: 5, name: accelerometer Y fault, means: fault}
  - {bit: 6, name: accelerometer Z fault, means: fault}
  - {bit: 7, name: dither fault, means: fault}
  - {bit: 8, name: over-temperature, means: fault}
  - {bit: 9, name: power, means: fault}
  - {bit: 10, name: pulse overflow, means: saturated}
  # In self-test the unit stimulates its own sensors: what it counts then is no motion.
  - {bit: 15, name: self-test running, means: fault}
"""

CANFD = """\
# 50-type unit over CAN FD: one message a sample (ICD, section 5): bytes 4..41 of the serial frame,
# the CRC over the frame's id and length bytes and those, zeros.
format: imu50-profile
version: 1
name: imu50-canfd
transport: can
line: {bitrate: 1000000, data_bitrate: 5000000}
sample_rate_hz: 1000
byte_order: little
counts: increment
nominal: {gyro_arcsec_per_pulse: 0.5, accelerometer_pulse_per_m_s: 2000.0}
messages:
  - id: 0x158
    length: 48
    fields:
      - {name: counter, type: u32, offset: 0}
      - {name: gyro, type: i32, offset: 4, axis: x}
      - {name: gyro, type: i32, offset: 8, axis: y}
      - {name: gyro, type: i32, offset: 12, axis: z}
      - {name: accelerometer, type: i32, offset: 16, axis: x}
      - {name: accelerometer, type: i32, offset: 20, axis: y}
      - {name: accelerometer, type: i32, offset: 24, axis: z}
      - {name: temperature, type: i16, offset: 28, sensor: gyro, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 30, sensor: accelerometer_x, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 32, sensor: accelerometer_y, degc_per_count: 0.01}
      - {name: temperature, type: i16, offset: 34, sensor: accelerometer_z, degc_per_count: 0.01}
      - {name: status, type: u16, offset: 36}
    check: {kind: crc, width: 16, polynomial: 0x1021, init: 0xFFFF, prefix: "50 26",
            first: 0, last: 37, offset: 38}
status_bits:
  - {bit: 0, name: warm-up, means: warm_up}
  - {bit: 1, name: gyro X fault, means: fault}
  - {bit: 2, name: gyro Y fault, means: fault}
  - {bit: 3, name: gyro Z fault, means: fault}
  - {bit: 4, name: accelerometer X fault, means: fault}
  - {bit: 5, name: accelerometer Y fault, means: fault}
  - {bit: 6, name: accelerometer Z fault, means: fault}
  - {bit: 7, name: dither fault, means: fault}
  - {bit: 8, name: over-temperature, means: fault}
  - {bit: 9, name: power, means: fault}
  - {bit: 10, name: pulse overflow, means: saturated}
  # In self-test the unit stimulates its own sensors: what it counts then is no motion.
  - {bit: 15, name: self-test running, means: fault}
"""

TEXTS = {"imu50-rs422": RS422, "imu50-rs422-acc": RS422_ACC, "imu50-can": CAN, "imu50-canfd": CANFD}


@pytest.mark.parametrize("name", TEXTS)
def test_the_file_of_version_1_gives_the_layout_of_the_shipped_one(name: str) -> None:
    old = parse_text(TEXTS[name].encode(), Profile, f"{name}.yaml")
    shipped = profiles.load(name)
    assert b"version: 2" in profiles.content(name)
    assert old.layout() == shipped.layout()
    assert (old.line, old.nominal, old.rate) == (shipped.line, shipped.nominal, shipped.rate)
    assert old.transmission_ns == shipped.transmission_ns


@pytest.mark.parametrize(
    ("here", "instead", "said"),
    [
        ("counts: increment", "counts: increments", "got text 'increments'; write increment"),
        (
            "width: 16",
            "width: sixteen",
            "messages[0].checks[0].width: expected a whole number, got text 'sixteen'",
        ),
        ("last: 41", "last: 45", "expected a check outside of the bytes it covers, got one inside"),
        ("version: 1", "version: 3", "version: expected 2, got 3"),
        ("version: 1", "version: 1.0", "version: expected 2, got 1.0"),
        ("counts: increment", "gyro: {values: rate, unit: deg/s}", "accelerometer: expected an entry"),
    ],
)
def test_what_is_wrong_in_a_file_of_version_1_is_reported(here: str, instead: str, said: str) -> None:
    assert here in RS422
    with pytest.raises(FaultyFileError) as caught:
        parse_text(RS422.replace(here, instead).encode(), Profile, "unit.yaml")
    assert any(said in fault for fault in caught.value.faults), caught.value.faults
