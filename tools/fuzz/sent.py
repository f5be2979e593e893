"""Samples that a unit of any layout can send."""

from fractions import Fraction
from typing import Final

import numpy as np
from numpy.random import Generator

from imudrv.records import Records, samples_type
from imudrv.units import NS
from imudrv.wire.layout import STATUS, Field, Layout, Sensor, SequenceKind, Values

MOST: Final = 1 << 40
"""Largest counts: the encoder computes in float64, whose totals are exact up to 2^53."""


def samples(rng: Generator, layout: Layout, count: int, first: int = 0) -> Records:
    """Return samples without a gap whose numbers fit the layout, each a whole number of counts.

    The numbers of floating-point fields are multiples of 1/8 below 100, whose totals float32 holds exactly.
    """
    gyro, accelerometer = layout.sensors
    made = np.zeros(
        count, samples_type(gyro_pulses=gyro.is_counted, accelerometer_pulses=accelerometer.is_counted)
    )
    ends = [int(layout.interval * k) for k in range(count + 1)]
    made["elapsed_ns"], made["interval_ns"] = ends[1:], np.diff(ends)
    step = layout.sequence.step if layout.sequence.kind is SequenceKind.COUNTER else Fraction(1)
    made["counter"] = (first + np.arange(count)) * int(step)
    for name, sensor in (("gyro", gyro), ("accelerometer", accelerometer)):
        for axis, field in enumerate(sensor.axes):
            if field is None:
                made[name][:, axis] = 0
                continue
            values = counts(rng, sensor, field, count) * sensor.per_count[axis]
            if sensor.values is Values.RATE:
                values *= made["interval_ns"] * NS
            made[name][:, axis] = values
    bits = sum(f.bits for m in layout.messages for f in m.fields if f.target == STATUS)
    made["status"] = rng.integers(0, 1 << bits, count)
    made["temperature_degc"] = 35.0
    return made


def counts(rng: Generator, sensor: Sensor, field: Field, count: int) -> np.ndarray:
    """Return counts inside the range of a field, not at its ends."""
    if field.is_float:
        return rng.integers(-800, 801, count) / 8
    if sensor.values is Values.TOTAL:
        lowest, highest = -(1 << (field.bits - 1)), (1 << (field.bits - 1)) - 1
    else:
        raw = (
            (-(1 << (field.bits - 1)), (1 << (field.bits - 1)) - 1)
            if field.signed
            else (0, (1 << field.bits) - 1)
        )
        lowest, highest = sorted(field.sign * (end - field.zero) for end in raw)
    # Both ends are saturated, of a signed field also the second number from its lowest end.
    lowest, highest = max(lowest + 2, -MOST), min(highest - 2, MOST)
    return rng.integers(lowest, highest, count, endpoint=True).astype(np.float64)
