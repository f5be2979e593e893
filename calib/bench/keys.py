"""Keyboard of the operator."""

import os
import select
import sys
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Thread
from types import TracebackType
from typing import Any, Final, Self

from calib.procedure.events import Abort, Action, Confirm, Redo, Skip, View
from imudrv.posix import termios, tty

BY_LINES: Final = termios is None
"""Whether the system delivers keys only line by line, each after Enter."""

_ACTIONS: Final = {"\n": "confirm", "\r": "confirm", "r": "redo", "s": "skip", "q": "abort"}


_BY_STEP: Final[dict[str, Callable[[str], Action]]] = {"confirm": Confirm, "redo": Redo, "skip": Skip}


class Keyboard:
    """Keys of the terminal, and the actions they stand for; Ctrl-C keeps its usual effect.

    There are none if standard input is no terminal.

    Attributes
    ----------
    there : bool
        Whether there is a terminal.
    asks : bool
        Whether an abort has to be confirmed by another key.
    """

    def __init__(self) -> None:
        self.there = sys.stdin.isatty()
        self.asks = False
        self._fd = sys.stdin.fileno() if self.there else -1
        self._before: Any = None
        self._typed: SimpleQueue[str] = SimpleQueue()

    def __enter__(self) -> Self:
        if self.there and BY_LINES:
            Thread(target=self._read_lines, name="keyboard", daemon=True).start()
        elif self.there:
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        if self.there and not BY_LINES:
            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def read(self) -> str:
        """Return the keys typed since the last call; escape sequences are ignored."""
        if BY_LINES:
            keys = ""
            with suppress(Empty):
                while True:
                    keys += self._typed.get_nowait()
            return keys
        if not self.there or not select.select([self._fd], [], [], 0.0)[0]:
            return ""
        typed = os.read(self._fd, 1024).decode(errors="replace")
        return "" if typed.startswith("\x1b") else typed.lower()

    def action(self, view: View) -> Action | None:
        """Return the action of the keys typed, if it is possible now; an abort must be repeated.

        Parameters
        ----------
        view : View
            View that the operator sees.

        Returns
        -------
        Confirm, Redo, Skip, Abort or None
        """
        for key in self.read():
            name = _ACTIONS.get(key)
            asked, self.asks = self.asks, False
            if name not in view.actions:
                continue
            if name == "abort":
                if asked:
                    return Abort()
                self.asks = True
                continue
            return _BY_STEP[name](view.step_id)
        return None

    def _read_lines(self) -> None:
        while line := os.read(self._fd, 1024):
            self._typed.put(line.decode(errors="replace").strip().lower() or "\n")
