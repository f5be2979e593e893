"""Arguments that several commands have."""

import argparse
import sys
from pathlib import Path
from typing import TextIO

from imudrv import profiles
from imudrv.files.outputs import is_standard_output


def add_profile(parser: argparse.ArgumentParser, required: bool = False) -> None:
    """Add ``--profile``."""
    text = f"wire format: {', '.join(profiles.OWN)}, another one of `imudrv profiles`, or a profile file"
    parser.add_argument("--profile", required=required, metavar="P", help=text)


def add_output(parser: argparse.ArgumentParser, text: str, metavar: str = "OUT") -> None:
    """Add ``-o``, required; `text` is its help."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar=metavar, help=text)


def message_stream(output: Path) -> TextIO:
    """Return the stream for messages about an output: not the one that carries its bytes."""
    return sys.stderr if is_standard_output(output) else sys.stdout
