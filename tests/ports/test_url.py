import pytest

from imudrv import Source
from imudrv.errors import InputError
from imudrv.ports import PortLostError, check_url, open_port
from imudrv.url import split, value

SERIAL_MISTAKES = [
    ("ttyUSB0", r"expected a URL that begins with serial://.*or a path like /dev/ttyUSB0"),
    ("usb:///dev/ttyUSB0", r"expected a URL that begins with serial://.*got 'usb:///dev/ttyUSB0'"),
    ("serial://dev/ttyUSB0", r"serial:///dev/ttyUSB0 \(three slashes\), got 'dev/ttyUSB0'"),
    ("serial:///dev/ttyUSB0?baud=9600", r"baud: unknown key; did you mean baudrate\?"),
    ("serial:///dev/ttyUSB0?parity=strange", r"parity: expected 'none', .*got text 'strange'"),
    ("serial:///dev/ttyUSB0?baudrate=fast", r"baudrate: expected a whole number, got text 'fast'"),
    ("serial:///dev/ttyUSB0?baudrate=0", r"baudrate: expected at least 50, got 0"),
    ("serial:///dev/ttyUSB0?baudrate", r"expected options as NAME=VALUE with & between, got 'baudrate'"),
    ("serial:///dev/ttyUSB0?baudrate=1&baudrate=2", r"expected each option once, got one twice"),
    ("serial:///", r"expected a serial device, got a folder"),
    ("socket://host", r"expected socket://HOST:PORT, got 'host'"),
    ("socket://host:port", r"expected socket://HOST:PORT, got 'host:port'"),
    ("socket://host:1/path", r"expected socket://HOST:PORT"),
    ("socket://host:1?baudrate=9600", r"expected no options for socket://, got baudrate"),
    ("can://virtual/x", r"expected a port for the serial profile imu50-rs422, like serial:///dev/"),
    ("replay:///no/such/file", r"/no/such/file: expected a file, there is none"),
]
CAN_MISTAKES = [
    ("serial:///dev/ttyUSB0", r"expected a port for the can profile imu50-can, like can://INTERFACE/CHANNEL"),
    ("/dev/ttyUSB0", r"expected a port for the can profile imu50-can"),
    ("can://", r"expected can://INTERFACE/CHANNEL like can://socketcan/can0"),
    ("can://socketcan", r"expected can://INTERFACE/CHANNEL"),
    ("can://socketcam/can0", r"got 'socketcam'; did you mean socketcan\?"),
    ("can://zzz/can0", r"got 'zzz'; known are .*slcan, "),
    ("can://virtual/x?channel=y", r"expected other options, got channel"),
    ("can://virtual/x?bitrate=fast", r"bitrate: expected a whole number, got text 'fast'"),
    ("can://virtual/x?bitrate=1", r"bitrate: expected at least 10000, got 1"),
    ("can://virtual/x?fd=perhaps", r"fd: expected true or false, got perhaps"),
]


@pytest.mark.parametrize(("url", "message"), SERIAL_MISTAKES)
def test_a_mistake_in_a_url_for_a_serial_unit_is_reported_before_anything_is_opened(url, message, rs422):
    with pytest.raises(InputError, match=message):
        check_url(url, rs422)
    with pytest.raises(InputError, match=message):
        open_port(url, rs422)


@pytest.mark.parametrize(("url", "message"), CAN_MISTAKES)
def test_a_mistake_in_a_url_for_a_can_unit_is_reported_before_anything_is_opened(url, message, can_profile):
    with pytest.raises(InputError, match=message):
        check_url(url, can_profile)
    with pytest.raises(InputError, match=message):
        open_port(url, can_profile)


@pytest.mark.parametrize("speed", ["0", "-1", "nan", "inf", "fast", "1e9", ""])
def test_a_replay_has_a_speed_or_max(speed, rs422, tmp_path):
    capture = tmp_path / "capture.raw"
    capture.write_bytes(bytes(44))
    with pytest.raises(
        InputError, match=f"speed: expected max or a number from 0.001 to 1e\\+06, got '{speed}'"
    ):
        check_url(f"replay://{capture}?speed={speed}", rs422)


def test_a_simulated_unit_is_a_port_and_its_mistakes_are_reported_at_once(rs422, opened, arrivals):
    with pytest.raises(InputError, match="no-such-scenario"):
        check_url("sim://no-such-scenario", rs422)
    check_url("sim://static", rs422)
    port = opened("sim://static?speed=max", rs422)
    assert port.source is Source.SIMULATOR
    assert arrivals(port, 44)[0].data.startswith(b"\xeb\x90\x50\x26")


def test_a_valid_url_is_accepted_without_a_device(rs422, can_profile):
    for url in ("/dev/no-such", "serial:///dev/no-such?stopbits=2&parity=even", "socket://[::1]:1"):
        check_url(url, rs422)
        assert split(url).scheme in ("serial", "socket")
    check_url("can://slcan//dev/no-such?tty_baudrate=3000000", can_profile)


def test_an_absent_port_is_reported_with_the_existing_ones(rs422, monkeypatch):
    monkeypatch.setattr("imudrv.ports.serial._ports_there_are", lambda: "there are /dev/ttyS7")
    with pytest.raises(PortLostError, match=r"there is no /dev/no-such; there are /dev/ttyS7"):
        open_port("serial:///dev/no-such", rs422)


def test_values_are_numbers_booleans_or_text():
    texts = {"115200": 115200, "0.5": 0.5, "true": True, "false": False, "none": "none", "can0": "can0"}
    assert {text: value(text) for text in texts} == texts
    assert all(type(value(text)) is type(meant) for text, meant in texts.items())


def test_an_address_is_taken_literally():
    assert split("replay:///a%20b/c d.raw?speed=max") == (
        "replay:///a%20b/c d.raw?speed=max",
        "replay",
        "/a%20b/c d.raw",
        {"speed": "max"},
    )
