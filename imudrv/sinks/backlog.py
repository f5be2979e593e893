"""Bounded queue of datagrams for a byte consumer; the oldest are dropped, always whole."""

from collections.abc import Callable
from typing import Final

from imudrv.wire.datagram import SIZE

LIMIT: Final = 4096
"""Maximum number of queued samples: 4 s at 1 kHz, 0.2 s at 20 kHz."""


class Backlog:
    """Queue of datagrams to one consumer; put = `sent` + `dropped` + `queued`.

    Parameters
    ----------
    piece : int
        Maximum number of samples written at a time.
    """

    def __init__(self, piece: int) -> None:
        self.sent = 0
        self.dropped = 0
        self._piece = piece * SIZE
        self._begun = b""  # rest of a datagram whose first bytes were written
        self._whole = bytearray()

    @property
    def queued(self) -> int:
        """Number of queued samples, one that is partly written included."""
        return len(self._whole) // SIZE + bool(self._begun)

    def put(self, datagrams: bytes, write: Callable[[bytes], int]) -> None:
        """Append datagrams, write as many as possible, and drop the oldest above the limit.

        Parameters
        ----------
        datagrams : bytes
            Whole datagrams.
        write : callable
            As for `flush`.

        Raises
        ------
        OSError
            Raised by `write`; the datagrams stay queued.
        """
        self._whole += datagrams
        try:
            self.flush(write)
        finally:
            excess = len(self._whole) - LIMIT * SIZE
            if excess > 0:
                del self._whole[:excess]
                self.dropped += excess // SIZE

    def written(self, datagrams: bytes, size: int) -> None:
        """Append datagrams of which the first `size` bytes were written already; nothing may be queued."""
        self._whole += datagrams[self._begin(datagrams, size) :]

    def flush(self, write: Callable[[bytes], int]) -> None:
        """Write queued datagrams until the consumer blocks.

        Parameters
        ----------
        write : callable
            Writes bytes and returns how many were written; raises `BlockingIOError` if none can be.

        Raises
        ------
        OSError
            Raised by `write`; the datagrams stay queued.
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
                del self._whole[: self._begin(piece, written)]
            if written < len(piece):
                return

    def _begin(self, datagrams: bytes, written: int) -> int:
        """Take note of a write; return where the datagrams begin of which nothing was written."""
        whole = -(-written // SIZE)
        self._begun = datagrams[written : whole * SIZE]
        self.sent += whole - bool(self._begun)
        return whole * SIZE

    def abandon(self) -> None:
        """Drop everything queued, as the consumer has disconnected."""
        self.dropped += self.queued
        self._begun = b""
        self._whole.clear()
