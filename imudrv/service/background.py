"""Work that is too slow for the loop, done beside it from time to time."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, Generic, TypeVar

from imudrv.units import NS_PER_S

PERIOD_NS: Final = 10 * NS_PER_S
"""Least time from one start to the next."""

Result = TypeVar("Result")


class Background(Generic[Result]):
    """Runs one piece of work at a time in a thread of its own."""

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(1)
        self.clear()

    def clear(self) -> None:
        """Forget the result; the work may start again at once."""
        self._running: Future[Result] | None = None
        self._result: Result | None = None
        self._next_ns = 0

    def poll(self, now_ns: int, work: Callable[[], Result]) -> Result | None:
        """Return the latest result, and start the work again if it is due; does not block.

        Parameters
        ----------
        now_ns : int
            Present time.
        work : callable
            The work; called in the thread, if it is due.

        Returns
        -------
        Result or None
            None until the work was done once.
        """
        if self._running is None and now_ns >= self._next_ns:
            self._next_ns = now_ns + PERIOD_NS
            self._running = self._pool.submit(work)
        if self._running is not None and self._running.done():
            self._result = self._running.result()
            self._running = None
        return self._result
