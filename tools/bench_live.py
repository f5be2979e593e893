"""Latency of the live service, compared with programs that only forward what they read.

A player writes samples at 1 kHz, to a pty or, as frames of SocketCAN, to a socket, and a receiver takes them
by UDP; both read the same clock. Between them runs one of the contestants, in turn, so that other load of the
machine affects all of them:

    C            poll, read and send, compiled by this benchmark: the floor that the system sets
    Python       a bare loop of select, os.read and send
    service      imudrv run
    recording    imudrv run with a recording
"""

import os
import pty
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
import tty
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.calibration import write_calibration
from imudrv.profiles import load
from imudrv.records import PULSES, Records
from imudrv.service.runtime import frozen_gc
from imudrv.sim.scenario import NOMINAL
from imudrv.wire.datagram import MAGIC, SIZE
from imudrv.wire.encode import CanEncoder, StreamEncoder

TAU_S: Final = 1e-3
SETTLE: Final = 500
"""Samples at the start that are ignored, while caches, branch predictors and the scheduler settle."""
FLOOR: Final = r"""
#include <arpa/inet.h>
#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <unistd.h>

int main(int argc, char **argv) {
    if (argc != 3) return 2;
    int is_bus = argv[1][0] != '/', out = socket(AF_INET, SOCK_DGRAM, 0);
    int fd = is_bus ? atoi(argv[1]) : open(argv[1], O_RDWR | O_NOCTTY);
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons(atoi(argv[2]))};
    to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (fd < 0 || connect(out, (struct sockaddr *)&to, sizeof to)) return 1;
    static char data[65536];
    struct pollfd port = {fd, POLLIN, 0};
    puts("ready");
    fflush(stdout);
    for (;;) {
        if (poll(&port, 1, -1) < 1) return 1;
        ssize_t n = 0, one;
        if (is_bus)
            while (n < 65000 && (one = recv(fd, data + n, 72, MSG_DONTWAIT)) > 0) n += one;
        else
            n = read(fd, data, sizeof data);
        if (n <= 0) return 1;
        for (ssize_t at = 0; at < n; at += 1408)
            send(out, data + at, n - at < 1408 ? n - at : 1408, 0);
    }
}
"""
BARE: Final = """
import gc, os, select, socket, sys
where, port = sys.argv[1], int(sys.argv[2])
is_bus = where[0] != "/"
fd = int(where) if is_bus else os.open(where, os.O_RDWR | os.O_NOCTTY)
bus = socket.socket(fileno=fd) if is_bus else None
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
out.connect(("127.0.0.1", port))
gc.collect(); gc.freeze(); gc.disable()
print("ready", flush=True)
while True:
    select.select([fd], [], [])
    if bus is None:
        data = os.read(fd, 65536)
    else:
        data = b""
        try:
            while True:
                data += bus.recv(72, socket.MSG_DONTWAIT)
        except BlockingIOError:
            pass
    for at in range(0, len(data), 1408):
        out.send(data[at:at + 1408])
"""
SERVICE_ON_A_SOCKET: Final = """
import os, socket, sys
import can
from imudrv.cli import main

class Bus(can.BusABC):
    def __init__(self, channel, *_, **__):
        self.socket = socket.socket(fileno=os.dup(int(channel)))
        super().__init__(channel)

    def fileno(self):
        return self.socket.fileno()

    def send(self, *_, **__):
        raise NotImplementedError

    def shutdown(self):
        super().shutdown()
        self.socket.close()

can.Bus = Bus
sys.exit(main())
"""
"""The service at an inherited socket in the place of that of SocketCAN, which few test machines have."""


class Echo(NamedTuple):
    """How the samples that a contestant forwards are known again.

    Parameters
    ----------
    first : int
        First byte.
    counter_at, counter_bytes : int
        Place of the counter.
    stride : int
        Bytes from one to the next.
    """

    first: int
    counter_at: int
    counter_bytes: int
    stride: int


