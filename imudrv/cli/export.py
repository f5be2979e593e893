"""Command `imudrv export`."""

import argparse
from pathlib import Path
from typing import Final

from imudrv.cli.arguments import add_output, message_stream
from imudrv.recording.export import KINDS, export, export_datagrams
from imudrv.recording.reader import Recording
from imudrv.terminal import say

EXAMPLE: Final = "run.mcap --to npz -o run.npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("recording", type=Path, help="a recording (.mcap); for tables also datagrams (.i50n)")
    parser.add_argument("--to", choices=KINDS, required=True, help="output format")
    add_output(parser, "file to write; - for standard output with csv, raw, candump")


def run(arguments: argparse.Namespace) -> None:
    """Write a recording in another format."""
    if arguments.recording.suffix.lower() == ".i50n":
        export_datagrams(arguments.recording, arguments.to, arguments.output)
    else:
        export(Recording(arguments.recording), arguments.to, arguments.output)
    say(f"{arguments.recording} -> {arguments.output}", message_stream(arguments.output))
