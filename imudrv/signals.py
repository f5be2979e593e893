"""Handlers of signals, for a time."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

SIGHUP: Final[signal.Signals | None] = getattr(signal, "SIGHUP", None)
"""The terminal was closed, or the calibration is to be read again; None on Windows, which lacks it."""


@contextmanager
def handled(
    handler: Callable[[int, FrameType | None], object], *numbers: signal.Signals | None
) -> Iterator[None]:
    """Handle signals within the context; the handlers from before it come back. None: not on this system."""
    before = {number: signal.signal(number, handler) for number in numbers if number is not None}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)
