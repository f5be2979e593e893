"""Command `imudrv demo`: the bench procedure on a simulated unit, as a technician runs it.

`calib` is the layer above this package, so it is started like any other program.
"""

import argparse
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from imudrv.files import settings_file
from imudrv.sim import scenario as scenarios
from imudrv.sim.scenario import Rest, Segment
from imudrv.terminal import OK

EXAMPLE: Final = "--full"

STORY: Final = """\
The driver service reads a simulated unit from a virtual serial port; the unit has errors that its certificate
does not contain. A simulated technician carries out the bench procedure in fast time: Z, X and Y up, each
aligned and rotated by 180 deg. The inner lever arms are identified from the recordings and written to a new
certificate; one more rotation, navigated with and without compensation, verifies them."""

FULL_STORY: Final = """\
A simulated unit that was never calibrated, from its raw pulses to a certificate that is proved. It is placed
on each of its six faces, turned and carried by hand: that shows its sensors. An hour at rest shows its noise.
Three rotations sharpen the lever arms, and one of them is navigated with and without compensation."""

PROFILE: Final = "imu50-rs422"
UNIT: Final = "50-0042"
REST_S: Final = 3600.0
POSES: Final = ("z-up", "x-up", "y-up")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = "a unit that was never calibrated: sensors, noise, lever arms, proof; several minutes"
    parser.add_argument("--full", action="store_true", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Rehearse the bench procedure from wire bytes to certificate, verification and report."""
    folder = Path(tempfile.mkdtemp(prefix="imu50-demo-"))
    if arguments.full:
        return _full(folder)
    print(STORY, flush=True)
    session = folder / "session"
    command = ["run", "--rehearse", "--speed", "max", "--session", str(session)]
    code = subprocess.run([sys.executable, "-m", "calib", *command], check=False).returncode
    if code == 0:
        print(f"to check the result from the recordings: calib verify {session}")
    return code


def _full(folder: Path) -> int:
    """Calibrate a new unit, one command after the other, each shown as a user would type it."""
    print(f"{FULL_STORY}\nAll files are in {folder}, and commands run there.", flush=True)
    write_scenarios(folder)
    for program, *command in commands():
        print(f"\n$ {program} {shlex.join(command)}", flush=True)
        code = subprocess.run([sys.executable, "-m", program, *command], cwd=folder, check=False).returncode
        if code != OK:
            return code
    print(f"\nreports: {', '.join(str(path) for path in sorted(folder.glob('*.html')))}")
    return OK


def write_scenarios(folder: Path) -> None:
    """Write the scenarios of one unit: by hand on six faces, an hour at rest, and three rotations."""
    faces = scenarios.load("six-faces-turned")
    rest = {"seed": faces.seed + 1, "motion": (Segment(rest=Rest(duration_s=REST_S)),)}
    settings_file.write(folder / "site.yaml", faces.site)
    settings_file.write(folder / "faces.yaml", faces)
    settings_file.write(folder / "rest.yaml", faces.model_copy(update=rest))
    for name in POSES:
        turned = scenarios.load(name).model_copy(update={"unit": faces.unit, "site": faces.site})
        settings_file.write(folder / f"{name}.yaml", turned)


def commands() -> Iterator[list[str]]:
    """Yield program and arguments of each step."""
    for name in ("faces", "rest", *POSES):
        truth = ["--truth", "truth.yaml"] if name == "faces" else []
        yield ["imudrv", "sim", f"{name}.yaml", "--profile", PROFILE, "-o", f"{name}.raw", *truth]
    common = ["--profile", PROFILE, "--site", "site.yaml"]
    plan = ["--procedure", "six-faces-turned"]
    out = ["-o", "sensors.yaml", "--report", "sensors.html"]
    yield ["calib", "sensors", "faces.raw", *common, "--unit", UNIT, *plan, *out]
    out = ["-o", "noise.yaml", "--report", "noise.html"]
    yield ["calib", "noise", "rest.raw", "--profile", PROFILE, "--calibration", "sensors.yaml", *out]
    captures = [f"{name}.raw" for name in POSES]
    out = ["-o", "unit.yaml", "--report", "arms.html", "--truth", "truth.yaml"]
    yield ["calib", "identify", *captures, *common, "--calibration", "noise.yaml", *out]
    yield ["calib", "validate", captures[0], *common, "--calibration", "unit.yaml", "--align", "360"]
