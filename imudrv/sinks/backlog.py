"""Datagrams that wait for a byte consumer: bounded, the oldest go first, none is ever torn."""

from collections.abc import Callable
from typing import Final

from imudrv.wire.datagram import SIZE

LIMIT: Final = 4096
"""Samples that wait at the most: 4 s at 1 kHz, 0.2 s at 20 kHz."""


class Backlog:
    """The way of datagrams to one consumer, with its books: put = `sent` + `dropped` + `queued`.

    Parameters
    ----------
    piece : int
        Samples written at a time at the most.
    """

    def __init__(self, piece: int) -> None:
        self.sent = 0
        self.dropped = 0
        self._piece = piece * SIZE
        self._begun = b""  # what is left of a datagram whose first bytes are out
        self._whole = bytearray()

    @property
    def queued(self) -> int:
        """Samples that wait, one that is partly out included."""
        return len(self._whole) // SIZE + bool(self._begun)

    def put(self, datagrams: bytes, write: Callable[[bytes], int]) -> None:
        """Take datagrams, write what the consumer takes, and drop the oldest of what is too much.

        Parameters
        ----------
        datagrams : bytes
            Whole ones.
        write : callable
            As for `flush`.

        Raises
        ------
        OSError
            Of `write`; the datagrams wait.
        """
        self._whole += datagrams
        try:
            self.flush(write)
        finally:
            excess = len(self._whole) - LIMIT * SIZE
            if excess > 0:
                del self._whole[:excess]
                self.dropped += excess // SIZE

    def flush(self, write: Callable[[bytes], int]) -> None:
        """Write what waits, as far as the consumer takes it.

        Parameters
        ----------
        write : callable
            Takes bytes and tells how many of them went out; raises `BlockingIOError` when none can now.

        Raises
        ------
        OSError
            Of `write`; what waits goes on waiting.
        """
        while piece := self._begun or bytes(self._whole[: self._piece]):
            try:
                written = write(piece)
            except BlockingIOError:
                return
            if self._begun:
                self._begun = piece[written:]
                self.sent += not self._begun
            else:
                whole = -(-written // SIZE)
                self._begun = piece[written : whole * SIZE]
                self.sent += whole - bool(self._begun)
                del self._whole[: whole * SIZE]
            if written < len(piece):
                return

    def abandon(self) -> None:
        """Drop all that waits: the consumer has gone."""
        self.dropped += self.queued
        self._begun = b""
        self._whole.clear()
