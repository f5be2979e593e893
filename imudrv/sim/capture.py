"""A simulated unit's output as a terminal program or candump would have recorded it."""

from collections.abc import Iterator

from imudrv.records import Records
from imudrv.sim.faults import MessageFaults, StreamFaults
from imudrv.sim.scenario import Scenario
from imudrv.sim.unit import simulate
from imudrv.wire.candump import format_candump
from imudrv.wire.encode import CanEncoder, StreamEncoder
from imudrv.wire.layout import Layout


def record(scenario: Scenario, layout: Layout) -> Iterator[tuple[bytes, Records]]:
    """Simulate a scenario onto the wire of a profile, with the scenario's faults.

    Parameters
    ----------
    scenario : Scenario
        What happens. Pulses that the wire cannot carry saturate.
    layout : Layout
        Of the profile.

    Yields
    ------
    bytes
        Wire bytes; for a CAN profile lines of a candump log.
    ndarray of TRUTH
        What really happened meanwhile.
    """
    chunks = simulate(_within(scenario, layout), layout.interval_ns)
    if layout.can:
        messages, bus = CanEncoder(layout), MessageFaults(scenario.faults, scenario.seed)
        for chunk in chunks:
            yield format_candump(bus.apply(messages.encode(chunk.pulses))[0]), chunk.truth
        return
    header = bytes(value for _, value in layout.messages[0].constants)
    frames, line = StreamEncoder(layout), StreamFaults(scenario.faults, header, scenario.seed)
    for chunk in chunks:
        yield line.apply(frames.encode(chunk.pulses), chunk.pulses["arrival_ns"])[0], chunk.truth


def _within(scenario: Scenario, layout: Layout) -> Scenario:
    limits = scenario.unit.saturation
    narrowed = limits.model_copy(
        update={
            "gyro_pulses": min(limits.gyro_pulses, layout.pulse_limit),
            "accelerometer_pulses": min(limits.accelerometer_pulses, layout.pulse_limit),
        }
    )
    return scenario.model_copy(update={"unit": scenario.unit.model_copy(update={"saturation": narrowed})})
