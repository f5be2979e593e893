"""Print the text of a command that serves a unit in a thread of its own.

A stopped terminal (Ctrl-S), a pipe that nobody reads and a full disk then stop only that thread.
"""

import os
import select
import time
from contextlib import AbstractContextManager, suppress
from queue import Empty, Full, Queue
from threading import Thread
from types import TracebackType
from typing import Final, TextIO

from imudrv.terminal import printable

LIMIT: Final = 1000
"""Maximum number of lines in the queue."""


STOPPED_S: Final = 1.0
"""Time after which an output that accepts no text is reported as stopped."""


_LAST_S: Final = 1.0


class Printer(AbstractContextManager["Printer"]):
    """Prints lines in the background.

    `say` neither blocks nor raises. The oldest lines of a full queue, and lines that cannot be written, are
    lost and counted; their number is printed once the output works again.

    Parameters
    ----------
    stream : text file or None
        ``sys.stdout`` or ``sys.stderr``; None, to which Python sets them in a process started with the
        stream closed: the text is discarded.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._name, self._encoding = os.devnull, "utf-8"
        # A descriptor, since at exit Python flushes the stream and waits for a thread that writes to it; its
        # own, since nobody else closes that.
        if stream is None:
            self._fd = os.open(os.devnull, os.O_WRONLY)
        else:
            self._name, self._encoding = str(stream.name).strip("<>"), stream.encoding
            self._fd = os.dup(stream.fileno())
        self._failure = ""
        self._writing_since_s: float | None = None
        self._overflowed = self._unwritten = 0  # each counted by one thread, so nothing is locked
        self._lines: Queue[str | None] = Queue(LIMIT)
        self._thread = Thread(target=self._run, name="printer", daemon=True)
        self._thread.start()

    def say(self, text: str) -> None:
        """Queue a line for printing.

        Parameters
        ----------
        text : str
            The line, without a line break at its end.
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
        """Number of lines that could not be printed."""
        return self._overflowed + self._unwritten

    @property
    def failure(self) -> str:
        """Why the last line could not be written; empty if it could."""
        return self._failure and f"{self._name}: cannot be written: {self._failure}; lost lines: {self.lost}"

    def notices(self) -> list[str]:
        """Return what is wrong with the output now, for the status: one sentence, or none."""
        since_s = self._writing_since_s
        if since_s is None or time.monotonic() - since_s < STOPPED_S:
            return [self.failure] if self.failure else []
        return [
            f"{self._name}: accepts no text; is the terminal stopped (Ctrl-S)? "
            f"waiting lines: {self._lines.qsize() + 1}, lost: {self.lost}"
        ]

    def close(self) -> None:
        """Print the queued lines, for two seconds at most."""
        try:
            self._lines.put(None, timeout=_LAST_S)
        except Full:
            return
        self._thread.join(_LAST_S)

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
            if self._write(f"{printable(line)}\n".encode(self._encoding, "backslashreplace")):
                reported = lost
        os.close(self._fd)

    def _write(self, data: bytes) -> bool:
        """Write a line, however long that takes; return whether it was written."""
        self._writing_since_s = time.monotonic()
        try:
            while data:
                try:
                    data = data[os.write(self._fd, data) :]
                except BlockingIOError:  # another process has made the shared output non-blocking
                    select.select([], [self._fd], [])
        except OSError as error:
            self._failure = error.strerror or str(error)
            self._unwritten += 1
            return False
        finally:
            self._writing_since_s = None
        self._failure = ""
        return True
