"""Command `calib key`."""

import argparse
import sys
from typing import Final

from calib.signing.keys import bench_key, key_path, make_bench_key, public_half
from imudrv.errors import InputError
from imudrv.files import settings_file

EXAMPLE: Final = "new --name 'bench 3'"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    text = "make the key of this bench, which then signs its sessions and certificates"
    new = actions.add_parser("new", help=text, description=text)
    new.add_argument("--name", help="name of the bench (default: that of the computer)")
    text = "print the public half of the key, a file for calib verify --key"
    actions.add_parser("show", help=text, description=text)


def run(arguments: argparse.Namespace) -> None:
    """Make or show the key of the bench."""
    if arguments.action == "new":
        path, key = make_bench_key(arguments.name)
        print(f"{path}: the key of {key}\nhand out its public half: calib key show > trusted.yaml")
        return
    shown = bench_key()
    if shown is None:
        raise InputError(f"{key_path() or 'this user'}: expected a key, got none; make one: calib key new")
    sys.stdout.write(settings_file.to_bytes(public_half(shown)).decode())
