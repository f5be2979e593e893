"""Takes from Python what Windows has not. With this folder on the path, every Python runs it at its start."""

import errno
import fcntl
import os
import select
import signal
import socket
import stat
import sys
from types import ModuleType

# Libraries of others find out themselves where they are: they are imported while this is a POSIX system.
import numba  # noqa: F401
import rich.live  # noqa: F401
import serial.tools.list_ports  # noqa: F401

MODULES = ("fcntl", "grp", "pty", "pwd", "resource", "termios", "tty")
NAMES = {
    os: "fork forkpty getuid geteuid getgid getpgid killpg openpty ttyname mkfifo chown setsid statvfs "
    "set_blocking sched_setscheduler sched_param SCHED_FIFO O_CLOEXEC O_DIRECTORY",
    signal: "SIGHUP SIGUSR1 SIGUSR2 SIGALRM pthread_sigmask",
    socket: "AF_UNIX SOCK_NONBLOCK SOCK_CLOEXEC",
    select: "poll epoll",
}
_select, _read, _write, _open = select.select, os.read, os.write, os.open


class Absent:
    """Finder of modules that are not there."""

    @staticmethod
    def find_spec(name, path=None, target=None):
        if name in MODULES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def _is_socket(file):
    return stat.S_ISSOCK(os.fstat(file if isinstance(file, int) else file.fileno()).st_mode)


def _select_sockets(reading, writing, other, timeout=None):
    if not all(_is_socket(file) for files in (reading, writing, other) for file in files):
        raise OSError(10038, "An operation was attempted on something that is not a socket")
    return _select(reading, writing, other, timeout)


def _no_socket(file):
    if _is_socket(file):
        raise OSError(errno.EBADF, "Bad file descriptor")
    return file


def _open_file(path, flags, mode=0o777, **more):
    if os.path.isdir(path):
        raise PermissionError(errno.EACCES, "Permission denied")
    return _open(path, flags, mode, **more)


def _socketpair():
    """Do as `socket.socketpair` does there: connect over the loopback."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        one = socket.create_connection(server.getsockname())
        return one, server.accept()[0]


def _locking(file, mode, size):
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        raise OSError(errno.EACCES, "Permission denied") from error


for module, names in NAMES.items():
    for name in names.split():
        delattr(module, name)
for name in MODULES:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Absent)
select.select, os.open, socket.socketpair = _select_sockets, _open_file, _socketpair
os.read = lambda file, size: _read(_no_socket(file), size)
os.write = lambda file, data: _write(_no_socket(file), data)
sys.modules["msvcrt"] = msvcrt = ModuleType("msvcrt")
msvcrt.LK_NBLCK, msvcrt.locking = 2, _locking
