"""Read files whole and bounded; write them whole or not at all; SHA-256."""

import hashlib
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from io import BufferedReader
from itertools import chain, count
from pathlib import Path
from tempfile import NamedTemporaryFile
from typing import IO, Final

from imudrv.errors import InputError
from imudrv.files.outputs import file_to_write

MAX_BYTES: Final = 1 << 20
"""Largest settings file, bytes."""


def content(path: str | os.PathLike[str]) -> bytes:
    """Read a settings file as it is.

    Parameters
    ----------
    path : path-like
        The file, at most `MAX_BYTES`.

    Returns
    -------
    bytes

    Raises
    ------
    InputError
        It cannot be read or is too large.
    """
    path = Path(path)
    with _reading(path), _open(path) as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise InputError(
            f"{path}: expected a settings file of at most {MAX_BYTES} bytes, got more; is it another file?"
        )
    return data


def sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file of any size.

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
    path = Path(path)
    with _reading(path), _open(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def change_mark(path: str | os.PathLike[str]) -> tuple[int, int, int]:
    """Time of modification (ns), size (bytes) and inode of a file: another mark, another content.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    tuple of int
        Zeros if there is no such file.
    """
    try:
        found = os.stat(path)
    except (OSError, ValueError):  # ValueError: a NUL in the path
        return 0, 0, 0
    return found.st_mtime_ns, found.st_size, found.st_ino


@contextmanager
def unchanged(path: str | os.PathLike[str]) -> Iterator[None]:
    """Watch a file that is read in several passes.

    Parameters
    ----------
    path : path-like
        The file.

    Raises
    ------
    InputError
        At the end: it was changed or replaced meanwhile.
    """
    before = change_mark(path)
    yield
    if change_mark(path) != before:
        raise InputError(
            f"{os.fspath(path)}: expected a file that stays as it is, it was changed while it was read; "
            "wait until it is complete, then try again"
        )


@contextmanager
def reported_errors(path: Path, done: str, missing: str) -> Iterator[None]:
    """Turn the system's errors about `path`, which should have been `done`, into ours."""
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{path}: {missing}") from error
    except PermissionError as error:
        raise InputError(
            f"{path}: cannot be {done}: permission denied; change the permissions or the user"
        ) from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise InputError(f"{path}: cannot be {done}: {getattr(error, 'strerror', None) or error}") from error


def _reading(path: Path) -> AbstractContextManager[None]:
    return reported_errors(path, "read", "expected a file, there is none; check the path")


def _open(path: Path) -> BufferedReader:
    if not stat.S_ISREG(path.stat().st_mode):
        raise InputError(f"{path}: expected a file, got a {'folder' if path.is_dir() else 'device or pipe'}")
    return path.open("rb")


def write_whole(path: Path, data: bytes) -> None:
    """Put `data` at `path` in one step that survives a loss of power."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def backup_name(path: Path) -> Path:
    """Find a free name for the file that is at `path`, by its time."""
    time = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    stem = f"{path.stem}.{time:%Y%m%dT%H%M%SZ}"
    names = chain([stem], (f"{stem}.{n}" for n in count(2)))
    return next(kept for name in names if not os.path.lexists(kept := path.with_name(name + path.suffix)))


@contextmanager
def atomic_write(path: Path) -> Iterator[IO[bytes]]:
    """A file that takes its name only once it is whole.

    Parameters
    ----------
    path : Path
        Its name; what has that name stays until then. A symbolic link is followed.

    Yields
    ------
    binary file
        To write to; after an exception nothing is left of it.

    Raises
    ------
    InputError
        The folder is not there or cannot be written to, the disk is full, or see `file_to_write`.
    """
    target = file_to_write(path)
    file: IO[bytes] | None = None
    try:
        with NamedTemporaryFile(dir=target.parent, prefix=f".{target.name}.", delete=False) as file:
            yield file
        os.chmod(file.name, 0o666 & ~_umask())
        os.replace(file.name, target)
        file = None
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        if file is not None:
            Path(file.name).unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
