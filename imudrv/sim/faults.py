"""Faults of a line: frames damaged, lost, duplicated; messages lost, duplicated, swapped; silences.

The seed determines the faults, however the data are divided into chunks. An unplugged cable is a silence.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.records import MESSAGE, Records
from imudrv.sim.scenario import Faults, Silence
from imudrv.units import NS

Bytes = NDArray[np.uint8]
_LONGEST: Final = 12
_MOST_FLIPS: Final = 3
_TRIES: Final = 16


class Kind(IntEnum):
    """Kind of fault of a frame or message."""

    NONE = 0
    BIT_FLIPS = 1
    BYTES_LOST = 2
    BYTES_INSERTED = 3
    FALSE_SYNC_INSIDE = 4
    LOST = 5
    BYTES_BETWEEN = 6
    FALSE_SYNC_BETWEEN = 7
    DOUBLED = 8
    SWAPPED = 9
    SILENCE = 10


_HARM: Final = (
    Kind.BIT_FLIPS,
    Kind.BYTES_LOST,
    Kind.BYTES_INSERTED,
    Kind.FALSE_SYNC_INSIDE,
    Kind.LOST,
    Kind.SILENCE,
)


@dataclass(frozen=True)
class Damage:
    """Faults of the frames or messages sent.

    Attributes
    ----------
    hit : ndarray of bool, shape (n,)
        The frame or message does not arrive as sent. Bytes between frames, duplicates and swaps do not
        count.
    kind : ndarray of uint8, shape (n,)
        `Kind` of each.
    size : ndarray of int64, shape (n,)
        Bytes that arrive for the frame, or number of messages for the message.
    """

    hit: NDArray[np.bool_]
    kind: NDArray[np.uint8]
    size: NDArray[np.int64]


class StreamFaults:
    """Faults of a serial line.

    Parameters
    ----------
    faults : Faults
        Faults of the scenario; all but `can` and `counter_jumps` are used.
    kinds : sequence of (int, bytes)
        Length and first bytes of the frames of a sample, in their order; the bytes are used for false syncs.
    seed : int
        Same seed, same faults.
    """

    def __init__(self, faults: Faults, kinds: Sequence[tuple[int, bytes]], seed: int) -> None:
        rates = faults.stream
        header = kinds[0][1]
        table: tuple[tuple[Kind, float, Callable[[bytes], bytes]], ...] = (
            (Kind.BIT_FLIPS, rates.bit_flips, self._flip),
            (Kind.BYTES_LOST, rates.bytes_lost, self._lose),
            (Kind.BYTES_INSERTED, rates.bytes_inserted, lambda frame: self._insert(frame, self._random())),
            (Kind.FALSE_SYNC_INSIDE, rates.false_sync_inside, lambda frame: self._insert(frame, header)),
            (Kind.LOST, rates.frame_lost, lambda frame: b""),
            (Kind.BYTES_BETWEEN, rates.bytes_between, lambda frame: self._random() + frame),
            (Kind.FALSE_SYNC_BETWEEN, rates.false_sync_between, lambda frame: header + frame),
            (Kind.DOUBLED, rates.frame_doubled, lambda frame: frame + frame),
        )
        self._odds = [(kind, rate) for kind, rate, _ in table]
        self._act: dict[Kind, Callable[[bytes], bytes]] = {kind: act for kind, _, act in table}
        self._act[Kind.SILENCE] = lambda frame: b""
        self._silences = faults.quiet
        self._lengths = [length for length, _ in kinds]
        self._next_headers = [kinds[(k + 1) % len(kinds)][1] for k in range(len(kinds))]
        # separate generators for kind and details: chunks of any size draw the same
        self._draw = _generator(seed, 5)
        self._rng = _generator(seed, 6)

    def apply(self, frames: Bytes, t_ns: NDArray[np.int64]) -> tuple[bytes, Damage]:
        """Apply the faults to frames.

        Parameters
        ----------
        frames : ndarray of uint8, shape (n, length)
            The frames of one sample per row.
        t_ns : ndarray of int64, shape (m,)
            Time of each frame since the start of the run.

        Returns
        -------
        bytes
            Bytes that arrive.
        Damage
            One row per frame.
        """
        kind = _kinds(self._odds, self._silences, t_ns, self._draw)
        size = np.tile(self._lengths, len(frames))
        ends = np.cumsum(size)
        sent = frames.tobytes()
        pieces = []
        done = 0
        for i in np.flatnonzero(kind).tolist():
            begin, end = int(ends[i] - size[i]), int(ends[i])
            frame = sent[begin:end]
            arrives = self._damaged(Kind(kind[i]), frame, self._next_headers[i % len(self._lengths)])
            if arrives == frame:
                kind[i] = Kind.NONE
            size[i] = len(arrives)
            pieces += [sent[done:begin], arrives]
            done = end
        pieces.append(sent[done:])
        return b"".join(pieces), _damage(kind, size)

    def _damaged(self, kind: Kind, frame: bytes, next_header: bytes) -> bytes:
        """Damage a frame; keep it whole if it stays readable after several attempts."""
        act = self._act[kind]
        if kind not in _HARM:
            return act(frame)
        for _ in range(_TRIES):
            arrives = act(frame)
            # lost last bytes may be equal to the header of the next frame
            if frame not in arrives + next_header[: len(frame) - 1]:
                return arrives
        return frame

    def _flip(self, frame: bytes) -> bytes:
        bits = self._rng.choice(8 * len(frame), self._rng.integers(1, _MOST_FLIPS + 1), replace=False)
        damaged = bytearray(frame)
        for bit in bits.tolist():
            damaged[bit // 8] ^= 1 << bit % 8
        return bytes(damaged)

    def _lose(self, frame: bytes) -> bytes:
        run = int(self._rng.integers(1, min(_LONGEST, len(frame) - 1) + 1))
        at = int(self._rng.integers(0, len(frame) - run + 1))
        return frame[:at] + frame[at + run :]

    def _insert(self, frame: bytes, more: bytes) -> bytes:
        at = int(self._rng.integers(1, len(frame)))
        return frame[:at] + more + frame[at:]

    def _random(self) -> bytes:
        return self._rng.bytes(int(self._rng.integers(1, _LONGEST + 1)))


class MessageFaults:
    """Faults of a CAN bus.

    Parameters
    ----------
    faults : Faults
        Faults of the scenario; all but `stream` and `counter_jumps` are used.
    seed : int
        Same seed, same faults.
    """

    def __init__(self, faults: Faults, seed: int) -> None:
        rates = faults.can
        self._odds = ((Kind.LOST, rates.lost), (Kind.DOUBLED, rates.doubled), (Kind.SWAPPED, rates.swapped))
        self._silences = faults.quiet
        self._draw = _generator(seed, 5)
        self._held = np.zeros(0, MESSAGE)

    def apply(self, messages: Records) -> tuple[Records, Damage]:
        """Apply the faults to messages.

        Parameters
        ----------
        messages : ndarray of MESSAGE, shape (n,)
            Messages with `t_ns` since the start of the run.

        Returns
        -------
        ndarray of MESSAGE
            Messages that arrive; swapped messages exchange all but their times. A last message that is to
            be swapped with the next one is held until the next call.
        Damage
            One row per message sent and not held. `SWAPPED` marks the first of a pair; a message before one
            with another fault is not swapped.
        """
        kind = _kinds(self._odds, self._silences, messages["t_ns"], self._draw)
        sent = np.concatenate([self._held, messages])
        kind = np.concatenate([np.full(self._held.size, Kind.SWAPPED, np.uint8), kind])
        order = np.arange(sent.size)
        stop = sent.size
        for i in np.flatnonzero(kind == Kind.SWAPPED).tolist():
            if kind[i] != Kind.SWAPPED:
                continue
            if i + 1 == sent.size:
                stop = i
            elif kind[i + 1] in (Kind.NONE, Kind.SWAPPED):
                order[i], order[i + 1] = i + 1, i
                kind[i + 1] = Kind.NONE
            else:
                kind[i] = Kind.NONE
        self._held = sent[stop:].copy()
        kind = kind[:stop]
        arrives = sent[order[:stop]]
        arrives["t_ns"] = sent["t_ns"][:stop]
        copies = np.where(np.isin(kind, _HARM), 0, np.where(kind == Kind.DOUBLED, 2, 1))
        return np.repeat(arrives, copies), _damage(kind, copies)

    def close(self) -> tuple[Records, Damage]:
        """End of the run: a message that is held has no next one and arrives as it is."""
        held, self._held = self._held, self._held[:0]
        return held, _damage(np.zeros(held.size, np.uint8), np.ones(held.size, np.int64))


def _kinds(
    odds: Sequence[tuple[Kind, float]],
    silences: Sequence[Silence],
    t_ns: NDArray[np.int64],
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """Return the kind of fault of each row: drawn, or silence."""
    kinds = np.array([kind for kind, _ in odds] + [Kind.NONE], np.uint8)
    edges = np.cumsum([rate for _, rate in odds])
    kind = kinds[np.searchsorted(edges, rng.random(t_ns.size), side="right")]
    for silence in silences:
        begin, end = round(silence.at_s / NS), round((silence.at_s + silence.duration_s) / NS)
        kind[(begin < t_ns) & (t_ns <= end)] = Kind.SILENCE
    return kind


def _damage(kind: NDArray[np.uint8], size: NDArray[np.int64]) -> Damage:
    return Damage(np.isin(kind, _HARM), kind, size)


def _generator(seed: int, stream: int) -> np.random.Generator:
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(stream,)))
