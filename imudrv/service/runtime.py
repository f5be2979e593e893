"""What the service needs from the system: memory, real-time priority, signals, the service manager."""

import ctypes
import gc
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Final

from imudrv.posix import resource
from imudrv.signals import SIGHUP, handled

PRIORITY: Final = 40
"""SCHED_FIFO priority: above ordinary work, below the kernel's interrupt threads (50)."""


_MCL_CURRENT_AND_FUTURE: Final = 3


@contextmanager
def frozen_gc() -> Iterator[None]:
    """Keep the garbage collector from interrupting the loop: existing objects are kept, none is searched."""
    gc.collect()
    gc.freeze()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
        gc.unfreeze()


def ask_realtime() -> str | None:
    """Ask for SCHED_FIFO and locked memory.

    Returns
    -------
    str or None
        Why it was refused and what to do; None if it was granted.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except (AttributeError, OSError) as error:
        limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0] if hasattr(resource, "RLIMIT_RTPRIO") else 0
        return (
            f"SCHED_FIFO priority {PRIORITY} was not granted ({error}; the limit is {limit}); "
            "set LimitRTPRIO=50 in the unit file, or rtprio in /etc/security/limits.d"
        )
    if ctypes.CDLL(None, use_errno=True).mlockall(_MCL_CURRENT_AND_FUTURE) != 0:
        reason = os.strerror(ctypes.get_errno())
        return f"memory was not locked ({reason}); set LimitMEMLOCK=infinity in the unit file"
    return None


class SignalFlags:
    """Signals for the loop, which checks them at each step.

    SIGTERM and SIGINT end it. SIGHUP makes it read the calibration again, but ends it if the terminal was
    closed.

    Attributes
    ----------
    stop, reload : bool
        Whether to end, and whether to read the calibration again.
    hung_up : bool
        Whether it ends because the terminal was closed.
    """

    def __init__(self) -> None:
        self.stop = False
        self.reload = False
        self.hung_up = False
        self._has_terminal = os.isatty(0)

    def _handle(self, number: int, _: object) -> None:
        if number == SIGHUP and os.isatty(0) == self._has_terminal:
            self.reload = True
        elif not self.stop:
            self.stop = True
            self.hung_up = number == SIGHUP

    def caught(self, *numbers: signal.Signals | None) -> AbstractContextManager[None]:
        """Handle these signals within the context."""
        return handled(self._handle, *numbers)


class SystemdNotifier:
    """Notifications to the service manager that started the process, if any: sd_notify(3) of systemd."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "").replace("@", "\0", 1)
        period_us = os.environ.get("WATCHDOG_USEC", "")
        self._period_ns = int(period_us) * 1000 // 3 if period_us.isdigit() else 0
        self._next_ns = 0

    def notify(self, message: str) -> None:
        """Send a message, such as ``READY=1``; a manager that has ended is ignored."""
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as channel:
            try:
                channel.sendto(message.encode(), self._address)
            except OSError:
                self._address = ""

    def feed_watchdog(self, now_ns: int) -> None:
        """Feed the watchdog, three times in its period."""
        if self._period_ns and now_ns >= self._next_ns:
            self._next_ns = now_ns + self._period_ns
            self.notify("WATCHDOG=1")
