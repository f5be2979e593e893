"""Command `imudrv pack`."""

import argparse
from pathlib import Path
from typing import Final

from imudrv.cli.arguments import add_output
from imudrv.files.outputs import require_other
from imudrv.recording.pack import pack
from imudrv.terminal import say

EXAMPLE: Final = "run.mcap -o packed.mcap"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("recording", type=Path)
    add_output(parser, "compressed recording to write", "PACKED.mcap")


def run(arguments: argparse.Namespace) -> None:
    """Write a compressed copy of a recording."""
    require_other(arguments.output, arguments.recording)
    pack(arguments.recording, arguments.output)
    before, after = arguments.recording.stat().st_size, arguments.output.stat().st_size
    say(f"{arguments.output}: {after} bytes, was {before}")
