"""Command `imudrv monitor`."""

import argparse
from pathlib import Path
from typing import Final

from imudrv.service.monitor import monitor
from imudrv.service.status_socket import default_status_path
from imudrv.terminal import console

EXAMPLE: Final = "--status /run/imu50/imu50.sock"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("--status", type=Path, metavar="PATH", help="status socket of the service")


def run(arguments: argparse.Namespace) -> None:
    """Show the status of a service until Ctrl-C."""
    monitor(arguments.status or default_status_path(), console())
