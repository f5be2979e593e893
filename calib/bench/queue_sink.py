"""Queue from the service's loop to the worker."""

import time
from queue import SimpleQueue

from imudrv.sinks.base import Batch, Sink, SinkState


class QueueSink(Sink):
    """Way from the service's loop to the worker.

    Parameters
    ----------
    most : int or None
        Samples that may wait; then the loop waits, as only a simulated unit may be asked to. None: any
        number.

    Attributes
    ----------
    is_closed : bool
        The service has ended; what waits can still be taken.
    """

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

    def tell(self, text: str) -> None:
        """Hand on what the service says, in its place among the samples."""
        self._items.put(text)

    def take(self, timeout_s: float) -> Batch | str | None:
        """The next item; None at the end. Raises `queue.Empty` when nothing comes in time."""
        item = self._items.get(timeout=timeout_s)
        if isinstance(item, Batch):
            self._taken += len(item.pulses)
        return item

    @property
    def state(self) -> SinkState:
        """See `Sink.state`."""
        return SinkState(self.url, "ok", True, self._taken, 0, self._put - self._taken)

    def release(self) -> None:
        """Nobody takes any more: the loop must not wait."""
        self._most = None

    def close(self) -> None:
        """See `Sink.close`."""
        self.is_closed = True
        self._items.put(None)
