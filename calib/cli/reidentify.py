"""Command `calib reidentify`."""

import argparse
from pathlib import Path
from typing import Final

from calib.fleet.reidentify import reidentify_all, sessions
from imudrv.errors import InputError
from imudrv.terminal import BAD_INPUT, NOT_GOOD, OK, say

EXAMPLE: Final = "sessions --workers 4"

_SAME_MM: Final = 1e-6


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = "folders with sessions, at any depth; they are not changed"
    parser.add_argument("sessions", type=Path, nargs="+", metavar="TREE", help=text)
    where = parser.add_mutually_exclusive_group()
    text = "processes on this computer (default: 1; more need pip install imu50[dask])"
    where.add_argument("--workers", type=int, default=1, metavar="N", help=text)
    text = "Dask scheduler whose workers do it, such as tcp://host:8786; they must see the same paths"
    where.add_argument("--scheduler", metavar="URL", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Identify sessions again; print how each differs from its certificate."""
    if arguments.workers < 1:
        raise InputError(f"--workers: expected at least 1, got {arguments.workers}")
    found, differing, faults = sessions(arguments.sessions), 0, 0
    for one in reidentify_all(found, arguments.workers, arguments.scheduler):
        say(str(one))
        faults += bool(one.fault)
        differing += one.shift_mm > _SAME_MM
    say(f"{len(found)} sessions: {differing} differ, {faults} without a comparison")
    if faults:
        return BAD_INPUT
    return NOT_GOOD if differing else OK
