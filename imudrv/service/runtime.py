"""What the service asks of the system: quiet memory, a real-time place, signals, the service manager."""

import ctypes
import gc
import os
import resource
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

PRIORITY: Final = 40
"""SCHED_FIFO priority: above ordinary work, below the kernel's interrupt threads (50)."""


_MCL_CURRENT_AND_FUTURE: Final = 3


@contextmanager
def frozen_gc() -> Iterator[None]:
    """Keep the garbage collector from stopping the loop: what stands now is kept, nothing is searched."""
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
        Why not, with what to do; None: granted.
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
    """SIGTERM and SIGINT end the loop, SIGHUP makes it read the calibration again; seen at its next turn.

    A SIGHUP because the terminal has gone ends it too: nobody is there any more.

    Attributes
    ----------
    stop, reload : bool
        Requested: the end, and that the calibration is read again.
    hung_up : bool
        Whether the end is due to the terminal and not to a request.
    """

    def __init__(self) -> None:
        self.stop = False
        self.reload = False
        self.hung_up = False
        self._has_terminal = os.isatty(0)

    def _handle(self, number: int, _: object) -> None:
        if number == signal.SIGHUP and os.isatty(0) == self._has_terminal:
            self.reload = True
        elif not self.stop:
            self.stop = True
            self.hung_up = number == signal.SIGHUP

    @contextmanager
    def caught(self, *numbers: signal.Signals) -> Iterator[None]:
        """Handle these while inside."""
        before = {number: signal.signal(number, self._handle) for number in numbers}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


class SystemdNotifier:
    """The service manager, where one started us (systemd's notify protocol, sd_notify(3))."""

    def __init__(self) -> None:
        self._address = os.environ.get("NOTIFY_SOCKET", "").replace("@", "\0", 1)
        period_us = os.environ.get("WATCHDOG_USEC", "")
        self._period_ns = int(period_us) * 1000 // 3 if period_us.isdigit() else 0
        self._next_ns = 0

    def tell(self, message: str) -> None:
        """Send a message, such as ``READY=1``; a manager that is gone does not matter."""
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as channel:
            try:
                channel.sendto(message.encode(), self._address)
            except OSError:
                self._address = ""

    def alive(self, now_ns: int) -> None:
        """Feed the watchdog three times in its period."""
        if self._period_ns and now_ns >= self._next_ns:
            self._next_ns = now_ns + self._period_ns
            self.tell("WATCHDOG=1")
