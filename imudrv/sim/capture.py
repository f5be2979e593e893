"""Output of a simulated unit: chunks with times, or a capture as a terminal program or candump records it."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.records import Records
from imudrv.sim.faults import MessageFaults, StreamFaults
from imudrv.sim.scenario import Scenario
from imudrv.sim.unit import TRUTH, More, simulate
from imudrv.wire.candump import format_candump
from imudrv.wire.encode import CanEncoder, StreamEncoder
from imudrv.wire.layout import Layout


class WireChunk(NamedTuple):
    """Wire data of consecutive samples.

    Parameters
    ----------
    data : bytes or ndarray of MESSAGE
        Wire bytes, or CAN messages with `t_ns` since the start of the run.
    t_ns : ndarray of int64, shape (n,)
        Time of each frame or message since the start of the run, never decreasing.
    end : ndarray of int64, shape (n,)
        Bytes or messages of `data` up to the end of each; a lost frame adds none.
    truth : ndarray of TRUTH
        Truth, one row per sample.
    """

    data: bytes | Records
    t_ns: NDArray[np.int64]
    end: NDArray[np.int64]
    truth: Records


def wire(
    scenario: Scenario, layout: Layout, chunk: int = 65_536, more: More | None = None
) -> Iterator[WireChunk]:
    """Simulate the wire data of a scenario, with its faults, for a profile.

    Parameters
    ----------
    scenario : Scenario
        Scenario.
    layout : Layout
        Layout of the profile.
    chunk : int
        Number of samples at a time; any value gives the same data.
    more : callable, optional
        See `imudrv.sim.unit.simulate`.

    Yields
    ------
    WireChunk
        Data of `chunk` samples.
    """
    chunks = simulate(scenario, layout, chunk, more)
    if layout.can:
        messages, bus = CanEncoder(layout), MessageFaults(scenario.faults, scenario.seed)
        for part in chunks:
            yield _messages(bus.apply(messages.encode(part.pulses))[0], part.truth)
        yield _messages(bus.close()[0], np.zeros(0, TRUTH))
        return
    kinds = [(message.length, message.header) for message in layout.messages if message.is_part]
    frames, line = StreamEncoder(layout), StreamFaults(scenario.faults, kinds, scenario.seed)
    for part in chunks:
        t_ns = np.repeat(part.pulses["arrival_ns"], len(kinds))
        data, damage = line.apply(frames.encode(part.pulses), t_ns)
        yield WireChunk(data, t_ns, np.cumsum(damage.size), part.truth)


def record(scenario: Scenario, layout: Layout) -> Iterator[tuple[bytes, Records]]:
    """Simulate the capture of a scenario.

    Parameters
    ----------
    scenario, layout
        As for `wire`.

    Yields
    ------
    bytes
        Wire bytes; for a CAN profile lines of a candump log.
    ndarray of TRUTH
        Truth of the same samples.
    """
    for piece in wire(scenario, layout):
        data = piece.data
        yield data if isinstance(data, bytes) else format_candump(data), piece.truth


def _messages(messages: Records, truth: Records) -> WireChunk:
    return WireChunk(messages, messages["t_ns"], np.arange(1, messages.size + 1), truth)
