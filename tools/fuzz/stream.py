"""Target: the decoder of serial streams."""

import numpy as np
from numpy.random import Generator

from imudrv.records import Records
from imudrv.wire.layout import TEMPERATURE
from imudrv.wire.stream import StreamDecoder

from .properties import Cuts, Setup, feed_all, plain_search, whole_as_pieces
from .random_input import mutated, pick, small_number
from .units import SERIAL, layout_of, random_profile, transmit


def make_stream(rng: Generator) -> tuple[Setup, bytes]:
    """Return frames, parts of frames, false headers, noise."""
    profile = pick(rng, SERIAL) if rng.integers(2) else random_profile(rng)
    layout = layout_of(profile)
    header = bytes(value for _, value in layout.messages[0].constants)
    tokens = [header, header[:1], 2 * header, transmit(rng, layout, 1), transmit(rng, layout, 2)[3:]]
    return profile, mutated(
        rng, transmit(rng, layout, small_number(rng)) or rng.bytes(small_number(rng, 3000)), tokens
    )


def check_stream(profile: Setup, data: bytes, cuts: Cuts) -> None:
    """Check that frames are those of a plain search, values are right, and each byte is counted once."""
    layout = layout_of(profile)
    (kind,) = layout.messages

    def decode(parts: list[bytes]) -> list[Records]:
        decoder = StreamDecoder(layout)
        return feed_all(
            decoder, parts, lambda n, *_: decoder.bytes_fed == n and decoder.pending < kind.length
        )

    frames, rejects = whole_as_pieces(decode, data, cuts)
    offsets, end = frames["offset"].tolist(), 0
    stretches = [(at, kind.length) for at in offsets] + [(at, size) for at, size, _ in rejects.tolist()]
    for at, size in sorted(stretches):
        assert (at, size > 0) == (end, True), f"expected the next frame or reject at byte {end}, got {at}"
        end = at + size
    assert end == len(data), f"{end} of {len(data)} bytes accounted for"
    skipped = np.diff([0, *(at + kind.length for at in offsets)]) - kind.length
    assert np.array_equal(frames["damaged"], -(-skipped // kind.length)), "wrong number of damaged frames"
    plain = plain_search(layout, data)
    assert offsets == plain, f"frames at {offsets}, a plain search finds them at {plain}"
    for frame, at in zip(frames, offsets, strict=True):
        pulses = (*frame["gyro"], *frame["accelerometer"])
        numbers = (frame["counter"], *pulses, frame["status"], *frame["temperature"])
        for f in kind.fields:
            order = "big" if f.big_endian else "little"
            value = int.from_bytes(data[at + f.offset :][: f.bits // 8], order, signed=f.signed)
            if f.target >= TEMPERATURE:
                value = int(np.float32(value))  # 24 bits of its numbers
            assert (value - int(numbers[f.target])) % 2**32 == 0, f"frame at {at}: {f} is {value}"
