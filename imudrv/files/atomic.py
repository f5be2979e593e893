"""Whole files: read with a bound on their size, watched for changes, hashed; written whole or not at all."""

import hashlib
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Final

from imudrv.errors import InputError
from imudrv.files.inputs import open_file, reason
from imudrv.files.lock import FileLock
from imudrv.files.outputs import file_to_write
from imudrv.posix import fcntl

MAX_BYTES: Final = 1 << 20
"""Largest settings file, bytes."""
_PARTIAL: Final = ".imu50-partial"
"""Suffix of a file that is being written."""


def content(path: str | os.PathLike[str], max_bytes: int = MAX_BYTES, kind: str = "a settings file") -> bytes:
    """Return the content of a file, by default a settings file.

    Parameters
    ----------
    path : path-like
        The file.
    max_bytes : int
        Largest size, bytes.
    kind : str
        What it is, for messages.

    Returns
    -------
    bytes

    Raises
    ------
    InputError
        The file cannot be read or is too large.
    """
    with open_file(path) as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise InputError(
            f"{path}: expected {kind} of at most {max_bytes} bytes, got more; is it another file?"
        )
    return data


def sha256(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file of any size.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    str
        64 hexadecimal digits.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    with open_file(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def change_mark(path: str | os.PathLike[str]) -> tuple[int, int, int]:
    """Return what changes when the content of a file does.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    tuple of int
        Time of modification (ns), size (bytes) and inode; zeros if there is no such file.
    """
    try:
        found = os.stat(path)
    except (OSError, ValueError):  # ValueError: a NUL in the path
        return 0, 0, 0
    return found.st_mtime_ns, found.st_size, found.st_ino


@contextmanager
def unchanged(path: str | os.PathLike[str]) -> Iterator[None]:
    """Check that a file does not change while it is read in several passes.

    Parameters
    ----------
    path : path-like
        The file.

    Raises
    ------
    InputError
        It is no regular file, which could not be read twice; or, at the end, it was changed meanwhile.
    """
    with open_file(path):
        pass
    before = change_mark(path)
    yield
    if change_mark(path) != before:
        raise InputError(
            f"{os.fspath(path)}: expected a file that does not change, it was changed while it was read; "
            "wait until it is complete, then try again"
        )


@contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """Write a file under another name beside it, and give it its own once it is complete and on the disk.

    What killed processes have left in its folder is removed first.

    Parameters
    ----------
    path : Path
        Its name; a file that has that name stays until then. A symbolic link is followed.

    Yields
    ------
    binary file
        To write to; after an exception nothing is left of it.

    Raises
    ------
    InputError
        The folder does not exist or cannot be written to, the disk is full, or see `file_to_write`.
    """
    target = file_to_write(path)
    remove_left_over(target.parent)
    temporary: Path | None = None
    try:
        beside = target.with_name(f".{target.name}.{secrets.token_hex(4)}{_PARTIAL}")
        with beside.open("xb") as file:
            temporary = beside
            if fcntl is not None:
                with suppress(OSError):  # a file system without locks: what is left stays there
                    fcntl.flock(file, fcntl.LOCK_EX)
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
        temporary = None
        sync_folder(target.parent)
    except OSError as error:
        why = reason(error)
        if not target.parent.is_dir():
            why = f"expected the folder {path.parent}, there is none; make it first"
        raise InputError(f"{path}: cannot be written: {why}") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def remove_left_over(folder: Path) -> None:
    """Remove what killed processes have left of `atomic_write` in a folder.

    Parameters
    ----------
    folder : Path
        The folder. The file of a live process stays: it is locked, or still empty. Where the system has no
        such locks, all stay.
    """
    if fcntl is None:
        return
    for path in folder.glob(f".*{_PARTIAL}"):
        with suppress(OSError):
            if path.stat().st_size:
                FileLock(path).remove()


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk, where the system can.

    Parameters
    ----------
    folder : Path
        The folder.

    Raises
    ------
    OSError
        The folder cannot be read.
    """
    if not hasattr(os, "O_DIRECTORY"):  # Windows opens no folder
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
