"""The line that a simulated unit plays on: a pty, a serial port, a TCP server or a CAN bus.

It can be unplugged. Nothing is lost silently: what a line could not deliver is counted.
"""

import array
import fcntl
import os
import secrets
import select
import socket
import termios
import threading
import time
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final
from urllib.parse import SplitResult, parse_qsl, urlsplit

import can
import serial

from imudrv.errors import InputError
from imudrv.profiles.schema import CanLine, Profile, SerialLine
from imudrv.records import Records

SETTLE_S: Final = 0.25
"""A reader that opens a port throws away what is in it, and sets it up; it is left so much time for that."""
PATIENCE_S: Final = 1.0
"""How long a TCP client may take nothing before it is cut off, and a reader to fetch the last bytes."""

_POLL_S: Final = 0.1
_RETRY_S: Final = 0.002
_AT_ONCE: Final = 4096


class SimulatedLine(ABC):
    """A line.

    Parameters
    ----------
    waits : bool
        Wait for a reader for as long as it takes; otherwise what nobody takes is given up.
    say : callable
        Told what a person wants to know.
    stop : Event
        Ends every wait.
    """

    def __init__(self, waits: bool, say: Callable[[str], None], stop: threading.Event) -> None:
        self.sent = 0
        self.undelivered = 0
        self._waits = waits
        self._say = say
        self._stop = stop

    def wait_for_reader(self) -> None:
        """Wait until somebody listens, where that can be told."""
        return

    @abstractmethod
    def send(self, data: bytes | Records) -> None:
        """Send what is due, and look after the line; returns when it is on its way or given up."""

    def unplug(self) -> None:
        """Pull the cable out."""
        return

    def plug(self) -> None:
        """Put it in again."""
        return

    def finish(self) -> None:
        """Wait, for a second at the most, until the reader has fetched what was sent."""
        return

    @abstractmethod
    def close(self) -> None:
        """Give the line back."""


class _FileLink(SimulatedLine):
    """A line behind a file descriptor, -1 while it is unplugged."""

    _fd = -1

    def _has_reader(self) -> bool:
        return self._fd >= 0

    def send(self, data: bytes | Records) -> None:
        """Send bytes."""
        assert isinstance(data, bytes)
        rest = memoryview(data)
        while rest:
            if not self._has_reader():
                if not self._waits or self._fd < 0 or self._stop.is_set():
                    break
                self.wait_for_reader()
                continue
            readable, writable, _ = select.select([self._fd], [self._fd], [], _POLL_S)
            if not writable and self._stop.is_set():
                break
            try:
                if readable:
                    os.read(self._fd, _AT_ONCE)  # what the reader sends is for a real unit
                if writable:
                    written = os.write(self._fd, rest)
                    self.sent += written
                    rest = rest[written:]
            except BlockingIOError:
                continue
            except OSError as error:
                raise InputError(f"the port went away: {error.strerror}") from error
        self.undelivered += len(rest)


