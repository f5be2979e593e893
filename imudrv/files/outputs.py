"""Names of outputs, checked before anything is written.

An output replaces what has its name. So a device, a pipe, a folder or an input of the command is refused.
"""

import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import Final

from imudrv.errors import InputError

_STANDARD_OUTPUT: Final = ("-", "/dev/stdout")


def is_standard_output(path: Path) -> bool:
    """Return whether a name means standard output: ``-`` or ``/dev/stdout``."""
    return str(path) in _STANDARD_OUTPUT


def file_to_write(path: Path) -> Path:
    """Return the file of an output: the name itself, or the target of the link.

    Parameters
    ----------
    path : Path
        The name that the user gave; the file need not exist.

    Returns
    -------
    Path
        No symbolic link.

    Raises
    ------
    InputError
        It is standard output, a folder, a device, a pipe or a socket, or cannot be examined.
    """
    if is_standard_output(path):
        raise InputError(f"{path}: expected a file, for this output cannot go to standard output")
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return Path(os.path.realpath(path))
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise InputError(f"{path}: cannot be written: {getattr(error, 'strerror', None) or error}") from error
    if not stat.S_ISREG(mode):
        raise InputError(f"{path}: expected a file, got {kind_of(mode)}; choose another name")
    return Path(os.path.realpath(path))


def require_other(path: Path, *inputs: str | Path | None) -> None:
    """Refuse an output that is one of the inputs, under any name.

    Parameters
    ----------
    path : Path
        The output.
    inputs : str, Path or None
        Inputs; None and names of no file are ignored.

    Raises
    ------
    InputError
        The output is an input; the message names both.
    """
    output = Path("/dev/stdout") if is_standard_output(path) else path
    for given in inputs:
        with suppress(OSError, ValueError):
            if given is not None and os.path.samefile(output, given):
                raise InputError(
                    f"{path}: expected an output apart from its input {given}, got the same file; "
                    "choose another name"
                )


def kind_of(mode: int) -> str:
    """Return what is no regular file, by its mode: a folder, a pipe, a socket or a device."""
    for is_kind, name in ((stat.S_ISDIR, "folder"), (stat.S_ISFIFO, "pipe"), (stat.S_ISSOCK, "socket")):
        if is_kind(mode):
            return f"a {name}"
    return "a device"
