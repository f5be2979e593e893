"""A byte stream to frames: finds messages, checks them, and returns every other byte with a reason.

Most units send one kind of message, which is a frame. Where a sample comes in several messages, these follow
each other in the profile's order with nothing between them: only that shows that they belong together.
"""

from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import FRAME, REJECT, Reason, Records
from imudrv.wire.fields import SLACK, checks_hold, fill, fill_all, hold, plain_check_holds
from imudrv.wire.layout import MAX_MESSAGES, Layout
from imudrv.wire.tables import Tables, layout_tables

STATE: Final = np.dtype(
    [
        ("offset", np.int64),  # of the buffer's first byte in the stream
        ("pending", np.int64),  # bytes of an incomplete message at the beginning of the buffer
        ("reject_offset", np.int64),  # where the run of rejected bytes begins that is still open; -1: none
        ("reject_reason", np.int64),
        ("skipped", np.int64),  # rejected bytes since the last frame
        # of a unit with several kinds of message:
        ("torn", np.int64),  # samples given up since the last frame
        ("parts", np.int64),  # messages of the open sample
        ("part_end", np.int64),  # where the last one of them ends in the stream
        ("part_offset", np.int64, MAX_MESSAGES),
        ("part_length", np.int64, MAX_MESSAGES),
        ("sample", FRAME),  # the open sample
        ("latest", FRAME),  # what the other messages said last
        ("others", np.int64),  # good messages that are no part of a sample
    ],
    align=True,
)
"""State that a call of the kernel leaves to the next."""

StreamArrays: TypeAlias = tuple[NDArray[np.uint8], Tables, Records, Records, bool]
"""Buffer, tables of the layout, state, room for rejects, and whether `_scan_kinds` is needed."""

