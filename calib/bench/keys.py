"""Keyboard of the operator."""

import os
import select
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from queue import Empty, SimpleQueue
from threading import Thread
from types import TracebackType
from typing import Any, Final, Self

from calib.messages import Message, message
from calib.procedure.events import Abort, Action, Confirm, Redo, Skip, View
from imudrv.posix import termios, tty

BY_LINES: Final = termios is None
"""Whether the system delivers keys only line by line, each after Enter."""

_POLL_S: Final = 0.05

KEYS: Final = {
    "\n": "confirm",
    "\r": "confirm",
    "r": "redo",
    "s": "skip",
    "b": "back",
    "q": "abort",
}
"""Action of each key."""

QUESTIONS: Final = {
    "redo": message("ask_redo"),
    "skip": message("ask_skip"),
    "back": message("ask_back"),
    "abort": message("ask_abort"),
}
"""What is asked before an action, because it gives work up."""


def action_of(name: str, view: View) -> Action:
    """Return the action of a name, for the step of a view in which it is possible."""
    if name == "abort":
        return Abort()
    if name == "back":
        return Redo(view.skipped[-1])
    by_step: dict[str, Callable[[str], Action]] = {"confirm": Confirm, "redo": Redo, "skip": Skip}
    return by_step[name](view.step_id)


class Keyboard:
    """Keys of the terminal, and their actions; Ctrl-C keeps its usual effect.

    There are none if standard input is no terminal.

    Attributes
    ----------
    there : bool
        Whether there is a terminal.
    question : Message or None
        What the operator has to answer by y or n.
    """

    def __init__(self) -> None:
        self.there = sys.stdin.isatty()
        self.question: Message | None = None
        self._asked: tuple[str, str] | None = None  # action and step
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
        """Return the action of the keys typed, if it is possible now and a question about it was answered.

        Parameters
        ----------
        view : View
            View that the operator sees.

        Returns
        -------
        Confirm, Redo, Skip, Abort or None
        """
        for key in self.read():
            asked, name = self._asked, KEYS.get(key)
            self._asked = self.question = None
            if asked is not None:
                name, step_id = asked
                if key == "y" and name in view.actions and step_id == view.step_id:
                    return action_of(name, view)
            elif name in QUESTIONS and name in view.actions:
                self._asked, self.question = (name, view.step_id), QUESTIONS[name]
            elif name is not None and name in view.actions:
                return action_of(name, view)
        return None

    def answer(self) -> bool | None:
        """Return the answer to a question, by y or n; None: not yet."""
        return next((key == "y" for key in self.read() if key in "yn"), None)

    def wait_for_answer(self) -> bool:
        """Return the answer to a question, see `answer`."""
        while (answer := self.answer()) is None:
            time.sleep(_POLL_S)
        return answer

    def _read_lines(self) -> None:
        while line := os.read(self._fd, 1024):
            self._typed.put(line.decode(errors="replace").strip().lower() or "\n")
