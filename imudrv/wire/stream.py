"""A byte stream to frames: finds them, checks them, and returns every other byte with a reason."""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import FRAME, REJECT, Reason, Records
from imudrv.wire.fields import SLACK, check_holds, fill
from imudrv.wire.layout import Layout
from imudrv.wire.tables import Tables, layout_tables

STATE: Final = np.dtype(
    [
        ("offset", np.int64),  # of the buffer's first byte in the stream
        ("reject_offset", np.int64),  # where the run of rejected bytes begins that is still open; -1: none
        ("reject_reason", np.int64),
        ("skipped", np.int64),  # rejected bytes since the last frame
    ],
    align=True,
)
"""State that a call of the kernel leaves to the next."""

_NO_SYNC: Final = int(Reason.NO_SYNC)
_CHECK_FAILED: Final = int(Reason.CHECK_FAILED)
_REJECTS_AT_ONCE: Final = 1024
_NO_REJECTS: Final = np.zeros(0, REJECT)


class Decoded(NamedTuple):
    """Frames and rejects of a decoder.

    Parameters
    ----------
    frames : ndarray of FRAME
        Good frames in the order of arrival.
    rejects : ndarray of REJECT
        Runs of input that are no frame, each with its `Reason`.
    """

    frames: Records
    rejects: Records


class StreamDecoder:
    """Decoder of a byte stream; feed it bytes as they arrive, in any pieces.

    The frames and rejects are the same for any cut of the stream into pieces, and every byte fed is in a
    frame, in a reject, or among the `pending` ones. After a bad frame the search resumes at its second byte.

    Parameters
    ----------
    layout : Layout
        Layout of a stream profile.
    """

    def __init__(self, layout: Layout) -> None:
        self._tables = layout_tables(layout)
        self._length = layout.messages[0].length
        self._buffer: NDArray[np.uint8] = np.zeros(self._length + SLACK, np.uint8)
        self._pending = 0
        self._state = np.zeros(1, STATE)
        self._state["reject_offset"] = -1
        self._rejects = np.zeros(_REJECTS_AT_ONCE, REJECT)

    @property
    def pending(self) -> int:
        """Number of bytes of an incomplete frame."""
        return self._pending

    @property
    def bytes_fed(self) -> int:
        """Number of bytes fed so far."""
        return int(self._state[0]["offset"]) + self._pending

    def feed(self, data: bytes | bytearray | memoryview | NDArray[np.uint8], t_ns: int = 0) -> Decoded:
        """Decode bytes.

        Parameters
        ----------
        data : bytes-like
            Any number of bytes.
        t_ns : int
            Their time of arrival, host clock, ns.

        Returns
        -------
        Decoded
            Frames and rejects that they complete.
        """
        piece = np.frombuffer(data, np.uint8)
        stop = self._pending + piece.size
        if stop + SLACK > self._buffer.size:
            grown = np.zeros(stop + SLACK, np.uint8)
            grown[: self._pending] = self._buffer[: self._pending]
            self._buffer = grown
        self._buffer[self._pending : stop] = piece
        frames = room = np.zeros(stop // self._length, FRAME)
        rejects: list[Records] = []
        position = 0
        while True:
            position, found, rejected, is_done = _scan(
                self._buffer, position, stop, t_ns, self._tables, self._state, room, self._rejects
            )
            if rejected:
                rejects.append(self._rejects[:rejected].copy())
            if is_done:
                break
            room = room[found:]
        self._pending = stop - position
        if self._pending:
            self._buffer[: self._pending] = self._buffer[position:stop].copy()
        return Decoded(frames[: frames.size - room.size + found], _joined(rejects))

    def close(self) -> Decoded:
        """End of the stream: what is still open or pending becomes a reject.

        Returns
        -------
        Decoded
            Rejects only.
        """
        s, rejects = self._state[0], []
        if s["reject_offset"] >= 0:
            begin, reason = s["reject_offset"], s["reject_reason"]
            rejects.append(np.array([(begin, s["offset"] - begin, reason)], REJECT))
            s["reject_offset"] = -1
        if self._pending:
            rejects.append(np.array([(s["offset"], self._pending, Reason.UNFINISHED)], REJECT))
            s["offset"] += self._pending
            self._pending = 0
        return Decoded(np.zeros(0, FRAME), _joined(rejects))


def _joined(rejects: list[Records]) -> Records:
    return np.concatenate(rejects) if rejects else _NO_REJECTS


_DIFFERS, _MATCHES, _IS_CUT = range(3)
"""How bytes compare with those that begin a frame."""


@kernel
def _scan(
    data: NDArray[np.uint8],
    p: int,
    stop: int,
    t_ns: int,
    tables: Tables,
    state: Records,
    frames: Records,
    rejects: Records,
) -> tuple[int, int, int, bool]:
    """Walk from `p` until the data or the room for rejects ends.

    Returns
    -------
    tuple
        Position of the first byte that is neither in a frame nor rejected; number of frames and of rejects;
        whether the data have ended. Bytes before that position then leave the buffer.
    """
    # Out of the tuple once: each access inside the loop would count references.
    kinds, fields, constants = tables
    kind, s = kinds[0], state[0]
    length, offset = kind["length"], s["offset"]
    found = rejected = 0
    while rejected < rejects.shape[0]:
        header = _compare(data, p, stop, constants)
        if header == _DIFFERS:
            _skip(s, offset + p, _NO_SYNC)
            p += 1
            continue
        if header == _IS_CUT or p + length > stop:
            s["offset"] += p
            return p, found, rejected, True
        is_good = check_holds(data, p, kind)
        if s["reject_offset"] >= 0:
            _close_reject(rejects[rejected], s, offset + p)
            rejected += 1
        if not is_good:
            _skip(s, offset + p, _CHECK_FAILED)
            p += 1
            continue
        frame = frames[found]
        fill(data, p, kind, fields, frame)
        frame["offset"], frame["t_ns"] = offset + p, t_ns
        frame["damaged"] = (s["skipped"] + length - 1) // length
        s["skipped"] = 0
        found += 1
        p += length
    return p, found, rejected, False


@kernel
def _compare(data: NDArray[np.uint8], p: int, stop: int, constants: Records) -> int:
    """Compare the bytes at `p` with the constant bytes of a frame, as far as they have come."""
    for c in range(constants.shape[0]):
        at = p + constants[c]["offset"]
        if at >= stop:
            return _IS_CUT
        if data[at] != constants[c]["value"]:
            return _DIFFERS
    return _MATCHES


@kernel
def _skip(s: np.void, offset: int, reason: int) -> None:
    """Reject the byte at this offset of the stream; the first one of a run gives the reason of all."""
    if s["reject_offset"] < 0:
        s["reject_offset"], s["reject_reason"] = offset, reason
    s["skipped"] += 1


@kernel
def _close_reject(reject: np.void, s: np.void, end: int) -> None:
    """Add the open run of rejected bytes, which ends at this offset of the stream, to the rejects."""
    reject["offset"], reject["length"] = s["reject_offset"], end - s["reject_offset"]
    reject["reason"] = s["reject_reason"]
    s["reject_offset"] = -1
