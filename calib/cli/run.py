"""Command `calib run`."""

import argparse
from datetime import date
from pathlib import Path
from typing import Final

from calib.bench.run import RunOptions, new_folder
from calib.bench.run import run as run_session
from calib.bench.technician import MISTAKES, MISTAKES_AT_REST
from calib.bench.web_console import ADDRESS
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
    text = (
        "certificate of the unit; replaced when you accept the new one; of the sensors it need not exist yet"
    )
    add("--calibration", type=Path, metavar="C.yaml", help=text)
    add("--site", type=Path, metavar="S.yaml", help="site of the bench: latitude, longitude, height")
    text = "who calibrates, where and with what, for the certificate; default: ~/.config/imu50/bench.yaml"
    add("--bench", type=Path, metavar="B.yaml", help=text)
    add("--operator", metavar="NAME", help="who conducts the session; asked at a terminal")
    add(
        "--unit",
        metavar="SERIAL",
        help="serial number on the unit; another one than the certificate's is refused",
    )
    text = "when the unit was received, such as 2026-11-26, for the certificate"
    add("--received", type=date.fromisoformat, metavar="DATE", help=text)
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
    add(
        "--hands-free",
        action="store_true",
        help="continue by the sensors alone; the result is accepted at a terminal, or with --accept",
    )
    text = "accept the result without a person, unless a verdict is bad"
    add("--accept", action="store_true", help=text)
    add("--pdf", action="store_true", help="the report as PDF, too; needs chromium or weasyprint")
    add("--language", metavar="L", help="en or zh_CN; default: the system's")
    add("--rehearse", action="store_true", help="use a simulated unit and technician")
    text = f"a page for browsers, beside the terminal; default address: {ADDRESS}, for this machine only"
    add("--web", nargs="?", const=ADDRESS, metavar="HOST:PORT", help=text)
    text = "in a rehearsal: you press the keys, and the technician does what the screen says"
    add("--keys", action="store_true", help=text)
    mistakes = ", ".join(kind.replace(" ", "-") for kind in dict.fromkeys((*MISTAKES, *MISTAKES_AT_REST)))
    text = f"in a rehearsal: random, or some of {mistakes}, by commas"
    add("--mistakes", default="", metavar="LIST", help=text)
    add("--speed", default="1", metavar="X", help="speed of the rehearsal: 1, 10, ... or max")


def run(arguments: argparse.Namespace) -> int:
    """Run or resume a session at the bench."""
    return run_session(RunOptions(**vars(arguments)), console())
