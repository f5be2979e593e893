"""The decorator of every numba kernel: compiled once for a user, and never stale.

A change in a helper of another file changes a kernel too, so the name of the folder of compiled kernels has a
hash of all sources that kernels read.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar, cast

from numba import njit
from numba.core import config

from imudrv.kernel_cache import keep_compiled, take_literals_as_variables

F = TypeVar("F", bound=Callable[..., Any])

CONSTANTS: Final = (
    "arrays.py",
    "ports/base.py",
    "records.py",
    "units.py",
    "service/clock_watch.py",
    "wire/layout.py",
    "wire/tables.py",
)
"""Files without kernels whose constants and types kernels read."""


def _cache_folder() -> Path | None:
    package = Path(__file__).parent
    digest = hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        text = source.read_bytes()
        if b"@kernel" in text or source.relative_to(package).as_posix() in CONSTANTS:
            digest.update(text)
    try:
        home = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError:  # a user without a home
        return None
    return Path(home) / "imu50" / f"kernels-{digest.hexdigest()[:16]}"


FOLDER: Final = _cache_folder()
"""Folder of compiled kernels; None for a user without a home."""


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
    compiled = njit(nogil=True, error_model="numpy", forceinline=True)(function)
    settings: Any = config  # numba makes its settings' names at run time
    if not settings.DISABLE_JIT:
        keep_compiled(compiled, FOLDER)
        take_literals_as_variables(compiled)
    return cast(F, compiled)
