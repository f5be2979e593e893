"""Command `calib verify`."""

import argparse
from pathlib import Path
from typing import Final

from calib.bench.verify import verify
from calib.signing.keys import read_trusted
from imudrv.terminal import BAD_INPUT, NOT_GOOD, OK, say

EXAMPLE: Final = "s1 --key trusted.yaml"

NOT_TRUSTED: Final = 4
"""Exit code: not signed by a trusted key."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("path", type=Path, metavar="PATH", help="folder of a session, or a certificate")
    text = "trusted public keys, see calib key show; a signature of one of them is then required"
    parser.add_argument("--key", type=Path, metavar="FILE", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Verify a session or a certificate; print what differs and who signed it."""
    trusted = None if arguments.key is None else read_trusted(arguments.key)
    verified = verify(arguments.path, trusted)
    say(str(verified))
    if verified.faults:
        return BAD_INPUT
    if verified.untrusted:
        return NOT_TRUSTED
    return NOT_GOOD if verified.unfinished else OK
