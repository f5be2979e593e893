"""Command `imudrv profiles`."""

import argparse
from pathlib import Path
from typing import Final

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.profiles.dbc import skeleton
from imudrv.terminal import say

EXAMPLE: Final = "imu50-can > unit.yaml"

_FROM_DBC: Final = "from-dbc"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = f"shipped profile to print, or {_FROM_DBC}; without it all are listed"
    parser.add_argument("name", nargs="?", metavar="NAME", help=text)
    text = f"with {_FROM_DBC}: file whose messages become the skeleton of a CAN profile"
    parser.add_argument("file", nargs="?", type=Path, metavar="FILE.dbc", help=text)


def run(arguments: argparse.Namespace) -> None:
    """List the shipped profiles, print one, or make one from a DBC file."""
    if (arguments.name == _FROM_DBC) != (arguments.file is not None):
        raise InputError(f"expected a profile's name alone, or {_FROM_DBC} FILE.dbc")
    if arguments.file is not None:
        print(skeleton(arguments.file), end="")
    elif arguments.name is not None:
        print(profiles.content(arguments.name).decode(), end="")
    else:
        _list()


def _list() -> None:
    names = [*profiles.OWN, *(name for name in profiles.shipped() if name not in profiles.OWN)]
    width = max(map(len, names))
    for name in names:
        profile = profiles.load(name)
        title = profiles.content(name).decode().partition("\n")[0].removeprefix("# ")
        say(f"{name:{width}}  {profile.transport:6}  {profile.rate_hz:4g} Hz  {title}")
