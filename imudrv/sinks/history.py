"""The last minutes of reads in memory, so that a recording can start at a sample in the past.

The request for a recording may be late, because of a slow disk or a loaded machine. It names the first
sample, and the history still has the reads that contain it.
"""

from collections import deque
from typing import Final, NamedTuple

from imudrv.records import Arrival
from imudrv.sinks.base import Batch

MAX_BYTES: Final = 64 << 20
"""Maximum memory of a history: at 1 kHz 150 s of a serial line, 80 s of a CAN bus, one sample per read."""
_OBJECT_BYTES: Final = 300
"""Overhead of Python for a read and its batch."""
_LEAD: Final = 2
"""Reads with samples to include before the first sample: its frame may begin in the read before, and running
totals need a reference."""


class Moment(NamedTuple):
    """One read, with the samples that it completed.

    Parameters
    ----------
    arrival : Arrival
        The read.
    datagrams : bytes
        The increments published after it; with a rate filter that has a delay, those of earlier samples.
    first, last : int
        Counters of the samples; `last` is less than `first` when there are none.
    """

    arrival: Arrival
    datagrams: bytes = b""
    first: int = 0
    last: int = -1


class History:
    """Ring buffer of the newest reads; used by the service loop only.

    Parameters
    ----------
    max_bytes : int
        Maximum memory; the oldest reads are dropped above it.
    counter_step : int
        Change of the unit's counter from a sample to the next; the counters here count samples.
    """

    def __init__(self, max_bytes: int = MAX_BYTES, counter_step: int = 1) -> None:
        self._max_bytes, self._counter_step = max_bytes, counter_step
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
            counter = batch.pulses["counter"] // self._counter_step
            newest = self._moments[-1]._replace(
                datagrams=batch.datagrams, first=int(counter[0]), last=int(counter[-1])
            )
            self._moments[-1] = newest
            self._bytes += len(newest.datagrams)

    def since(self, counter: int) -> list[Moment]:
        """Return the reads needed to decode a sample, and all later ones.

        Parameters
        ----------
        counter : int
            Counter of the sample; after a restart of the unit the newest sample with it is meant.

        Returns
        -------
        list of Moment
            All reads, if the sample was already dropped.
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
        """Remove everything."""
        self._moments.clear()
        self._bytes = 0


def _size(moment: Moment) -> int:
    return moment.arrival.size + len(moment.datagrams) + _OBJECT_BYTES
