"""System calls for kernels, as functions of the C library.

numba finds them by name (`types.ExternalFunction`), so that compiled code can be kept on disk, which it could
not with a pointer. That class is not part of numba's documented interface: it is used here only, and where it
is missing, as on Windows and macOS, `IS_AVAILABLE` is false and the live loop is that of Python.

Each call returns what the C function returns, or the error as ``-errno``.
"""

import sys
from typing import Any, Final

import numba
import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel

_numba: Any = numba  # has no type hints
_types, _carray = _numba.types, _numba.carray

IS_AVAILABLE: bool = sys.platform == "linux" and sys.maxsize > 2**32 and hasattr(_types, "ExternalFunction")
"""Whether kernels can call the system; structures are those of 64 bits."""

POLL: Final = np.dtype([("fd", np.int32), ("events", np.int16), ("revents", np.int16)])
"""A descriptor to wait for: struct pollfd of poll(2)."""
POLLIN: Final = 1

CLOCK_REALTIME: Final = 0
CLOCK_MONOTONIC: Final = 1
CLOCK_BOOTTIME: Final = 7
EINTR: Final = 4
EAGAIN: Final = 11

_MSG_DONTWAIT: Final = 0x40
_MSG_NOSIGNAL: Final = 0x4000

if IS_AVAILABLE:
    _poll = _types.ExternalFunction("poll", _types.intc(_types.intp, _types.uintp, _types.intc))
    _read = _types.ExternalFunction("read", _types.intp(_types.intc, _types.intp, _types.uintp))
    _write = _types.ExternalFunction("write", _types.intp(_types.intc, _types.intp, _types.uintp))
    _recv = _types.ExternalFunction("recv", _types.intp(_types.intc, _types.intp, _types.uintp, _types.intc))
    _send = _types.ExternalFunction("send", _types.intp(_types.intc, _types.intp, _types.uintp, _types.intc))
    _clock = _types.ExternalFunction("clock_gettime", _types.intc(_types.intc, _types.intp))
    _errno = _types.ExternalFunction("__errno_location", _types.CPointer(_types.int32)())


@kernel
def poll(descriptors: NDArray[np.void], timeout_ns: int) -> int:
    """Wait until a descriptor is ready; return how many are.

    Parameters
    ----------
    descriptors : ndarray of POLL
        Their `revents` are set.
    timeout_ns : int
        Longest wait; rounded up to whole milliseconds.
    """
    milliseconds = -(-max(timeout_ns, 0) // 1_000_000)
    ready = _poll(descriptors.ctypes.data, np.uint64(descriptors.size), np.int32(milliseconds))
    return int(ready) if ready >= 0 else -int(_carray(_errno(), 1)[0])


@kernel
def read(fd: int, data: NDArray[np.uint8]) -> int:
    """Read into an array; return the number of bytes, 0 at the end of the file."""
    count = _read(np.int32(fd), data.ctypes.data, np.uint64(data.size))
    return int(count) if count >= 0 else -int(_carray(_errno(), 1)[0])


@kernel
def write(fd: int, data: NDArray[np.uint8]) -> int:
    """Write an array; return the number of bytes that were written."""
    count = _write(np.int32(fd), data.ctypes.data, np.uint64(data.size))
    return int(count) if count >= 0 else -int(_carray(_errno(), 1)[0])


@kernel
def send(fd: int, data: NDArray[np.uint8]) -> int:
    """Send an array over a socket without waiting; return the number of bytes that were taken."""
    flags = np.int32(_MSG_DONTWAIT | _MSG_NOSIGNAL)
    count = _send(np.int32(fd), data.ctypes.data, np.uint64(data.size), flags)
    return int(count) if count >= 0 else -int(_carray(_errno(), 1)[0])


@kernel
def recv(fd: int, data: NDArray[np.uint8]) -> int:
    """Receive a packet of a socket into an array without waiting; return its number of bytes."""
    count = _recv(np.int32(fd), data.ctypes.data, np.uint64(data.size), np.int32(_MSG_DONTWAIT))
    return int(count) if count >= 0 else -int(_carray(_errno(), 1)[0])


@kernel
def clock_ns(which: int, timespec: NDArray[np.int64]) -> int:
    """Read a clock, ns; `timespec`, two numbers, is room for the system's answer."""
    _clock(np.int32(which), timespec.ctypes.data)
    return int(timespec[0] * 1_000_000_000 + timespec[1])
