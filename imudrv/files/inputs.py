"""Files to read: regular ones, some commands also pipes; never folders, nor devices, which may not end."""

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path

from imudrv.errors import InputError
from imudrv.files.outputs import kind_of


def is_pipe(path: str | os.PathLike[str]) -> bool:
    """Return whether an input is a pipe and no regular file.

    Parameters
    ----------
    path : path-like
        The input.

    Returns
    -------
    bool

    Raises
    ------
    InputError
        It is neither, there is no such file, or it cannot be examined.
    """
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError as error:
        raise InputError(f"{os.fspath(path)}: expected a file, there is none; check the path") from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise InputError(f"{os.fspath(path)}: cannot be read: {reason(error)}") from error
    if not (stat.S_ISREG(mode) or stat.S_ISFIFO(mode)):
        raise InputError(f"{os.fspath(path)}: expected a file, got {kind_of(mode)}")
    return stat.S_ISFIFO(mode)


@contextmanager
def open_file(path: str | os.PathLike[str]) -> Iterator[BufferedReader]:
    """Open a regular file for reading.

    Parameters
    ----------
    path : path-like
        The file.

    Yields
    ------
    binary file

    Raises
    ------
    InputError
        It is a pipe, see `is_pipe`, or it cannot be read, also later.
    """
    if is_pipe(path):
        raise InputError(f"{os.fspath(path)}: expected a file, got a pipe; write the data to a file first")
    try:
        with Path(path).open("rb") as file:
            yield file
    except OSError as error:
        raise InputError(f"{os.fspath(path)}: cannot be read: {reason(error)}") from error


def total_size(paths: Iterable[str | os.PathLike[str]]) -> int | None:
    """Return the size of some files for a progress bar, bytes; None if it is not known, as of a pipe."""
    try:
        return sum(os.stat(path).st_size for path in paths) or None
    except (OSError, ValueError):
        return None


def reason(error: Exception) -> str:
    """Return why the system refused, and what to do."""
    if isinstance(error, PermissionError):
        return "permission denied; change the permissions or the user"
    return getattr(error, "strerror", None) or str(error)
