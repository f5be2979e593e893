"""Command `imudrv monitor`."""

import argparse
import sys
from pathlib import Path
from typing import Final

from imudrv.messages import language
from imudrv.service.monitor import monitor
from imudrv.service.printer import Printer
from imudrv.service.status_socket import default_status_path
from imudrv.service.web_monitor import ADDRESS, serve
from imudrv.terminal import console

EXAMPLE: Final = "--status /run/imu50/imu50.sock"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("--status", type=Path, metavar="PATH", help="status socket of the service")

    parser.add_argument("--language", metavar="L", help="en or zh_CN; default: the system's")
    text = f"show it on a page for browsers; default address: {ADDRESS}, for this machine only"
    parser.add_argument("--web", nargs="?", const=ADDRESS, metavar="HOST:PORT", help=text)


def run(arguments: argparse.Namespace) -> None:
    """Show the status of a service until Ctrl-C."""
    path = arguments.status or default_status_path()
    if arguments.web is None:
        monitor(path, console(), language(arguments.language))
        return
    with Printer(sys.stdout) as printer:
        serve(path, arguments.web, printer.say, language(arguments.language))
