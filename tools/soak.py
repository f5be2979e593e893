#!/usr/bin/env python3
"""Hold the live service to its promises: real processes, real ptys, sockets, buses and full disks.

    tools/run python tools/soak.py all
    tools/run python tools/soak.py loopback [--seconds 60]     also loopback-can, loopback-canfd
    tools/run python tools/soak.py fast [--seconds 5]          20 kHz
    tools/run python tools/soak.py faults [--seconds 20]       the same counts, whichever way the bytes take
    tools/run python tools/soak.py kill [--times 20]           what a recording has after kill -9
    tools/run python tools/soak.py unplug [--seconds 15]       and a full disk, and consumers that are none
    tools/run python tools/soak.py hours [--hours 10]          in virtual time

Each prints what was promised and what was found; the exit code is 1 when something was not kept. Promises of
counts and contents hold on any machine; times, loads and sizes are the machine's too.
"""

import argparse
import io
import os
import pty
import resource
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import termios
import threading
import time
import tty
from collections.abc import Callable, Sequence
from contextlib import ExitStack, redirect_stderr, redirect_stdout, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from imudrv import cli, profiles
from imudrv.calibration import write_calibration
from imudrv.capture import Capture
from imudrv.errors import InputError
from imudrv.files.tables import increment_columns
from imudrv.imu.sequence import SampleCounts
from imudrv.receiver import receive
from imudrv.recording.reader import Recording
from imudrv.records import INCREMENTS, PULSES, Flag, Records
from imudrv.service.status_socket import ask
from imudrv.sim.scenario import NOMINAL
from imudrv.wire.encode import StreamEncoder

SERIAL: Final = "imu50-rs422"
LAYOUT: Final = profiles.load(SERIAL).layout()
FRAME: Final = LAYOUT.messages[0].length
BUS: Final = "can://udp_multicast/239.74.163.2"
RATE_HZ: Final = 1000
GRACE_NS: Final = 250_000_000
"""What was read longer ago than this outlives a kill."""
CPU_PERCENT: Final = 15.0
RSS_MB: Final = 250.0
GROWTH_MB: Final = 5.0
"""Flat: in ten hours a leak of one byte a sample would be 36 MB; the allocator alone settles within 2."""
DEADLINE_S: Final = 60.0
"""Only ends what is broken."""

Status = dict[str, Any]


class BrokenOffError(Exception):
    """A step did not come about, so there is nothing to judge."""


class Check(NamedTuple):
    """One promise.

    Parameters
    ----------
    promise, found : str
        In words and figures.
    kept : bool
        Whether both agree.
    of_machine : bool
        A time, a load or a size: another machine, or a busy one, gives another.
    """

    promise: str
    found: str
    kept: bool
    of_machine: bool = False

    def __str__(self) -> str:
        """One line."""
        return f"  {'kept  ' if self.kept else 'BROKEN'} {self.promise}: {self.found}"


def measured(promise: str, found: str, kept: bool = True) -> Check:
    """Check a time, a load or a size; without `kept` it is only told."""
    return Check(promise, found, bool(kept), of_machine=True)


# Processes


