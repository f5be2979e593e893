"""A simulated unit's output: pieces with their times, and as a terminal program or candump records it."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.records import Records
from imudrv.sim.faults import MessageFaults, StreamFaults
from imudrv.sim.scenario import Scenario
from imudrv.sim.unit import TRUTH, simulate
from imudrv.wire.candump import format_candump
from imudrv.wire.encode import CanEncoder, StreamEncoder
from imudrv.wire.layout import Layout


class WireChunk(NamedTuple):
    """What the wire carries for a stretch of samples.

    Parameters
    ----------
    data : bytes or ndarray of MESSAGE
        Wire bytes, or CAN messages with `t_ns` from the beginning of the run.
    t_ns : ndarray of int64, shape (n,)
        When each frame or message is sent, from the beginning of the run; never less than the one before.
    end : ndarray of int64, shape (n,)
        Bytes or messages of `data` up to the end of each; a frame that is lost adds none.
    truth : ndarray of TRUTH
        What really happened meanwhile, a row a sample.
    """

    data: bytes | Records
    t_ns: NDArray[np.int64]
    end: NDArray[np.int64]
    truth: Records


def wire(scenario: Scenario, layout: Layout, chunk: int = 65_536) -> Iterator[WireChunk]:
    """Simulate a scenario onto the wire of a profile, with the scenario's faults.

    Parameters
    ----------
    scenario : Scenario
        What happens. Pulses that the wire cannot carry saturate.
    layout : Layout
        Of the profile.
    chunk : int
        Samples at a time. Any value gives the same bytes and messages.

    Yields
    ------
    Piece
        Of `chunk` samples.
    """
    chunks = simulate(_within(scenario, layout), layout.interval_ns, chunk)
    if layout.can:
        encoder, bus = CanEncoder(layout), MessageFaults(scenario.faults, scenario.seed)
        for part in chunks:
            yield _messages(bus.apply(encoder.encode(part.pulses))[0], part.truth)
        yield _messages(bus.close()[0], np.zeros(0, TRUTH))
        return
    header = bytes(value for _, value in layout.messages[0].constants)
    frames, line = StreamEncoder(layout), StreamFaults(scenario.faults, header, scenario.seed)
    for part in chunks:
        t_ns = part.pulses["arrival_ns"]
        data, damage = line.apply(frames.encode(part.pulses), t_ns)
        yield WireChunk(data, t_ns, np.cumsum(damage.size), part.truth)


def record(scenario: Scenario, layout: Layout) -> Iterator[tuple[bytes, Records]]:
    """Simulate a scenario into a capture.

    Parameters
    ----------
    scenario, layout
        As for `wire`.

    Yields
    ------
    bytes
        Wire bytes; for a CAN profile lines of a candump log.
    ndarray of TRUTH
        What really happened meanwhile.
    """
    for piece in wire(scenario, layout):
        data = piece.data
        yield data if isinstance(data, bytes) else format_candump(data), piece.truth


def _messages(messages: Records, truth: Records) -> WireChunk:
    return WireChunk(messages, messages["t_ns"], np.arange(1, messages.size + 1), truth)


def _within(scenario: Scenario, layout: Layout) -> Scenario:
    limits = scenario.unit.saturation
    narrowed = limits.model_copy(
        update={
            "gyro_pulses": min(limits.gyro_pulses, layout.pulse_limit),
            "accelerometer_pulses": min(limits.accelerometer_pulses, layout.pulse_limit),
        }
    )
    return scenario.model_copy(update={"unit": scenario.unit.model_copy(update={"saturation": narrowed})})
