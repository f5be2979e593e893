"""What a recording contains after `kill -9` of the service."""

import os
import pty
import signal
import termios
import threading
import time
import tty
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from imudrv.receiver import receive
from imudrv.recording.reader import Recording
from imudrv.records import INCREMENTS

from .checks import TIMEOUT_S, Check, measured, wait_until
from .data import FRAME, RATE_HZ, SERIAL, difference, encoded_frames
from .processes import Stage, free_port, run_ok

LOSS_NS: Final = 250_000_000
"""Data read longer ago than this survives a kill."""


class PtyUnit(threading.Thread):
    """A unit on a pty, in this process, that notes when it sent each sample."""

    def __init__(self, samples: int) -> None:
        super().__init__(daemon=True)
        self.frames = encoded_frames(0, samples)
        self.sent_ns = np.zeros(samples, np.int64)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._stopped = threading.Event()

    def run(self) -> None:
        """Send a frame each millisecond; block while nobody reads."""
        begin = time.monotonic()
        for k, frame in enumerate(self.frames):
            if self._stopped.wait(max(0.0, begin + k / RATE_HZ - time.monotonic())):
                return
            self.sent_ns[k] = time.monotonic_ns()
            os.write(self._master, frame.tobytes())

    def close(self) -> None:
        """Stop."""
        self._stopped.set()
        while self.is_alive():
            termios.tcflush(self._slave, termios.TCIFLUSH)  # unblocks a write
            self.join(0.01)
        os.close(self._master)
        os.close(self._slave)


class Receiver(threading.Thread):
    """A receiver in this process that notes when it received each sample."""

    def __init__(self, url: str, samples: int) -> None:
        super().__init__(daemon=True)
        self._receiver = receive(url, timeout_s=0.2)
        self._stopped = threading.Event()
        self.received_ns = np.zeros(samples, np.int64)
        self.start()

    def run(self) -> None:
        """Receive."""
        with self._receiver as receiver:
            while not self._stopped.is_set():
                for increments in receiver:
                    self.received_ns[increments["counter"]] = time.monotonic_ns()

    def close(self) -> None:
        """Stop."""
        self._stopped.set()
        self.join()


class Killed(NamedTuple):
    """What a recording contains after a kill.

    Parameters
    ----------
    required : int
        Samples that were received `LOSS_NS` before the kill.
    frames, increments : int
        Samples whose frames, and whose increments are in the file.
    lost_ms : float
        How long before the kill the unit sent the oldest sample that is not in the file; 0: none is missing.
    faults : list of str
        What is wrong with the file.
    """

    required: int
    frames: int
    increments: int
    lost_ms: float
    faults: list[str]


def kill_once(folder: Path, after_s: float) -> Killed:
    """Record, kill the service some time after the first sample, and examine the file."""
    samples = round((after_s + TIMEOUT_S) * RATE_HZ)
    out = f"udp://127.0.0.1:{free_port()}"
    path = folder / "run.mcap"
    with Stage(folder) as stage:
        receiver = Receiver(out, samples)
        stage.callback(receiver.close)
        unit = PtyUnit(samples)
        stage.callback(unit.close)
        service = stage.service(unit.path, SERIAL, "--out", out, "--record", path)
        unit.start()
        wait_until(receiver.received_ns.any, "first sample")
        time.sleep(after_s)
        killed_ns = time.monotonic_ns()
        service.stop(signal.SIGKILL)
    received, sent = receiver.received_ns, unit.sent_ns
    recording = Recording(path)
    wire = b"".join(bytes(arrival.data) for arrival in recording.arrivals())
    frames = len(wire) // FRAME
    increments = np.concatenate([np.zeros(0, INCREMENTS), *recording.increments()])
    faults = [] if wire == unit.frames.tobytes()[: len(wire)] else ["the recorded bytes are not those sent"]
    run_ok("export", path, "--to", "raw", "-o", folder / "run.raw")
    if (folder / "run.raw").read_bytes() != wire:
        faults.append("the export has other bytes")
    if frames:  # else it was killed before anything had to be in it
        run_ok("compensate", path, "-o", folder / "run.npz")
        if differs := difference(increments, folder / "run.npz"):
            faults.append(f"a replay has other increments: {differs}")
    elif len(increments):
        faults.append("increments without their bytes")
    required = np.count_nonzero((received > 0) & (received <= killed_ns - LOSS_NS))
    lost_ms = 1e-6 * max(0, killed_ns - int(sent[frames])) if sent[frames] else 0.0
    return Killed(int(required), frames, len(increments), lost_ms, faults)


def kill(folder: Path, times: float, longest_s: float = 3.0) -> list[Check]:
    """Kill the recording service at random moments."""
    runs = []
    for k, after_s in enumerate(np.random.default_rng(7).uniform(0.0, longest_s, round(times)).tolist()):
        (folder / str(k)).mkdir()
        runs.append(kill_once(folder / str(k), after_s))
    faults = [fault for run in runs for fault in run.faults]
    short = [run.required - run.frames for run in runs if run.frames < run.required]
    lost_ms = np.array([run.lost_ms for run in runs])
    frames, increments = sum(run.frames for run in runs), sum(run.increments for run in runs)
    return [
        Check(
            f"{len(runs)} recordings open, export to raw, and replay to the recorded increments",
            "; ".join(faults) or f"all; {frames:,} samples and {increments:,} increments in total",
            not faults and increments > 0,
        ),
        measured(
            "what was received 0.25 s before the kill is in the file",
            f"short of {short} samples" if short else "every sample",
            not short,
        ),
        measured(
            "the oldest lost sample was sent <= 250 ms before the kill",
            f"median {np.median(lost_ms):.0f} ms, worst {lost_ms.max():.0f} ms",
            lost_ms.max() <= LOSS_NS * 1e-6,
        ),
    ]
