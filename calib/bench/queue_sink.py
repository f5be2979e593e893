"""Queue from the service's loop to the worker thread."""

import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, wait
from queue import Empty, SimpleQueue
from typing import Final

from imudrv.sinks.base import HOUSEKEEPING_NS, Batch, Sink, SinkState

TIMEOUT_S: Final = 0.2
"""Longest wait for the next item."""


CLOSING_S: Final = 10.0
"""Longest wait for a recording to be closed after the service has ended, s."""


class ServiceEndedError(Exception):
    """The service has ended before the session."""


class QueueSink(Sink):
    """Sink of the service that passes samples and messages to the worker thread.

    Parameters
    ----------
    most : int or None
        Number of samples that may wait; the service's loop blocks when there are more, which only a simulated
        unit allows. None: no limit.

    Attributes
    ----------
    is_closed : bool
        Whether the service has ended; waiting items can still be taken.
    """

    patience_ns = HOUSEKEEPING_NS

    def __init__(self, most: int | None) -> None:
        super().__init__("bench")
        self._most = most
        self._items: SimpleQueue[Batch | str | None] = SimpleQueue()
        self._put = self._taken = 0
        self.is_closed = False

    def publish(self, batch: Batch) -> None:
        """See `Sink.publish`."""
        self._items.put(batch)
        self._put += len(batch.pulses)
        while (most := self._most) is not None and self._put - self._taken > most:
            time.sleep(0.001)

    def put_message(self, text: str) -> None:
        """Pass on a message of the service, in order with the samples."""
        self._items.put(text)

    def take(self, timeout_s: float) -> Batch | str | None:
        """Return the next item, None at the end; raise `queue.Empty` if there is none in time."""
        item = self._items.get(timeout=timeout_s)
        if isinstance(item, Batch):
            self._taken += len(item.pulses)
        return item

    @property
    def state(self) -> SinkState:
        """See `Sink.state`."""
        return SinkState(self.url, "ok", True, self._taken, 0, self._put - self._taken)

    def release(self) -> None:
        """Never block the service's loop again: the worker has ended."""
        self._most = None

    def close(self) -> None:
        """See `Sink.close`."""
        self.is_closed = True
        self._items.put(None)


class QueueReader:
    """The worker's end of the queue.

    Parameters
    ----------
    queue : QueueSink
        The queue.
    on_message : callable
        Receives the messages of the service.
    """

    def __init__(self, queue: QueueSink, on_message: Callable[[str], None]) -> None:
        self._queue, self._on_message = queue, on_message
        self._backlog: deque[Batch] = deque()
        self._has_ended = False

    @property
    def has_samples(self) -> bool:
        """Whether samples wait."""
        return bool(self._backlog) or self._queue.state.queued > 0

    def next(self) -> Batch | None:
        """Return the next samples, those kept by `wait` first; see `take`."""
        return self._backlog.popleft() if self._backlog else self.take()

    def take(self) -> Batch | None:
        """Return the next samples of the queue.

        Returns
        -------
        Batch or None
            None after a message, or if there is nothing within `TIMEOUT_S`.

        Raises
        ------
        ServiceEndedError
            The service has ended, and nothing is left.
        """
        if self._has_ended:
            raise ServiceEndedError
        try:
            item = self._queue.take(TIMEOUT_S)
        except Empty:
            return None
        if isinstance(item, Batch):
            return item
        if item is None:
            self._has_ended = True
            raise ServiceEndedError
        self._on_message(item)
        return None

    def wait(self, done: Future[None]) -> None:
        """Wait until the service has finished a job or has ended; keep the samples that arrive meanwhile."""
        try:
            while not done.done():
                if batch := self.take():
                    self._backlog.append(batch)
        except ServiceEndedError:
            wait([done], CLOSING_S)
        if done.done() and not done.cancelled():
            done.result()
