"""Recordings of a running service: one at most at a time, begun and ended between two reads."""

from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from pathlib import Path
from threading import Thread

from imudrv.errors import InputError
from imudrv.records import Arrival
from imudrv.sinks.base import Batch, SinkState
from imudrv.sinks.history import History
from imudrv.sinks.recorder import Recorder


class Recordings:
    """The current recording, the requests for another one, and the history that one may begin with.

    Parameters
    ----------
    create : callable
        Returns a recorder that writes to a path; raises `InputError` if it cannot.
    history : History or None
        Filled with each arrival and batch.
    """

    def __init__(self, create: Callable[[Path], Recorder], history: History | None) -> None:
        self._create, self._history = create, history
        self._recorder: Recorder | None = None
        self._requests: deque[tuple[Path | None, int | None, Future[None]]] = deque()
        self._is_closed = False

    def begin(self, path: Path) -> None:
        """Begin the first recording."""
        self._recorder = self._create(path)

    def request(self, path: Path | None, since: int | None) -> Future[None]:
        """Request another recording, see `imudrv.service.loop.Service.record`; for any thread."""
        done: Future[None] = Future()
        self._requests.append((path, since, done))
        if self._is_closed:
            done.cancel()
        return done

    def switch(self) -> None:
        """Carry out the oldest request."""
        if not self._requests:
            return
        path, since, done = self._requests.popleft()
        before, self._recorder = self._recorder, None
        if path is not None:
            try:
                self._recorder = self._create(path)
            except InputError as error:
                done.set_exception(error)
            else:
                if since is not None and self._history is not None:
                    self._recorder.catch_up(self._history.since(since))

        def close() -> None:
            if before is not None:
                before.close()
            if not done.done():
                done.set_result(None)

        # Closing waits for the disk, which the loop must not.
        Thread(target=close, name="close recording", daemon=True).start()

    @property
    def are_on(self) -> bool:
        """Whether arrivals and batches are of use."""
        return self._recorder is not None or self._history is not None

    @property
    def state(self) -> SinkState | None:
        """State of the current recording; None if there is none."""
        return self._recorder.state if self._recorder is not None else None

    def arrived(self, arrival: Arrival) -> None:
        """Record an arrival; to be called before it is decoded."""
        if self._recorder is not None:
            self._recorder.arrived(arrival)
        if self._history is not None:
            self._history.arrived(arrival)

    def publish(self, batch: Batch) -> None:
        """Record the samples of the last arrival."""
        if self._recorder is not None and len(batch.increments):
            self._recorder.publish(batch)
        if self._history is not None:
            self._history.publish(batch)

    def calibration(self, t_ns: int, content: bytes) -> None:
        """Record a new calibration, and clear the history: a recording begins with one calibration."""
        if self._recorder is not None:
            self._recorder.calibration(t_ns, content)
        if self._history is not None:
            self._history.clear()

    def event(self, t_ns: int, text: str) -> None:
        """Record an event."""
        if self._recorder is not None:
            self._recorder.event(t_ns, text)

    def status(self, document: Callable[[], Mapping[str, object]]) -> None:
        """Record the status, which is made in the writing thread."""
        if self._recorder is not None:
            self._recorder.status(document)

    def poll(self) -> None:
        """Let the recorder check its file."""
        if self._recorder is not None:
            self._recorder.poll()

    def close(self) -> None:
        """Close the current recording and cancel the requests."""
        if self._recorder is not None:
            self._recorder.close()
        self._is_closed = True
        while self._requests:
            self._requests.popleft()[-1].cancel()
