"""Serial line, or any other device that pyserial can open.

A device with a file descriptor (line, pty, TCP connection) is read with `select` and one `read`, which has
the lowest latency; other devices are read by pyserial.
"""

import errno
import os
import select
import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, cast
from urllib.parse import urlencode

import serial
from serial.tools.list_ports import comports

from imudrv.errors import InputError
from imudrv.hostclock import now_ns
from imudrv.ports.base import OTHER_END_GONE, LineErrors, Port, PortLostError, require_transport
from imudrv.ports.holders import holders
from imudrv.ports.permission import permission_advice
from imudrv.posix import fcntl, termios
from imudrv.profiles.schema import Profile, SerialLine
from imudrv.records import Arrival, Source
from imudrv.url import Url, device_path, host_and_port, serial_settings

_AT_ONCE: Final = 1 << 16
_SLICE_S: Final = 0.02
"""Longest wait inside pyserial, s; a change of its timeout would set up an open line again."""
_CONNECT_S: Final = 1.0
_SHOWN_PORTS: Final = 10
_TIOCGICOUNT: Final = 0x545D  # Linux, asm-generic/ioctls.h
_OPEN_ERRORS: Final = (OSError,) if termios is None else (OSError, termios.error)
_COUNTS: Final = struct.Struct("20i")  # struct serial_icounter_struct, linux/serial.h


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
        return partial(_connect, url.text, host_and_port(url))
    own = url
    if url.scheme == "serial":
        target = _device(url)
    else:
        foreign = {name: text for name, text in url.options.items() if name not in SerialLine.model_fields}
        own = url._replace(options={name: text for name, text in url.options.items() if name not in foreign})
        target = f"{url.scheme}://{url.address}" + (f"?{urlencode(foreign)}" if foreign else "")
    line = cast(SerialLine, profile.line)  # by `require_transport`
    return partial(_open, url.text, target, serial_settings(own, line))


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
            return f"no permission for {device}; {permission_advice(Path(device))}"
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


def receiver_of(device: serial.Serial | socket.socket) -> Callable[[int], bytes]:
    """Return what reads at most a number of bytes that a device has now."""
    # Only on POSIX systems is a socket a file.
    return device.recv if isinstance(device, socket.socket) else partial(os.read, device.fileno())


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
        self._fd = device.fileno()
        self._receive = receiver_of(device)
        self._closed = False

    def read(self, timeout_s: float) -> Arrival:
        """See `Port.read`."""
        if self._closed:
            raise PortLostError(f"{self.url}: the port is closed")
        try:
            ready = select.select([self._fd], (), (), timeout_s)[0]
            data = self._receive(_AT_ONCE) if ready else b""
        except BlockingIOError:
            return Arrival(now_ns(), b"")
        except OSError as error:
            raise self.fault(error.errno or errno.EIO) from error
        t_ns = now_ns()
        if ready and not data:
            raise self.fault(OTHER_END_GONE)
        return Arrival(t_ns, data)

    @property
    def descriptor(self) -> int | None:
        """See `Port.descriptor`."""
        return None if self._closed else self._fd

    def line_errors(self) -> LineErrors:
        """See `Port.line_errors`."""
        if self._closed or fcntl is None:
            return LineErrors()
        try:
            counts = fcntl.ioctl(self._fd, _TIOCGICOUNT, bytes(_COUNTS.size))
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


def _open(url: str, target: str, settings: dict[str, Any]) -> Port:
    try:
        device = serial.serial_for_url(target, do_not_open=True, timeout=_SLICE_S, exclusive=True, **settings)
        # Otherwise opening a device discards its input buffer.
        vars(device)["_reset_input_buffer"] = lambda: None
        device.open()
    except KeyError as error:  # raised by pyserial while it reports an unknown option
        raise InputError(f"{url}: {error.__context__ or error}") from error
    except ValueError as error:
        cause = error.__context__
        if isinstance(cause, OSError) and cause.errno != errno.EINVAL:  # unplugged while its speed was set
            raise PortLostError(f"{url}: {explain(target, cause)}") from error
        raise InputError(f"{url}: {error}") from error
    except _OPEN_ERRORS as error:
        if "expected a string in the form" in str(error):
            raise InputError(f"{url}: {error}") from error
        reason = error if isinstance(error, OSError) else OSError(*error.args)
        raise PortLostError(f"{url}: {explain(target, reason)}") from error
    if termios is None or not isinstance(device, serial.Serial) or target.startswith("spy:"):
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


def _device(url: Url) -> str:
    device = Path(device_path(url))
    if termios is not None and os.path.exists(device) and not device.is_char_device():
        kind = "folder" if device.is_dir() else "file"
        raise InputError(
            f"{url.text}: expected a serial device, got a {kind}; a capture is read with "
            f"replay://{url.address}"
        )
    return url.address


def _ports_there_are() -> str:
    named = sorted(map(str, Path("/dev/serial/by-id").glob("*")))
    names = named or sorted(port.device for port in comports())
    if not names:
        return "there is no serial port: is it plugged in?"
    more = ", ..." if len(names) > _SHOWN_PORTS else ""
    return f"there are {', '.join(names[:_SHOWN_PORTS])}{more}"