class Line:
    """A pty, for a serial unit."""

    def __init__(self) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.address = self.port = os.ttyname(self._slave)
        self.inherited: tuple[int, ...] = ()
        self.service = ["-m", "imudrv"]

    profile = "imu50-rs422"
    echo = Echo(0xEB, 4, 4, 44)

    @classmethod
    def samples(cls, count: int) -> list[list[bytes]]:
        """Return what is written for each sample."""
        encoded = StreamEncoder(load(cls.profile).layout()).encode(samples(count))
        return [[row.tobytes()] for row in encoded]

    def write(self, data: bytes) -> None:
        """Send to the contestant."""
        os.write(self._master, data)

    def close(self) -> None:
        """Close both ends."""
        os.close(self._master)
        os.close(self._slave)


class Bus:
    """A socket of frames, for a CAN unit with two messages a sample."""

    def __init__(self) -> None:
        self._unit, self._port = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._unit.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 22)
        self.address = str(self._port.fileno())
        self.port = f"can://socketcan/{self.address}"
        self.inherited = (self._port.fileno(),)
        self.service = ["-c", SERVICE_ON_A_SOCKET]

    profile = "imu50-can"
    echo = Echo(0x51, 14, 2, 16)  # of the second message of a sample

    @classmethod
    def samples(cls, count: int) -> list[list[bytes]]:
        """Return what is written for each sample: frames of 16 bytes, struct can_frame of linux/can.h."""
        row = struct.Struct("=IBxxx8s")
        frames: list[list[bytes]] = [[] for _ in range(count)]
        sample = -1
        for message in CanEncoder(load(cls.profile).layout()).encode(samples(count)):
            sample += int(message["id"]) == _FIRST_ID
            frames[sample].append(row.pack(message["id"], message["length"], message["data"][:8].tobytes()))
        return frames

    def write(self, data: bytes) -> None:
        """Send to the contestant."""
        self._unit.send(data)

    def close(self) -> None:
        """Close both ends."""
        self._unit.close()
        self._port.close()


_FIRST_ID: Final = 0x150
TRANSPORTS: Final[dict[str, type[Line] | type[Bus]]] = {"live": Line, "can": Bus}


def samples(count: int) -> Records:
    """Return samples of a unit at rest."""
    pulses = np.zeros(count, PULSES)
    pulses["counter"] = np.arange(count)
    pulses["temperature_degc"] = 35.0
    return pulses


def play(unit: Line | Bus, sent_ns: NDArray[np.int64], process: int) -> float:
    """Write a sample each millisecond, store the time, and return the part of a core that a process took."""
    frames = unit.samples(len(sent_ns))
    begin = time.monotonic() + 0.1
    begin_s = 0.0
    for k, messages in enumerate(frames):
        if k == SETTLE:
            begin_s = cpu_seconds(process)
        time.sleep(max(0.0, begin + k * TAU_S - time.monotonic()))
        sent_ns[k] = time.monotonic_ns()
        for message in messages:
            unit.write(message)
    return (cpu_seconds(process) - begin_s) / ((len(frames) - SETTLE) * TAU_S)


def receive(inlet: socket.socket, echo: Echo, received_ns: NDArray[np.int64]) -> None:
    """Store the time at which each sample arrives, until none does for 2 s; the first may take 20 s."""
    inlet.settimeout(20.0)
    buffer, rest = bytearray(1 << 17), 0
    while True:
        try:
            stop = rest + inlet.recv_into(memoryview(buffer)[rest:])
        except TimeoutError:
            return
        now = time.monotonic_ns()
        inlet.settimeout(2.0)
        at = 0
        while at + echo.stride <= stop:
            begin = at + echo.counter_at
            counter = int.from_bytes(buffer[begin : begin + echo.counter_bytes], "little")
            if buffer[at] == echo.first and counter < len(received_ns):
                received_ns[counter] = now
            at += echo.stride
        rest = stop - at  # a read may have ended within a sample
        buffer[:rest] = buffer[at:stop]


class Round(NamedTuple):
    """Result of a round.

    Parameters
    ----------
    latency_s : ndarray
        Of each sample.
    cpu : float
        Part of a core that the contestant took.
    """

    latency_s: NDArray[np.float64]
    cpu: float


