import fcntl
import os
import socket
import struct
import subprocess
import sys
import termios
import threading
import tty
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import serial
from realtime import DEADLINE_S

from imudrv import Source
from imudrv.errors import InputError
from imudrv.hostclock import now_ns
from imudrv.ports import PortLostError, open_port
from imudrv.ports.permission import permission_advice
from imudrv.ports.serial import DescriptorPort, PyserialPort, explain, take_exclusively

MANY = bytes(range(256)) * 12  # less than the 4 KiB that a pty holds; has every byte that a terminal may eat


class Line:
    """A pty: we hold the unit's end, the driver gets the other one by its path."""

    def __init__(self) -> None:
        self.unit, self.descriptor = os.openpty()
        tty.setraw(self.descriptor)
        self.path = os.ttyname(self.descriptor)

    def pull(self) -> None:
        if self.unit >= 0:
            os.close(self.unit)
            self.unit = -1

    def close(self) -> None:
        self.pull()
        os.close(self.descriptor)


@pytest.fixture
def line() -> Iterator[Line]:
    pty = Line()
    yield pty
    pty.close()


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening


def _url(server: socket.socket) -> str:
    return f"socket://127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize(
    "form", ["{}", "serial://{}", "serial://{}?baudrate=115200", "alt://{}?class=VTIMESerial"]
)
def test_bytes_are_received_complete_and_stamped_on_arrival(form, line, rs422, opened, arrivals):
    port = opened(form.format(line.path), rs422)
    assert isinstance(port, DescriptorPort)
    assert port.source is Source.HARDWARE
    before = now_ns()
    os.write(line.unit, MANY)
    found = arrivals(port, len(MANY))
    after = now_ns()
    assert b"".join(arrival.data for arrival in found) == MANY
    assert all(before <= arrival.t_ns <= after for arrival in found)
    assert port.read(0).data == b""


def test_a_spy_url_is_read_through_pyserial(line, rs422, opened, arrivals, capfd):
    port = opened(f"spy://{line.path}", rs422)
    assert isinstance(port, PyserialPort)
    os.write(line.unit, MANY)
    assert b"".join(arrival.data for arrival in arrivals(port, len(MANY))) == MANY
    assert port.read(0).data == b""
    line.pull()
    with pytest.raises(PortLostError, match="the port is gone"):
        port.read(1)
    assert "F1 F2 F3 F4" in capfd.readouterr().err


def test_bytes_buffered_before_opening_are_not_discarded(line, rs422, opened, arrivals):
    os.write(line.unit, MANY)
    port = opened(line.path, rs422)
    assert b"".join(arrival.data for arrival in arrivals(port, len(MANY))) == MANY


def test_the_line_is_set_as_the_profile_says_unless_the_url_does(line, rs422, opened):
    port = opened(line.path, rs422)
    settings = termios.tcgetattr(line.unit)
    assert settings[4] == settings[5] == termios.B921600
    assert not settings[2] & termios.CSTOPB
    port.close()
    opened(f"serial://{line.path}?baudrate=460800&stopbits=2", rs422)
    settings = termios.tcgetattr(line.unit)
    assert settings[4] == settings[5] == termios.B460800
    assert settings[2] & termios.CSTOPB


def test_an_unplugged_port_is_lost_and_stays_lost(line, rs422, opened):
    port = opened(line.path, rs422)
    line.pull()
    for _ in range(3):
        with pytest.raises(PortLostError, match=rf"{line.path}: the (port is gone|other end has gone)"):
            port.read(1)


def test_a_port_pulled_while_a_read_waits_is_lost(line, rs422, opened):
    port = opened(line.path, rs422)
    pulling = threading.Timer(0.1, line.pull)
    pulling.start()
    with pytest.raises(PortLostError, match=r"the (port is gone|other end has gone)"):
        port.read(DEADLINE_S)
    pulling.join()


def test_a_port_that_another_one_has_open_is_busy(line, rs422, opened):
    opened(line.path, rs422)
    with pytest.raises(PortLostError, match=r"/dev/pts/.* is open in another program \(`sudo fuser -v"):
        open_port(line.path, rs422)


