"""The host's time: UNIX nanoseconds that never step, because only the monotonic clock moves them on."""

import time
from typing import Final

_OFFSET_NS: Final = time.time_ns() - time.monotonic_ns()


def now_ns() -> int:
    """Time now, ns since the UNIX epoch as the wall clock stood when the process began; monotonic."""
    return time.monotonic_ns() + _OFFSET_NS
