"""Counts and memory over hours of virtual time; every datagram is sent to a port without receiver."""

import shutil
from pathlib import Path

from .checks import TIMEOUT_S, Check, StepError, measured
from .data import FRAME, RATE_HZ, SERIAL, encoded_frames
from .processes import Stage, free_port
from .usage import UsageMonitor, memory_checks


def virtual_hours(folder: Path, hours: float) -> list[Check]:
    """Replay a capture as fast as possible."""
    samples = round(hours * 3600 * RATE_HZ)
    if shutil.disk_usage(folder).free < samples * FRAME + (1 << 30):
        raise StepError(
            f"{folder}: expected {samples * FRAME / 1e9:.1f} GB and 1 GB of free space; set TMPDIR"
        )
    with (folder / "long.raw").open("wb") as file:
        for first in range(0, samples, 100_000):
            file.write(encoded_frames(first, min(100_000, samples - first)).tobytes())
    with Stage(folder) as stage:
        out = f"udp://127.0.0.1:{free_port()}"
        service = stage.service("replay://long.raw?speed=max", SERIAL, "--out", out)
        monitor = UsageMonitor(service.process.pid, 0.05)
        code = service.wait(TIMEOUT_S + 600.0 * hours)
        usage = monitor.stop()
    duration_s = usage[-1].at_s - usage[0].at_s
    summary = service.line_with("end: ").partition("end: ")[2]
    all_good = f"{samples} samples by the counter = {samples} good; 0 duplicate, 0 restarts of the unit"
    return [
        Check("the service ends with exit code 0", f"exit code {code}", code == 0),
        Check("the counts add up", summary, summary == all_good),
        measured(f"{hours:g} h", f"{duration_s:.1f} s, {samples / duration_s / 1e6:.2f} M samples/s"),
        *memory_checks(usage, 0.1 * duration_s),
    ]
