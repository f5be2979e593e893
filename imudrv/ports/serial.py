"""Serial line, or any other device that pyserial can open.

A device with a file descriptor (line, pty, TCP connection) is read with `select` and one `read`, which has
the lowest latency; other devices are read by pyserial.
"""

import errno
import os
import select
import socket
import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlencode, urlsplit

import serial
from serial.tools.list_ports import comports

from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.hostclock import now_ns
from imudrv.ports.base import LineErrors, Port, PortLostError
from imudrv.ports.holders import holders
from imudrv.ports.url import Url, require_transport, value
from imudrv.profiles.schema import Profile, SerialLine
from imudrv.records import Arrival, Source

_AT_ONCE: Final = 1 << 16
_SLICE_S: Final = 0.02
"""Longest wait inside pyserial, s; a change of its timeout would set up an open line again."""
_CONNECT_S: Final = 1.0
_PARITY: Final = {
    "none": serial.PARITY_NONE,
    "even": serial.PARITY_EVEN,
    "odd": serial.PARITY_ODD,
    "mark": serial.PARITY_MARK,
    "space": serial.PARITY_SPACE,
}
_SHOWN_PORTS: Final = 10
_SYSTEM_ERRORS: tuple[type[Exception], ...] = (OSError,)
_TIOCGICOUNT: Final = 0x545D  # Linux, asm-generic/ioctls.h
_COUNTS: Final = struct.Struct("20i")  # struct serial_icounter_struct, linux/serial.h
if os.name == "posix":
    import fcntl
    import termios

    _SYSTEM_ERRORS += (termios.error,)


def prepare(url: Url, profile: Profile) -> Callable[[], Port]:
    """Check a URL of pyserial.

    Parameters
    ----------
    url : Url
        Scheme ``serial`` or one of pyserial.
    profile : Profile
        Profile of a serial unit, with the default line settings.

    Returns
    -------
    callable
        Opens the port; raises `PortLostError` if the device is absent.

    Raises
    ------
    InputError
        The URL is not valid.
    """
    require_transport(url, profile, "serial")
    if url.scheme == "socket":
        return partial(_connect, url.text, _host_and_port(url))
    own = url.options
    foreign: dict[str, str] = {}
    if url.scheme == "serial":
        _require_device_name(url)
        target = url.address
    else:
        own = {name: text for name, text in url.options.items() if name in SerialLine.model_fields}
        foreign = {name: text for name, text in url.options.items() if name not in own}
        target = f"{url.scheme}://{url.address}" + (f"?{urlencode(foreign)}" if foreign else "")
    asked = {**profile.line.model_dump(), **{name: value(text) for name, text in own.items()}}
    return partial(_open, url.text, target, settings_file.parse(asked, SerialLine, url.text))


def explain(device: str, error: OSError) -> str:
    """Return why a serial device cannot be opened, and what to do.

    Parameters
    ----------
    device : str
        Path of the device.
    error : OSError
        Error of the system or of pyserial.

    Returns
    -------
    str
        One sentence.
    """
    match error.errno:
        case errno.ENOENT | errno.ENODEV | errno.ENXIO:
            return f"there is no {device}; {_ports_there_are()}"
        case errno.EACCES | errno.EPERM:
            return f"no permission for {device}; {_who_may(device)}"
        case errno.EBUSY | errno.EAGAIN:
            users, _ = holders(Path(device).resolve())
            who = ", ".join(users) or f"another program (`sudo fuser -v {device}` names it)"
            return f"{device} is open in {who}: end that program"
        case _:
            return f"cannot open {device}: {error.strerror or error}"


def take_exclusively(descriptor: int) -> None:
    """Refuse the line to programs that open it later, where the driver can.

    Pyserial's lock is advisory: `cat`, which does not ask for it, would take a part of the bytes.

    Parameters
    ----------
    descriptor : int
        File descriptor of the open line.
    """
    with suppress(OSError):
        fcntl.ioctl(descriptor, termios.TIOCEXCL)


class DescriptorPort(Port):
    """Device with a file descriptor; one read of it is one arrival.

    Bytes in the input buffer at opening are kept: the decoder rejects what is no frame.

    Parameters
    ----------
    url : str
        As the user gave it.
    device : Serial or socket
        Open device, not blocking, closed by `close`.
    """

    def __init__(self, url: str, device: serial.Serial | socket.socket) -> None:
        super().__init__(url, Source.HARDWARE)
        self._device = device
        self._ready = [device.fileno()]
        self._take: Callable[[int], bytes] = (
            device.recv if isinstance(device, socket.socket) else partial(os.read, device.fileno())
        )
        self._closed = False

    def read(self, timeout_s: float) -> Arrival:
        """See `Port.read`."""
        if self._closed:
            raise PortLostError(f"{self.url}: the port is closed")
        try:
            ready = select.select(self._ready, (), (), timeout_s)[0]
            data = self._take(_AT_ONCE) if ready else b""
        except BlockingIOError:
            return Arrival(now_ns(), b"")
        except OSError as error:
            raise PortLostError(f"{self.url}: the port is gone: {error.strerror or error}") from error
        t_ns = now_ns()
        if ready and not data:
            raise PortLostError(f"{self.url}: the other end has gone")
        return Arrival(t_ns, data)

    def line_errors(self) -> LineErrors:
        """See `Port.line_errors`."""
        if sys.platform != "linux" or self._closed:
            return LineErrors()
        try:
            counts = fcntl.ioctl(self._ready[0], _TIOCGICOUNT, bytes(_COUNTS.size))
        except OSError:  # a pty, a socket, or a driver that does not count
            return LineErrors()
        framing, overrun, parity, _, buffer_overrun = _COUNTS.unpack(counts)[6:11]
        return LineErrors(framing, parity, overrun + buffer_overrun)

    def close(self) -> None:
        """See `Port.close`."""
        if not self._closed:
            self._closed = True
            self._device.close()


