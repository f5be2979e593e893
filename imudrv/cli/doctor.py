"""Command `imudrv doctor`."""

import argparse
from typing import Final

from imudrv.cli.arguments import add_profile
from imudrv.doctor.examine import doctor
from imudrv.terminal import BAD_INPUT, OK, say

EXAMPLE: Final = "--port /dev/ttyUSB0"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("--port", metavar="URL", required=True, help="port of the unit, as for run")
    add_profile(parser)


def run(arguments: argparse.Namespace) -> int:
    """Examine a port."""
    return OK if doctor(arguments.port, arguments.profile, say) else BAD_INPUT
