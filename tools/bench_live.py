"""Latency of the live service, compared with a loop that only forwards bytes.

A player writes frames to a pty at 1 kHz and a receiver takes them by UDP; both read the same clock. Between
them runs either the service or a bare loop of `select`, `os.read` and `send`, whose latency is that of the
operating system. The two alternate, so that other load of the machine affects both.
"""

import os
import pty
import signal
import socket
import subprocess
import sys
import tempfile
import time
import tty
from pathlib import Path
from typing import Final

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


def one_round(samples: int, service: bool, folder: Path) -> NDArray[np.float64]:
    """Play samples through service or bare loop; return the latency of each, s."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    inlet = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    inlet.bind(("127.0.0.1", 0))
    port = inlet.getsockname()[1]
    if service:
        write_calibration(folder / "unit.yaml", NOMINAL)
        command = [sys.executable, "-m", "imudrv", "run", "--port", path, "--profile", LAYOUT.name]
        command += ["--calibration", str(folder / "unit.yaml"), "--out", f"udp://127.0.0.1:{port}"]
        command += ["--status", str(folder / "status.sock")]
    else:
        command = [sys.executable, "-c", BARE, path, str(port)]
    middle = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    assert middle.stdout is not None
    middle.stdout.readline()
    received_ns = np.zeros(samples, np.int64)
    listener = os.fork()
    if listener == 0:
        with frozen_gc():
            receive(inlet, *((8, SIZE) if service else (4, FRAME)), received_ns)
        np.save(folder / "received.npy", received_ns)
        os._exit(0)
    sent_ns = np.zeros(samples, np.int64)
    with frozen_gc():
        play(master, sent_ns)
    os.waitpid(listener, 0)
    middle.send_signal(signal.SIGTERM)
    middle.wait()
    inlet.close()
    os.close(master)
    os.close(slave)
    received_ns = np.load(folder / "received.npy")
    lost = int(np.count_nonzero(received_ns == 0))
    if lost:
        raise SystemExit(
            f"{'service' if service else 'bare loop'}: {lost} of {samples} samples did not arrive"
        )
    return (received_ns - sent_ns)[SETTLE:] * 1e-9


def live(seconds: int, rounds: int) -> dict[str, dict[str, float]]:
    """Measure both alternately.

    Parameters
    ----------
    seconds, rounds : int
        Duration of a round, and number of rounds of each.

    Returns
    -------
    dict
        Quantiles of the latency, s, and their ratios.
    """
    taken: dict[str, list[NDArray[np.float64]]] = {"bare loop": [], "service": []}
    with tempfile.TemporaryDirectory() as name:
        for _ in range(rounds):
            for which, all_rounds in taken.items():
                all_rounds.append(one_round(seconds * 1000, which == "service", Path(name)))
    quantiles = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
    result = {
        which: {name: float(np.quantile(np.concatenate(all_rounds), q)) for name, q in quantiles.items()}
        for which, all_rounds in taken.items()
    }
    result["ratio"] = {name: result["service"][name] / result["bare loop"][name] for name in quantiles}
    return result
