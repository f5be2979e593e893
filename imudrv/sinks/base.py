"""What every sink keeps to: where increments go; a slow, dead or absent consumer costs the loop nothing."""

from abc import ABC, abstractmethod
from typing import NamedTuple

from imudrv.records import Records


class Batch(NamedTuple):
    """What the loop hands on at a time: one sample, or all that came after a stall.

    Nothing in it changes afterwards: a sink may keep it.

    Parameters
    ----------
    pulses : ndarray of PULSES
        Accounted for; with a rate filter that lags, newer than the increments.
    increments : ndarray of INCREMENTS
        Compensated.
    datagrams : bytes
        The same increments as `I50N` datagrams.
    """

    pulses: Records
    increments: Records
    datagrams: bytes


class SinkState(NamedTuple):
    """How a sink is.

    Parameters
    ----------
    url : str
        As the user gave it.
    state : str
        One or a few words: ``ok``, ``waiting for a client``, ``2 clients``, ``disk full``.
    healthy : bool
        Nothing needs a person.
    sent, dropped : int
        Samples handed over, and given up since the queue was full or the consumer gone; a sample that goes to
        several clients counts once for each.
    queued : int
        Samples that wait now.
    """

    url: str
    state: str
    healthy: bool
    sent: int
    dropped: int
    queued: int


class Sink(ABC):
    """A way out.

    `publish` and `poll` are called by the live loop and never block: what cannot go out at once waits in a
    bounded queue of the sink's own, whose oldest samples are dropped and counted when it is full. The queue
    is for a consumer that stalls; one that is absent gets what comes once it is there. Neither raises for a
    consumer's fault; the state tells it.

    Parameters
    ----------
    url : str
        As the user gave it.
    """

    def __init__(self, url: str) -> None:
        self.url = url

    @abstractmethod
    def publish(self, batch: Batch) -> None:
        """Hand a batch on."""

    def poll(self) -> None:
        """Housekeeping, at least twenty times a second: new clients, what waits, what to open again."""
        return

    @property
    @abstractmethod
    def state(self) -> SinkState:
        """How it is now."""

    @abstractmethod
    def close(self) -> None:
        """Send what waits, for a second at the most, and let go."""
