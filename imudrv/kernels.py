"""The decorator of every numba kernel: compiled once for a user, and never stale.

numba keeps compiled code beside the source and looks only at the file that holds the kernel, so a change in a
helper of another file would go unseen. Here the cache folder carries a hash of all sources of the package.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba import njit

F = TypeVar("F", bound=Callable[..., Any])


def _cache_folder() -> str:
    sources = hashlib.sha256()
    for source in sorted(Path(__file__).parent.rglob("*.py")):
        sources.update(source.read_bytes())
    home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return str(Path(home) / "imu50" / f"kernels-{sources.hexdigest()[:16]}")


_FOLDER = _cache_folder()


def kernel(function: F) -> F:
    """Compile `function` at its first call; the compiled code is kept between runs.

    Parameters
    ----------
    function : callable
        Scalars, tuples and arrays only; see numba's supported features.

    Returns
    -------
    callable
        The same function, compiled; releases the interpreter lock, divides as IEEE 754 says.
    """
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = _FOLDER
    try:
        compiled: F = njit(cache=True, nogil=True, error_model="numpy", forceinline=True)(function)
    finally:
        numba.config.CACHE_DIR = before
    return compiled
