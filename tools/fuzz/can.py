"""Target: the assembler of CAN messages."""

import numpy as np
from numpy.random import Generator

from imudrv.records import MESSAGE, Records
from imudrv.wire.can import OPEN_SAMPLES, CanAssembler
from imudrv.wire.layout import SEQUENCE

from .properties import Cuts, Setup, feed_all, whole_as_pieces
from .random_input import mutated, pick, small_number
from .units import CAN, layout_of, random_can_profile, transmit


def make_can(rng: Generator) -> tuple[Setup, bytes]:
    """Return messages of a unit with restarts, mutated."""
    profile = pick(rng, CAN) if rng.integers(2) else random_can_profile(rng)
    layout = layout_of(profile)
    sent = np.concatenate([transmit(rng, layout, small_number(rng, 800)) for _ in range(rng.integers(1, 3))])
    tokens = [
        m.tobytes() for m in (transmit(rng, layout, 1), transmit(rng, layout, 2)[:-1], sent[:3], sent[-9:])
    ]
    return profile, mutated(rng, sent.tobytes(), tokens, MESSAGE.itemsize)


def check_can(profile: Setup, data: bytes, cuts: Cuts) -> None:
    """Check that each message is counted once at any moment."""
    layout = layout_of(profile)
    parts = sum(kind.every == 1 for kind in layout.messages)
    hold = 2 * max(
        (kind.every for kind in layout.messages if kind.every > 1 and kind.has(SEQUENCE)), default=0
    )

    def assemble(batches: list[Records]) -> list[Records]:
        decoder = CanAssembler(layout)

        def holds(n: int, frames: int, rejects: int) -> bool:
            known = parts * frames + rejects + decoder.slow + decoder.foreign + decoder.pending
            return decoder.messages_fed == n == known and decoder.pending <= parts * (OPEN_SAMPLES + hold)

        return feed_all(decoder, batches, holds)

    messages = np.frombuffer(data, MESSAGE).copy()
    frames, rejects = whole_as_pieces(assemble, messages, [cut // MESSAGE.itemsize for cut in cuts])
    ends = [*frames["offset"].tolist(), *rejects["offset"].tolist()]
    assert len(set(ends)) == len(ends), "a message is counted twice"
    assert set(ends) <= set(range(len(messages)))