_NO_SYNC: Final = int(Reason.NO_SYNC)
_CHECK_FAILED: Final = int(Reason.CHECK_FAILED)
_TORN: Final = int(Reason.TORN)
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
    frame, in a reject, in a good message that is no part of a sample, or among the `pending` ones. After a
    bad message the search resumes at its second byte.

    Parameters
    ----------
    layout : Layout
        Layout of a stream profile.
    """

    def __init__(self, layout: Layout) -> None:
        self._tables = layout_tables(layout)
        self._length = sum(message.length for message in layout.messages if message.is_part)
        self._longest = max(message.length for message in layout.messages)
        only = layout.messages[0]
        is_usual = (
            len(layout.messages) == 1 and not only.multiplexed and only.checks in ((), (only.plain_check,))
        )
        self._has_kinds = not is_usual
        self._state = np.zeros(1, STATE)
        self._buffer: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._rejects = np.zeros(0, REJECT)
        self._end: NDArray[np.int64] = np.zeros(1, np.int64)  # of the one read of `feed`
        self._time: NDArray[np.int64] = np.zeros(1, np.int64)
        self.reserve(0)
        self._state["reject_offset"] = -1
        self._state["latest"]["status"] = layout.status.inverted
        self._state["latest"]["temperature"] = np.nan

    @property
    def pending(self) -> int:
        """Number of bytes of an incomplete message, and of the messages of an incomplete sample."""
        s = self._state[0]
        return int(s["pending"] + s["part_length"][: s["parts"]].sum())

    @property
    def bytes_fed(self) -> int:
        """Number of bytes fed so far."""
        return int(self._state[0]["offset"] + self._state[0]["pending"])

    @property
    def others(self) -> int:
        """Number of bytes of good messages that are no part of a sample."""
        return int(self._state[0]["others"])

    @property
    def arrays(self) -> StreamArrays:
        """Arguments of `decode`; valid until `reserve` makes the buffer larger."""
        return self._buffer, self._tables, self._state, self._rejects, self._has_kinds

    def reserve(self, size: int) -> None:
        """Make room in the buffer for so many bytes besides the pending ones, now and later."""
        needed = self._longest + size + SLACK
        if needed > self._buffer.size:
            pending = int(self._state[0]["pending"])
            grown = np.zeros(needed, np.uint8)
            grown[:pending] = self._buffer[:pending]
            self._buffer = grown
            # A byte begins one reject at most; those of the open sample come on top.
            self._rejects = np.zeros(needed + MAX_MESSAGES, REJECT)

    def put(self, data: bytes | bytearray | memoryview | NDArray[np.uint8]) -> int:
        """Put bytes into the buffer, for `decode`; return their number. There must be room for them."""
        piece = np.frombuffer(data, np.uint8)
        begin = int(self._state[0]["pending"])
        self._buffer[begin : begin + piece.size] = piece
        return piece.size

    def most_frames(self, size: int) -> int:
        """Return the largest number of frames that so many bytes complete."""
        return (self._longest + size) // self._length + 1

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
        self._end[0], self._time[0] = piece.size, t_ns
        return self.feed_reads(piece, self._end, self._time)

    def feed_reads(
        self,
        data: NDArray[np.uint8],
        ends: NDArray[np.int64],
        times: NDArray[np.int64],
    ) -> Decoded:
        """Decode the bytes of several reads; the result is that of feeding one read after the other.

        Parameters
        ----------
        data : ndarray of uint8
            All bytes.
        ends : ndarray of int64, shape (n,)
            Where each read ends in them; the last one at their end.
        times : ndarray of int64, shape (n,)
            Time of arrival of each read, host clock, ns.

        Returns
        -------
        Decoded
            Frames and rejects that they complete.
        """
        if len(ends) != len(times) or (ends[-1] if len(ends) else 0) != data.size:
            raise ValueError(f"expected an end and a time a read, the last end {data.size}")
        self.reserve(data.size)
        self.put(data)
        frames = np.zeros(self.most_frames(data.size), FRAME)
        found, rejected = decode(ends, times, *self.arrays, frames)
        return Decoded(frames[:found], self._rejects[:rejected].copy() if rejected else _NO_REJECTS)

    def close(self) -> Decoded:
        """End of the stream: what is still open or pending becomes a reject.

        Returns
        -------
        Decoded
            Rejects only.
        """
        s = self._state[0]
        parts = range(s["parts"])
        rejects = [np.array([(s["part_offset"][k], s["part_length"][k], _TORN)], REJECT) for k in parts]
        s["parts"] = 0
        if s["reject_offset"] >= 0:
            begin, reason = s["reject_offset"], s["reject_reason"]
            rejects.append(np.array([(begin, s["offset"] - begin, reason)], REJECT))
            s["reject_offset"] = -1
        if s["pending"]:
            rejects.append(np.array([(s["offset"], s["pending"], Reason.UNFINISHED)], REJECT))
            s["offset"] += s["pending"]
            s["pending"] = 0
        return Decoded(np.zeros(0, FRAME), np.concatenate(rejects) if rejects else _NO_REJECTS)


@kernel
def decode(
    ends: NDArray[np.int64],
    times: NDArray[np.int64],
    buffer: NDArray[np.uint8],
    tables: Tables,
    state: Records,
    rejects: Records,
    has_kinds: bool,
    frames: Records,
) -> tuple[int, int]:
    """Decode the new bytes of the buffer, which follow the pending ones; what remains moves to its beginning.

    Parameters
    ----------
    ends : ndarray of int64, shape (n,)
        Where each read ends in the new bytes.
    times : ndarray of int64, shape (n,)
        Time of arrival of each read.
    buffer, tables, state, rejects, has_kinds
        `StreamDecoder.arrays`.
    frames : ndarray of FRAME
        Receives the frames, see `StreamDecoder.most_frames`.

    Returns
    -------
    tuple of int
        Number of frames and of rejects.
    """
    s = state[0]
    if ends.shape[0] == 0:
        return 0, 0
    begin = s["pending"]
    stop = begin + ends[-1]
    if has_kinds:
        position, found, rejected = _scan_kinds(buffer, begin, ends, times, tables, state, frames, rejects)
    else:
        position, found, rejected = _scan(buffer, begin, ends, times, tables, state, frames, rejects)
    s["offset"] += position
    s["pending"] = stop - position
    for k in range(stop - position):
        buffer[k] = buffer[position + k]
    return found, rejected


_DIFFERS, _MATCHES, _IS_CUT = range(3)
"""How bytes compare with those that begin a frame."""


@kernel
def _scan(
    data: NDArray[np.uint8],
    begin: int,
    ends: NDArray[np.int64],
    times: NDArray[np.int64],
    tables: Tables,
    state: Records,
    frames: Records,
    rejects: Records,
) -> tuple[int, int, int]:
    """Walk read by read to the end of the data.

    Read k ends at `begin + ends[k]`. A message may have to wait for bytes behind it that show what is before
    it, so a later read may complete it.

    Returns
    -------
    tuple of int
        Position of the first byte that is neither in a frame nor rejected; number of frames and of rejects.
    """
    # Out of the tuple once: each access inside the loop would count references.
    kinds, fields, _, constants, _ = tables
    kind, s = kinds[0], state[0]
    length, offset = kind["length"], s["offset"]
    p = found = rejected = read = 0
    while read < ends.shape[0]:
        stop = begin + ends[read]
        header = _compare(data, p, stop, constants)
        if header == _DIFFERS:
            _skip(s, offset + p, _NO_SYNC)
            p += 1
            continue
        if header == _IS_CUT or p + length > stop:
            read += 1
            continue
        is_good = plain_check_holds(data, p, kind)
        if s["reject_offset"] >= 0:
            _close_reject(rejects[rejected], s, offset + p)
            rejected += 1
        if not is_good:
            _skip(s, offset + p, _CHECK_FAILED)
            p += 1
            continue
        frame = frames[found]
        frame["offset"], frame["t_ns"], frame["damaged"] = offset + p, times[read], 0
        if s["skipped"]:
            frame["damaged"] = (s["skipped"] + length - 1) // length
            s["skipped"] = 0
        found += 1
        p += length
    fill_all(data, offset, kind, fields, frames[:found])
    return p, found, rejected


@kernel
def _scan_kinds(
    data: NDArray[np.uint8],
    begin: int,
    ends: NDArray[np.int64],
    times: NDArray[np.int64],
    tables: Tables,
    state: Records,
    frames: Records,
    rejects: Records,
) -> tuple[int, int, int]:
    """Do what `_scan` does, for several kinds of message, multiplexed numbers or any checks; slower."""
    kinds, fields, multiplexed, constants, checks = tables
    s = state[0]
    offset = s["offset"]
    parts, length = _parts_of(kinds)
    p = found = rejected = read = 0
    while read < ends.shape[0]:
        stop = begin + ends[read]
        k = _kind_at(data, p, stop, kinds, constants)
        if k == _NO_KIND:
            _skip(s, offset + p, _NO_SYNC)
            p += 1
            continue
        if k == _CUT_KIND:
            read += 1
            continue
        kind = kinds[k]
        is_good = checks_hold(data, p, kind, checks)
        if s["reject_offset"] >= 0:
            _close_reject(rejects[rejected], s, offset + p)
            rejected += 1
        if not is_good:
            _skip(s, offset + p, _CHECK_FAILED)
            p += 1
            continue
        at = offset + p
        p += kind["length"]
        if kind["part"] < 0:
            s["others"] += kind["length"]
            if not kind["is_skipped"]:
                fill(data, at - offset, kind, fields, multiplexed, s["latest"])
            continue
        if s["parts"] and (kind["part"] != s["parts"] or s["part_end"] != at):
            rejected = _tear(s, rejects, rejected)
        if kind["part"] != s["parts"]:
            s["torn"] += 1
            _reject(rejects[rejected], at, kind["length"], _TORN)
            rejected += 1
            continue
        if s["parts"] == 0:
            s["sample"] = s["latest"]
        fill(data, at - offset, kind, fields, multiplexed, s["sample"])
        s["part_offset"][s["parts"]], s["part_length"][s["parts"]] = at, kind["length"]
        s["parts"] += 1
        s["part_end"] = at + kind["length"]
        if s["parts"] == parts:
            frames[found] = s["sample"]
            frame = frames[found]
            frame["offset"], frame["t_ns"] = s["part_offset"][0], times[read]
            frame["damaged"], frame["torn"] = (s["skipped"] + length - 1) // length, s["torn"]
            hold(frame, s["latest"])
            s["parts"] = s["skipped"] = s["torn"] = 0
            found += 1
    return p, found, rejected


@kernel
def _parts_of(kinds: Records) -> tuple[int, int]:
    """Return how many messages make a sample, and their bytes."""
    parts = length = 0
    for k in range(kinds.shape[0]):
        if kinds[k]["part"] >= 0:
            parts += 1
            length += kinds[k]["length"]
    return parts, length


_NO_KIND, _CUT_KIND = -1, -2


@kernel
def _kind_at(data: NDArray[np.uint8], p: int, stop: int, kinds: Records, constants: Records) -> int:
    """Return the kind of message that is whole at `p`, or that none is, or that the data end too early."""
    for k in range(kinds.shape[0]):
        kind = kinds[k]
        header = _compare(data, p, stop, constants[kind["first_constant"] : kind["end_constant"]])
        if header == _MATCHES and p + kind["length"] <= stop:
            return k
        if header != _DIFFERS:
            return _CUT_KIND
    return _NO_KIND


@kernel
def _tear(s: np.void, rejects: Records, rejected: int) -> int:
    """Reject the messages of the open sample; return the number of rejects."""
    for k in range(s["parts"]):
        _reject(rejects[rejected], s["part_offset"][k], s["part_length"][k], _TORN)
        rejected += 1
    s["torn"] += 1
    s["parts"] = 0
    return rejected


@kernel
def _reject(reject: np.void, offset: int, length: int, reason: int) -> None:
    reject["offset"], reject["length"], reject["reason"] = offset, length, reason


@kernel
def _compare(data: NDArray[np.uint8], p: int, stop: int, constants: Records) -> int:
    """Compare the bytes at `p` with the constant bytes of a message, as far as they have come."""
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
    _reject(reject, s["reject_offset"], end - s["reject_offset"], s["reject_reason"])
    s["reject_offset"] = -1
