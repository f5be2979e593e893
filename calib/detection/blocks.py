"""Blocks of 20 ms, by the counter."""

import weakref
from tempfile import SpooledTemporaryFile, gettempdir
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from imudrv.errors import InputError
from imudrv.kernels import kernel
from imudrv.records import Records
from imudrv.units import NS
from imudrv.vectors import Vector

BLOCK_NS: Final = 20_000_000
"""Length of a block, ns."""


_IN_MEMORY_BYTES: Final = 32 << 20


BLOCK: Final = np.dtype(
    [
        ("index", np.int64),  # of the block, by the counter
        ("samples", np.int64),
        ("interval_ns", np.int64),
        ("dtheta_b", np.float64, 3),
        ("dv_b", np.float64, 3),
        ("angle", np.float64, 3),  # sum over the samples of the angle since the block's beginning
        ("velocity", np.float64, 3),  # likewise
        ("flags", np.int64),  # of any sample
    ]
)


class Block(NamedTuple):
    """20 ms of samples."""

    rows: Records
    last: int  # counter of the last sample
    seconds: float  # that the samples cover
    dtheta: Vector  # rad, body axes
    force: Vector  # mean, m/s^2
    flags: int  # of any sample
    missing: int  # number of samples missing since the last block
    hole: bool  # too much is missing to distinguish rest from motion
    restarted: bool  # the counter restarted


