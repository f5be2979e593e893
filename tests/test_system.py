"""System calls as kernels make them: what they return, and their errors."""

import errno
import os
import socket
import time

import numpy as np
import pytest

from imudrv import system

pytestmark = pytest.mark.skipif(not system.IS_AVAILABLE, reason="needs Linux")


def descriptors(fd: int) -> np.ndarray:
    return np.array([(fd, system.POLLIN, 0)], system.POLL)


def test_bytes_pass_from_send_and_write_to_read() -> None:
    one, other = socket.socketpair()
    with one, other:
        data, room = np.frombuffer(bytearray(b"abcdef"), np.uint8), np.zeros(10, np.uint8)
        assert system.poll(descriptors(other.fileno()), 0) == 0
        assert system.send(one.fileno(), data) == 6
        assert system.write(one.fileno(), data[2:]) == 4
        assert system.poll(descriptors(other.fileno()), 10**12) == 1
        assert system.read(other.fileno(), room) == 10
        assert room.tobytes() == b"abcdefcdef"
        one.close()
        assert system.read(other.fileno(), room) == 0


def test_errors_are_those_of_the_system() -> None:
    one, other = socket.socketpair()
    with one, other:
        data = np.zeros(10, np.uint8)
        other.setblocking(False)
        assert system.read(other.fileno(), data) == -errno.EAGAIN
        sent = 1
        while sent > 0:
            sent = system.send(one.fileno(), data)
        assert sent == -errno.EAGAIN
        other.close()
        # without the signal SIGPIPE, which would end the process
        assert system.send(one.fileno(), data) in (-errno.EPIPE, -errno.ECONNRESET)
    closed = os.dup(0)
    os.close(closed)
    assert system.read(closed, data) == -errno.EBADF
    assert system.write(closed, data) == -errno.EBADF
    assert system.send(closed, data) == -errno.EBADF


def test_clocks_are_those_of_python() -> None:
    timespec = np.zeros(2, np.int64)
    for which in (system.CLOCK_REALTIME, system.CLOCK_MONOTONIC, system.CLOCK_BOOTTIME):
        system.clock_ns(which, timespec)  # compiled
        before = time.clock_gettime_ns(which)
        between = system.clock_ns(which, timespec)
        assert before <= between <= time.clock_gettime_ns(which)
