"""Command `calib verify`."""

import argparse
from pathlib import Path
from typing import Final

from calib.bench.verify import verify
from imudrv.terminal import BAD_INPUT, OK, say

EXAMPLE: Final = "s1"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("session", type=Path, metavar="DIR", help="folder of the session")


def run(arguments: argparse.Namespace) -> int:
    """Verify a session; print what differs."""
    verified = verify(arguments.session)
    say(str(verified))
    return BAD_INPUT if verified.faults else OK
