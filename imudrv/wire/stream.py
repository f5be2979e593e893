"""A byte stream to frames: finds them, checks them, and gives every other byte back with a reason."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import FRAME, REJECT, Reason, Records
from imudrv.wire.fields import SLACK, check_holds, fill
from imudrv.wire.layout import Layout
from imudrv.wire.tables import message_tables

_NO_SYNC: Final = int(Reason.NO_SYNC)
_CHECK_FAILED: Final = int(Reason.CHECK_FAILED)
_OPEN_OFFSET, _OPEN_REASON, _SKIPPED = range(3)
_REJECTS_AT_ONCE: Final = 1024
_NO_REJECTS: Final = np.zeros(0, REJECT)


class Decoded(NamedTuple):
    """What a decoder found.

    Parameters
    ----------
    frames : ndarray of FRAME
        Good frames in the order of arrival.
    rejects : ndarray of REJECT
        Stretches that are no frame, each with its `Reason`.
    """

    frames: Records
    rejects: Records


class StreamDecoder:
    """Decoder of a byte stream; feed it as it comes, in any pieces.

    The frames and rejects are the same for any cut of the stream into pieces, and every byte fed is in a
    frame, in a reject, or among the `pending` ones. After damage the search resumes one byte on.

    Parameters
    ----------
    layout : Layout
        Of a stream profile.
    """

    def __init__(self, layout: Layout) -> None:
        (message,) = layout.messages
        # A plain tuple: a named one reaches a kernel 1 us later.
        self._tables = tuple(message_tables(layout, message))
        self._length = message.length
        self._buffer: NDArray[np.uint8] = np.zeros(message.length + SLACK, np.uint8)
        self._pending = 0
        self._offset = 0
        self._state = np.array([-1, 0, 0], np.int64)
        self._rejects = np.zeros(_REJECTS_AT_ONCE, REJECT)

    @property
    def pending(self) -> int:
        """Bytes that wait for the rest of their frame; fewer than one frame."""
        return self._pending

    @property
    def bytes_fed(self) -> int:
        """Bytes fed since the beginning."""
        return self._offset + self._pending

    def feed(self, data: bytes | bytearray | memoryview | NDArray[np.uint8], t_ns: int = 0) -> Decoded:
        """Take bytes in.

        Parameters
        ----------
        data : bytes-like
            Any number of bytes.
        t_ns : int
            Their time of arrival, host clock, ns.

        Returns
        -------
        Decoded
            What became complete with them.
        """
        piece = np.frombuffer(data, np.uint8)
        stop = self._pending + piece.size
        if stop + SLACK > self._buffer.size:
            grown = np.zeros(stop + SLACK, np.uint8)
            grown[: self._pending] = self._buffer[: self._pending]
            self._buffer = grown
        self._buffer[self._pending : stop] = piece
        frames = np.zeros(stop // self._length, FRAME)
        rejects = []
        position = found = 0
        while True:
            position, found, rejected, hungry = _scan(
                self._buffer,
                position,
                stop,
                self._tables,
                self._state,
                self._offset,
                t_ns,
                frames,
                found,
                self._rejects,
            )
            if rejected:
                rejects.append(self._rejects[:rejected].copy())
            if hungry:
                break
        self._pending = stop - position
        if self._pending:
            self._buffer[: self._pending] = self._buffer[position:stop].copy()
        self._offset += position
        return Decoded(frames[:found], _joined(rejects))

    def close(self) -> Decoded:
        """End of the stream: what is still open or pending comes out as rejects."""
        rejects = []
        if self._state[_OPEN_OFFSET] >= 0:
            begun = self._state[_OPEN_OFFSET]
            rejects.append(np.array([(begun, self._offset - begun, self._state[_OPEN_REASON])], REJECT))
            self._state[_OPEN_OFFSET] = -1
        if self._pending:
            rejects.append(np.array([(self._offset, self._pending, Reason.UNFINISHED)], REJECT))
            self._offset += self._pending
            self._pending = 0
        return Decoded(np.zeros(0, FRAME), _joined(rejects))


def _joined(rejects: list[Records]) -> Records:
    return np.concatenate(rejects) if rejects else _NO_REJECTS


@kernel
def _scan(data, p, stop, tables, state, offset, t_ns, frames, found, rejects):  # type: ignore[no-untyped-def]
    """Walk from `p` until the data or the room for rejects ends; `offset`: stream offset of `data[0]`."""
    # Out of the tuple once: each access inside the loop would count references.
    length, big_endian, constants, fields, check, crc_table = tables
    rejected = 0
    while p < stop and rejected < rejects.shape[0]:
        matches = True
        for c in range(constants.shape[0]):
            at = p + constants[c, 0]
            if at >= stop:
                return p, found, rejected, True
            if data[at] != constants[c, 1]:
                matches = False
                break
        if not matches:
            if state[_OPEN_OFFSET] < 0:
                state[_OPEN_OFFSET] = offset + p
                state[_OPEN_REASON] = _NO_SYNC
            state[_SKIPPED] += 1
            p += 1
            continue
        if p + length > stop:
            return p, found, rejected, True
        good = check_holds(data, p, big_endian, check, crc_table)
        if state[_OPEN_OFFSET] >= 0:
            rejects[rejected]["offset"] = state[_OPEN_OFFSET]
            rejects[rejected]["length"] = offset + p - state[_OPEN_OFFSET]
            rejects[rejected]["reason"] = state[_OPEN_REASON]
            rejected += 1
            state[_OPEN_OFFSET] = -1
        if good:
            frame = frames[found]
            fill(data, p, fields, big_endian, frame)
            frame["offset"] = offset + p
            frame["t_ns"] = t_ns
            frame["damaged"] = (state[_SKIPPED] + length - 1) // length
            state[_SKIPPED] = 0
            found += 1
            p += length
        else:
            state[_OPEN_OFFSET] = offset + p
            state[_OPEN_REASON] = _CHECK_FAILED
            state[_SKIPPED] += 1
            p += 1
    return p, found, rejected, p >= stop
