"""Command `imudrv files`: what is installed beside the program, out of the package."""

import argparse
from pathlib import Path
from typing import Final

import imudrv
from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write

EXAMPLE: Final = "--to imu50-files"

FILES: Final = {
    "i50n.h": "C header that decodes the output datagrams; C99 or C++, without dependencies",
    "i50n_receiver.c": "example of a receiver in C",
    "99-imu50.rules": "udev rules for USB serial adapters: access, low latency, a permanent name",
    "imudrv.service": "systemd unit of the driver service",
}
"""What each file is, by its name. How it is installed is at its top."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("--to", type=Path, metavar="DIR", help="write them there; without it they are listed")


def run(arguments: argparse.Namespace) -> None:
    """List the files, or write them to a folder."""
    if arguments.to is not None:
        _write(arguments.to)
    width = max(map(len, FILES))
    for name, text in FILES.items():
        print(f"{name:{width}}  {text}")


def _write(folder: Path) -> None:
    shipped = Path(imudrv.__file__).parent / "share"
    contents = {folder / name: (shipped / name).read_bytes() for name in FILES}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        other = [path.name for path, data in contents.items() if path.exists() and path.read_bytes() != data]
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{folder}: expected a folder to write to: {reason}") from error
    if other:
        raise InputError(
            f"{folder}: expected no {other[0]} of another version or with changes, got one; "
            "remove it, or name another folder"
        )
    for path, data in contents.items():
        with atomic_write(path) as file:
            file.write(data)
