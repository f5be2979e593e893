"""Text for people from a command that serves a unit: printed by a thread of its own.

A terminal that is stopped (Ctrl-S), a pipe that nobody reads and a full disk hold or fail that thread alone.
"""

import os
import select
import time
from contextlib import suppress
from queue import Empty, Full, Queue
from threading import Thread
from types import TracebackType
from typing import Final, Self, TextIO

LIMIT: Final = 1000
"""Maximum number of lines that wait to be printed."""


STOPPED_S: Final = 1.0
"""An output that has not taken a line after this time is reported as stopped."""


_LAST_S: Final = 1.0


class Printer:
    """Prints lines in the background.

    `say` neither blocks nor raises. The oldest lines of a full queue, and lines that cannot be written, are
    lost and counted; the output says so once it works again.

    Parameters
    ----------
    stream : text file or None
        ``sys.stdout`` or ``sys.stderr``; None, as Python has it in a process that was started with the
        stream closed: nobody wants the text.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._name, self._encoding = os.devnull, "utf-8"
        # The descriptor, since at exit Python flushes the stream and waits for a thread that writes to it.
        if stream is None:
            self._fd = os.open(os.devnull, os.O_WRONLY)
        else:
            self._name, self._encoding = str(stream.name).strip("<>"), stream.encoding
            self._fd = stream.fileno()
        self._failure = ""
        self._writing_since_s: float | None = None
        self._overflowed = self._unwritten = 0  # each counted by one thread, so nothing is locked
        self._lines: Queue[str | None] = Queue(LIMIT)
        self._thread = Thread(target=self._run, name="printer", daemon=True)
        self._thread.start()

    def say(self, text: str) -> None:
        """Print a line, soon.

        Parameters
        ----------
        text : str
            Without the line break at its end.
        """
        while True:
            try:
                self._lines.put_nowait(text)
                return
            except Full:
                with suppress(Empty):
                    self._lines.get_nowait()
                    self._overflowed += 1

    @property
    def lost(self) -> int:
        """Number of lines that were not printed and never will be."""
        return self._overflowed + self._unwritten

    @property
    def failure(self) -> str:
        """Why the last line could not be written; empty if it could."""
        return self._failure and f"{self._name}: cannot be written: {self._failure}; lost lines: {self.lost}"

    def notices(self) -> list[str]:
        """What is wrong with the output now, for the status: one sentence, or none."""
        since_s = self._writing_since_s
        if since_s is None or time.monotonic() - since_s < STOPPED_S:
            return [self.failure] if self.failure else []
        return [
            f"{self._name}: takes no text, is the terminal stopped (Ctrl-S)? "
            f"waiting lines: {self._lines.qsize() + 1}, lost: {self.lost}"
        ]

    def close(self) -> None:
        """Print what waits, for two seconds at most."""
        try:
            self._lines.put(None, timeout=_LAST_S)
        except Full:
            return
        self._thread.join(_LAST_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self.close()

    def _run(self) -> None:
        reported = 0
        while (line := self._lines.get()) is not None:
            lost = self.lost
            if lost > reported:
                line = f"(lost lines: {lost - reported})\n{line}"
            if self._write(f"{line}\n".encode(self._encoding, "backslashreplace")):
                reported = lost

    def _write(self, data: bytes) -> bool:
        """Write a line, however long that takes; whether it is out."""
        self._writing_since_s = time.monotonic()
        try:
            while data:
                try:
                    data = data[os.write(self._fd, data) :]
                except BlockingIOError:  # whoever shares the output has made it non-blocking
                    select.select([], [self._fd], [])
        except OSError as error:
            self._failure = error.strerror or str(error)
            self._unwritten += 1
            return False
        finally:
            self._writing_since_s = None
        self._failure = ""
        return True