class BlockSplitter:
    """Divider of samples into blocks aligned with the counter, in any pieces."""

    def __init__(self, interval_ns: int) -> None:
        self._size = max(1, BLOCK_NS // interval_ns)
        self._waiting: list[Records] = []
        self._newest: int | None = None  # counter of the newest sample
        self._restarts = 0
        self._began(0)

    def _began(self, counter: int) -> None:
        """Start numbering blocks at this counter."""
        self._origin = counter
        self._index, self._last = -1, counter - 1  # of the newest block handed on
        self._waiting.clear()

    def feed(self, increments: Records) -> list[Block]:
        """Process samples and return the completed blocks."""
        if not len(increments):
            return []
        counter = increments["counter"]
        if self._newest is None:
            self._newest = int(counter[0]) - 1
            self._began(int(counter[0]))
        back = np.flatnonzero(np.diff(counter, prepend=self._newest) <= 0)
        self._newest = int(counter[-1])
        if not len(back):
            return self._more(increments)
        blocks = []
        for k, piece in enumerate(np.split(increments, back)):
            if k:
                self._began(int(piece["counter"][0]))
                self._restarts += 1
            if len(piece):
                blocks += self._more(piece)
        return blocks

    def _more(self, rows: Records) -> list[Block]:
        self._waiting.append(rows)
        newest = int(rows["counter"][-1])
        first = (int(self._waiting[0]["counter"][0]) - self._origin) // self._size
        if newest < self._end(first):
            return []
        rows = np.concatenate(self._waiting) if len(self._waiting) > 1 else rows
        self._waiting.clear()
        index = (rows["counter"] - self._origin) // self._size
        if newest < self._end(int(index[-1])):
            whole = int(np.searchsorted(index, index[-1]))
            self._waiting.append(rows[whole:])
            rows, index = rows[:whole], index[:whole]
        return self._blocks(rows, index)

    def _end(self, index: int) -> int:
        """Return the counter of a block's last sample."""
        return self._origin + (index + 1) * self._size - 1

    def _blocks(self, rows: Records, index: NDArray[np.int64]) -> list[Block]:
        starts = np.concatenate([[0], np.flatnonzero(np.diff(index)) + 1])
        stops = np.append(starts[1:], len(rows))
        index, last = index[starts], rows["counter"][stops - 1]
        interval_ns = np.add.reduceat(rows["interval_ns"], starts)
        missing = np.diff(last, prepend=self._last) - (stops - starts)
        hole = (2 * missing >= self._size) | (np.diff(index, prepend=self._index) > 1)
        seconds = interval_ns * NS
        dtheta = np.add.reduceat(rows["dtheta_b"], starts)
        force = np.add.reduceat(rows["dv_b"], starts) / seconds[:, None]
        flags = np.bitwise_or.reduceat(rows["flags"], starts)
        restarted = self._index < 0 < self._restarts
        self._index, self._last = int(index[-1]), int(last[-1])
        columns = (a.tolist() for a in (starts, stops, last, seconds, dtheta, force, flags, missing, hole))
        return [
            Block(rows[a:b], at, s, tuple(w), tuple(f), bits, lost, empty, restarted and not a)
            for a, b, at, s, w, f, bits, lost, empty in zip(*columns, strict=True)
        ]


class BlockSums:
    """Sums over the blocks of a capture; their bits do not depend on how the samples are divided.

    Parameters
    ----------
    first : int
        Counter of the first sample.
    size : int
        Samples per block.
    """

    def __init__(self, first: int, size: int) -> None:
        self._first, self._size = first, size
        self._open = np.zeros(1, BLOCK)

    @property
    def incomplete(self) -> int | None:
        """Index of the block that has begun and is not complete, if there is one."""
        return int(self._open["index"][0]) if self._open["samples"][0] else None

    def feed(self, increments: Records) -> Records:
        """Process samples and return the completed blocks.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order.

        Returns
        -------
        ndarray of BLOCK
        """
        blocks = np.empty(len(increments) + 1, BLOCK)
        return blocks[: _add(increments, self._first, self._size, self._open, blocks)]


@kernel
def _add(increments: Records, first: int, size: int, open_block: Records, blocks: Records) -> int:
    """Add samples to the open block; return the number of blocks that became complete."""
    block, done = open_block[0], 0
    for i in range(len(increments)):
        sample = increments[i]
        index = (sample["counter"] - first) // size
        if block["samples"] and block["index"] != index:
            blocks[done] = block
            block["samples"] = 0
            done += 1
        if block["samples"] == 0:
            block["index"], block["interval_ns"], block["flags"] = index, 0, 0
            for axis in range(3):
                block["dtheta_b"][axis] = block["dv_b"][axis] = 0.0
                block["angle"][axis] = block["velocity"][axis] = 0.0
        block["samples"] += 1
        block["interval_ns"] += sample["interval_ns"]
        block["flags"] |= sample["flags"]
        for axis in range(3):
            block["dtheta_b"][axis] += sample["dtheta_b"][axis]
            block["dv_b"][axis] += sample["dv_b"][axis]
            block["angle"][axis] += block["dtheta_b"][axis]
            block["velocity"][axis] += block["dv_b"][axis]
        if sample["counter"] - first == (index + 1) * size - 1:
            blocks[done] = block
            block["samples"] = 0
            done += 1
    return done


class BlockStore:
    """Blocks of a capture in order; those of more than an hour are in a temporary file."""

    def __init__(self) -> None:
        self._count = 0
        self._file = SpooledTemporaryFile(_IN_MEMORY_BYTES)  # noqa: SIM115
        weakref.finalize(self, self._file.close)

    def __len__(self) -> int:
        return self._count

    def __deepcopy__(self, _: dict[int, object]) -> Self:
        copy = type(self)()  # with a file of its own
        copy.append(self.rows(0, len(self)))
        return copy

    def append(self, blocks: Records) -> None:
        """Append blocks.

        Raises
        ------
        InputError
            The disk is full.
        """
        try:
            self._file.seek(0, 2)
            self._file.write(blocks.tobytes())
        except OSError as error:
            size_mb = (self._count + len(blocks)) * BLOCK.itemsize / 1e6
            raise InputError(
                f"{gettempdir()}: expected room for {size_mb:.0f} MB of a long capture, cannot write them: "
                f"{error.strerror}; set TMPDIR to another folder"
            ) from error
        self._count += len(blocks)

    def rows(self, begin: int, stop: int) -> Records:
        """Return the blocks from `begin` to `stop`."""
        self._file.seek(begin * BLOCK.itemsize)
        return np.frombuffer(self._file.read((stop - begin) * BLOCK.itemsize), BLOCK)
