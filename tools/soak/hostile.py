"""All that other programs and people can do to a running service at once, and what its receiver notices."""

import os
import random
import socket
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Final

import numpy as np

from imudrv.calibration import write_calibration
from imudrv.recording.reader import Recording
from imudrv.records import Flag, Records
from imudrv.sim.scenario import NOMINAL

from .checks import TIMEOUT_S, Check, measured
from .data import SERIAL, last_status, write_scenario
from .processes import Service, Stage, free_port
from .usage import Usage, UsageMonitor, memory_checks

CLIENTS: Final = 40
MOST_RATIO: Final = 1.2
DELETED: Final = 2
SETTLED_S: Final = 60.0
_QUEUES_MB: Final = 16.0
"""Room for the queues of 32 clients that read nothing, 10 MB."""
_SEED: Final = 5


def hostile(folder: Path, minutes: float) -> list[Check]:
    """Run a service under attack and one in peace, side by side, and compare.

    What else the machine does then affects both alike.
    """
    with ThreadPoolExecutor() as pool:
        runs = [
            pool.submit(_Run, folder / name, 60.0 * minutes, under_attack)
            for name, under_attack in (("peace", False), ("attack", True))
        ]
        peace, attack = (run.result() for run in runs)
    median, late = ([float(np.quantile(run.latency_s, q)) for run in (peace, attack)] for q in (0.5, 0.99))
    counters = attack.received["counter"]
    return [
        Check(
            f"all {attack.samples:,} samples arrive, in order",
            f"{len(counters):,} received",
            np.array_equal(counters, np.arange(attack.samples)),
        ),
        Check("the service ends with exit code 0", f"exit code {attack.code}", attack.code == 0),
        Check(
            "no sample lacks its size effect but the first",
            f"{np.count_nonzero(attack.received['flags'] & Flag.SIZE_EFFECT == 0)} without it",
            bool(np.all(attack.received["flags"][5:] & Flag.SIZE_EFFECT)),
        ),
        Check(
            "the last status counts all samples, and says what happened to the recordings",
            f"{attack.good:,} good; {attack.recording}",
            attack.good == attack.samples and "while it was written" in attack.recording,
        ),
        Check(
            "calibrations were replaced, recordings deleted, sockets taken over",
            f"{attack.replaced} replaced in the last of {DELETED + 1} recordings, "
            f"{len(attack.recordings)} left at the end",
            attack.replaced > minutes and len(attack.recordings) == 1,
        ),
        measured(
            f"median latency from sample to receiver within {MOST_RATIO:g} times that in peace",
            f"p50 {1e6 * median[1]:.0f} us, {median[1] / median[0]:.2f} times; "
            f"p99 {1e6 * late[1]:.0f} us, {late[1] / late[0]:.2f} times",
            median[1] <= MOST_RATIO * median[0],
        ),
        *memory_checks(attack.usage, min(SETTLED_S, 30.0 * minutes), _QUEUES_MB),
    ]


class _Run:
    """A service with its receiver, and what they say at the end."""

    def __init__(self, folder: Path, seconds: float, under_attack: bool) -> None:
        folder.mkdir()
        self.samples = write_scenario(folder, seconds)
        udp, tcp = f"udp://127.0.0.1:{free_port()}", free_port()
        records = folder / "records"
        records.mkdir()
        options = ["--out", udp, "--out", f"tcp://127.0.0.1:{tcp}", "--record", records]
        with Stage(folder) as stage:
            listener = stage.listener(udp, "received.npy")
            unit, service = stage.unit_and_service(SERIAL, "1", *options)
            monitor = UsageMonitor(service.process.pid)
            attack = Attack(service, tcp, records, seconds) if under_attack else None
            unit.wait(TIMEOUT_S + 2.0 * seconds)
            if attack is not None:
                attack.stop()
            self.usage: list[Usage] = monitor.stop()
            self.code = service.stop(timeout_s=TIMEOUT_S + seconds)  # it packs the recording
            listener.stop()
        self.received: Records = np.load(folder / "received.npy")
        times = np.load(folder / "received.npy.times.npy")
        locked = self.received["flags"] & Flag.CLOCK_UNLOCKED == 0
        self.latency_s = (times - self.received["t_ns"])[locked] * 1e-9
        self.recordings = sorted(records.glob("*.mcap"))
        recording = Recording(self.recordings[-1])
        counts, status = last_status(recording)
        self.good = counts.good
        self.recording = str(status["recording"]["state"])
        self.replaced = sum("calibration replaced" in event for _, event in recording.events())


class Attack:
    """Threads that disturb a service.

    Parameters
    ----------
    service : Service
        The service; its calibration is ``unit.yaml`` beside its status socket.
    port : int
        Its TCP port.
    records : Path
        Folder of its recordings.
    seconds : float
        Duration of the run.
    """

    def __init__(self, service: Service, port: int, records: Path, seconds: float) -> None:
        self._service, self._port, self._records = service, port, records
        self._seconds = seconds
        self._stopped = threading.Event()
        tasks: list[Callable[[], object]] = [lambda k=k: self._client(k) for k in range(CLIENTS)]
        tasks += [self._calibrations, self._recordings, self._status_socket]
        self._threads = [threading.Thread(target=task, daemon=True) for task in tasks]
        service.hang_up()
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End the attack."""
        self._stopped.set()
        for thread in self._threads:
            thread.join()

    def _client(self, seed: int) -> None:
        """Connect, and never read; send noise; leave in one of several ways; come again."""
        chance = random.Random(_SEED + seed)
        while not self._stopped.is_set():
            with socket.socket() as client, suppress(OSError):
                client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
                client.settimeout(1.0)
                client.connect(("127.0.0.1", self._port))
                end = chance.choice(("stay", "noise", "reset", "leave"))
                if end == "noise":
                    client.sendall(chance.randbytes(100_000))
                if end == "reset":
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
                self._stopped.wait(chance.uniform(0.0, 2.0) if end in ("reset", "leave") else 60.0)

    def _calibrations(self) -> None:
        """Replace the calibration ten times a second: by good ones, damaged ones, and none."""
        chance = random.Random(_SEED)
        path = self._service.socket.with_name("unit.yaml")
        good = path.read_bytes()
        required = good.index(b"C_ba")  # cut behind it, a file is that of a unit without lever arms
        while not self._stopped.wait(0.1):
            match chance.choice(("good", "good", "half", "noise", "none")):
                case "good":
                    scale = (chance.uniform(0.5, 2.0),) * 3
                    gyro = NOMINAL.gyro.model_copy(update={"scale_arcsec_per_pulse": scale})
                    write_calibration(path, NOMINAL.model_copy(update={"gyro": gyro}))
                case "half":
                    path.write_bytes(good[: chance.randrange(required)])
                case "noise":
                    path.write_bytes(chance.randbytes(1000))
                case "none":
                    path.unlink(missing_ok=True)

    def _recordings(self) -> None:
        """Delete the recording, again and again."""
        for _ in range(DELETED):
            if self._stopped.wait(self._seconds / (DELETED + 1)):
                return
            for path in self._records.glob("*.mcap"):
                path.unlink()

    def _status_socket(self) -> None:
        """Take the status socket over twice."""
        for _ in range(2):
            if self._stopped.wait(self._seconds / 4.0):
                return
            path = self._service.socket
            path.unlink(missing_ok=True)
            with socket.socket(socket.AF_UNIX) as intruder:
                intruder.bind(os.fspath(path))
                intruder.listen()
                self._stopped.wait(2.0)
            path.unlink(missing_ok=True)
