"""Target: the decoder of datagrams."""

import numpy as np
from numpy.random import Generator

from imudrv.records import INCREMENTS, Records, Source
from imudrv.wire.datagram import _LAYOUT, DATAGRAM, SIZE, DatagramDecoder, encode

from .properties import Cuts, Setup, concatenated, plain_search, whole_as_pieces
from .random_input import mutated, small_number


def make_datagram(rng: Generator) -> tuple[Setup, bytes]:
    """Return datagrams with random bits, mutated."""
    sent = encode(
        np.frombuffer(rng.bytes(small_number(rng) * INCREMENTS.itemsize), INCREMENTS), Source.REPLAY
    )
    return None, mutated(rng, sent, [b"I50N", b"I50N\x01", sent[:SIZE], sent[5:SIZE]])


def check_datagram(_: Setup, data: bytes, cuts: Cuts) -> None:
    """Check that datagrams are those of a plain search, values are right, and each byte is counted once."""
    end = bytes(SIZE) + encode(np.zeros(1, INCREMENTS), Source.REPLAY)  # completes a partial datagram

    def receive(parts: list[bytes]) -> list[Records]:
        decoder, found = DatagramDecoder(), []
        for part in [*parts, end]:
            found.append(decoder.feed(part))
            assert decoder._tail.size < SIZE, f"{decoder._tail.size} bytes are buffered"
        return concatenated(found)

    increments, source, rejects = whole_as_pieces(receive, data, cuts)
    assert SIZE * len(increments) + rejects["length"].sum() == len(data) + len(end)
    plain = b"".join((data + end)[at : at + SIZE] for at in plain_search(_LAYOUT, data + end))
    rows = np.frombuffer(plain, DATAGRAM)
    assert len(rows) == len(increments), f"{len(increments)} datagrams, a plain search finds {len(rows)}"
    assert np.array_equal(source, rows["source"])
    for name in set(DATAGRAM.names or ()) & set(INCREMENTS.names or ()):
        assert increments[name].astype(DATAGRAM[name].base).tobytes() == rows[name].tobytes(), name
