"""CAN bus that python-can reads."""

import errno
from contextlib import suppress
from typing import Final

import can
import numpy as np

from imudrv.hostclock import now_ns
from imudrv.ports.base import Port, PortLostError
from imudrv.records import EXTENDED, MESSAGE, MESSAGE_ROW, Arrival, Records, Source

ID_MASK: Final = 0x1FFFFFFF
_AT_ONCE: Final = 4096
"""Maximum number of messages of one read."""
_BUS_OFF: Final = 0x40
"""Bit in the identifier of an error frame (linux/can/error.h)."""


class CanPort(Port):
    """CAN bus; error and remote frames are dropped.

    Parameters
    ----------
    url : str
        As the user gave it.
    bus : can.BusABC
        Open bus, shut down by `close`.
    """

    def __init__(self, url: str, bus: can.BusABC) -> None:
        super().__init__(url, Source.HARDWARE)
        self.bus = bus
        self._closed = False

    def read(self, timeout_s: float) -> Arrival:
        """See `Port.read`; each message has its own time of arrival."""
        if self._closed:
            raise PortLostError(f"{self.url}: the port is closed")
        rows = []
        message = self._receive(timeout_s)
        while message is not None:
            if message.is_error_frame:
                if message.arbitration_id & _BUS_OFF:
                    raise self.bus_off()
            elif not message.is_remote_frame:
                data, identifier = message.data, message.arbitration_id & ID_MASK
                identifier |= EXTENDED * message.is_extended_id
                rows.append(MESSAGE_ROW.pack(now_ns(), identifier, len(data), message.is_fd, data))
            message = self._receive(0) if len(rows) < _AT_ONCE else None
        if not rows and self._is_off():
            raise self.bus_off()
        # A bytearray: arrays over bytes are read-only, which is another type for the kernels.
        messages: Records = np.frombuffer(bytearray().join(rows), MESSAGE)
        return Arrival(now_ns(), messages)

    def close(self) -> None:
        """See `Port.close`."""
        if self._closed:
            return
        self._closed = True
        with suppress(Exception):  # a driver may raise anything
            self.bus.shutdown()
        # If a serial adapter is unplugged, shutdown fails to stop it and does not close the device.
        device = getattr(self.bus, "serialPortOrig", None)
        if device is not None:
            device.close()

    def _is_off(self) -> bool:
        try:
            return self.bus.state is can.BusState.ERROR
        except NotImplementedError:
            return False
        except Exception as error:  # a driver may raise anything
            raise self.lost(error) from error

    def bus_off(self) -> PortLostError:
        """Return the loss of a controller that has left the bus."""
        return PortLostError(f"{self.url}: the controller is bus-off; check wiring and bit rate")

    def _receive(self, timeout_s: float) -> can.Message | None:
        try:
            return self.bus.recv(timeout_s)
        except (ValueError, IndexError):
            return None  # a line of the adapter that is no message
        except Exception as error:  # a driver may raise anything
            if str(error) == "could not unpack received message":
                return None  # a datagram of another program
            raise self.lost(error) from error

    def lost(self, error: Exception) -> PortLostError:
        """Return the loss that an error of the driver means."""
        return PortLostError(f"{self.url}: {in_words(error)}")


def in_words(error: Exception) -> str:
    """Return what an error of a driver says, and what to do."""
    code = error.error_code if isinstance(error, can.CanError) else getattr(error, "errno", None)
    if code == errno.ENETDOWN:
        return "the CAN interface is down; `sudo ip link set NAME up type can bitrate RATE`"
    cause = error.__cause__
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return f"{text}: {cause}" if isinstance(cause, OSError) and str(cause) not in text else text
