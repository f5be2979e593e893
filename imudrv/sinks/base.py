"""What every sink keeps to: where increments go; a slow, dead or absent consumer costs the loop nothing."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar, Final, NamedTuple

from imudrv.records import Records
from imudrv.units import NS_PER_S

HOUSEKEEPING_NS: Final = NS_PER_S // 4
"""Time between two rounds of the live loop's housekeeping."""
ON_DISK_NS: Final = NS_PER_S // 8
"""The same while a file is written; with the 50 ms of the writing thread it leaves one that is complete up to
0.25 s ago."""


class Batch(NamedTuple):
    """Samples published together: one, or several after a stall.

    A batch never changes afterwards: a sink may keep it.

    Parameters
    ----------
    pulses : ndarray of PULSES
        Pulses; with a rate filter that has a delay, newer than the increments.
    increments : ndarray of INCREMENTS
        Compensated increments.
    datagrams : bytes
        The increments as `I50N` datagrams.
    """

    pulses: Records
    increments: Records
    datagrams: bytes


class Outlet(NamedTuple):
    """Descriptor that takes datagrams without Python.

    Parameters
    ----------
    fd : int
        The descriptor; writing to it does not block.
    piece : int
        Most bytes of one write, whole datagrams.
    is_socket : bool
        Whether it is a socket.
    """

    fd: int
    piece: int
    is_socket: bool = True


class Written(NamedTuple):
    """What an outlet has taken of the datagrams of a batch.

    Parameters
    ----------
    size : int
        Number of bytes, from the first datagram on.
    last : int
        Number of bytes in the last write.
    error : int
        Error number of the write after it; 0 if there was none.
    """

    size: int
    last: int
    error: int


class SinkState(NamedTuple):
    """State of a sink.

    Parameters
    ----------
    url : str
        URL as the user gave it.
    state : str
        One or a few words: ``ok``, ``waiting for a client``, ``2 clients``, ``disk full``.
    healthy : bool
        Whether no action of the user is needed.
    sent, dropped : int
        Samples delivered, and samples dropped because the queue was full or the consumer absent; for several
        clients a sample counts once for each.
    queued : int
        Samples in the queue.
    """

    url: str
    state: str
    healthy: bool
    sent: int
    dropped: int
    queued: int


class Sink(ABC):
    """Output for samples.

    `publish` and `poll` are called by the live loop and never block: what cannot be sent at once waits in a
    bounded queue, whose oldest samples are dropped and counted when it is full. The queue is for a consumer
    that stalls; an absent one receives the samples published after it appears. Neither method raises for a
    fault of the consumer; `state` reports it.

    Parameters
    ----------
    url : str
        URL as the user gave it.

    Attributes
    ----------
    patience_ns : int
        How long after a batch arrived `publish` may be called; 0: at once, which costs the loop time.
    """

    patience_ns: ClassVar[int] = 0

    def __init__(self, url: str) -> None:
        self.url = url

    @abstractmethod
    def publish(self, batch: Batch) -> None:
        """Send a batch."""

    def outlets(self) -> list[Outlet]:
        """Return descriptors for the datagrams of the next batch; there may be none."""
        return []

    def written(self, batch: Batch, outlets: list[Written]) -> None:
        """Take note of what the outlets have taken of a batch, and send the rest.

        Parameters
        ----------
        batch : Batch
            The samples, as old as `patience_ns`.
        outlets : list of Written
            One for each of `outlets`.
        """
        self.publish(batch)

    def poll(self) -> None:
        """Accept clients, send what is queued, reopen devices.

        Called at least four times a second, and fifty times while `state` has samples in the queue.
        """
        return

    def status(self, document: Callable[[], Mapping[str, object]]) -> None:
        """Take the status of the service, once a second and after each event; most sinks have no use for it.

        Parameters
        ----------
        document : callable
            Returns values that JSON can represent; for any thread but that of the loop.
        """
        return

    def event(self, t_ns: int, text: str) -> None:
        """Take an event of the service; most sinks have no use for it.

        Parameters
        ----------
        t_ns : int
            UNIX time, ns.
        text : str
            What happened.
        """
        return

    @property
    @abstractmethod
    def state(self) -> SinkState:
        """Current state."""

    @abstractmethod
    def close(self) -> None:
        """Send what is queued for at most a second, and close."""
