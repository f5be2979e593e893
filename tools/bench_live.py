"""Latency of the live service, compared with programs that only forward bytes.

A player writes frames to a pty at 1 kHz and a receiver takes them by UDP; both read the same clock. Between
them runs one of the contestants, in turn, so that other load of the machine affects all of them:

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
from imudrv.records import PULSES
from imudrv.service.runtime import frozen_gc
from imudrv.sim.scenario import NOMINAL
from imudrv.wire.datagram import SIZE
from imudrv.wire.encode import StreamEncoder

LAYOUT: Final = load("imu50-rs422").layout()
FRAME: Final = LAYOUT.messages[0].length
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
    int fd = open(argv[1], O_RDWR | O_NOCTTY), out = socket(AF_INET, SOCK_DGRAM, 0);
    struct sockaddr_in to = {.sin_family = AF_INET, .sin_port = htons(atoi(argv[2]))};
    to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (fd < 0 || connect(out, (struct sockaddr *)&to, sizeof to)) return 1;
    static char data[65536];
    struct pollfd port = {fd, POLLIN, 0};
    puts("ready");
    fflush(stdout);
    for (;;) {
        if (poll(&port, 1, -1) < 1) return 1;
        ssize_t n = read(fd, data, sizeof data);
        if (n <= 0) return 1;
        for (ssize_t at = 0; at < n; at += 1408)
            send(out, data + at, n - at < 1408 ? n - at : 1408, 0);
    }
}
"""
BARE: Final = """
import gc, os, select, socket, sys
path, port = sys.argv[1], int(sys.argv[2])
fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
out.connect(("127.0.0.1", port))
gc.collect(); gc.freeze(); gc.disable()
print("ready", flush=True)
while True:
    select.select([fd], [], [])
    data = os.read(fd, 65536)
    for at in range(0, len(data), 1408):
        out.send(data[at:at + 1408])
"""


def play(master: int, sent_ns: NDArray[np.int64]) -> None:
    """Write a frame each millisecond and store the time."""
    pulses = np.zeros(len(sent_ns), PULSES)
    pulses["counter"] = np.arange(len(sent_ns))
    pulses["temperature_degc"] = 35.0
    frames = [row.tobytes() for row in StreamEncoder(LAYOUT).encode(pulses)]
    begin = time.monotonic() + 0.1
    for k, frame in enumerate(frames):
        time.sleep(max(0.0, begin + k * TAU_S - time.monotonic()))
        sent_ns[k] = time.monotonic_ns()
        os.write(master, frame)


def receive(inlet: socket.socket, counter_at: int, size: int, received_ns: NDArray[np.int64]) -> None:
    """Store the time at which each sample arrives, until none does for 2 s."""
    inlet.settimeout(2.0)
    buffer = bytearray(65536)
    while True:
        try:
            length = inlet.recv_into(buffer)
        except TimeoutError:
            return
        now = time.monotonic_ns()
        for at in range(0, length, size):
            counter = int.from_bytes(buffer[at + counter_at : at + counter_at + 4], "little")
            if counter < len(received_ns):
                received_ns[counter] = now


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


def command(which: str, path: str, port: int, folder: Path) -> list[str]:
    """Return the command of a contestant that forwards from a pty to a UDP port."""
    if which == "C":
        return [str(folder / "floor"), path, str(port)]
    if which == "Python":
        return [sys.executable, "-c", BARE, path, str(port)]
    write_calibration(folder / "unit.yaml", NOMINAL)
    words = [sys.executable, "-m", "imudrv", "run", "--port", path, "--profile", LAYOUT.name]
    words += ["--calibration", str(folder / "unit.yaml"), "--out", f"udp://127.0.0.1:{port}"]
    words += ["--status", str(folder / "status.sock")]
    return [*words, "--record", str(folder)] if which == "recording" else words


def cpu_seconds(process: int) -> float:
    """Return the processor time of a process so far, all threads."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def one_round(samples: int, which: str, folder: Path) -> Round:
    """Play samples through a contestant."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    inlet = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    inlet.bind(("127.0.0.1", 0))
    middle = subprocess.Popen(
        command(which, os.ttyname(slave), inlet.getsockname()[1], folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert middle.stdout is not None
    middle.stdout.readline()
    received_ns = np.zeros(samples, np.int64)
    listener = os.fork()
    if listener == 0:
        with frozen_gc():
            receive(inlet, *((4, FRAME) if which in ("C", "Python") else (8, SIZE)), received_ns)
        np.save(folder / "received.npy", received_ns)
        os._exit(0)
    sent_ns = np.zeros(samples, np.int64)
    before_s = cpu_seconds(middle.pid)
    with frozen_gc():
        play(master, sent_ns)
    cpu = (cpu_seconds(middle.pid) - before_s) / (samples * TAU_S)
    os.waitpid(listener, 0)
    middle.send_signal(signal.SIGTERM)
    middle.wait()
    middle.stdout.close()
    inlet.close()
    os.close(master)
    os.close(slave)
    received_ns = np.load(folder / "received.npy")
    lost = int(np.count_nonzero(received_ns == 0))
    if lost:
        raise SystemExit(f"{which}: {lost} of {samples} samples did not arrive")
    return Round((received_ns - sent_ns)[SETTLE:] * 1e-9, cpu)


def live(seconds: int, rounds: int) -> dict[str, dict[str, float]]:
    """Measure all contestants in turn.

    Parameters
    ----------
    seconds, rounds : int
        Duration of a round, and number of rounds of each.

    Returns
    -------
    dict
        Of each contestant quantiles of the latency, s, and the part of a core that it took; and the ratios of
        the quantiles to those of the first one.
    """
    quantiles = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
    with tempfile.TemporaryDirectory() as name:
        taken: dict[str, list[Round]] = {which: [] for which in contestants(Path(name))}
        for _ in range(rounds):
            for which, all_rounds in taken.items():
                all_rounds.append(one_round(seconds * 1000, which, Path(name)))
    result = {}
    for which, all_rounds in taken.items():
        latency_s = np.concatenate([one.latency_s for one in all_rounds])
        result[which] = {name: float(np.quantile(latency_s, q)) for name, q in quantiles.items()}
        result[which]["cpu"] = float(np.mean([one.cpu for one in all_rounds]))
    first = next(iter(taken))
    for which in list(taken)[1:]:
        ratios = {name: result[which][name] / result[first][name] for name in quantiles}
        result[f"{which} / {first}"] = ratios
    return result
