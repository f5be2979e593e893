"""Command `imudrv status`."""

import argparse
import json
from contextlib import suppress
from pathlib import Path
from typing import Final

from imudrv.service.status_socket import EXIT_CODES, ask, default_status_path
from imudrv.terminal import say

EXAMPLE: Final = "--json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("--status", type=Path, metavar="PATH", help="status socket of the service")
    parser.add_argument("--json", action="store_true", help="the whole status as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the status of a service; return the exit code of its health."""
    status = ask(arguments.status or default_status_path())
    text = (
        json.dumps(status, indent=1) if arguments.json else "\n".join([status["health"], *status["reasons"]])
    )
    with suppress(BrokenPipeError):  # the health is the same whether or not all of it is read
        say(text)
    return EXIT_CODES[status["health"]]
