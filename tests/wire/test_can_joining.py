"""Messages of one sample are joined by a counter that soon begins anew, or by their order and time."""

from collections.abc import Sequence

import numpy as np

from imudrv.profiles import load
from imudrv.records import EXTENDED, MESSAGE, Reason
from imudrv.wire.can import CanAssembler
from imudrv.wire.decoder import FrameDecoder

BOSCH = load("bosch-mm7").layout()  # a counter of 4 bits at 100 Hz, three messages a sample
J1939 = load("openimu-j1939").layout()  # no counter, two messages a sample
MS = 1_000_000
START = 5_000 * MS
"""Any time but 0, which means that it is not known."""


def crc8(data: bytes) -> int:
    """CRC-8/SAE-J1850 without its final inversion: polynomial 1D, init FF."""
    register = 0xFF
    for byte in data:
        register ^= byte
        for _ in range(8):
            register = (register << 1 ^ (0x1D if register & 0x80 else 0)) & 0xFF
    return register


def bosch(identifier: int, number: int, t_ms: float) -> tuple[int, bytes, float]:
    data = bytes([0, 0x80, 0, 0, 0, 0x80, number % 16 << 4])
    return identifier, data + bytes([crc8(data)]), t_ms


def group(identifier: int, t_ms: float, x: int = 32000) -> tuple[int, bytes, float]:
    axis = x.to_bytes(2, "little")
    return EXTENDED | identifier, 3 * axis + b"\xff\x05", t_ms


def messages(rows: Sequence[tuple[int, bytes, float]]) -> np.ndarray:
    out = np.zeros(len(rows), MESSAGE)
    for row, (identifier, data, t_ms) in zip(out, rows, strict=True):
        row["id"], row["length"], row["t_ns"] = identifier, len(data), START + round(t_ms * MS)
        row["data"][: len(data)] = list(data)
    return out


def test_a_reader_that_pauses_between_the_messages_of_a_sample_does_not_tear_it() -> None:
    # A virtual machine stalls for up to 130 ms; this counter wraps after 160 ms.
    sent = [
        bosch(0x174, 1, 0),
        bosch(0x178, 1, 0),
        bosch(0x17C, 1, 70),
        *(bosch(i, 2, 70) for i in (0x174, 0x178, 0x17C)),
    ]
    assembler = CanAssembler(BOSCH)
    frames, rejects = assembler.feed(messages(sent))
    assert frames["counter"].tolist() == [1, 2]
    assert len(rejects) == 0


def test_equal_counters_a_round_apart_are_two_samples() -> None:
    sent = [bosch(0x174, 1, 0), bosch(0x178, 1, 0.2), *(bosch(i, 17, 160) for i in (0x17C, 0x174, 0x178))]
    assembler = CanAssembler(BOSCH)
    frames, rejects = assembler.feed(messages(sent))
    assert len(frames) == 1
    assert rejects["offset"].tolist() == [0, 1]
    assert set(rejects["reason"].tolist()) == {Reason.TORN}


def test_messages_in_order_but_of_two_samples_are_not_joined() -> None:
    sent = [group(0x0CF02A80, 0), group(0x0CF02D80, 10.2), group(0x0CF02A80, 20), group(0x0CF02D80, 20.2)]
    frames, rejects = CanAssembler(J1939).feed(messages(sent))
    assert len(frames) == 1
    assert rejects["offset"].tolist() == [0, 1]


def test_of_two_units_with_the_same_groups_the_one_that_sends_first_is_read() -> None:
    sent = [
        group(address | identifier, 10 * n + delay, x)
        for n in range(3)
        for delay, address, identifier, x in (
            (0.0, 0x80, 0x0CF02A00, 32001),
            (0.1, 0x81, 0x0CF02A00, 32002),
            (0.2, 0x80, 0x0CF02D00, 32003),
            (0.3, 0x81, 0x18F02D00, 32004),
        )
    ]
    decoder = FrameDecoder(J1939)
    frames = decoder.feed(messages(sent))
    assert frames["gyro"].tolist() == [[1, 1, 1]] * 3
    assert frames["accelerometer"].tolist() == [[3, 3, 3]] * 3
    assert decoder.rejected == {}