class PtyLink(_FileLink):
    """The master of a pseudo terminal.

    Parameters
    ----------
    waits, say, stop
        As for `SimulatedLine`.
    name : str
        What plays, for people.
    link : str or None
        Symbolic link to the slave, made again with each pty.
    """

    def __init__(
        self, waits: bool, say: Callable[[str], None], stop: threading.Event, name: str, link: str | None
    ) -> None:
        super().__init__(waits, say, stop)
        self._link = Path(link) if link is not None else None
        if self._link is not None and self._link.exists() and not self._link.is_symlink():
            raise InputError(f"link {link}: expected a name that is free, got a file; take another name")
        self._path = ""
        self.plug()
        say(f"{name} plays on {self._link or self._path}")

    def plug(self) -> None:
        """Make a pty."""
        self._fd, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._fd, False)
        self._path = os.ttyname(slave)
        os.close(slave)
        if self._link is not None:
            try:
                # beside it first: a reader finds the old name or the new one
                beside = self._link.with_name(f".{self._link.name}.{secrets.token_hex(4)}")
                beside.symlink_to(self._path)
                beside.replace(self._link)
            except OSError as error:
                self.close()
                raise InputError(f"link {self._link}: cannot be made: {error.strerror}") from error

    def unplug(self) -> None:
        """Close the pty; the link goes too."""
        self.finish()
        self.close()

    def _has_reader(self) -> bool:
        if self._fd < 0:
            return False
        poll = select.poll()
        poll.register(self._fd, 0)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def wait_for_reader(self) -> None:
        """Wait until the slave is open, and set up."""
        while not self._has_reader() and not self._stop.is_set():
            time.sleep(_RETRY_S)
        self._stop.wait(SETTLE_S)

    def finish(self) -> None:
        """Wait until the slave's reader has fetched everything: what is left is lost when the pty closes."""
        if not self._has_reader():
            return
        slave = os.open(self._path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            left, since, empty = _waiting(slave), time.monotonic(), 0
            # what is on its way between both ends does not show: empty for a while, then
            while empty < 5 and time.monotonic() - since < PATIENCE_S:
                time.sleep(_RETRY_S)
                before, left = left, _waiting(slave)
                empty = empty + 1 if left == 0 else 0
                if left != before:
                    since = time.monotonic()
        finally:
            os.close(slave)
        self.sent -= left
        self.undelivered += left

    def close(self) -> None:
        """Close the pty and take the link away."""
        if self._fd < 0:
            return
        os.close(self._fd)
        self._fd = -1
        if self._link is not None and self._link.is_symlink():
            with suppress(OSError):
                if os.readlink(self._link) == self._path:
                    self._link.unlink()


class SerialLink(_FileLink):
    """A real serial port.

    Parameters
    ----------
    waits, say, stop
        As for `SimulatedLine`.
    name : str
        What plays, for people.
    path : str
        Of the device.
    line : SerialLine
        Its settings.
    """

    def __init__(
        self,
        waits: bool,
        say: Callable[[str], None],
        stop: threading.Event,
        name: str,
        path: str,
        line: SerialLine,
    ) -> None:
        super().__init__(waits, say, stop)
        self._path = path
        self._line = line
        self._port: serial.Serial | None = None
        self.plug()
        say(f"{name}, {line.baudrate} baud, plays on {path}")

    def plug(self) -> None:
        """Open the port."""
        line = self._line
        try:
            self._port = serial.Serial(
                self._path,
                baudrate=line.baudrate,
                bytesize=line.bytesize,
                parity=line.parity[0].upper(),
                stopbits=line.stopbits,
                exclusive=True,
            )
        except (OSError, ValueError) as error:
            raise InputError(f"{self._path}: cannot be opened as a serial port: {error}") from error
        self._fd = self._port.fileno()

    def unplug(self) -> None:
        """Close the port."""
        self.finish()
        self.close()

    def finish(self) -> None:
        """Wait until everything is on the wire."""
        deadline = time.monotonic() + PATIENCE_S
        with suppress(OSError):  # it may have gone just now
            while self._port is not None and self._port.out_waiting and time.monotonic() < deadline:
                time.sleep(_RETRY_S)

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
        self._port = None
        self._fd = -1


class TcpLink(SimulatedLine):
    """A TCP server; every client gets every byte from when it came.

    Parameters
    ----------
    waits, say, stop
        As for `SimulatedLine`.
    name : str
        What plays, for people.
    host, port
        Where to listen; port 0 takes a free one.
    """

    def __init__(
        self, waits: bool, say: Callable[[str], None], stop: threading.Event, name: str, host: str, port: int
    ) -> None:
        super().__init__(waits, say, stop)
        self._address = (host, port)
        self._server: socket.socket | None = None
        self._clients: list[socket.socket] = []
        self.plug()
        shown = f"[{host}]" if ":" in host else host
        say(f"{name} plays on tcp://{shown}:{self._address[1]}")

    def plug(self) -> None:
        """Listen."""
        try:
            family = socket.AF_INET6 if ":" in self._address[0] else socket.AF_INET
            self._server = socket.create_server(self._address, family=family)
        except OSError as error:
            host, port = self._address
            raise InputError(f"tcp://{host}:{port}: cannot listen there: {error.strerror}") from error
        self._server.setblocking(False)
        self._address = (self._address[0], self._server.getsockname()[1])

    def wait_for_reader(self) -> None:
        """Wait for a client."""
        self._look()
        while not self._clients and not self._stop.is_set():
            time.sleep(_RETRY_S)
            self._look()

    def send(self, data: bytes | Records) -> None:
        """Send bytes to every client."""
        assert isinstance(data, bytes)
        self._look()
        if data and self._waits and self._server:
            self.wait_for_reader()
        if self._clients:
            self.sent += len(data)
        else:
            self.undelivered += len(data)
        for client in list(self._clients):
            self._send_to(client, memoryview(data))

    def _send_to(self, client: socket.socket, rest: memoryview) -> None:
        since = time.monotonic()
        why = "has gone"
        try:
            while rest:
                _, writable, _ = select.select([], [client], [], _POLL_S)
                if writable:
                    rest = rest[client.send(rest) :]
                    since = time.monotonic()
                elif self._stop.is_set():
                    why = "still waits"
                    break
                elif not self._waits and time.monotonic() - since > PATIENCE_S:
                    why = "takes nothing"
                    break
        except OSError:
            pass
        if rest:
            self.undelivered += len(rest)
            self._cut_off(client, why)

    def _cut_off(self, client: socket.socket, why: str) -> None:
        client.close()
        self._clients.remove(client)
        self._say(f"a client {why}; {len(self._clients)} left")

    def _look(self) -> None:
        """Let new clients in and those that left out; what they send is for a real unit."""
        for client in list(self._clients):
            try:
                gone = not client.recv(_AT_ONCE)
            except BlockingIOError:
                continue
            except OSError:
                gone = True
            if gone:
                self._cut_off(client, "has gone")
        if self._server is None:
            return
        with suppress(BlockingIOError, ConnectionError):
            client, _ = self._server.accept()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients.append(client)

    def unplug(self) -> None:
        """Close the clients and listen no more."""
        self.close()

    def close(self) -> None:
        """Close all; the server first, so that no client is let in that would be sent away."""
        if self._server is not None:
            self._server.close()
        self._server = None
        for client in self._clients:
            with suppress(OSError):
                client.shutdown(socket.SHUT_WR)
            client.close()
        self._clients = []


class CanLink(SimulatedLine):
    """A CAN bus, of any interface of python-can; unplugged it is silent.

    Parameters
    ----------
    waits, say, stop
        As for `SimulatedLine`.
    name : str
        What plays, for people.
    url : str
        ``can://INTERFACE/CHANNEL?...``; what follows the question mark is python-can's.
    line : CanLine
        Settings of the bus.
    """

    def __init__(
        self,
        waits: bool,
        say: Callable[[str], None],
        stop: threading.Event,
        name: str,
        url: SplitResult,
        line: CanLine,
    ) -> None:
        super().__init__(waits, say, stop)
        settings: dict[str, Any] = {"bitrate": line.bitrate, "data_bitrate": line.data_bitrate}
        settings |= {key: can.util.cast_from_string(value) for key, value in parse_qsl(url.query)}
        try:
            self._bus = can.Bus(
                interface=url.netloc,
                channel=url.path.removeprefix("/"),
                ignore_config=True,
                fd=line.data_bitrate is not None,
                **{key: value for key, value in settings.items() if value is not None},
            )
        except (can.CanError, NotImplementedError, OSError, TypeError, ValueError) as error:
            raise InputError(f"{url.geturl()}: cannot be opened as a CAN bus: {error}") from error
        say(f"{name} plays on {url.geturl()}")

    def send(self, data: bytes | Records) -> None:
        """Send messages."""
        if isinstance(data, bytes):
            return  # nothing is due
        content = data["data"].tobytes()
        width = len(content) // max(1, data.size)
        heads = zip(data["id"].tolist(), data["length"].tolist(), data["fd"].tolist(), strict=True)
        for i, (identifier, length, fd) in enumerate(heads):
            message = can.Message(
                arbitration_id=identifier,
                is_extended_id=identifier > 0x7FF,
                is_fd=bool(fd),
                bitrate_switch=bool(fd),
                data=content[i * width : i * width + length],
            )
            if not self._send(message):
                self.undelivered += data.size - i
                return

    def _send(self, message: can.Message) -> bool:
        since = time.monotonic()
        while True:
            try:
                self._bus.send(message, timeout=_POLL_S)
                self.sent += 1
                return True
            except can.CanError:
                # nobody acknowledges, or the interface's queue is full
                if self._stop.is_set() or (not self._waits and time.monotonic() - since > PATIENCE_S):
                    return False
                time.sleep(_RETRY_S)

    def close(self) -> None:
        """Leave the bus."""
        self._bus.shutdown()


def open_link(
    target: str,
    profile: Profile,
    waits: bool,
    say: Callable[[str], None],
    link: str | None,
    stop: threading.Event,
) -> SimulatedLine:
    """Open the line that a target names.

    Parameters
    ----------
    target : str
        As for `imudrv.sim.live.play`.
    profile : Profile
        What plays on it, and the settings of the line.
    waits, say, stop
        As for `SimulatedLine`.
    link : str or None
        As for `PtyLink`.

    Returns
    -------
    Link

    Raises
    ------
    InputError
        It makes no sense, does not fit the profile, or cannot be opened.
    """
    name, line = profile.name, profile.line
    url = urlsplit(target)
    if link is not None and target != "pty":
        raise InputError(f"link {link}: expected only with the port pty, got {target}")
    if (url.scheme == "can") != isinstance(line, CanLine):
        kinds = "can://INTERFACE/CHANNEL" if isinstance(line, CanLine) else "pty, a serial port or tcp://"
        raise InputError(f"port {target}: expected {kinds} for the profile {name}")
    if isinstance(line, CanLine):
        return CanLink(waits, say, stop, name, url, line)
    if target == "pty":
        return PtyLink(waits, say, stop, name, link)
    try:
        if url.scheme == "tcp":
            return TcpLink(waits, say, stop, name, url.hostname or "127.0.0.1", url.port or 0)
        if url.scheme in ("serial", ""):
            options = dict(parse_qsl(url.query, strict_parsing=bool(url.query)))
            baudrate = int(options.pop("baudrate", line.baudrate))
            if url.path and not url.netloc and not options:
                settings = line.model_copy(update={"baudrate": baudrate})
                return SerialLink(waits, say, stop, name, url.path, settings)
    except ValueError as error:
        raise InputError(f"port {target}: {error}") from error
    raise InputError(
        f"port {target}: expected pty, a serial port's path, serial:///PATH?baudrate=N, "
        "tcp://HOST:PORT or can://INTERFACE/CHANNEL"
    )


def _waiting(fd: int) -> int:
    """Bytes that a terminal's reader has not fetched yet."""
    count = array.array("i", [0])
    fcntl.ioctl(fd, termios.FIONREAD, count)
    return count[0]
