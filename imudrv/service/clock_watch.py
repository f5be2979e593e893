"""Detection of steps of the host's real-time clock, and of suspends.

NTP corrects a clock by steps or by slewing. A slew changes the rate of all clocks of a Linux host alike: the
times of arrival follow it, and the clock model with them, so it needs no detection. A step (NTP, ``date -s``,
a leap second) moves the real-time clock against the times of arrival; a suspend moves these against the
monotonic clock. Elsewhere the monotonic clock is not slewed, and a slew is followed in small steps.
"""

from collections.abc import Callable
from typing import Final

from imudrv.hostclock import Readings, read_clocks
from imudrv.records import Timebase
from imudrv.units import NS

STEP_NS: Final = 10_000_000
"""Smallest step that is followed: a tenth of the smallest step of any NTP daemon (chrony: 0.1 s, ntpd: 0.128
s), and a hundred times the error of a reading. Smaller steps are followed once they add up to it."""
_MAX_SPREAD_NS: Final = 100_000  # of readings that are used: an interrupted one says nothing
_FIRST_READINGS: Final = 5


class ClockWatch:
    """Comparison of the host's clocks, made after each read of the port.

    Parameters
    ----------
    read : callable, optional
        Reads the clocks.

    Attributes
    ----------
    timebase : Timebase
        Relation of the times of arrival to UNIX time.
    """

    def __init__(self, read: Callable[[], Readings] = read_clocks) -> None:
        self._read = read
        self.timebase = Timebase()
        first = min((read() for _ in range(_FIRST_READINGS)), key=lambda readings: readings.spread_ns)
        self._slept_origin_ns = first.now_ns - first.awake_ns

    @property
    def awake_offset_ns(self) -> int:
        """Time of arrival less the clock that excludes suspends, with the suspends that are known."""
        return self._slept_origin_ns + self.timebase.slept_ns

    def poll(self) -> str:
        """Compare the clocks; return what has happened to them since the last call, empty if nothing."""
        readings = self._read()
        if readings.spread_ns > _MAX_SPREAD_NS:
            return ""
        offset_ns = readings.real_ns - readings.now_ns
        slept_ns = readings.now_ns - readings.awake_ns - self._slept_origin_ns
        stepped_ns, suspended_ns = offset_ns - self.timebase.offset_ns, slept_ns - self.timebase.slept_ns
        has_stepped, has_slept = abs(stepped_ns) >= STEP_NS, suspended_ns >= STEP_NS
        if not has_stepped and not has_slept:
            return ""
        self.timebase = Timebase(
            offset_ns if has_stepped else self.timebase.offset_ns,
            slept_ns if has_slept else self.timebase.slept_ns,
        )
        slept = f"the host slept for {suspended_ns * NS:.3f} s" if has_slept else ""
        stepped = f"the host's clock was set by {stepped_ns * NS:+.3f} s" if has_stepped else ""
        return "; ".join(filter(None, (slept, stepped)))
