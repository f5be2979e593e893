"""Target: decoder and sequence of random valid profiles of every kind."""

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.random import Generator

from imudrv.files import settings_file
from imudrv.imu.sequence import SequenceTracker
from imudrv.profiles.schema import Profile
from imudrv.records import MESSAGE, Records
from imudrv.wire.can import CanAssembler
from imudrv.wire.encode import CanEncoder, StreamEncoder
from imudrv.wire.layout import Layout
from imudrv.wire.stream import StreamDecoder

from . import documents
from .properties import Cuts, Setup, feed_all, whole_as_pieces
from .random_input import mutated, pick
from .sent import samples

T = TypeVar("T")


class _Random:
    """Choices of numpy."""

    def __init__(self, rng: Generator) -> None:
        self._rng = rng

    def pick(self, choices: Sequence[T]) -> T:
        chosen: T = pick(self._rng, choices)
        return chosen

    def integer(self, lowest: int, highest: int) -> int:
        return int(self._rng.integers(lowest, highest, endpoint=True))


def layout_of(document: Any) -> Layout:
    """Return the layout of a random profile."""
    return settings_file.parse(document, Profile, "random profile").layout()


def on_the_wire(layout: Layout, sent: Records) -> Any:
    """Return samples as bytes of a stream, or as messages."""
    if layout.can:
        return CanEncoder(layout).encode(sent)
    return StreamEncoder(layout).encode(sent).reshape(-1)


def make_any_profile(rng: Generator) -> tuple[Setup, bytes]:
    """Return samples of a random unit, damaged, with noise and parts of its messages between."""
    document = documents.profile(_Random(rng))
    layout = layout_of(document)
    unit = MESSAGE.itemsize if layout.can else 1
    first = int(rng.integers(1 << 20))
    pieces = []
    for _ in range(int(rng.integers(1, 20))):
        piece = on_the_wire(layout, samples(rng, layout, int(rng.integers(1, 300)), first)).tobytes()
        tokens = [piece[: 3 * unit], piece[: len(piece) // unit // 3 * unit], piece[-unit:]]
        pieces.append(mutated(rng, piece, tokens, unit))
        pieces.append(rng.bytes(unit * pick(rng, (0, 0, 1, 100))))
        first += int(rng.integers(-100, 1000))
    return document, b"".join(pieces)


def check_any_profile(document: Setup, data: bytes, cuts: Cuts) -> None:
    """Check that all input is accounted for, any cut gives the same bits, and the counts close."""
    layout = layout_of(document)
    parts = [message.length for message in layout.messages if message.is_part]

    def assemble(batches: list[Any]) -> list[Records]:
        decoder = CanAssembler(layout)

        def holds(n: int, frames: int, rejects: int) -> bool:
            known = len(parts) * frames + rejects + decoder.slow + decoder.foreign + decoder.pending
            return decoder.messages_fed == n == known

        return feed_all(decoder, batches, holds)

    def decode(batches: list[Any]) -> list[Records]:
        decoder = StreamDecoder(layout)
        frames, rejects = feed_all(decoder, batches, lambda n, *_: decoder.bytes_fed == n)
        known = sum(parts) * len(frames) + int(rejects["length"].sum()) + decoder.others
        assert known == len(data), f"{known} of {len(data)} bytes accounted for"
        return [frames, rejects]

    if layout.can:
        messages = np.frombuffer(data, MESSAGE).copy()
        frames, _ = whole_as_pieces(assemble, messages, [cut // MESSAGE.itemsize for cut in cuts])
    else:
        frames, _ = whole_as_pieces(decode, data, cuts)
    for has_times in (False, True):
        frames["t_ns"] = (1 << 40) + np.arange(len(frames)) * layout.interval_ns if has_times else 0
        _check_sequence(layout, frames, [cut // layout.messages[0].length for cut in cuts])


def _check_sequence(layout: Layout, frames: Records, cuts: Cuts) -> None:
    def track(batches: list[Records]) -> list[Records]:
        tracker = SequenceTracker(layout)
        out = np.concatenate([tracker.feed(batch) for batch in batches])
        assert tracker.counts.closes, f"{tracker.counts} does not add up"
        assert len(out) == tracker.counts.good
        assert min(vars(tracker.counts).values()) >= 0
        assert np.all(np.diff(out["elapsed_ns"]) > 0), "time goes backwards"
        return [out]

    whole_as_pieces(track, frames, cuts)
