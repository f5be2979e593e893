"""CAN bus of any interface that python-can knows."""

import difflib
import errno
import logging
import os
import socket
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

import can

from imudrv import system
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.ports.base import PortLostError, require_transport
from imudrv.ports.can_port import ID_MASK, CanPort, in_words
from imudrv.ports.serial import explain
from imudrv.ports.socketcan import SocketcanPort
from imudrv.profiles.schema import CanLine, Profile
from imudrv.records import EXTENDED
from imudrv.url import Url, value

# Our messages contain what python-can logs; without a handler it would go to the terminal.
logging.getLogger("can").addHandler(logging.NullHandler())

_BUFFER_BYTES: Final = 1 << 22
"""Receive buffer requested for a socket; the usual 200 kB hold only 0.1 s of messages."""
_RESERVED: Final = ("interface", "channel", "can_filters", "config_context", "ignore_config", "timing")
_TIMED: Final = ("pcan", "slcan")
"""Interfaces that take a data bit rate only as a complete bit timing."""
_ARPHRD_CAN: Final = "280"


def prepare(url: Url, profile: Profile) -> "Callable[[], CanPort]":
    """Check a ``can://`` URL.

    Parameters
    ----------
    url : Url
        ``can://INTERFACE/CHANNEL``.
    profile : Profile
        Profile of a CAN unit: default bit rates, and the only identifiers that are received.

    Returns
    -------
    callable
        Opens the port; raises `PortLostError` if the bus is absent.

    Raises
    ------
    InputError
        The URL is not valid.
    """
    require_transport(url, profile, "can")
    interface, _, channel = url.address.partition("/")
    if not interface or not channel:
        raise InputError(f"{url.text}: expected can://INTERFACE/CHANNEL like can://socketcan/can0")
    if interface not in can.VALID_INTERFACES:
        near = difflib.get_close_matches(interface, can.VALID_INTERFACES, 1)
        known = f"did you mean {near[0]}?" if near else f"known are {', '.join(sorted(can.VALID_INTERFACES))}"
        raise InputError(f"{url.text}: expected an interface of python-can, got {interface!r}; {known}")
    options: dict[str, Any] = {name: value(text) for name, text in url.options.items()}
    if taken := [name for name in options if name in _RESERVED]:
        raise InputError(
            f"{url.text}: expected other options, got {', '.join(taken)}; the URL or the profile sets these"
        )
    fd = options.pop("fd", profile.fd)
    if not isinstance(fd, bool):
        raise InputError(f"{url.text}: fd: expected true or false, got {url.options['fd']}")
    asked = {name: options.pop(name) for name in CanLine.model_fields if name in options}
    line = settings_file.parse({**profile.line.model_dump(), **asked}, CanLine, url.text)
    options |= _rates(url, interface, line, fd)
    filters = [
        {
            "can_id": kind.can_id & ID_MASK,
            "can_mask": kind.can_mask & ID_MASK,
            "extended": bool(kind.can_id & EXTENDED),
        }
        for kind in profile.layout().messages
    ]
    return partial(_open, url.text, interface, channel, {**options, "can_filters": filters})


def _rates(url: Url, interface: str, line: CanLine, fd: bool) -> dict[str, Any]:
    if not fd:
        return {"fd": False, "bitrate": line.bitrate}
    data_bitrate = line.data_bitrate or line.bitrate
    if interface not in _TIMED:
        return {"fd": True, "bitrate": line.bitrate, "data_bitrate": data_bitrate}
    try:
        timing = can.BitTimingFd.from_sample_point(80_000_000, line.bitrate, 80.0, data_bitrate, 75.0)
    except ValueError as error:
        raise InputError(f"{url.text}: {error}") from error
    return {"fd": True, "timing": timing}


def _open(url: str, interface: str, channel: str, options: dict[str, Any]) -> CanPort:
    try:
        bus = can.Bus(channel, interface, ignore_config=True, **options)
    except NotImplementedError as error:
        hint = "; pip install msgpack" if "msgpack" in str(error) else ""
        raise InputError(f"{url}: interface {interface} cannot be used here: {error}{hint}") from error
    except (TypeError, ValueError) as error:
        raise InputError(f"{url}: {error}") from error
    except Exception as error:  # a driver may raise anything
        if isinstance(error.__cause__, ValueError):
            raise InputError(f"{url}: {error}") from error
        raise PortLostError(f"{url}: {_why_not(interface, channel, error)}") from error
    _enlarge_buffer(bus)
    if interface == "socketcan" and system.IS_AVAILABLE:
        return SocketcanPort(url, bus)
    return CanPort(url, bus)


def _enlarge_buffer(bus: can.BusABC) -> None:
    with (
        suppress(OSError, NotImplementedError, can.CanError),
        socket.socket(fileno=os.dup(bus.fileno())) as receiver,
    ):
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)


def _why_not(interface: str, channel: str, error: Exception) -> str:
    cause = error.__cause__
    if interface == "slcan" and isinstance(cause, OSError):
        return explain(channel, cause)
    if interface == "socketcan" and isinstance(error, OSError):
        if error.errno == errno.ENODEV:
            return f"there is no CAN interface {channel}; {_interfaces_there_are()}"
        if error.errno == errno.EAFNOSUPPORT:
            return "the kernel has no CAN support (module can_raw)"
    return f"cannot open it: {in_words(error)}"


def _interfaces_there_are() -> str:
    kinds = sorted(Path("/sys/class/net").glob("*/type"))
    names = [kind.parent.name for kind in kinds if kind.read_text().strip() == _ARPHRD_CAN]
    return (
        f"there are {', '.join(names)}" if names else "there is no CAN interface: is the adapter plugged in?"
    )
