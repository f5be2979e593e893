"""The operator's keys."""

import os
import select
import sys
import termios
import tty
from collections.abc import Callable
from types import TracebackType
from typing import Any, Final, Self

from calib.procedure.events import Abort, Action, Confirm, Redo, Skip, View

_ACTIONS: Final = {"\n": "confirm", "\r": "confirm", "r": "redo", "s": "skip", "q": "abort"}


_BY_STEP: Final[dict[str, Callable[[str], Action]]] = {"confirm": Confirm, "redo": Redo, "skip": Skip}


class Keyboard:
    """Keys, and what they ask for; Ctrl-C stays the system's.

    Where standard input is no terminal there are none.
    """

    def __init__(self) -> None:
        self.there = sys.stdin.isatty()
        self.asks = False
        self._fd = sys.stdin.fileno() if self.there else -1
        self._before: Any = None

    def __enter__(self) -> Self:
        if self.there:
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        if self.there:
            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    def read(self) -> str:
        """What was typed since the last time; a key that sends more than a character is left out."""
        if not self.there or not select.select([self._fd], [], [], 0.0)[0]:
            return ""
        typed = os.read(self._fd, 1024).decode(errors="replace")
        return "" if typed.startswith("\x1b") else typed.lower()

    def action(self, view: View) -> Action | None:
        """What was asked for, if it makes sense now; an abort only once it was asked for again.

        Parameters
        ----------
        view : View
            What the operator sees.

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
