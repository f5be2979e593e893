"""A pipe that ends the wait of the kernel `imudrv.service.serve`: for signals and for other threads."""

import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress


class WakePipe:
    """Pipe whose reading end is among the descriptors that the kernel waits for."""

    def __init__(self) -> None:
        self._reader, self._writer = socket.socketpair()
        self._reader.setblocking(False)
        self._writer.setblocking(False)

    @property
    def descriptor(self) -> int:
        """Reading end."""
        return self._reader.fileno()

    def wake(self) -> None:
        """End the present wait, or the next one; for any thread."""
        with suppress(OSError):  # full, so that it wakes anyhow; or closed
            self._writer.send(b"\0")

    def clear(self) -> None:
        """Wait anew."""
        with suppress(BlockingIOError):
            self._reader.recv(1 << 16)

    @contextmanager
    def woken_by_signals(self) -> Iterator[None]:
        """Let signals that have a handler wake, too; only for the main thread."""
        before = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(before)

    def close(self) -> None:
        """Close both ends."""
        self._reader.close()
        self._writer.close()
