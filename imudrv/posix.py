"""What POSIX systems have and Windows has not: modules are None there."""

import os
import sys
from importlib import import_module
from typing import Any, Final

from imudrv.errors import InputError


def _module(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        return None


fcntl: Final = _module("fcntl")
resource: Final = _module("resource")
termios: Final = _module("termios")
tty: Final = _module("tty")

O_NOFOLLOW: Final[int] = getattr(os, "O_NOFOLLOW", 0)
"""Flag for `os.open` that refuses a symbolic link; 0 where there is none."""
O_BINARY: Final[int] = getattr(os, "O_BINARY", 0)
"""Flag for `os.open` of a file that is not text; 0 where all files are alike."""


def require_posix(what: str, instead: str) -> None:
    """Refuse what only a POSIX system can do.

    Parameters
    ----------
    what, instead : str
        What was asked for, and what to do.

    Raises
    ------
    InputError
        On another system.
    """
    if termios is None:
        raise InputError(f"{what}: expected a POSIX system such as Linux, got {sys.platform}; {instead}")
