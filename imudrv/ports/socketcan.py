"""CAN bus of Linux: messages are read from the socket that python-can has opened, filtered and set up.

`receive` is the only reader of these sockets, for the live loop without Python and for `SocketcanPort.read`.
"""

import os
import select
from typing import Final

import can
import numpy as np
from numpy.typing import NDArray

from imudrv.hostclock import OFFSET_NS, now_ns
from imudrv.kernels import kernel
from imudrv.ports.base import OTHER_END_GONE, PortLostError
from imudrv.ports.can_port import CanPort
from imudrv.records import EXTENDED, MESSAGE, Arrival, Records
from imudrv.system import CLOCK_BOOTTIME, EAGAIN, EINTR, clock_ns, recv

MESSAGES_AT_ONCE: Final = 1024
"""Most messages of one read."""
BUS_OFF: Final = -2
"""Error of `receive` that is not one of the system: the controller has left the bus."""

_HEADER_BYTES: Final = 8
_CLASSIC_BYTES: Final = 16  # struct can_frame and canfd_frame of linux/can.h
FRAME_BYTES: Final = 72
_ERROR_FRAME: Final = 0x20000000
_REMOTE_FRAME: Final = 0x40000000
_BUS_OFF_BIT: Final = 0x40  # linux/can/error.h
_LONG_ID: Final = EXTENDED | 0x1FFFFFFF
_SHORT_ID: Final = 0x7FF


class SocketcanPort(CanPort):
    """CAN bus of Linux; error and remote frames are dropped.

    Parameters
    ----------
    url : str
        As the user gave it.
    bus : can.BusABC
        Open bus, shut down by `close`.
    """

    def __init__(self, url: str, bus: can.BusABC) -> None:
        super().__init__(url, bus)
        self._fd = bus.fileno()
        self._messages = np.zeros(MESSAGES_AT_ONCE, MESSAGE)
        self._frame: NDArray[np.uint8] = np.zeros(FRAME_BYTES, np.uint8)
        self._timespec: NDArray[np.int64] = np.zeros(2, np.int64)
        self._error = 0  # came after the messages of the read before

    def read(self, timeout_s: float) -> Arrival:
        """See `Port.read`; each message has its own time of arrival."""
        if self._closed:
            raise PortLostError(f"{self.url}: the port is closed")
        if not self._error and select.select([self._fd], (), (), timeout_s)[0]:
            count, self._error = receive(self._fd, self._frame, self._timespec, OFFSET_NS, self._messages)
            if count:
                return Arrival(now_ns(), self._messages[:count].copy())
        if self._error:
            raise self.fault(self._error)
        return Arrival(now_ns(), self._messages[:0].copy())

    @property
    def descriptor(self) -> int | None:
        """See `Port.descriptor`."""
        return None if self._closed else self._fd

    def fault(self, error: int) -> PortLostError:
        """See `Port.fault`."""
        if error == BUS_OFF:
            return self.bus_off()
        if error == OTHER_END_GONE:
            return super().fault(error)
        return self.lost(OSError(error, os.strerror(error)))


@kernel
def receive(
    fd: int, frame: NDArray[np.uint8], timespec: NDArray[np.int64], offset_ns: int, messages: Records
) -> tuple[int, int]:
    """Receive all messages that wait in a socket, as far as there is room.

    Parameters
    ----------
    fd : int
        Socket.
    frame : ndarray of uint8, shape (FRAME_BYTES,)
    timespec : ndarray of int64, shape (2,)
        Room for the system's answers.
    offset_ns : int
        Time of arrival less CLOCK_BOOTTIME.
    messages : ndarray of MESSAGE
        Receives the messages.

    Returns
    -------
    tuple of int
        Number of messages, and the error after them: 0, an errno, `OTHER_END_GONE` or `BUS_OFF`. The system
        reports an error once only.
    """
    words = frame.view(np.uint32)
    count = 0
    while count < len(messages):
        size = recv(fd, frame)
        if size == -EAGAIN:
            break
        if size == -EINTR:
            continue
        if size < 0:
            return count, -size
        if size == 0:
            return count, OTHER_END_GONE
        identifier = np.int64(words[0])
        if size not in (_CLASSIC_BYTES, FRAME_BYTES) or identifier & _REMOTE_FRAME:
            continue
        if identifier & _ERROR_FRAME:
            if identifier & _BUS_OFF_BIT:
                return count, BUS_OFF
            continue
        message = messages[count]
        message["t_ns"] = clock_ns(CLOCK_BOOTTIME, timespec) + offset_ns
        message["id"] = identifier & (_LONG_ID if identifier & EXTENDED else _SHORT_ID)
        message["fd"] = size == FRAME_BYTES
        length = min(int(frame[4]), size - _HEADER_BYTES)
        message["length"] = length
        for k in range(FRAME_BYTES - _HEADER_BYTES):
            message["data"][k] = frame[_HEADER_BYTES + k] if k < length else 0
        count += 1
    return count, 0
