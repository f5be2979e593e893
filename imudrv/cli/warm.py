"""Command `imudrv warm`."""

import argparse
from pathlib import Path
from typing import Final

from imudrv.compilation import can_keep, compile_all, remove_unused
from imudrv.errors import InputError
from imudrv.kernels import FOLDER
from imudrv.wording import counted

EXAMPLE: Final = ""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add no arguments: the command has none."""


def run(arguments: argparse.Namespace) -> None:
    """Compile all kernels that are missing."""
    if FOLDER is None or not can_keep(FOLDER):
        raise InputError(
            f"{FOLDER or 'home folder'}: expected a folder to keep compiled kernels in; "
            "set XDG_CACHE_HOME to one that can be written to"
        )
    remove_unused(FOLDER)
    before = _files(FOLDER)
    if not compile_all():
        raise InputError(
            f"{FOLDER}: expected memory to compile kernels and space to keep them; free some, and repeat"
        )
    if made := len(_files(FOLDER) - before):
        print(f"{FOLDER}: {counted(made, 'kernel')} compiled")
    else:
        print(f"{FOLDER}: all kernels are compiled, nothing to do")


def _files(folder: Path) -> set[tuple[str, int]]:
    return {(path.name, path.stat().st_mtime_ns) for path in folder.glob("*.kernel")}
