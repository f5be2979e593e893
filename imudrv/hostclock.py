"""Clocks of the host: times of arrival on a scale that never steps, and what the real-time clock says.

Times of arrival are those of a clock that nobody can set and that includes suspends (CLOCK_BOOTTIME on
Linux), plus a constant that makes them UNIX time at the start of the process. They stay on this scale when
the real-time clock is set later; `imudrv.service.clock_watch` detects that.
"""

import sys
import time
from typing import Final, NamedTuple

_COMPARISONS: Final = 5


class Readings(NamedTuple):
    """Clocks of the host, read together, ns.

    Parameters
    ----------
    now_ns : int
        `now_ns` before the others were read.
    real_ns : int
        UNIX time.
    awake_ns : int
        Monotonic clock that excludes suspends, from an arbitrary origin.
    spread_ns : int
        Duration of the reading.
    """

    now_ns: int
    real_ns: int
    awake_ns: int
    spread_ns: int


if sys.platform == "linux":

    def _steady_ns() -> int:
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME)

else:
    _steady_ns = time.monotonic_ns


def now_ns() -> int:
    """Time now on the scale of the arrivals, ns since the UNIX epoch as of the start of the process."""
    return _steady_ns() + OFFSET_NS


def read_clocks() -> Readings:
    """Read all clocks."""
    before, real, awake = now_ns(), time.time_ns(), time.monotonic_ns()
    return Readings(before, real, awake, now_ns() - before)


def _unix_offset_ns() -> int:
    """UNIX time less the steady clock, from the quickest of some comparisons."""
    comparisons = []
    for _ in range(_COMPARISONS):
        before, real, after = _steady_ns(), time.time_ns(), _steady_ns()
        comparisons.append((after - before, real - before))
    return min(comparisons)[1]


OFFSET_NS: Final = _unix_offset_ns()
"""`now_ns` less the steady clock of the system, ns."""
