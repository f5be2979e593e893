"""Pseudo terminal with an optional stable name."""

import array
import os
import secrets
import select
import time
from contextlib import suppress
from pathlib import Path
from typing import Final

from imudrv.errors import InputError
from imudrv.posix import fcntl, require_posix, termios, tty
from imudrv.sim.links.base import READ_BYTES, RETRY_S, TIMEOUT_S, FileLine, LineOptions

SETTLE_S: Final = 0.25
"""Time that a reader has to flush and set up the port after opening it, s."""


class SimulatedPty(FileLine):
    """Master of a pseudo terminal.

    Parameters
    ----------
    options : LineOptions
        Options of every line.
    link : str or None
        Symbolic link to the slave, renewed with each pty.

    Raises
    ------
    InputError
        The link cannot be made.
    """

    def __init__(self, options: LineOptions, link: str | None) -> None:
        super().__init__(options)
        require_posix("port pty", "use tcp://127.0.0.1:PORT instead")
        self._link = Path(link) if link is not None else None
        if self._link is not None and self._link.exists() and not self._link.is_symlink():
            raise InputError(f"link {link}: expected an unused name, got a file; choose another name")
        self._path = ""
        self.plug()
        self._say(f"{options.name} plays on {self._link or self._path}")

    def plug(self) -> None:
        """Make a pty."""
        self._fd, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._fd, False)
        self._path = os.ttyname(slave)
        os.close(slave)
        if self._link is not None:
            try:
                # a new link replaces the old one: at any time a reader finds one of them
                new = self._link.with_name(f".{self._link.name}.{secrets.token_hex(4)}")
                new.symlink_to(self._path)
                new.replace(self._link)
            except OSError as error:
                self.close()
                raise InputError(f"link {self._link}: cannot be made: {error.strerror}") from error

    def _has_reader(self) -> bool:
        if self._fd < 0:
            return False
        poll = select.poll()
        poll.register(self._fd, 0)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))

    def wait_for_reader(self) -> None:
        """Wait until a reader has opened the slave and set it up."""
        while not self._has_reader() and not self._stop.is_set():
            time.sleep(RETRY_S)
        self._stop.wait(SETTLE_S)

    def finish(self) -> None:
        """Wait until everything has been read: what is unread is lost when the pty closes."""
        if not self._has_reader():
            return
        slave = os.open(self._path, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        try:
            unread, since, empty = queued_bytes(slave), time.monotonic(), 0
            # A reader may empty the queue just before the rest is moved there: it is looked at several times.
            while empty < 5 and time.monotonic() - since < TIMEOUT_S:
                time.sleep(RETRY_S)
                before, unread = unread, queued_bytes(slave)
                empty = empty + 1 if unread == 0 else 0
                if unread != before:
                    since = time.monotonic()
            left = 0
            with suppress(BlockingIOError):  # at its end; the queue shows at most 4 KiB
                while piece := os.read(slave, READ_BYTES):
                    left += len(piece)
        finally:
            os.close(slave)
        self.sent -= left
        self.undelivered += left

    def close(self) -> None:
        """Remove the link and close the pty, in this order: no reader finds a closed pty."""
        if self._fd < 0:
            return
        if self._link is not None and self._link.is_symlink():
            with suppress(OSError):
                if os.readlink(self._link) == self._path:
                    self._link.unlink()
        os.close(self._fd)
        self._fd = -1


def queued_bytes(fd: int) -> int:
    """Return the number of bytes in a terminal's input queue; not 0 while some are on their way there."""
    ready, _, _ = select.select([fd], [], [], 0)  # moves what was written but not handed over to the queue
    count = array.array("i", [0])
    fcntl.ioctl(fd, termios.FIONREAD, count)
    return count[0] or len(ready)
