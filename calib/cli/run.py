"""Command `calib run`."""

import argparse
from pathlib import Path
from typing import Final

from calib.bench.run import RunOptions, new_folder
from calib.bench.run import run as run_session
from calib.procedure import plan
from imudrv.cli.arguments import add_profile
from imudrv.terminal import console

EXAMPLE: Final = (
    "--port /dev/ttyUSB0 --profile imu50-rs422 --calibration unit.yaml --site site.yaml --session s1"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add = parser.add_argument
    add("--port", metavar="URL", help="port of the unit, as for imudrv run")
    add_profile(parser)
    text = "certificate of the unit; replaced when you accept the new one"
    add("--calibration", type=Path, metavar="C.yaml", help=text)
    add("--site", type=Path, metavar="S.yaml", help="site of the bench: latitude, longitude, height")
    add("--procedure", metavar="P", help=f"{', '.join(plan.shipped())}, or a procedure file")
    text = "folder for journal and recordings; an existing session is resumed"
    add("--session", dest="folder", type=Path, default=new_folder(), metavar="DIR", help=text)
    text = "repeat this step of an existing session; may be given several times"
    add("--redo", action="append", default=[], metavar="STEP", help=text)
    add(
        "--plan",
        action="store_true",
        help="only show the steps, how long they take, and the expected accuracy",
    )
    text = "name of this bench, and of its operator, for the record; kept for later sessions"
    add("--bench", metavar="NAME", help=text)
    add("--operator", metavar="NAME", help="see --bench")
    add("--hands-free", action="store_true", help="continue by the sensors alone, without keys")
    add("--rehearse", action="store_true", help="use a simulated unit and technician")
    add("--speed", default="1", metavar="X", help="speed of the rehearsal: 1, 10, ... or max")


def run(arguments: argparse.Namespace) -> int:
    """Run or resume a session at the bench."""
    return run_session(RunOptions(**vars(arguments)), console())
