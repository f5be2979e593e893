"""Recordings of a running service: one at most at a time, begun and ended between two reads."""

import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from itertools import count
from pathlib import Path
from threading import Thread
from typing import Final

from imudrv.errors import InputError
from imudrv.records import Arrival, Timebase
from imudrv.service.serve import Served
from imudrv.sinks.base import Batch, SinkState
from imudrv.sinks.history import History
from imudrv.sinks.recorder import Recorder

_RETRY_S: Final = 1.0


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
        self._path = Path()  # as asked for
        self._displaced = ""  # what has happened to an earlier file of this recording
        self._retry_at = 0.0
        self._requests: deque[tuple[Path | None, int | None, Future[None]]] = deque()
        self._is_closed = False

    def begin(self, path: Path) -> None:
        """Begin the first recording."""
        self._recorder, self._path = self._create(path), path

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
        before, self._recorder, self._displaced = self._recorder, None, ""
        if path is not None:
            self._path = path
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

        _in_background(close)

    @property
    def are_on(self) -> bool:
        """Whether arrivals and batches are of use."""
        return self._recorder is not None or self._history is not None

    @property
    def state(self) -> SinkState | None:
        """State of the current recording; None if there is none."""
        if self._recorder is None:
            return None
        state = self._recorder.state
        if self._displaced and state.healthy:
            return state._replace(state=self._displaced, healthy=False)
        return state

    def served(self, served: Served, timebase: Timebase) -> None:
        """Record what the kernel has read: as a block, and read by read where a history is kept."""
        if self._recorder is not None:
            self._recorder.arrived(served.block(timebase))
            if served.output.datagrams:
                self._recorder.publish(Batch(*served.output))
        if self._history is not None:
            for arrival, batch in served.arrivals(timebase):
                self._history.arrived(arrival)
                self._history.publish(batch)

    def arrived(self, arrival: Arrival) -> None:
        """Record an arrival; to be called before it is decoded."""
        if self._recorder is not None:
            self._recorder.arrived(arrival.block)
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

    def poll(self) -> str:
        """Let the recorder check its file, and begin a new one if it was deleted or renamed.

        Returns
        -------
        str
            What has happened, for the user; usually empty.
        """
        before = self._recorder
        if before is None:
            return ""
        before.poll()
        if not before.displaced or time.monotonic() < self._retry_at:
            return ""
        self._retry_at = time.monotonic() + _RETRY_S
        try:
            self._recorder = self._create(_unused(self._path))
        except InputError:
            return ""  # the state of the old one says what is wrong
        _in_background(before.close)
        lost, now = before.state.url, self._recorder.state.url
        self._displaced = f"{lost} was {before.displaced} while it was written; {now} continues it"
        return f"recording {self._displaced}"

    def close(self) -> Path | None:
        """Close the current recording and cancel the requests; return its file if it is complete."""
        if self._recorder is not None:
            self._recorder.close()
        self._is_closed = True
        while self._requests:
            self._requests.popleft()[-1].cancel()
        return None if self._recorder is None else self._recorder.finished


def _in_background(close: Callable[[], object]) -> None:
    # Closing waits for the disk, which the loop must not.
    Thread(target=close, name="close recording", daemon=True).start()


def _unused(path: Path) -> Path:
    """Return the path, or one like it that is not used; a folder is one."""
    names = (path.with_stem(f"{path.stem}-{k}") for k in count(2))
    return path if path.is_dir() or not path.exists() else next(name for name in names if not name.exists())