class Child:
    """A Python process of ours and what it says."""

    def __init__(self, folder: Path, *command: object) -> None:
        self._name = " ".join(map(str, command))
        self.process = subprocess.Popen(
            [sys.executable, *map(str, command)],
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self.said: list[str] = []
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.said.extend(iter(self.process.stdout.readline, ""))

    def heard(self, words: str) -> str:
        """Last line with these words; empty if there is none."""
        return next((line.strip() for line in reversed(self.said) if words in line), "")

    def await_words(self, words: str) -> None:
        """Wait for a line."""
        until(lambda: self.heard(words) or self.process.poll() is not None, f"{words!r} from {self._name}")
        if not self.heard(words):
            self._reader.join()
            raise BrokenOffError(f"{self._name}: {''.join(self.said[-9:])}")

    def ended(self, longest_s: float = DEADLINE_S) -> int:
        """Wait for the end; the exit code."""
        try:
            code = self.process.wait(longest_s)
        except subprocess.TimeoutExpired:
            raise BrokenOffError(f"{self._name} does not end: {''.join(self.said[-9:])}") from None
        self._reader.join()
        return code

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Send a signal; the exit code."""
        self.process.send_signal(number)
        return self.ended()

    def close(self) -> None:
        """Kill it if it still runs."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join()
        if self.process.stdout is not None:
            self.process.stdout.close()


class Service(Child):
    """A running `imudrv run` of the nominal unit; every kernel is warm once it is made."""

    def __init__(self, folder: Path, port: str, profile: str, *more: object) -> None:
        write_calibration(folder / "unit.yaml", NOMINAL)
        self.socket = folder / "status.sock"
        common = ["--profile", profile, "--calibration", "unit.yaml", "--status", self.socket]
        super().__init__(folder, "-m", "imudrv", "run", "--port", port, *common, *more)
        try:
            self.await_words("serving")
        except BrokenOffError:
            self.close()
            raise

    def await_status(self, true: Callable[[Status], object], what: str) -> Status:
        """Wait for a status."""
        found: Status = {}

        def holds() -> object:
            nonlocal found
            if self.process.poll() is not None:
                raise BrokenOffError(f"the service has ended: {''.join(self.said[-9:])}")
            with suppress(InputError):  # not there yet
                found = ask(self.socket)
            return found and true(found)

        until(holds, what)
        return found

    def await_port(self, *states: str) -> None:
        """Wait until the port is in one of these states."""
        self.await_status(lambda status: status["port"]["state"] in states, f"the port {' or '.join(states)}")


class Stage(ExitStack):
    """Processes in a folder; those that still run at its end are killed."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder

    def unit(self, port: str, profile: str, speed: str, *more: object) -> Child:
        """Start a simulated unit that plays ``scenario.yaml``."""
        command = ["sim", "scenario.yaml", "--profile", profile, "--port", port, "--speed", speed, *more]
        return self._started(Child(self._folder, "-m", "imudrv", *command), "plays on")

    def service(self, port: str, profile: str, *more: object) -> Service:
        """Start the service."""
        service = Service(self._folder, port, profile, *more)
        self.callback(service.close)
        return service

    def pair(self, profile: str, speed: str, *more: object) -> tuple[Child, Service]:
        """Start unit and service so that none of the samples is lost: on a pty, or on a bus by UDP."""
        if not profiles.load(profile).layout().can:
            unit = self.unit("pty", profile, speed, "--link", "unit")  # waits for its first reader
            return unit, self.service(str(self._folder / "unit"), profile, *more)
        port = f"{BUS}?port={free_port()}"
        service = self.service(port, profile, *more)
        service.await_port("silent")
        return self.unit(port, profile, speed), service

    def listener(self, url: str, name: str) -> Child:
        """Start a receiver that keeps what it gets in a file."""
        return self._started(Child(self._folder, Path(__file__).resolve(), "listen", url, name), "listening")

    def _started(self, child: Child, words: str) -> Child:
        self.callback(child.close)
        child.await_words(words)
        return child


def until(true: Callable[[], object], what: str) -> None:
    """Wait for what must come."""
    end = time.monotonic() + DEADLINE_S
    while not true():
        if time.monotonic() > end:
            raise BrokenOffError(f"waited in vain for {what}")
        time.sleep(0.02)


def command(*arguments: object) -> tuple[int, str]:
    """Run `imudrv` to its end, in this process for speed: exit code and what it says."""
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        code = cli.main([str(argument) for argument in arguments])
    return code, said.getvalue()


def done(*arguments: object) -> list[str]:
    """Run a command that must succeed; its lines."""
    code, said = command(*arguments)
    if code:
        raise BrokenOffError(f"imudrv {' '.join(map(str, arguments))}: exit code {code}: {said}")
    return said.splitlines()


def listen(url: str, path: Path) -> None:
    """Receive until SIGTERM, and until nothing more waits; keep it in a file."""
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    got = [np.zeros(0, INCREMENTS)]
    with receive(url, timeout_s=0.3) as receiver:
        print("listening", flush=True)
        while not stop.is_set():
            got.extend(receiver)
    np.save(path, np.concatenate(got))
    print(f"lost {receiver.lost}, {receiver.rejected_bytes} bytes of something else")


def free_port() -> int:
    """A port that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Usage(NamedTuple):
    """What a process has used: CPU seconds with all threads and children, memory now."""

    at_s: float
    cpu_s: float
    rss_mb: float


def usage(pid: int) -> Usage:
    """Look at a process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    cpu_s = sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
    return Usage(time.monotonic(), cpu_s, int(fields[21]) * resource.getpagesize() / 1e6)


class Watch(threading.Thread):
    """Looks at a process again and again until it is told to stop, or the process has ended."""

    def __init__(self, pid: int, period_s: float = 0.25) -> None:
        super().__init__(daemon=True)
        self._pid, self._period_s = pid, period_s
        self._stopped = threading.Event()
        self._seen = [usage(pid)]
        self.start()

    def run(self) -> None:
        """Look."""
        with suppress(OSError):  # the process has ended
            while not self._stopped.wait(self._period_s):
                self._look()

    def stop(self) -> list[Usage]:
        """Look once more; all that was seen."""
        self._stopped.set()
        self.join()
        with suppress(OSError):
            self._look()
        return self._seen

    def _look(self) -> None:
        if (use := usage(self._pid)).rss_mb:  # one that has ended and was not waited for has no memory
            self._seen.append(use)


def memory(seen: Sequence[Usage], settled_s: float) -> list[Check]:
    """Whether memory was small, and flat from some time after the beginning on."""
    later = [use for use in seen if use.at_s >= seen[0].at_s + settled_s] or [seen[-1]]
    worst = max(use.rss_mb for use in seen)
    grown = max(use.rss_mb for use in later) - later[0].rss_mb
    after_s = later[0].at_s - seen[0].at_s
    return [
        measured(
            f"memory flat: at most {GROWTH_MB:g} MB more",
            f"{later[0].rss_mb:.1f} MB after {after_s:.1f} s, {later[-1].rss_mb:.1f} MB at the end, "
            f"{grown:.2f} MB more at worst",
            grown <= GROWTH_MB,
        ),
        measured(f"memory < {RSS_MB:g} MB", f"{worst:.0f} MB at worst", worst < RSS_MB),
    ]


# Contents


def write_scenario(folder: Path, run_s: float, faults: dict[str, Any] | None = None) -> int:
    """Write a rocking unit as ``scenario.yaml``; how many samples it makes."""
    rock = {"duration_s": run_s, "band_hz": [0.5, 3.0], "ramp_s": min(1.0, run_s / 2.0)}
    document = {
        "format": "imu50-scenario",
        "version": 1,
        "seed": 11,
        "site": {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0},
        "motion": [{"rock": {**rock, "rate_rms_deg_per_s": [40.0, 40.0, 40.0]}}],
        "unit": {"noise": {"arw_deg_per_sqrt_h": 0.002, "vrw_m_s_per_sqrt_h": 0.003}},
        "faults": faults or {},
    }
    (folder / "scenario.yaml").write_text(yaml.safe_dump(document))
    return round(run_s * RATE_HZ)


def turning(first: int, count: int) -> NDArray[np.uint8]:
    """Frames of a unit that turns a little, one a row."""
    pulses = np.zeros(count, PULSES)
    pulses["counter"] = first + np.arange(count)
    pulses["gyro"] = np.rint(100.0 * np.sin(pulses["counter"] / 50.0))[:, None]
    pulses["accelerometer"] = [0, 0, 20]
    pulses["temperature_degc"] = 35.0
    return StreamEncoder(LAYOUT).encode(pulses)


def difference(left: Records, npz: Path) -> str:
    """Column in which increments differ from the first rows of a command's file; empty: the same bits."""
    with np.load(npz) as columns:
        for name, column in increment_columns(left).items():
            other = columns[name][: len(left)]
            if column.shape != other.shape or column.tobytes() != other.tobytes():
                return f"{name} differs"
    return ""


def last_status(recording: Recording) -> tuple[SampleCounts, Status]:
    """Sample counts and status that a recording ends with."""
    *_, (_, status) = recording.statuses()
    samples = status["samples"]
    return SampleCounts(**{name: samples[name] for name in SampleCounts.__dataclass_fields__}), status


# The proofs


def loopback(folder: Path, seconds: float, profile: str = SERIAL, speed: float = 1.0) -> list[Check]:
    """Every sample from the unit's process through the service's into a third one."""
    samples = write_scenario(folder, seconds * speed)
    out = f"udp://127.0.0.1:{free_port()}"
    load = os.getloadavg()[0]
    with Stage(folder) as stage:
        listener = stage.listener(out, "got.npy")
        unit, service = stage.pair(profile, f"{speed:g}", "--out", out, "--record", "run.mcap")
        watch = Watch(service.process.pid)
        unit.ended(DEADLINE_S + 2.0 * seconds)
        seen = watch.stop()
        load = max(load, os.getloadavg()[0])
        service.await_port("lost", "silent")  # all that was sent has been read
        code = service.stop()
        listener.stop()
    got: Records = np.load(folder / "got.npy")
    counts, status = last_status(Recording(folder / "run.mcap"))
    said = done("compensate", folder / "run.mcap", "-o", folder / "offline.npz")
    differs = difference(got, folder / "offline.npz")
    percent = 100.0 * (seen[-1].cpu_s - seen[0].cpu_s) / seconds
    limit = CPU_PERCENT if speed == 1.0 else 100.0
    latency = {name: status["latency"][name] * 1e3 for name in ("p50_s", "p99_s", "p999_s", "max_s")}
    return [
        Check(
            f"{samples:,} samples, each one, in order",
            f"{len(got):,} came; {listener.heard('lost')}",
            np.array_equal(got["counter"], np.arange(samples)),
        ),
        Check("the service ends well", f"exit code {code}", code == 0),
        Check("the counts add up", str(counts), counts.closes and counts.good == samples),
        Check(
            "bit-identical to `imudrv compensate` of the recording",
            differs or f"{len(got):,} rows, all columns, times and flags too",
            not differs and f"  {counts}" in said,
        ),
        measured("the unit", unit.said[-1].strip()),
        measured(
            f"CPU <= {limit:g} % of a core",
            f"{percent:.1f} %; system load {load:.1f} on {os.cpu_count()} cores",
            percent <= limit,
        ),
        measured(
            "from read to socket, p50 p99 p99.9 max", " ".join(f"{x:.2f}" for x in latency.values()) + " ms"
        ),
        *memory(seen, 10.0),
    ]


RANDOM_FAULTS: Final = {
    "stream": dict.fromkeys(
        (
            "bit_flips",
            "bytes_lost",
            "bytes_inserted",
            "false_sync_inside",
            "frame_lost",
            "bytes_between",
            "false_sync_between",
            "frame_doubled",
        ),
        0.01,
    ),
    "can": dict.fromkeys(("lost", "doubled", "swapped"), 0.01),
}


def faults(folder: Path, seconds: float, wires: Sequence[str] = profiles.OWN) -> list[Check]:
    """One scenario with every fault there is: the same counts, offline, live and from the recording."""
    of_unit = {
        "silences": [{"at_s": 0.3 * seconds, "duration_s": 0.1 * seconds}],
        "counter_jumps": [{"at_s": 0.5 * seconds, "by": 40}, {"at_s": 0.7 * seconds, "by": -300}],
    }
    write_scenario(folder, seconds, {**RANDOM_FAULTS, **of_unit})
    checks = [check for wire in wires for check in three_ways(folder, wire)]
    write_scenario(folder, seconds, of_unit)
    sums = set()
    for wire in wires:
        counts, _ = decoded(captured(folder, wire), wire)
        lost = counts.missing + counts.damaged + counts.torn
        sums.add((counts.expected, counts.good + counts.reference, lost, counts.restarts))
    return [
        *checks,
        Check(
            f"without the line's own faults {len(wires)} wires have the same counts",
            " and ".join("{} = {} good or reference + {} lost, {} restarts".format(*each) for each in sums),
            len(sums) == 1,
        ),
    ]


def three_ways(folder: Path, wire: str) -> list[Check]:
    """What becomes of ``scenario.yaml`` on a wire: its capture decoded, live, the recording decoded."""
    offline, rejected = decoded(captured(folder, wire), wire)
    recording = folder / f"{wire}.mcap"
    # A bus does not wait for its readers, so that there it plays at its own pace.
    is_can = profiles.load(wire).layout().can
    with Stage(folder) as stage:
        unit, service = stage.pair(wire, "1" if is_can else "max", "--record", recording)
        unit.ended()
        service.await_port("lost", "silent")
        service.stop()
    live, status = last_status(Recording(recording))
    again = decoded(recording, wire)
    runs = {name: tuple(kind.values()) for name, kind in status["rejected"].items()}
    return [
        Check(f"{wire}: the counts add up", str(offline), offline.closes and offline.lost > 0),
        Check(
            f"{wire}: {'bus' if is_can else 'pty'} and `imudrv run`, count by count",
            "the same" if live == offline else str(live),
            live == offline,
        ),
        Check(
            f"{wire}: what was no frame, runs and length by reason",
            ", ".join(f"{name} {count} {length}" for name, (count, length) in rejected.items()),
            runs == rejected,
        ),
        Check(
            f"{wire}: the recording decoded again",
            "the same" if again == (offline, rejected) else str(again[0]),
            again == (offline, rejected),
        ),
    ]


def captured(folder: Path, wire: str) -> Path:
    """Play ``scenario.yaml`` into a capture."""
    path = folder / f"{wire}.capture"
    done("sim", folder / "scenario.yaml", "--profile", wire, "-o", path)
    return path


def decoded(path: Path, wire: str) -> tuple[SampleCounts, dict[str, tuple[int, int]]]:
    """Decode a capture as `imudrv decode` does: sample counts, and runs and length by reason."""
    capture = Capture(path, profiles.load(wire))
    for _ in capture.pulses(lambda _: None):
        pass
    rejected = sorted(capture.rejected.items())
    return capture.tracker.counts, {
        reason.name.lower(): (entry.runs, entry.length) for reason, entry in rejected
    }


class Player(threading.Thread):
    """A unit on a pty, in this process, that notes when it sent what."""

    def __init__(self, samples: int) -> None:
        super().__init__(daemon=True)
        self.frames = turning(0, samples)
        self.sent_ns = np.zeros(samples, np.int64)
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._stopped = threading.Event()

    def run(self) -> None:
        """Send one frame each millisecond; while nobody reads, wait."""
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
            termios.tcflush(self._slave, termios.TCIFLUSH)  # a write that waits goes on
            self.join(0.01)
        os.close(self._master)
        os.close(self._slave)


class Downstream(threading.Thread):
    """A receiver in this process that notes when each sample came."""

    def __init__(self, url: str, samples: int) -> None:
        super().__init__(daemon=True)
        self._receiver = receive(url, timeout_s=0.2)
        self._stopped = threading.Event()
        self.came_ns = np.zeros(samples, np.int64)
        self.start()

    def run(self) -> None:
        """Receive."""
        with self._receiver as receiver:
            while not self._stopped.is_set():
                for increments in receiver:
                    self.came_ns[increments["counter"]] = time.monotonic_ns()

    def close(self) -> None:
        """Stop."""
        self._stopped.set()
        self.join()


class Killed(NamedTuple):
    """What was found after a kill.

    Parameters
    ----------
    before : int
        Samples that were downstream 0.25 s before it.
    wire, increments : int
        Samples whose bytes, and whose increments are in the file.
    lost_ms : float
        How long before the kill the unit sent the oldest sample that is not in the file; 0: all is in it.
    trouble : str
        What is wrong with the file; empty: nothing.
    """

    before: int
    wire: int
    increments: int
    lost_ms: float
    trouble: str


def kill_once(folder: Path, after_s: float) -> Killed:
    """Record, kill some time after the first sample, and look at the file."""
    samples = round((after_s + DEADLINE_S) * RATE_HZ)
    out = f"udp://127.0.0.1:{free_port()}"
    path = folder / "run.mcap"
    with Stage(folder) as stage:
        downstream = Downstream(out, samples)
        stage.callback(downstream.close)
        unit = Player(samples)
        stage.callback(unit.close)
        service = stage.service(unit.path, SERIAL, "--out", out, "--record", path)
        unit.start()
        until(lambda: downstream.came_ns.any(), "the first sample")
        time.sleep(after_s)
        killed_ns = time.monotonic_ns()
        service.stop(signal.SIGKILL)
    came, sent = downstream.came_ns, unit.sent_ns
    before = np.count_nonzero((came > 0) & (came <= killed_ns - GRACE_NS))
    recording = Recording(path)
    wire = b"".join(bytes(arrival.data) for arrival in recording.arrivals())
    own = np.concatenate([np.zeros(0, INCREMENTS), *recording.increments()])
    trouble = [] if wire == unit.frames.tobytes()[: len(wire)] else ["the wire's bytes are others"]
    done("export", path, "--to", "raw", "-o", folder / "run.raw")
    if (folder / "run.raw").read_bytes() != wire:
        trouble.append("the export has other bytes")
    if len(wire) >= FRAME:  # else it was killed before anything had to be in it
        done("compensate", path, "-o", folder / "run.npz")
        if differs := difference(own, folder / "run.npz"):
            trouble.append(f"a replay has other increments: {differs}")
    elif len(own):
        trouble.append("increments without their bytes")
    lost = sent[len(wire) // FRAME :]
    lost_ms = 1e-6 * max(0, killed_ns - int(lost[0])) if lost[0] else 0.0
    return Killed(int(before), len(wire) // FRAME, len(own), lost_ms, ", ".join(trouble))


def kill(folder: Path, times: int, longest_s: float = 3.0) -> list[Check]:
    """Kill the recording service at random moments."""
    runs = []
    for k, after_s in enumerate(np.random.default_rng(7).uniform(0.0, longest_s, times).tolist()):
        (folder / str(k)).mkdir()
        runs.append(kill_once(folder / str(k), after_s))
    spoilt = [run.trouble for run in runs if run.trouble]
    short = [run.before - run.wire for run in runs if run.wire < run.before]
    lost_ms = np.array([run.lost_ms for run in runs])
    wire, increments = sum(run.wire for run in runs), sum(run.increments for run in runs)
    return [
        Check(
            f"{times} recordings open, export to raw, and replay to their own increments",
            "; ".join(spoilt) or f"all of them; {wire:,} samples and {increments:,} increments together",
            not spoilt and increments > 0,
        ),
        measured(
            "what was downstream 0.25 s before the kill is in the file",
            f"short of {short} samples" if short else "each sample of it",
            not short,
        ),
        measured(
            "the oldest sample lost was sent <= 250 ms before the kill",
            f"median {np.median(lost_ms):.0f} ms, worst {lost_ms.max():.0f} ms",
            lost_ms.max() <= GRACE_NS * 1e-6,
        ),
    ]


class Disk:
    """A full disk: a small tmpfs where root may mount one, else a limit on the size of a process' files."""

    def __init__(self, stage: Stage, folder: Path, size: int, room: int) -> None:
        folder.mkdir()
        self._ballast = folder / "ballast"
        self._limits = (room, size)
        mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "soak", str(folder)]
        self._is_mounted = os.geteuid() == 0 and not subprocess.run(mount, capture_output=True).returncode
        if self._is_mounted:
            stage.callback(subprocess.run, ["umount", str(folder)], check=True)
            self._ballast.write_bytes(bytes(size - room))
        self.kind = f"a tmpfs of {size / 1e6:.0f} MB" if self._is_mounted else "a limit on the file's size"

    def fill(self, pid: int) -> None:
        """Leave little room."""
        if not self._is_mounted:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, self._limits)

    def make_room(self, pid: int) -> None:
        """Leave enough of it."""
        if self._is_mounted:
            self._ballast.unlink()
        else:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (self._limits[1], self._limits[1]))


