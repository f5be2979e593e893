"""CPU time and memory of a process."""

import os
import resource
import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from .checks import Check, measured

RSS_MB: Final = 250.0
GROWTH_MB: Final = 5.0
"""In ten hours a leak of one byte a sample would be 36 MB; the allocator alone varies within 2."""


class Usage(NamedTuple):
    """CPU time with all threads and children, and resident memory, of a process at a moment."""

    at_s: float
    cpu_s: float
    rss_mb: float


class UsageMonitor(threading.Thread):
    """Reads the usage of a process periodically until it is stopped or the process ends."""

    def __init__(self, pid: int, period_s: float = 0.25) -> None:
        super().__init__(daemon=True)
        self._stat, self._period_s = Path(f"/proc/{pid}/stat"), period_s
        self._stopped = threading.Event()
        self._history: list[Usage] = []
        self._sample()
        self.start()

    def run(self) -> None:
        """Sample."""
        with suppress(OSError):  # the process has ended
            while not self._stopped.wait(self._period_s):
                self._sample()

    def stop(self) -> list[Usage]:
        """Sample once more; return all samples."""
        self._stopped.set()
        self.join()
        with suppress(OSError):
            self._sample()
        return self._history

    def _sample(self) -> None:
        fields = self._stat.read_text().rpartition(")")[2].split()
        cpu_s = sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
        if rss_mb := int(fields[21]) * resource.getpagesize() / 1e6:  # 0: a zombie
            self._history.append(Usage(time.monotonic(), cpu_s, rss_mb))


def memory_checks(history: Sequence[Usage], settled_s: float, growth_mb: float = GROWTH_MB) -> list[Check]:
    """Check that memory is small, and constant within `growth_mb` from `settled_s` after the start."""
    settled = [usage for usage in history if usage.at_s >= history[0].at_s + settled_s] or [history[-1]]
    worst = max(usage.rss_mb for usage in history)
    growth = max(usage.rss_mb for usage in settled) - settled[0].rss_mb
    return [
        measured(
            f"memory grows by at most {growth_mb:g} MB",
            f"{settled[0].rss_mb:.1f} MB after {settled[0].at_s - history[0].at_s:.1f} s, "
            f"{settled[-1].rss_mb:.1f} MB at the end, at most {growth:.2f} MB more",
            growth <= growth_mb,
        ),
        measured(f"memory < {RSS_MB:g} MB", f"at most {worst:.0f} MB", worst < RSS_MB),
    ]
