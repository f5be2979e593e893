"""Samples, status and events under a key of Zenoh."""

import errno
import os
import select
import time
from collections.abc import Callable, Mapping
from typing import Final

from imudrv.sinks.backlog import Backlog
from imudrv.sinks.base import HOUSEKEEPING_NS, Batch, Outlet, Sink, SinkState, Written
from imudrv.streams import EVENTS, STATUS, Publication
from imudrv.url import split
from imudrv.wire.datagram import SIZE

_PIECE: Final = 256
_CLOSE_S: Final = 1.0


class ZenohSink(Sink):
    """Samples to all subscribers of a key, without loss while one of them stalls for some seconds.

    The status goes to ``KEY/status``, events to ``KEY/events``.

    Parameters
    ----------
    url : str
        ``zenoh://imu50/BENCH/UNIT``; ``?config=FILE.json5``: endpoints, routers, TLS.

    Raises
    ------
    InputError
        See `imudrv.streams.Publication`.
    """

    patience_ns = HOUSEKEEPING_NS

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self._publication = Publication(split(url, ("zenoh",)))
        self._socket = self._publication.socket
        self._backlog = Backlog(_PIECE)
        self._trouble = ""

    def publish(self, batch: Batch) -> None:
        """Send a batch."""
        try:
            self._backlog.put(batch.datagrams, self._socket.send)
        except OSError as error:
            self._trouble = f"lost: {error.strerror or error}"

    def outlets(self) -> list[Outlet]:
        """See `Sink.outlets`."""
        is_free = not self._backlog.queued and not self._trouble
        return [Outlet(self._socket.fileno(), _PIECE * SIZE)] if is_free else []

    def written(self, batch: Batch, outlets: list[Written]) -> None:
        """See `Sink.written`."""
        if not outlets:
            self.publish(batch)
            return
        size, _, error = outlets[0]
        self._backlog.written(batch.datagrams, size)
        if error not in (0, errno.EAGAIN):
            self._trouble = f"lost: {os.strerror(error)}"

    def poll(self) -> None:
        """Send what is queued."""
        try:
            self._backlog.flush(self._socket.send)
        except OSError as error:
            self._trouble = f"lost: {error.strerror or error}"

    def status(self, document: Callable[[], Mapping[str, object]]) -> None:
        """Publish the status."""
        self._publication.note(STATUS, document)

    def event(self, t_ns: int, text: str) -> None:
        """Publish an event."""
        self._publication.note(EVENTS, lambda: {"t_ns": t_ns, "text": text})

    @property
    def state(self) -> SinkState:
        """Current state."""
        counts = self._backlog
        words = self._trouble or "ok"
        return SinkState(self.url, words, not self._trouble, counts.sent, counts.dropped, counts.queued)

    def close(self) -> None:
        """Send what is queued for at most a second, and close."""
        deadline = time.monotonic() + _CLOSE_S
        while self._backlog.queued and not self._trouble and (left := deadline - time.monotonic()) > 0:
            select.select([], [self._socket], [], left)
            self.poll()
        self._backlog.abandon()
        self._publication.close()
