"""Lock of a file: held by one process, and released by the system when that ends."""

import os
from contextlib import suppress
from importlib import import_module
from pathlib import Path

from imudrv.posix import O_BINARY, O_NOFOLLOW, fcntl


class FileLock:
    """Lock of a file, created if there is none.

    Parameters
    ----------
    path : Path
        The file; it stays empty.

    Raises
    ------
    BlockingIOError
        Another process holds the lock.
    OSError
        The file cannot be created, or is a symbolic link.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = os.open(path, os.O_RDWR | os.O_CREAT | O_NOFOLLOW | O_BINARY, 0o666)
        try:
            _lock(self._file)
            if not os.path.samestat(os.fstat(self._file), os.stat(path)):
                raise BlockingIOError(f"{path}: was replaced meanwhile")
        except OSError:
            os.close(self._file)
            raise

    def release(self) -> None:
        """Release the lock; the file stays."""
        os.close(self._file)

    def remove(self) -> None:
        """Remove the file, then release the lock: nobody gets a lock of a file without a name."""
        with suppress(OSError):  # Windows removes no file that is open
            self._path.unlink()
        os.close(self._file)


def _lock(file: int) -> None:
    if fcntl is not None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return
    msvcrt = import_module("msvcrt")
    try:
        msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
    except OSError as error:
        raise BlockingIOError(*error.args) from error
