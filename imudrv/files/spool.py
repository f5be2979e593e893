"""A file that a thread of its own appends to, so that a slow disk does not stop the live loop."""

import errno
import os
import time
from collections.abc import Callable
from math import inf
from pathlib import Path
from threading import Event, Thread
from typing import Final, NamedTuple

from imudrv.errors import InputError
from imudrv.files.outputs import file_to_write
from imudrv.posix import O_BINARY

PERIOD_S: Final = 0.05
"""Period of writing, s."""
_PAUSE_S: Final = 0.002  # between the pieces of a backlog, so that the loop runs meanwhile
_CLOSE_TIMEOUT_S: Final = 5.0
_LOOK_S: Final = 0.5
"""Period of looking whether the file is still there."""
_FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class Piece(NamedTuple):
    """Data of one write.

    Parameters
    ----------
    data : bytes
        Bytes of bounded length; empty if nothing waits.
    samples : int
        Number of samples in it.
    more : bool
        Whether more waits already, so that the next piece is written at once.
    """

    data: bytes
    samples: int
    more: bool


_NOTHING: Final = Piece(b"", 0, False)


class AppendThread:
    """Writer of one new file.

    Each piece is handed to the system at once and survives the end of this process. If the disk takes only a
    part of it, that part is removed and the piece written again, so that the file ends with a complete piece
    at all times except during a write.

    Parameters
    ----------
    path : Path
        The file, which must not exist.
    head : bytes
        Beginning of the file, written at once.
    next_piece : callable
        Returns the next piece; called in the thread.
    last_piece : callable
        Returns the end of the file; called in the thread.
    sync_s : float, optional
        Have the disk keep what was written at least this often, which a power failure then does not undo; by
        default the system chooses the time, usually 5 to 30 s.

    Attributes
    ----------
    displaced : str
        What has happened to the file, such as ``deleted``; empty while its name leads to it.
    is_finished : bool
        Whether the file is closed and complete.

    Raises
    ------
    InputError
        The file exists, the folder cannot be written to, there is no room for the head, or see
        `file_to_write`.
    """

    def __init__(
        self,
        path: Path,
        head: bytes,
        next_piece: Callable[[], Piece],
        last_piece: Callable[[], bytes] = bytes,
        sync_s: float | None = None,
    ) -> None:
        self._target = target = file_to_write(path)
        try:
            self._file = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_EXCL | O_BINARY, 0o666)
        except FileExistsError as error:
            raise InputError(
                f"{path}: expected a new file, there is one of that name; move it away or take another name"
            ) from error
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
        self.sent = 0
        self._size = 0
        self._trouble = self.displaced = ""
        self.is_finished = False
        self._sync_s = inf if sync_s is None else sync_s
        self._synced = self._looked = time.monotonic()
        if not self._append(head):
            os.close(self._file)
            target.unlink()
            raise InputError(f"{path}: cannot be written: {self._trouble}")
        self._next_piece = next_piece
        self._last_piece = last_piece
        self._is_closing = Event()
        self._thread = Thread(target=self._run, name=f"writer of {path.name}", daemon=True)
        self._thread.start()

    @property
    def trouble(self) -> str:
        """Current error: ``disk full`` or the message of the system; empty without one."""
        if not self._thread.is_alive() and not self._is_closing.is_set():
            return "the writer has stopped"
        return self._trouble or (f"{self.displaced} while it was written" if self.displaced else "")

    def close(self) -> None:
        """Write what waits, within a few seconds, and close the file."""
        self._is_closing.set()
        self._thread.join(_CLOSE_TIMEOUT_S)

    def _run(self) -> None:
        piece = _NOTHING
        is_last = False
        while not is_last:
            is_last = self._is_closing.wait(PERIOD_S)
            more = True
            while more:
                piece = piece if piece.data else self._next_piece()
                if not piece.data or not self._append(piece.data):
                    break
                self.sent += piece.samples
                more, piece = piece.more, _NOTHING
                if more:
                    time.sleep(_PAUSE_S)
            self._look_after()
        is_whole = not piece.data and self._append(self._last_piece())
        os.close(self._file)
        self.is_finished = is_whole

    def _look_after(self) -> None:
        """Look for the file, and have the disk keep it, as often as either is due."""
        now = time.monotonic()
        if now - self._looked >= _LOOK_S:
            self._looked = now
            self.displaced = self._found()
        if now - self._synced >= self._sync_s:
            self._synced = now
            try:
                os.fsync(self._file)
            except OSError as error:
                self._trouble = (error.strerror or str(error)).lower()

    def _found(self) -> str:
        """Return what has happened to the file; empty if its name leads to it."""
        mine = os.fstat(self._file)
        if not mine.st_nlink:
            return "deleted"
        try:
            is_there = os.path.samestat(os.stat(self._target), mine)
        except OSError:
            is_there = False
        return "" if is_there else "renamed"

    def _append(self, piece: bytes) -> bool:
        """Append a piece; return whether it is in the file."""
        rest = memoryview(piece)
        try:
            while rest:
                rest = rest[os.write(self._file, rest) :]
        except OSError as error:
            self._trouble = "disk full" if error.errno in _FULL else (error.strerror or str(error)).lower()
            os.ftruncate(self._file, self._size)
            os.lseek(self._file, self._size, os.SEEK_SET)
            return False
        self._size += len(piece)
        self._trouble = ""
        return True
