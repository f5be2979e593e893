"""Rehearse the bench procedure, kill it with SIGKILL at random moments, and resume it each time.

    python tools/rehearse_kills.py [--kills 30] [--seed 1] [FOLDER]

Every third run has a terminal that accepts no output, as after Ctrl-S. At the end the session must verify, no
accepted step may be repeated, no sample logged twice, and the result must agree with that of an undisturbed
rehearsal within three sigma of their difference.
"""

import argparse
import json
import os
import pty
import random
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import numpy as np

from calib.bench.verify import verify
from imudrv.calibration import read_calibration
from imudrv.units import MM

RUN: Final = (
    "import sys; from pathlib import Path; from rich.console import Console; "
    "from calib.bench.run import RunOptions, run; "
    "run(RunOptions(Path(sys.argv[1]), rehearse=True, speed='max'), Console())"
)
PAUSE_S: Final = (3.0, 25.0)
"""Shortest and longest time before a kill; the start takes part of it."""


def main() -> int:
    """Run the rehearsals and print the faults."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?", help="for the sessions (default: a temporary one)")
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    folder = arguments.folder or Path(tempfile.mkdtemp(prefix="rehearse-kills-"))
    folder.mkdir(parents=True, exist_ok=True)
    moments = random.Random(arguments.seed)

    begin = time.monotonic()
    rehearse(folder / "undisturbed")
    print(f"undisturbed: {time.monotonic() - begin:.0f} s", flush=True)
    killed, kills, sessions = folder / "killed-1", 0, 1
    disturbed = []
    while kills < arguments.kills:
        lifetime_s = moments.uniform(*PAUSE_S)
        if rehearse(killed, lifetime_s, is_stopped=kills % 3 == 1):
            disturbed.append(killed)
            sessions += 1
            killed = folder / f"killed-{sessions}"
        else:
            kills += 1
            lines = journal(killed)
            print(f"kill {kills} after {lifetime_s:.1f} s: {killed.name}, {len(lines)} lines", flush=True)
    if killed.exists():
        rehearse(killed)
        disturbed.append(killed)
    faults = [fault for session in disturbed for fault in check(session, folder / "undisturbed")]
    print("\n".join(faults) or f"{kills} kills over {len(disturbed)} sessions, no fault")
    return 1 if faults else 0


def rehearse(folder: Path, longest_s: float | None = None, is_stopped: bool = False) -> bool:
    """Start or resume a rehearsal with output to a log or a stopped terminal; return whether it finished."""
    with ExitStack() as opened:
        output: Any = opened.enter_context(open(f"{folder}.log", "a"))
        if is_stopped:
            master, output = pty.openpty()
            for end in (master, output):
                opened.callback(os.close, end)
        process = subprocess.Popen(
            [sys.executable, "-c", RUN, str(folder)],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env={**os.environ, "TERM": "xterm"},
        )
        try:
            process.wait(longest_s)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            return any(entry["event"] == "end" for entry in journal(folder))
    if process.returncode:
        raise SystemExit(
            f"{folder}: exit code {process.returncode}\n{Path(f'{folder}.log').read_text()[-3000:]}"
        )
    return True


def check(folder: Path, undisturbed: Path) -> list[str]:
    """Return the faults of a disturbed session."""
    verified = verify(folder)
    faults = [*verified.faults, *verified.unfinished]
    done: set[str] = set()
    for entry in journal(folder):
        if entry["event"] == "accepted":
            if entry["step_id"] in done:
                faults.append(f"{folder}: {entry['step_id']} was accepted twice")
            done.add(entry["step_id"])
            with np.load(folder / entry["recording"].replace(".mcap", ".npz")) as log:
                if (np.diff(log["counter"]) <= 0).any():
                    faults.append(f"{folder}: {entry['recording']}: a sample was logged twice")
        elif entry["event"] == "entered" and entry["phase"] == "place" and entry["step_id"] in done:
            faults.append(f"{folder}: {entry['step_id']} was requested again")
    (found, sigma), (expected, _) = sensing_points(folder), sensing_points(undisturbed)
    apart = np.abs(found - expected)
    print(f"{folder.name}: {apart.max() / MM:.4f} mm from undisturbed, {(apart / sigma).max():.2f} sigma")
    if (apart > 3.0 * 2.0**0.5 * sigma).any():
        faults.append(f"{folder}: the result differs from that of the undisturbed session")
    return faults


def journal(folder: Path) -> list[dict[str, Any]]:
    """Return the complete lines of a session's journal."""
    path = folder / "journal.jsonl"
    lines = []
    for line in path.read_text(errors="replace").splitlines() if path.exists() else []:
        try:
            lines.append(json.loads(line))
        except ValueError:
            continue  # a partial line after a kill
    return lines


def sensing_points(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the sensing points of a session's result, and their sigma, m, shape (3, 3) each."""
    found = read_calibration(folder / "certificate.yaml").size_effect
    if found is None or found.covariance_m2 is None:
        raise SystemExit(f"{folder}: expected a certificate with a size effect and its covariance")
    return found.r_m, np.sqrt(np.diag(found.covariance_m2)).reshape(3, 3)


if __name__ == "__main__":
    sys.exit(main())
