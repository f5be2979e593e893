"""The last minutes of the line in memory, so that a recording can begin at a sample that is already past.

Whoever asks for a recording may be late: the thread was held up by a slow disk, the machine is loaded. With
the history it names the sample to begin with, and the reads that brought that sample are still there.
"""

from collections import deque
from typing import Final, NamedTuple

from imudrv.records import Arrival
from imudrv.sinks.base import Batch

MAX_BYTES: Final = 64 << 20
"""Most memory that a history takes: at 1 kHz 150 s of a serial line, 80 s of a CAN bus, read one by one."""
_OBJECT_BYTES: Final = 300
"""Python's own part of a read and its batch."""
_LEAD: Final = 2
"""Completed samples before the wanted one: its frame may begin in the read before, running totals need a
reference."""


class Moment(NamedTuple):
    """One read and the samples that it completed.

    Parameters
    ----------
    arrival : Arrival
        The read.
    datagrams : bytes
        The increments that were published then; with a rate filter that lags, of earlier samples.
    first, last : int
        Counters of the samples; `last` is less than `first` when there are none.
    """

    arrival: Arrival
    datagrams: bytes = b""
    first: int = 0
    last: int = -1


class History:
    """Ring of the newest reads; used by the service's loop alone.

    Parameters
    ----------
    max_bytes : int
        Most memory that it takes; beyond it the oldest reads are dropped.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._bytes = 0
        self._moments: deque[Moment] = deque()

    def arrived(self, arrival: Arrival) -> None:
        """Append a read."""
        self._moments.append(Moment(arrival))
        self._bytes += _size(self._moments[-1])
        while self._bytes > self._max_bytes:
            self._bytes -= _size(self._moments.popleft())

    def publish(self, batch: Batch) -> None:
        """Add the samples that the newest read completed."""
        if len(batch.pulses) and self._moments:
            counter = batch.pulses["counter"]
            newest = self._moments[-1]._replace(
                datagrams=batch.datagrams, first=int(counter[0]), last=int(counter[-1])
            )
            self._moments[-1] = newest
            self._bytes += len(newest.datagrams)

    def since(self, counter: int) -> list[Moment]:
        """Return what is needed to decode a sample, and all that came after.

        Parameters
        ----------
        counter : int
            Of the sample; where the unit has restarted meanwhile, the newest of that number.

        Returns
        -------
        list of Moment
            Everything that is left when the sample itself is dropped already.
        """
        moments, completed = [], 0
        for moment in reversed(self._moments):
            moments.append(moment)
            if moment.first <= counter <= moment.last or (completed and moment.first <= moment.last):
                completed += 1
            if completed > _LEAD:
                break
        return moments[::-1]

    def clear(self) -> None:
        """Forget everything."""
        self._moments.clear()
        self._bytes = 0


def _size(moment: Moment) -> int:
    data = moment.arrival.data
    return (len(data) if isinstance(data, bytes) else data.nbytes) + len(moment.datagrams) + _OBJECT_BYTES
