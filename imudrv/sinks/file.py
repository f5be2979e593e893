"""Increments to a growing file, as datagrams or rows of text."""

from collections import deque
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import Final

import numpy as np

from imudrv.errors import InputError
from imudrv.files.spool import AppendThread, Piece
from imudrv.files.tables import CsvTable, increment_columns
from imudrv.records import Records
from imudrv.sinks.base import ON_DISK_NS, Batch, Sink, SinkState

LIMIT: Final = 16_384
"""Maximum number of queued samples."""
_PIECE: Final = 512


class FileSink(Sink):
    """New file, complete up to 0.25 s ago at any time.

    Parameters
    ----------
    url : str
        ``file:NAME.i50n`` (datagrams) or ``file:NAME.csv`` (the columns of `imudrv compensate`).

    Raises
    ------
    InputError
        Another suffix, an existing file, or a folder that cannot be written to.
    """

    patience_ns = ON_DISK_NS

    def __init__(self, url: str) -> None:
        super().__init__(url)
        path = Path(url.removeprefix("file:"))
        if path.suffix not in (".i50n", ".csv"):
            raise InputError(
                f"{url}: expected file:NAME.i50n or file:NAME.csv, got {path.suffix or 'no suffix'}; "
                "for other formats record the run and export the recording"
            )
        self._queue: deque[Batch] = deque()
        self._put = self._dropped = 0
        self._text = BytesIO()
        self._table = CsvTable(self._text, {}) if path.suffix == ".csv" else None
        self._spool = AppendThread(path, b"", self._next_piece)

    def publish(self, batch: Batch) -> None:
        """Send a batch."""
        self._put += batch.increments.size
        self._queue.append(batch)
        while self._queued > LIMIT:
            try:
                self._dropped += self._queue.popleft().increments.size
            except IndexError:  # the thread has taken all of it
                return

    @property
    def state(self) -> SinkState:
        """Current state."""
        trouble = self._spool.trouble
        return SinkState(
            self.url, trouble or "ok", not trouble, self._spool.sent, self._dropped, self._queued
        )

    def close(self) -> None:
        """Write what is queued for at most some seconds, and close the file."""
        self._spool.close()
        self._dropped += self._queued

    @property
    def _queued(self) -> int:
        return self._put - self._dropped - self._spool.sent

    def _next_piece(self) -> Piece:
        batches: list[Batch] = []
        samples = 0
        with suppress(IndexError):
            while samples < _PIECE:
                batches.append(self._queue.popleft())
                samples += batches[-1].increments.size
        if not samples:
            return Piece(b"", 0, False)
        more = samples >= _PIECE
        if self._table is None:
            return Piece(b"".join(batch.datagrams for batch in batches), samples, more)
        self._text.seek(0)
        self._text.truncate()
        increments: Records = np.concatenate([batch.increments for batch in batches])
        self._table.write(increment_columns(increments))
        return Piece(self._text.getvalue(), samples, more)
