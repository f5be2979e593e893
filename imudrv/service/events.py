"""Events of a running service: printed, kept for the status, recorded."""

from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Final

from imudrv.units import NS

_KEPT: Final = 20


class EventLog:
    """Log of the service's events.

    Parameters
    ----------
    say, warn : callable
        Called with the line of an event, and of one that is a failure; must not block.
    record : callable
        Called with the time (ns) and the text of each event.
    clock : callable
        Returns the time on the scale of the arrivals, ns.

    Attributes
    ----------
    offset_ns : int
        UNIX time less the time of the clock.
    is_new : bool
        Whether there is something to publish: at first, and after each event until it is cleared.
    """

    def __init__(
        self,
        say: Callable[[str], None],
        warn: Callable[[str], None],
        record: Callable[[int, str], None],
        clock: Callable[[], int],
    ) -> None:
        self._say, self._warn, self._record, self._clock = say, warn, record, clock
        self._lines: deque[str] = deque(maxlen=_KEPT)
        self.offset_ns = 0
        self.is_new = True

    @property
    def lines(self) -> list[str]:
        """Latest events with their time (UTC), oldest first."""
        return list(self._lines)

    def event(self, text: str) -> None:
        """Log an event."""
        self._log(text, self._say)

    def failure(self, text: str) -> None:
        """Log an event that is a failure."""
        self._log(text, self._warn)

    def _log(self, text: str, say: Callable[[str], None]) -> None:
        now = self._clock()
        time = datetime.fromtimestamp((now + self.offset_ns) * NS, UTC).isoformat(timespec="milliseconds")
        self._lines.append(f"{time.replace('+00:00', 'Z')} {text}")
        self.is_new = True
        say(self._lines[-1])
        self._record(now, text)
