"""Base classes of the lines that a simulated unit sends on."""

import os
import select
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, cast

from imudrv.errors import InputError
from imudrv.records import Records

TIMEOUT_S: Final = 1.0
"""Time after which a TCP client that reads nothing is disconnected, and allowed for the last bytes, s."""
POLL_S: Final = 0.1
"""Longest wait between two looks at `LineOptions.stop`, s."""
RETRY_S: Final = 0.002
"""Pause between two attempts, s."""
READ_BYTES: Final = 4096
"""Bytes read at a time of what a reader sends; they are discarded, for they are meant for a real unit."""


@dataclass(frozen=True)
class LineOptions:
    """Options of every line.

    Parameters
    ----------
    name : str
        Name of the profile, for messages.
    waits : bool
        Wait for a reader without limit; otherwise what nobody reads is dropped and counted.
    say : callable
        Receives messages for the user.
    stop : Event
        Ends every wait.
    """

    name: str
    waits: bool
    say: Callable[[str], None]
    stop: threading.Event


class SimulatedLine(ABC):
    """Line that a simulated unit sends on; it can be unplugged.

    Parameters
    ----------
    options : LineOptions
        Options of every line.

    Attributes
    ----------
    sent, undelivered : int
        Bytes, on CAN messages, that were delivered, and that were not.
    """

    def __init__(self, options: LineOptions) -> None:
        self.sent = 0
        self.undelivered = 0
        self._waits = options.waits
        self._say = options.say
        self._stop = options.stop

    def wait_for_reader(self) -> None:
        """Wait for a reader, where the line can detect one."""
        return

    @abstractmethod
    def send(self, data: bytes | Records) -> None:
        """Send data and service the line; return when the data are sent or dropped.

        Parameters
        ----------
        data : bytes or ndarray of MESSAGE
            Bytes, on a CAN bus messages; empty if nothing is due.
        """

    def unplug(self) -> None:
        """Disconnect the cable."""
        return

    def plug(self) -> None:
        """Connect the cable."""
        return

    def finish(self) -> None:
        """Wait at most `TIMEOUT_S` until the reader has read what was sent."""
        return

    @abstractmethod
    def close(self) -> None:
        """Close the line."""


class FileLine(SimulatedLine):
    """Line on a file descriptor, which is -1 while unplugged."""

    _fd = -1

    def _has_reader(self) -> bool:
        return self._fd >= 0

    def send(self, data: bytes | Records) -> None:
        """Send bytes."""
        rest = memoryview(cast(bytes, data))  # only CAN profiles make messages
        while rest:
            if not self._has_reader():
                if not self._waits or self._fd < 0 or self._stop.is_set():
                    break
                self.wait_for_reader()
                continue
            readable, writable, _ = select.select([self._fd], [self._fd], [], POLL_S)
            if not writable and self._stop.is_set():
                break
            try:
                if readable:
                    os.read(self._fd, READ_BYTES)
                if writable:
                    written = os.write(self._fd, rest)
                    self.sent += written
                    rest = rest[written:]
            except BlockingIOError:
                continue
            except OSError as error:
                if not self._has_reader():  # it has left since
                    continue
                raise InputError(f"the port went away: {error.strerror}") from error
        self.undelivered += len(rest)

    def unplug(self) -> None:
        """Close the port."""
        self.finish()
        self.close()
