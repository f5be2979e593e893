"""Command `calib reidentify`."""

import argparse
from pathlib import Path
from typing import Final

from calib.cli.arguments import add_workers
from calib.fleet.reidentify import reidentify_all, sessions
from imudrv.terminal import BAD_INPUT, NOT_GOOD, OK, say
from imudrv.wording import counted

EXAMPLE: Final = "sessions --workers 4"

_SAME_MM: Final = 1e-6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = "folders with sessions, at any depth; they are not changed"
    parser.add_argument("sessions", type=Path, nargs="+", metavar="TREE", help=text)
    add_workers(parser)


def run(arguments: argparse.Namespace) -> int:
    """Identify sessions again; print how each differs from its certificate."""
    found, differing, faults = sessions(arguments.sessions), 0, 0
    for one in reidentify_all(found, arguments.workers, arguments.scheduler):
        say(str(one))
        faults += bool(one.fault)
        differing += one.shift_mm > _SAME_MM
    say(f"{counted(len(found), 'session')}: {differing} differ, {faults} without a comparison")
    if faults:
        return BAD_INPUT
    return NOT_GOOD if differing else OK
