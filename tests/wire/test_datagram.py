"""The output datagram, both directions."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imudrv.records import INCREMENTS, Records, Source
from imudrv.wire.datagram import SIZE, DatagramDecoder, encode

# ICD, section 7.
WORKED = bytes.fromhex(
    "49 35 30 4e 01 02 41 00 40 e2 01 00 40 42 0f 00 15 cd 85 3d fe 9c 97 17"
    "8d ed b5 a0 f7 c6 b0 3e 8d ed b5 a0 f7 c6 c0 be 54 e4 10 71 73 2a c9 3e"
    "00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 00 6e a3 01 bc 05 12 84 3f f2 8a 07 dd"
)


def worked_increment() -> Records:
    increments = np.zeros(1, INCREMENTS)
    increments["flags"] = 0x41
    increments["counter"] = 123456
    increments["interval_ns"] = 1_000_000
    increments["t_ns"] = 1_700_000_000_123_456_789
    increments["dtheta_b"] = (1e-6, -2e-6, 3e-6)
    increments["dv_b"] = (0.0, 0.0, 9.8e-3)
    return increments


def test_the_worked_datagram_of_the_icd_is_encoded_byte_for_byte() -> None:
    assert encode(worked_increment(), Source.SIMULATOR) == WORKED


def test_the_worked_datagram_is_decoded() -> None:
    received = DatagramDecoder().feed(WORKED)
    np.testing.assert_array_equal(received.increments, worked_increment())
    assert received.source.tolist() == [Source.SIMULATOR]


def test_the_counter_goes_out_modulo_two_to_the_32() -> None:
    increments = worked_increment()
    increments["counter"] += 2**32
    assert encode(increments, Source.SIMULATOR) == WORKED


@given(
    cuts=st.lists(st.integers(0, 7 * SIZE), max_size=6),
    damage=st.lists(st.tuples(st.integers(0, 7 * SIZE - 1), st.integers(1, 255)), max_size=3),
)
def test_damage_loses_only_the_damaged_datagrams_in_any_pieces(
    cuts: list[int], damage: list[tuple[int, int]]
) -> None:
    sent = np.repeat(worked_increment(), 7)
    sent["counter"] = np.arange(7)
    wire = bytearray(encode(sent, Source.HARDWARE))
    flips = dict(damage)
    for at, change in flips.items():
        wire[at] ^= change
    hit = {at // SIZE for at in flips}
    decoder = DatagramDecoder()
    edges = [0, *sorted(cuts), len(wire)]
    pieces = [decoder.feed(bytes(wire[a:b])) for a, b in pairwise(edges)]
    got = np.concatenate([p.increments for p in pieces])
    assert got["counter"].tolist() == [k for k in range(7) if k not in hit]


@pytest.mark.parametrize("junk", [b"", b"I50N", b"I50N\x02" + bytes(71), bytes(200)])
def test_what_is_no_datagram_gives_no_increment(junk: bytes) -> None:
    assert len(DatagramDecoder().feed(junk).increments) == 0