def test_the_program_that_has_a_port_open_is_named(line, rs422):
    program = (
        f"import serial, sys; line = serial.Serial({line.path!r}, exclusive=True); "
        "print(flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        other.stdout.readline()
        with pytest.raises(PortLostError, match=rf"is open in \S+ \(process {other.pid}\)"):
            open_port(line.path, rs422)
        other.communicate(b"")


def test_a_line_is_taken_exclusively_but_not_a_pty_which_its_other_end_would_keep_taken(line, rs422, opened):
    def is_exclusive(descriptor):
        return bool(struct.unpack("i", fcntl.ioctl(descriptor, 0x80045440, bytes(4)))[0])  # TIOCGEXCL

    opened(line.path, rs422)
    assert not is_exclusive(line.descriptor)
    take_exclusively(line.descriptor)
    assert is_exclusive(line.descriptor)
    with open("/dev/null") as null:
        take_exclusively(null.fileno())  # has no such flag


def test_errors_that_the_driver_has_counted_are_reported_and_a_pty_counts_none(
    line, rs422, opened, monkeypatch
):
    port = opened(line.path, rs422)
    before = port.line_errors()
    assert not any(before)
    # linux/serial.h: cts, dsr, rng, dcd, rx, tx, frame, overrun, parity, brk, buf_overrun, reserved
    counts = struct.pack("20i", 0, 0, 0, 0, 9000, 0, 12, 3, 4, 7, 2, *[0] * 9)
    monkeypatch.setattr("imudrv.ports.serial.fcntl.ioctl", lambda fd, request, room: counts)
    assert str(port.line_errors().since(before)) == "12 framing errors, 4 parity errors, 5 overruns"


def test_a_closed_port_is_closed_once_lost_when_read_and_free_for_others(line, rs422, opened):
    port = opened(line.path, rs422)
    port.close()
    port.close()
    with pytest.raises(PortLostError, match="the port is closed"):
        port.read(0)
    opened(line.path, rs422)


def test_a_file_is_no_serial_device(rs422, tmp_path):
    capture = tmp_path / "unit.raw"
    capture.write_bytes(b"x")
    with pytest.raises(InputError, match=f"got a file; a capture is read with replay://{capture}"):
        open_port(f"serial://{capture}", rs422)


def test_a_device_that_is_no_terminal_is_not_opened(rs422):
    with pytest.raises(PortLostError, match="cannot open /dev/null: Could not configure port"):
        open_port("/dev/null", rs422)


@pytest.mark.parametrize(
    ("trouble", "kind", "message"),
    [
        (
            termios.error(5, "Input/output error"),
            PortLostError,
            "cannot open /dev/pts/.*: Input/output error",
        ),
        (OSError(5, "Input/output error"), PortLostError, "cannot open /dev/pts/.*: Input/output error"),
        (OSError(22, "Invalid argument"), InputError, r"Failed to set custom baud rate \(123457\)"),
    ],
)
def test_a_port_that_vanishes_during_opening_is_lost_and_an_unsupported_speed_an_error(
    trouble, kind, message, line, rs422, monkeypatch
):
    def fail(self, speed):
        if isinstance(trouble, termios.error):
            raise trouble
        try:
            raise trouble
        except OSError as error:
            raise ValueError(f"Failed to set custom baud rate ({speed}): {error}") from error

    monkeypatch.setattr("serial.Serial._set_special_baudrate", fail)
    with pytest.raises(kind, match=message):
        open_port(f"serial://{line.path}?baudrate=123457", rs422)


def test_a_refusal_says_how_to_get_permission(tmp_path):
    device = tmp_path / "tty"
    device.touch()
    text = explain(str(device), PermissionError(13, "Permission denied"))
    assert text == f"no permission for {device}; {permission_advice(device)}"


def test_the_stream_of_a_tcp_server_is_received_complete(server, rs422, opened, arrivals):
    port = opened(_url(server), rs422)
    with server.accept()[0] as unit, ThreadPoolExecutor(1) as pool:
        sending = pool.submit(unit.sendall, MANY * 40)  # perhaps more than the system holds
        assert b"".join(arrival.data for arrival in arrivals(port, len(MANY) * 40)) == MANY * 40
        sending.result()
        assert port.read(0).data == b""


def test_a_tcp_server_that_closes_is_a_lost_port_after_its_last_byte(server, rs422, opened):
    port = opened(_url(server), rs422)
    with server.accept()[0] as unit:
        unit.sendall(b"last")
    assert port.read(DEADLINE_S).data == b"last"
    for _ in range(2):
        with pytest.raises(PortLostError, match=r"(the other end has gone|the port is gone)"):
            port.read(DEADLINE_S)


def test_an_absent_tcp_server_is_a_lost_port(server, rs422):
    url = _url(server)
    server.close()
    with pytest.raises(PortLostError, match=r"cannot connect: Connection refused; is the server running\?"):
        open_port(url, rs422)


def test_a_loop_is_read_through_pyserial(rs422, opened, arrivals, monkeypatch):
    devices = []
    open_device = serial.serial_for_url

    def remember(*arguments, **settings):
        devices.append(open_device(*arguments, **settings))
        return devices[0]

    monkeypatch.setattr(serial, "serial_for_url", remember)
    port = opened("loop://?baudrate=115200", rs422)
    assert isinstance(port, PyserialPort)
    assert port.read(0).data == b""
    devices[0].write(MANY)
    assert b"".join(arrival.data for arrival in arrivals(port, len(MANY))) == MANY
    port.close()
    port.close()
    with pytest.raises(PortLostError, match="the port is gone"):
        port.read(0)


@pytest.mark.parametrize(
    "url", ["loop://?colour=red", "rfc2217://127.0.0.1:1?colour=red", "alt:///dev/x?class=No"]
)
def test_an_option_unknown_to_pyserial_is_a_mistake_of_the_user(url, rs422):
    with pytest.raises(InputError, match=r"unknown option: 'colour'|unknown class: 'No'"):
        open_port(url, rs422)


def test_an_absent_port_given_by_a_pyserial_url_is_lost(rs422):
    with pytest.raises(PortLostError, match="no ports found matching"):
        open_port("hwgrep://no-such-device", rs422)
