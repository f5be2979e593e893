"""What every port keeps to: where wire bytes or CAN messages come from, with their time of arrival."""

from abc import ABC, abstractmethod

from imudrv.errors import Imu50Error
from imudrv.records import Arrival, Source


class PortLostError(Imu50Error):
    """The port went away: unplugged, bus off, the other end gone. Open it again."""


class PortEndedError(Imu50Error):
    """A replay or a simulation has come to its end; nothing is wrong."""


class Port(ABC):
    """A way in.

    Who stamps: the port, right after the read that brought the data returned. What blocks: `read` alone, for
    its timeout at the most; it returns at once what is there already and never waits to gather more. How an
    unplug shows: `read` raises `PortLostError`, in whatever form the system reported it (`OSError`,
    `SerialException`, an empty read of a port that said it was ready). What `close` does: gives the device
    back, as often as it is called; a `read` after it raises `PortLostError`.

    Parameters
    ----------
    url : str
        What was opened, as the user gave it.
    source : Source
        What stands behind it.
    """

    def __init__(self, url: str, source: Source) -> None:
        self.url = url
        self.source = source

    @abstractmethod
    def read(self, timeout_s: float) -> Arrival:
        """Wait for data.

        Parameters
        ----------
        timeout_s : float
            Longest wait.

        Returns
        -------
        Arrival
            What was there, as much as one read of the device gives.

        Raises
        ------
        PortLostError
            The port went away.
        PortEndedError
            There will never be more.
        """

    @abstractmethod
    def close(self) -> None:
        """Give the device back."""