def unplug(folder: Path, seconds: float, speed: float = 10.0) -> list[Check]:
    """All at once, at 10 kHz: cable out and in, disk full, one client stuck, one receiver not there."""
    out_s = 1.0
    cable = {"at_s": 0.3 * seconds * speed, "duration_s": out_s * speed}
    samples = write_scenario(folder, seconds * speed, {"unplugs": [cable]})
    good, absent, tcp = (free_port() for _ in range(3))
    outs = [f"udp://127.0.0.1:{good}", f"udp://127.0.0.1:{absent}", f"tcp://127.0.0.1:{tcp}"]
    path = folder / "disk" / "run.mcap"
    with Stage(folder) as stage:
        disk = Disk(stage, path.parent, 400 * samples, 1_000_000)  # 250 bytes a sample are recorded
        listener = stage.listener(outs[0], "got.npy")
        options = [option for url in outs for option in ("--out", url)]
        unit, service = stage.pair(SERIAL, f"{speed:g}", *options, "--record", path)
        pid = service.process.pid
        disk.fill(pid)
        stuck = stage.enter_context(socket.socket())
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.connect(("127.0.0.1", tcp))
        watch = Watch(pid)
        service.await_status(
            lambda s: (s["recording"]["state"], s["port"]["state"]) == ("disk full", "streaming"),
            "a full disk",
        )
        loud = command("status", "--status", service.socket)
        service.await_status(lambda s: s["port"]["reconnects"], "the cable in again")
        full = service.await_status(lambda s: s["sinks"][2]["dropped"], "drops for the client that is stuck")
        disk.make_room(pid)
        service.await_status(lambda s: s["recording"]["healthy"], "a recording that goes on")
        calm = command("status", "--status", service.socket)[1]
        unit.ended(DEADLINE_S + 2.0 * seconds)
        service.await_port("lost")
        seen = watch.stop()
        code = service.stop()
        listener.stop()
        recording = Recording(path)
        counts, status = last_status(recording)
        own = np.concatenate(list(recording.increments()))
        reads = [(arrival.t_ns, len(arrival.data)) for arrival in recording.arrivals()]
        told_ns = next((t_ns for t_ns, s in recording.statuses() if s["port"]["state"] == "lost"), 0)
        done("compensate", path, "-o", folder / "offline.npz")
    got: Records = np.load(folder / "got.npy")
    flagged = got["counter"][got["flags"] & Flag.MISSING_BEFORE != 0]
    gaps = got["counter"][1:][np.diff(got["counter"]) != 1]
    delivered = int(unit.said[-1].split(", ")[1].split()[0]) // FRAME
    frames = sum(length for _, length in reads) // FRAME
    told_s = 1e-9 * (told_ns - max((t_ns for t_ns, _ in reads if t_ns <= told_ns), default=0))
    back_s = (samples - counts.good) / RATE_HZ / speed - out_s
    nobody, client = status["sinks"][1:]
    differs = difference(own, folder / "offline.npz")
    return [
        Check("the service lives through it and ends well", f"exit code {code}", code == 0),
        Check(
            "counted: the counts add up, and good is what the unit's line took",
            f"{counts}; {delivered:,} delivered",
            counts.closes and counts.expected == samples and counts.good == delivered,
        ),
        Check(
            "flagged: the sample after the gap, downstream",
            f"{len(got):,} came, flagged {flagged.tolist()}",
            len(got) == counts.good and len(gaps) == 1 and gaps.tolist() == flagged.tolist(),
        ),
        Check(
            "a UDP receiver that is not there is told and counted",
            f"{nobody['state']}, {nobody['dropped']:,} dropped",
            nobody["state"] == "nobody listens" and nobody["dropped"] > 0,
        ),
        Check(
            "a TCP client that stops reading loses its own samples, counted",
            f"{client['dropped']:,} dropped, {client['queued']:,} wait",
            client["dropped"] > 0 and client["sent"] + client["dropped"] + client["queued"] <= counts.good,
        ),
        Check(
            f"a full disk ({disk.kind}) is loud",
            f"`imudrv status` exits with {loud[0]}: {' / '.join(loud[1].splitlines()[:2])}",
            loud[0] == 4 and "disk full" in loud[1] and full["recording"]["state"] == "disk full",
        ),
        Check(
            "with room again the recording goes on and has all of it",
            f"{full['recording']['queued']:,} waited, {frames:,} frames and "
            f"{len(own):,} increments are in it{', ' if differs else ''}{differs}",
            "disk full" not in calm and frames == delivered and np.array_equal(own, got) and not differs,
        ),
        measured(
            "the status tells of it within 0.5 s",
            f"{1e3 * told_s:.0f} ms after the last read",
            0 <= told_s <= 0.5,
        ),
        measured("stream back within 2 s of the port", f"{back_s:.2f} s", back_s <= 2.0),
        *memory(seen, 0.0)[1:],  # what waits for the disk takes memory
    ]