def contestants(folder: Path) -> list[str]:
    """Return their names; that in C takes part where there is a compiler."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is not None:
        (folder / "floor.c").write_text(FLOOR)
        subprocess.run([compiler, "-O2", "floor.c", "-o", "floor"], cwd=folder, check=True)
    return [*(["C"] if compiler else []), "Python", "service", "recording"]


def command(which: str, unit: Line | Bus, port: int, folder: Path) -> list[str]:
    """Return the command of a contestant that forwards from the unit to a UDP port."""
    if which == "C":
        return [str(folder / "floor"), unit.address, str(port)]
    if which == "Python":
        return [sys.executable, "-c", BARE, unit.address, str(port)]
    write_calibration(folder / "unit.yaml", NOMINAL)
    words = [sys.executable, *unit.service, "run", "--port", unit.port, "--profile", unit.profile]
    words += ["--calibration", str(folder / "unit.yaml"), "--out", f"udp://127.0.0.1:{port}"]
    words += ["--status", str(folder / "status.sock")]
    return [*words, "--record", str(folder)] if which == "recording" else words


def cpu_seconds(process: int) -> float:
    """Return the processor time of a process so far, all threads that it has."""
    spent = [path.read_text().split()[0] for path in Path(f"/proc/{process}/task").glob("*/schedstat")]
    return sum(map(int, spent)) * 1e-9  # /proc/PID/stat has ticks of 10 ms


def one_round(transport: type[Line] | type[Bus], samples: int, which: str, folder: Path) -> Round:
    """Play samples through a contestant."""
    unit = transport()
    inlet = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    inlet.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    inlet.bind(("127.0.0.1", 0))
    middle = subprocess.Popen(
        command(which, unit, inlet.getsockname()[1], folder),
        pass_fds=unit.inherited,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert middle.stdout is not None
    middle.stdout.readline()
    received_ns = np.zeros(samples, np.int64)
    listener = os.fork()
    if listener == 0:
        with frozen_gc():
            receive(inlet, unit.echo if which in ("C", "Python") else Echo(MAGIC[0], 8, 4, SIZE), received_ns)
        np.save(folder / "received.npy", received_ns)
        os._exit(0)
    sent_ns = np.zeros(samples, np.int64)
    with frozen_gc():
        cpu = play(unit, sent_ns, middle.pid)
    os.waitpid(listener, 0)
    middle.send_signal(signal.SIGTERM)
    middle.wait()
    middle.stdout.close()
    inlet.close()
    unit.close()
    received_ns = np.load(folder / "received.npy")
    lost = int(np.count_nonzero(received_ns == 0))
    if lost:
        raise SystemExit(f"{which}: {lost} of {samples} samples did not arrive")
    return Round((received_ns - sent_ns)[SETTLE:] * 1e-9, cpu)


def live(transport: type[Line] | type[Bus], seconds: int, rounds: int) -> dict[str, dict[str, float]]:
    """Measure all contestants in turn.

    Parameters
    ----------
    transport : type
        Of `TRANSPORTS`.
    seconds, rounds : int
        Duration of a round, and number of rounds of each.

    Returns
    -------
    dict
        Of each contestant quantiles of the latency, s, and the part of a core that it took, each the median
        over its rounds, so that a disturbance of one round does not decide; and the ratios to those of the
        first one.
    """
    if seconds * 1000 > 1 << 16:
        raise SystemExit("expected rounds of 65 s at most: a counter of 16 bits repeats itself")
    quantiles = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
    with tempfile.TemporaryDirectory() as name:
        taken: dict[str, list[Round]] = {which: [] for which in contestants(Path(name))}
        for _ in range(rounds):
            for which, all_rounds in taken.items():
                all_rounds.append(one_round(transport, seconds * 1000, which, Path(name)))
    result = {}
    for which, all_rounds in taken.items():
        result[which] = {
            name: float(np.median([np.quantile(one.latency_s, q) for one in all_rounds]))
            for name, q in quantiles.items()
        }
        result[which]["cpu"] = float(np.median([one.cpu for one in all_rounds]))
    first = next(iter(taken))
    for which in list(taken)[1:]:
        result[f"{which} / {first}"] = {
            name: value / result[first][name] for name, value in result[which].items()
        }
    return result
