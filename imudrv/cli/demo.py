"""Command `imudrv demo`: the bench procedure on a simulated unit, as a technician runs it.

`calib` is the layer above this package, so it is started like any other program.
"""

import argparse
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

EXAMPLE: Final = ""

STORY: Final = """\
The driver service reads a simulated unit from a virtual serial port; the unit has errors that its certificate
does not contain. A simulated technician carries out the bench procedure in fast time: Z, X and Y up, each
aligned and rotated by 180 deg. The inner lever arms are identified from the recordings and written to a new
certificate; one more rotation, navigated with and without compensation, verifies them."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add no arguments: the command has none."""


def run(arguments: argparse.Namespace) -> int:
    """Rehearse the bench procedure from wire bytes to certificate, verification and report."""
    print(STORY, flush=True)
    session = Path(tempfile.mkdtemp(prefix="imu50-demo-")) / "session"
    command = ["run", "--rehearse", "--speed", "max", "--session", str(session)]
    code = subprocess.run([sys.executable, "-m", "calib", *command], check=False).returncode
    if code == 0:
        print(f"to check the result from the recordings: calib verify {session}")
    return code
