"""Command `imudrv status`."""

import argparse
import json
from contextlib import suppress
from pathlib import Path
from typing import Final

from imudrv.errors import InputError
from imudrv.service.status_socket import EXIT_CODES, ask, default_status_path
from imudrv.terminal import say

EXAMPLE: Final = "--json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("--status", type=Path, metavar="PATH", help="status socket of the service")
    parser.add_argument("--json", action="store_true", help="the whole status as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Print the status of a service; return the exit code of its health."""
    path = arguments.status or default_status_path()
    status = ask(path)
    health, reasons = status.get("health"), status.get("reasons")
    if (
        health not in tuple(EXIT_CODES)
        or not isinstance(reasons, list)
        or not all(isinstance(reason, str) for reason in reasons)
    ):
        raise InputError(
            f"{path}: expected a status with health and reasons, got another; restart the service"
        )
    text = json.dumps(status, indent=1) if arguments.json else "\n".join([health, *reasons])
    with suppress(BrokenPipeError):  # the health is the same whether or not all of it is read
        say(text)
    return EXIT_CODES[health]
