"""Cable out and in, full disk, a stuck client and an absent receiver, all at once."""

import os
import resource
import socket
import subprocess
from pathlib import Path
from typing import Final

import numpy as np

from imudrv.recording.reader import Recording
from imudrv.records import Flag, Records

from .checks import TIMEOUT_S, Check, measured
from .data import FRAME, difference, last_status, profile_at, write_scenario
from .processes import Stage, free_port, run_imudrv, run_ok
from .usage import UsageMonitor, memory_checks


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
        self.kind = f"a tmpfs of {size / 1e6:.0f} MB" if self._is_mounted else "a limit on the file size"

    def fill(self, pid: int) -> None:
        """Leave little room."""
        if not self._is_mounted:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, self._limits)

    def make_room(self, pid: int) -> None:
        """Leave enough room."""
        if self._is_mounted:
            self._ballast.unlink()
        else:
            resource.prlimit(pid, resource.RLIMIT_FSIZE, (self._limits[1], self._limits[1]))


RATE_HZ: Final = 10_000
_UNPLUGGED_S: Final = 1.0


def disruption(folder: Path, seconds: float) -> list[Check]:
    """Disturb a run."""
    unplug = {"at_s": 0.3 * seconds, "duration_s": _UNPLUGGED_S}
    samples = write_scenario(folder, seconds, {"unplugs": [unplug]}, RATE_HZ)
    good, absent, tcp = (free_port() for _ in range(3))
    outs = [f"udp://127.0.0.1:{good}", f"udp://127.0.0.1:{absent}", f"tcp://127.0.0.1:{tcp}"]
    path = folder / "disk" / "run.mcap"
    with Stage(folder) as stage:
        disk = Disk(stage, path.parent, 400 * samples, 1_000_000)  # 250 bytes a sample are recorded
        listener = stage.listener(outs[0], "received.npy")
        options = [option for url in outs for option in ("--out", url)]
        unit, service = stage.unit_and_service(profile_at(folder, RATE_HZ), "1", *options, "--record", path)
        pid = service.process.pid
        disk.fill(pid)
        stuck = stage.enter_context(socket.socket())
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.connect(("127.0.0.1", tcp))
        monitor = UsageMonitor(pid)
        service.await_status(
            lambda s: (s["recording"]["state"], s["port"]["state"]) == ("disk full", "streaming"), "full disk"
        )
        alarm_code, alarm = run_imudrv("status", "--status", service.socket)
        service.await_status(lambda s: s["port"]["reconnects"], "reconnection")
        full = service.await_status(
            lambda s: s["sinks"][2]["dropped"], "samples dropped for the stuck client"
        )
        disk.make_room(pid)
        service.await_status(lambda s: s["recording"]["healthy"], "healthy recording")
        _, all_clear = run_imudrv("status", "--status", service.socket)
        unit.wait(TIMEOUT_S + 2.0 * seconds)
        service.await_port("lost")
        usage = monitor.stop()
        code = service.stop()
        listener.stop()
        recording = Recording(path)
        counts, status = last_status(recording)
        recorded = np.concatenate(list(recording.increments()))
        reads = [(arrival.t_ns, len(arrival.data)) for arrival in recording.arrivals()]
        absent_states = {s["sinks"][1]["state"] for _, s in recording.statuses()}
        reported_ns = next((t_ns for t_ns, s in recording.statuses() if s["port"]["state"] == "lost"), 0)
        run_ok("compensate", path, "-o", folder / "offline.npz")
    received: Records = np.load(folder / "received.npy")
    flagged = received["counter"][received["flags"] & Flag.MISSING_BEFORE != 0]
    gaps = received["counter"][1:][np.diff(received["counter"]) != 1]
    delivered = int(unit.lines[-1].split(", ")[1].split()[0]) // FRAME
    frames = sum(length for _, length in reads) // FRAME
    last_read_ns = max((t_ns for t_ns, _ in reads if t_ns <= reported_ns), default=0)
    report_s = 1e-9 * (reported_ns - last_read_ns)
    recovery_s = (samples - counts.good) / RATE_HZ - _UNPLUGGED_S
    udp_sink, tcp_sink = status["sinks"][1:]
    differs = difference(recorded, folder / "offline.npz")
    return [
        Check("the service keeps running and ends with exit code 0", f"exit code {code}", code == 0),
        Check(
            "the counts add up, and the good samples are those delivered to the line",
            f"{counts}; {delivered:,} delivered",
            counts.closes and counts.expected == samples and counts.good == delivered,
        ),
        Check(
            "the receiver gets the sample after the gap flagged",
            f"{len(received):,} received, flagged {flagged.tolist()}",
            len(received) == counts.good and len(gaps) == 1 and gaps.tolist() == flagged.tolist(),
        ),
        Check(
            "an absent UDP receiver is reported and its samples counted",
            f"{', '.join(sorted(absent_states))}; {udp_sink['dropped']:,} dropped",
            "nobody listens" in absent_states and udp_sink["dropped"] > 0,
        ),
        Check(
            "a TCP client that stops reading loses only its own samples, counted",
            f"{tcp_sink['dropped']:,} dropped, {tcp_sink['queued']:,} queued",
            tcp_sink["dropped"] > 0
            and tcp_sink["sent"] + tcp_sink["dropped"] + tcp_sink["queued"] <= counts.good,
        ),
        Check(
            f"a full disk ({disk.kind}) is an alarm",
            f"`imudrv status` exits with {alarm_code}: {' / '.join(alarm.splitlines()[:2])}",
            alarm_code == 4 and "disk full" in alarm and full["recording"]["state"] == "disk full",
        ),
        Check(
            "with room again the recording continues and is complete",
            f"{full['recording']['queued']:,} were queued, {frames:,} frames and "
            f"{len(recorded):,} increments recorded{', ' if differs else ''}{differs}",
            "disk full" not in all_clear
            and frames == delivered
            and np.array_equal(recorded, received)
            and not differs,
        ),
        measured(
            "the status reports the lost port within 0.5 s",
            f"{1e3 * report_s:.0f} ms after the last read",
            0 <= report_s <= 0.5,
        ),
        measured("the stream is back within 2 s of the port", f"{recovery_s:.2f} s", recovery_s <= 2.0),
        *memory_checks(usage, 0.0)[1:],  # what waits for the disk takes memory
    ]
