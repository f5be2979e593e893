"""Every sample from the process of the unit through that of the service into a third one."""

import os
from pathlib import Path
from typing import Final

import numpy as np

from imudrv import profiles
from imudrv.recording.reader import Recording
from imudrv.records import Records

from .checks import TIMEOUT_S, Check, measured
from .data import RATE_HZ, SERIAL, difference, last_status, profile_at, write_scenario
from .processes import Stage, free_port, run_ok
from .usage import UsageMonitor, memory_checks

CPU_PERCENT: Final = 15.0
BY_PYTHON_PERCENT: Final = 30.0
"""The same where python-can reads, which takes 26 us a message, of which a sample has two, and 26 us more to
find that there is no other; the rest are Python's calls of the stages and outputs."""


def loopback(folder: Path, seconds: float, profile: str = SERIAL, rate_hz: int = RATE_HZ) -> list[Check]:
    """Play a unit for some seconds and compare what arrives with the offline command.

    Parameters
    ----------
    folder : Path
        Where everything is written.
    seconds : float
        Duration.
    profile : str
        Of the unit, at 1 kHz.
    rate_hz : int
        Another rate of the serial unit.
    """
    samples = write_scenario(folder, seconds, rate_hz=rate_hz)
    if rate_hz != RATE_HZ:
        profile = profile_at(folder, rate_hz)
    out = f"udp://127.0.0.1:{free_port()}"
    load = os.getloadavg()[0]
    with Stage(folder) as stage:
        listener = stage.listener(out, "received.npy")
        unit, service = stage.unit_and_service(profile, "1", "--out", out, "--record", "run.mcap")
        monitor = UsageMonitor(service.process.pid)
        unit.wait(TIMEOUT_S + 2.0 * seconds)
        usage = monitor.stop()
        load = max(load, os.getloadavg()[0])
        service.await_port("lost", "silent")  # all that was sent has been read
        code = service.stop()
        listener.stop()
    received: Records = np.load(folder / "received.npy")
    counts, status = last_status(Recording(folder / "run.mcap"))
    report = run_ok("compensate", folder / "run.mcap", "-o", folder / "offline.npz")
    differs = difference(received, folder / "offline.npz")
    percent = 100.0 * (usage[-1].cpu_s - usage[0].cpu_s) / seconds
    is_can = profiles.load(profile).layout().can
    limit = BY_PYTHON_PERCENT if is_can else CPU_PERCENT if rate_hz == RATE_HZ else 100.0
    latency = (status["latency"][name] * 1e3 for name in ("p50_s", "p99_s", "p999_s", "max_s"))
    return [
        Check(
            f"all {samples:,} samples arrive, in order",
            f"{len(received):,} received; {listener.line_with('lost')}",
            np.array_equal(received["counter"], np.arange(samples)),
        ),
        Check("the service ends with exit code 0", f"exit code {code}", code == 0),
        Check("the counts add up", str(counts), counts.closes and counts.good == samples),
        Check(
            "bit-identical to `imudrv compensate` of the recording",
            differs or f"{len(received):,} rows, all columns with times and flags",
            not differs and f"  {counts}" in report,
        ),
        measured("the unit", unit.lines[-1].strip()),
        measured(
            f"CPU <= {limit:g} % of a core",
            f"{percent:.1f} %; system load {load:.1f} on {os.cpu_count()} cores",
            percent <= limit,
        ),
        measured(
            "latency from read to socket, p50 p99 p99.9 max", " ".join(f"{x:.2f}" for x in latency) + " ms"
        ),
        *memory_checks(usage, 10.0),
    ]
