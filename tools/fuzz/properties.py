"""Properties of every decoder."""

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np

from imudrv.records import Records
from imudrv.wire.layout import Layout
from imudrv.wire.stream import StreamDecoder

Setup: TypeAlias = Any
"""What a case needs in addition to its bytes, as a literal that can be pasted into a test."""
Cuts: TypeAlias = Sequence[int]
"""Where the input is cut into pieces, in bytes."""
Decode: TypeAlias = Callable[[list[Any]], Sequence[Records]]


def pieces(data: Any, cuts: Cuts) -> list[Any]:
    """Cut bytes or records; cuts beyond the end are ignored."""
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    return [data[a:b] for a, b in itertools.pairwise(edges)]


def feed_all(decoder: Any, parts: list[Any], holds: Callable[[int, int, int], bool]) -> list[Records]:
    """Return all outputs; `holds` gets input size, items and rejects after each part."""
    found, size, items, rejects = [], 0, 0, 0
    for feed, data in [*((decoder.feed, part) for part in parts), (decoder.close, b"")]:
        found.append(feed(data) if feed == decoder.feed else feed())
        size, items, rejects = size + len(data), items + len(found[-1][0]), rejects + len(found[-1][-1])
        assert holds(size, items, rejects), f"after {size}: input not accounted for, or too much buffered"
    assert decoder.pending == 0
    return concatenated(found)


def concatenated(found: Iterable[Sequence[Records]]) -> list[Records]:
    """Concatenate each of several outputs."""
    return [np.concatenate(arrays) for arrays in zip(*found, strict=True)]


def whole_as_pieces(decode: Decode, data: Any, cuts: Cuts) -> Sequence[Records]:
    """Return the outputs of the whole data; in pieces they must have the same bits, padding excepted."""
    whole = decode([data])
    for one, other in zip(whole, decode(pieces(data, cuts)), strict=True):
        assert len(one) == len(other), f"whole: {len(one)} items, in pieces: {len(other)}"
        for name in one.dtype.names or (...,):
            assert one[name].tobytes() == other[name].tobytes(), f"{name} differs between whole and pieces"
    return whole


def plain_search(layout: Layout, data: bytes) -> list[int]:
    """Return the offsets of the good messages of a stream, each decoded alone."""
    (kind,), decoder, offsets, at = layout.messages, StreamDecoder(layout), [], 0
    while 0 <= (at := data.find(kind.constants[0][1], at)) <= len(data) - kind.length:
        good = len(decoder.feed(data[at : at + kind.length]).frames) == 1
        decoder.close()
        offsets += [at] * good
        at += kind.length if good else 1
    return offsets