class PyserialPort(Port):
    """Device that only pyserial can read; a read may take 20 ms longer than its timeout.

    Parameters
    ----------
    url : str
        As the user gave it.
    device : Serial
        Open device with a timeout of 20 ms, closed by `close`.
    """

    def __init__(self, url: str, device: serial.Serial) -> None:
        super().__init__(url, Source.HARDWARE)
        self._device = device

    def read(self, timeout_s: float) -> Arrival:
        """See `Port.read`."""
        deadline_ns = now_ns() + int(timeout_s * 1e9)
        try:
            while not (data := self._device.read(1)) and now_ns() < deadline_ns:
                pass
            if data and (waiting := self._device.in_waiting):
                data += self._device.read(min(waiting, _AT_ONCE))
        except OSError as error:
            raise PortLostError(f"{self.url}: the port is gone: {error}") from error
        return Arrival(now_ns(), data)

    def close(self) -> None:
        """See `Port.close`."""
        self._device.close()


def _open(url: str, target: str, line: SerialLine) -> Port:
    settings: dict[str, Any] = {
        "baudrate": line.baudrate,
        "bytesize": line.bytesize,
        "parity": _PARITY[line.parity],
        "stopbits": line.stopbits,
        "timeout": _SLICE_S,
        "exclusive": True if os.name == "posix" else None,
    }
    try:
        device = serial.serial_for_url(target, do_not_open=True, **settings)
        # Otherwise opening a POSIX device discards its input buffer.
        vars(device)["_reset_input_buffer"] = lambda: None
        device.open()
    except KeyError as error:  # raised by pyserial while it reports an unknown option
        raise InputError(f"{url}: {error.__context__ or error}") from error
    except ValueError as error:
        cause = error.__context__
        if isinstance(cause, OSError) and cause.errno != errno.EINVAL:  # unplugged while its speed was set
            raise PortLostError(f"{url}: {explain(target, cause)}") from error
        raise InputError(f"{url}: {error}") from error
    except _SYSTEM_ERRORS as error:
        if "expected a string in the form" in str(error):
            raise InputError(f"{url}: {error}") from error
        reason = error if isinstance(error, OSError) else OSError(*error.args)
        raise PortLostError(f"{url}: {explain(target, reason)}") from error
    if os.name != "posix" or not isinstance(device, serial.Serial) or target.startswith("spy:"):
        return PyserialPort(url, device)
    if not Path(target).resolve().is_relative_to("/dev/pts"):  # the other end of a pty keeps the flag alive
        take_exclusively(device.fileno())
    with suppress(ValueError, OSError, NotImplementedError):  # not supported by ptys and some drivers
        device.set_low_latency_mode(True)
    return DescriptorPort(url, device)


def _connect(url: str, address: tuple[str, int]) -> Port:
    # Not by pyserial, which discards what was received before and waits 0.3 s at closing.
    try:
        connection = socket.create_connection(address, timeout=_CONNECT_S)
    except OSError as error:
        raise PortLostError(
            f"{url}: cannot connect: {error.strerror or error}; is the server running?"
        ) from error
    connection.setblocking(False)
    return DescriptorPort(url, connection)


def _host_and_port(url: Url) -> tuple[str, int]:
    try:
        parts = urlsplit(f"//{url.address}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or not port or parts.path:
        raise InputError(f"{url.text}: expected socket://HOST:PORT, got {url.address!r} as the address")
    if url.options:
        raise InputError(f"{url.text}: expected no options for socket://, got {', '.join(url.options)}")
    return host, port


def _require_device_name(url: Url) -> None:
    if os.name == "posix":
        device = Path(url.address)
        if not device.is_absolute():
            raise InputError(
                f"{url.text}: expected the path of a device like serial:///dev/ttyUSB0 (three slashes), "
                f"got {url.address!r}"
            )
        if device.exists() and not device.is_char_device():
            kind = "folder" if device.is_dir() else "file"
            raise InputError(
                f"{url.text}: expected a serial device, got a {kind}; a capture is read with "
                f"replay://{url.address}"
            )
    elif not url.address:
        raise InputError(f"{url.text}: expected the name of a device like serial://COM3, got none")


def _ports_there_are() -> str:
    named = sorted(map(str, Path("/dev/serial/by-id").glob("*")))
    names = named or sorted(port.device for port in comports())
    if not names:
        return "there is no serial port: is it plugged in?"
    more = ", ..." if len(names) > _SHOWN_PORTS else ""
    return f"there are {', '.join(names[:_SHOWN_PORTS])}{more}"


def _who_may(device: str) -> str:
    try:
        group = Path(device).group()
    except (OSError, KeyError):
        return "run as a user with permission"
    return f"its group is {group}: `sudo usermod -aG {group} $USER`, then log in again, or add a udev rule"
