"""Target: the decoder of candump logs."""

import io

import numpy as np
from numpy.random import Generator

from imudrv.records import EXTENDED, Records
from imudrv.wire.candump import LONGEST_LINE, CandumpDecoder, format_candump

from .properties import Cuts, Setup, feed_all, whole_as_pieces
from .random_input import mutated, pick, small_number
from .units import CAN, SHIPPED, transmit


def make_candump(rng: Generator) -> tuple[Setup, bytes]:
    """Return lines of valid and invalid words, and a real log, mutated."""
    words = (
        (b"(1.5)", b"(1700000000.123456)", b"(9999999999.5)", b"(0001.123456789)", b"(1.)", b"(.5)", b""),
        (b" ", b" can0 ", b"\tc\r ", b" c0 c0 ", b" " + b"c" * int(rng.integers(300)) + b" "),
        (b"150", b"7FF", b"800", b"00000151", b"1fffffff", b"15", b"20000000"),
        (b"#", b"##1", b"##", b"#R", b""),
        tuple(rng.bytes(n).hex().encode() for n in (0, 1, 7, 8, 9, 64, 65)),
        (b"\n", b"\n", b"\r\n", b" R\n", b"\tT \r\n", b"R\n", b"0\n", b"", b"\n \t\n"),
    )
    lines = b"".join(pick(rng, group) for _ in range(small_number(rng, 60)) for group in words)
    lines += format_candump(transmit(rng, SHIPPED[pick(rng, CAN)], small_number(rng, 60)))
    return None, mutated(rng, lines, [word for group in words for word in group])


def check_candump(_: Setup, data: bytes, cuts: Cuts) -> None:
    """Check that each line is a message, a reject or blank, and that messages survive writing and reading."""
    channels: list[dict[str, int]] = []

    def decode(parts: list[bytes]) -> list[Records]:
        decoder, kept = CandumpDecoder(), LONGEST_LINE + 1
        found = feed_all(decoder, parts, lambda n, *_: decoder.bytes_fed == n and decoder._line.size <= kept)
        channels.append(decoder.channels)
        return found

    messages, rejects = whole_as_pieces(decode, data, cuts)
    assert channels[0] == channels[1], f"whole: {channels[0]}, in pieces: {channels[1]}"
    bad = {offset: size for offset, size, _ in rejects.tolist()}
    offset = lines = 0
    for line in io.BytesIO(data):
        assert bad.pop(offset, len(line)) == len(line), f"line at {offset}: its reject has a different length"
        lines += bool(line.strip(b" \t\r\n")) or len(line.rstrip(b"\n")) > LONGEST_LINE
        offset += len(line)
    assert not bad, f"rejects that do not start a line: {bad}"
    assert lines == sum(channels[0].values()) + len(rejects), f"{lines} lines, messages {channels[0]}"
    assert len(messages) == next(iter(channels[0].values()), 0), f"{len(messages)} messages of {channels[0]}"
    assert np.all(messages["length"] <= np.where(messages["fd"], 64, 8)), "more data than a frame holds"
    identifiers = messages["id"]
    limits = np.where(identifiers & EXTENDED, 2**29, 2**11)
    assert np.all(identifiers & ~np.uint32(EXTENDED) < limits), "identifier of more than 29 bits"
    again, _ = decode([format_candump(messages)])
    again["t_ns"] += messages["t_ns"] % 1000  # a log has microseconds
    assert np.array_equal(again, messages)