def hours(folder: Path, count: float) -> list[Check]:
    """Hours in virtual time; every datagram goes out, to where nobody listens."""
    samples = round(count * 3600 * RATE_HZ)
    if shutil.disk_usage(folder).free < samples * FRAME + (1 << 30):
        raise BrokenOffError(f"{folder}: expected {samples * FRAME / 1e9:.1f} GB and some room; set TMPDIR")
    with (folder / "long.raw").open("wb") as file:
        for first in range(0, samples, 100_000):
            file.write(turning(first, min(100_000, samples - first)).tobytes())
    with Stage(folder) as stage:
        out = f"udp://127.0.0.1:{free_port()}"
        service = stage.service("replay://long.raw?speed=max", SERIAL, "--out", out)
        watch = Watch(service.process.pid, 0.05)
        code = service.ended(DEADLINE_S + 600.0 * count)
        seen = watch.stop()
    taken_s = seen[-1].at_s - seen[0].at_s
    summary = service.heard("end: ").partition("end: ")[2]
    all_good = f"{samples} samples by the counter = {samples} good; 0 duplicate, 0 restarts of the unit"
    return [
        Check("the service ends well", f"exit code {code}", code == 0),
        Check("the counts add up", summary, summary == all_good),
        measured(f"{count:g} h", f"{taken_s:.1f} s, {samples / taken_s / 1e6:.2f} M samples/s"),
        *memory(seen, 0.1 * taken_s),
    ]


