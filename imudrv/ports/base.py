"""Interface of a port, the source of wire bytes or CAN messages with their times of arrival."""

import os
from abc import ABC, abstractmethod
from typing import Final, NamedTuple, Self

from imudrv.errors import Imu50Error, InputError
from imudrv.profiles.schema import Profile
from imudrv.records import Arrival, Source
from imudrv.url import Url

OTHER_END_GONE: Final = -1
"""Error of a port that was ready and gave no bytes."""


class PortLostError(Imu50Error):
    """The port was lost: unplugged, bus off, disconnected. Open it again."""


class PortEndedError(Imu50Error):
    """A replay or a simulation has ended; this is no fault."""


class LineErrors(NamedTuple):
    """Errors that the driver of a serial line has counted.

    Parameters
    ----------
    framing, parity : int
        Bytes without a stop bit where one was expected, and with a wrong parity bit.
    overrun : int
        Bytes lost in the hardware, or because the buffer of the driver was full.
    """

    framing: int = 0
    parity: int = 0
    overrun: int = 0

    def since(self, before: Self) -> "LineErrors":
        """Return the errors since an earlier count."""
        return LineErrors(*(now - then for now, then in zip(self, before, strict=True)))

    def __str__(self) -> str:
        """Errors that occurred, such as ``12 framing errors, 3 overruns``; empty if none."""
        names = ("framing errors", "parity errors", "overruns")
        return ", ".join(f"{count} {name}" for count, name in zip(self, names, strict=True) if count)


class Port(ABC):
    """Source of wire data.

    The port stamps data right after the read that returned them. Only `read` blocks, at most for its timeout;
    it returns available data at once and never waits for more. After an unplug `read` raises `PortLostError`,
    however the system reports it (`OSError`, `SerialException`, an empty read of a port that was ready).
    `close` may be called repeatedly; a `read` after it raises `PortLostError`.

    Parameters
    ----------
    url : str
        URL as the user gave it.
    source : Source
        Kind of data source.
    """

    def __init__(self, url: str, source: Source) -> None:
        self.url = url
        self.source = source

    @abstractmethod
    def read(self, timeout_s: float) -> Arrival:
        """Return available data, or wait for some.

        Parameters
        ----------
        timeout_s : float
            Longest wait.

        Returns
        -------
        Arrival
            The data of one read of the device; empty after the timeout.

        Raises
        ------
        PortLostError
            The port was lost.
        PortEndedError
            There are no more data.
        """

    @property
    def descriptor(self) -> int | None:
        """Descriptor that gives wire bytes, or frames of SocketCAN, without blocking; None if none does."""
        return None

    def fault(self, error: int) -> PortLostError:
        """Return the loss that an error means which the reader of the descriptor has received.

        Parameters
        ----------
        error : int
            Error of the system, `OTHER_END_GONE`, or another negative number of the port's own.
        """
        if error == OTHER_END_GONE:
            return PortLostError(f"{self.url}: the other end has gone")
        return PortLostError(f"{self.url}: the port is gone: {os.strerror(error)}")

    def line_errors(self) -> LineErrors:
        """Return the errors that the driver has counted; zeros where it does not count."""
        return LineErrors()

    @abstractmethod
    def close(self) -> None:
        """Close the device."""


def require_transport(url: Url, profile: Profile, transport: str) -> None:
    """Refuse a profile whose transport is not that of the port.

    Raises
    ------
    InputError
        The message names the URLs that fit the profile.
    """
    if profile.transport != transport:
        fitting = "can://INTERFACE/CHANNEL" if profile.transport == "can" else "serial:///dev/..."
        raise InputError(
            f"{url.text}: expected a port for the {profile.transport} profile {profile.name}, "
            f"like {fitting}, got a {transport} port; change the URL or the profile"
        )
