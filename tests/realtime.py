"""What the tests of real processes, lines and sockets share: waiting for outcomes, and free ports."""

import socket
import time
from collections.abc import Callable

DEADLINE_S = 600.0
"""Longest wait for an outcome. Nothing is judged by time: the deadline only ends a broken test."""


def until(true: Callable[[], object], what: str = "the outcome") -> None:
    """Wait for something that must come."""
    end = time.monotonic() + DEADLINE_S
    while not true():
        assert time.monotonic() < end, f"waited in vain: {what}"
        time.sleep(0.01)


def free_port() -> int:
    """Return a UDP port that nobody has; tests that run side by side must not share one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])
