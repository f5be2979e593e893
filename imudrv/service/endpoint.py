"""Where a service is asked for its status: a Unix socket, known by its path and open to its user only.

A locked file beside the socket shows that its service lives; without a lock the socket was left by one that
was killed, and is removed. Where the system has no Unix sockets, as Windows, the service listens on a port of
the loopback, and a file at the path contains its number; every user of the machine can then ask.
"""

import os
import socket
import stat
import tempfile
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Final

from imudrv.errors import InputError
from imudrv.files.atomic import change_mark
from imudrv.files.lock import FileLock
from imudrv.loopback import LOOPBACK

_SOCKETS: Final = "imu50*.sock"
_MARK: Final = b"imu50-status "
_LONGEST: Final = 64
_ADVICE: Final = "give --status another path"


class Endpoint:
    """Listening socket at a path, whose lock this process holds.

    Parameters
    ----------
    path : Path
        Path of the socket. One left by a process that was killed is replaced.

    Attributes
    ----------
    path : Path
        As given.
    listener : socket
        The listening socket.

    Raises
    ------
    InputError
        A live service has the path, something else is there, or the socket cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        _remove_left_over(path.parent)
        with ExitStack() as undo:
            try:
                self._lock = FileLock(_lock_path(path))
                undo.callback(self._lock.remove)
                _unlink_left_over(path)
                self.listener = _listen(path)
                undo.callback(lambda: self.listener.close())
                self._own = change_mark(path)
            except BlockingIOError as error:
                raise InputError(
                    f"{path}: expected no other service, got one that runs; stop it, or {_ADVICE}"
                ) from error
            except OSError as error:
                raise InputError(
                    f"{path}: cannot be used for the status: {error.strerror or error}; {_ADVICE}"
                ) from error
            self._close = undo.pop_all()

    def renew(self) -> None:
        """Listen anew if the socket was removed; if another one has its path, leave that alone."""
        if os.path.lexists(self.path):
            return
        with suppress(OSError):
            listener = _listen(self.path)
            self.listener.close()
            self.listener, self._own = listener, change_mark(self.path)

    def close(self) -> None:
        """Stop listening; remove the socket, unless another one has its path meanwhile."""
        with self._close, suppress(OSError):
            if change_mark(self.path) == self._own:
                self.path.unlink()


def connect(path: Path, timeout_s: float) -> socket.socket:
    """Connect to the service at a path.

    Parameters
    ----------
    path : Path
        Its path.
    timeout_s : float
        Longest wait for each answer.

    Returns
    -------
    socket

    Raises
    ------
    OSError
        No service listens there.
    """
    if not hasattr(socket, "AF_UNIX"):
        return socket.create_connection((LOOPBACK, _port(path)), timeout_s)
    channel = socket.socket(socket.AF_UNIX)
    try:
        channel.settimeout(timeout_s)
        channel.connect(os.fspath(path))
    except OSError:
        channel.close()
        raise
    return channel


def default_folder() -> Path:
    """Return the folder of this user's sockets: XDG_RUNTIME_DIR, or a private one for temporary files.

    Raises
    ------
    InputError
        The private folder cannot be made, or others may write to it.
    """
    if given := os.environ.get("XDG_RUNTIME_DIR"):
        return Path(given)
    user = os.getuid() if hasattr(os, "getuid") else None  # elsewhere each user has temporary files apart
    folder = Path(tempfile.gettempdir()) / ("imu50" if user is None else f"imu50-{user}")
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise InputError(f"{folder}: cannot be made: {error.strerror or error}; {_ADVICE}") from error
    is_private = stat.S_ISDIR(found.st_mode) and found.st_uid == user and not found.st_mode & 0o077
    if user is not None and not is_private:
        raise InputError(
            f"{folder}: expected a folder of this user with mode 700, got another; remove it, or {_ADVICE}"
        )
    return folder


def _listen(path: Path) -> socket.socket:
    if not hasattr(socket, "AF_UNIX"):
        listener = socket.create_server((LOOPBACK, 0))
        path.write_bytes(_MARK + b"%d\n" % listener.getsockname()[1])
        return listener
    listener = socket.socket(socket.AF_UNIX)
    before = os.umask(0o177)
    try:
        listener.bind(os.fspath(path))
        listener.listen(8)
    except OSError:
        listener.close()
        raise
    finally:
        os.umask(before)
    return listener


def _port(path: Path) -> int:
    """Return the port number in a file; raise OSError if it contains none."""
    with path.open("rb") as file:
        text = file.read(_LONGEST)
    number = text.removeprefix(_MARK).strip()
    if number == text or not number.isdigit() or not 0 < int(number) < 1 << 16:
        raise OSError("the file has no port of a service")
    return int(number)


def _lock_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.lock")


def _unlink_left_over(path: Path) -> None:
    """Remove the socket at a path whose lock is held; raise OSError for anything else that is there."""
    if not os.path.lexists(path):
        return
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            _port(path)
    except OSError as error:
        raise OSError("there is a file or folder that is no socket") from error
    path.unlink()


def _remove_left_over(folder: Path) -> None:
    """Remove the sockets of killed services and sessions."""
    for path in folder.glob(_SOCKETS):
        with suppress(OSError):  # that of a live process is locked
            lock = FileLock(_lock_path(path))
            with suppress(OSError):
                _unlink_left_over(path)
            lock.remove()
