"""The decorator of every numba kernel: compiled once for a user, and never stale.

numba keeps compiled code beside the source and looks only at the file that holds the kernel, so a change in a
helper of another file would go unseen. Here the cache folder carries a hash of all sources that kernels read.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar, cast

from numba import njit
from numba.core import config

F = TypeVar("F", bound=Callable[..., Any])

CONSTANTS: Final = (
    "arrays.py",
    "records.py",
    "units.py",
    "service/clock_watch.py",
    "wire/layout.py",
    "wire/tables.py",
)
"""Files without kernels whose constants and types kernels read."""


def _cache_folder() -> str:
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        text = source.read_bytes()
        if b"@kernel" in text or source.relative_to(package).as_posix() in CONSTANTS:
            digest.update(text)
    home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return str(Path(home) / "imu50" / f"kernels-{digest.hexdigest()[:16]}")


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
    settings: Any = config  # numba makes its settings' names at run time
    before = settings.CACHE_DIR
    settings.CACHE_DIR = _FOLDER
    try:
        return cast(F, njit(cache=True, nogil=True, error_model="numpy", forceinline=True)(function))
    finally:
        settings.CACHE_DIR = before