class Proof(NamedTuple):
    """A proof and what the command line calls its size."""

    run: Callable[[Path, float], list[Check]]
    option: str
    usual: float
    text: str


PROOFS: Final = {
    "loopback": Proof(loopback, "--seconds", 60, "every sample, from a pty to UDP, at 1 kHz"),
    "loopback-can": Proof(partial(loopback, profile="imu50-can"), "--seconds", 60, "from a CAN bus"),
    "loopback-canfd": Proof(partial(loopback, profile="imu50-canfd"), "--seconds", 60, "from CAN FD"),
    "fast": Proof(partial(loopback, speed=20.0), "--seconds", 5, "every sample at 20 kHz"),
    "faults": Proof(faults, "--seconds", 20, "the same counts, whichever way the bytes take"),
    "kill": Proof(lambda folder, times: kill(folder, round(times)), "--times", 20, "what kill -9 leaves"),
    "unplug": Proof(unplug, "--seconds", 15, "cable out, disk full, consumers that are none"),
    "hours": Proof(hours, "--hours", 10, "counts and memory over hours of virtual time"),
}


def prove(name: str, size: float) -> bool:
    """Run a proof in a folder of its own and tell; whether all was kept."""
    print(f"{name} {PROOFS[name].option} {size:g}", flush=True)
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        try:
            checks = PROOFS[name].run(Path(folder), size)
        except BrokenOffError as error:
            checks = [Check("it comes to its end", str(error), False)]
    print(*checks, sep="\n", flush=True)
    return all(check.kept for check in checks)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    commands = parser.add_subparsers(dest="name", required=True, metavar="PROOF")
    commands.add_parser("all", help="all of them")
    for name, proof in PROOFS.items():
        sub = commands.add_parser(name, help=proof.text)
        text = "default: %(default)s"
        sub.add_argument(proof.option, dest="size", type=float, default=proof.usual, help=text)
    listener = commands.add_parser("listen", help="the receiver of the others: into a file until SIGTERM")
    listener.add_argument("url")
    listener.add_argument("path", type=Path)
    options = parser.parse_args(argv)
    if options.name == "listen":
        listen(options.url, options.path)
        return 0
    if getattr(options, "size", 1) <= 0:
        parser.error("expected a number above 0")
    names = list(PROOFS) if options.name == "all" else [options.name]
    kept = [prove(name, getattr(options, "size", PROOFS[name].usual)) for name in names]
    return 0 if all(kept) else 1


if __name__ == "__main__":
    sys.exit(main())
