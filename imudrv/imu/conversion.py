"""Contents of a frame to increments, temperatures and flags.

A unit sends increments, running totals modulo 2^bits, or rates. The difference of two totals is a signed
number of that width. Across lost samples it still holds all their increments, in one long interval. A rate is
multiplied by the interval of its own sample, never by that of a gap.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import MAX_TEMPERATURES, Flag, Records
from imudrv.units import NS
from imudrv.wire.fields import ahead_of
from imudrv.wire.layout import NARROW_BITS, Field, Layout, Sensor, SequenceKind, Values

Array = NDArray[np.int64]

MAX_INTERVAL_NS: Final = 2**32 - 1
"""Longest interval that the output datagram can carry; a longer gap in totals is not recovered."""

SENSOR: Final = np.dtype(
    [
        ("values", np.int64),  # Values
        ("in_pulses", np.bool_),
        ("is_float", np.int64, 3),  # 0 or 1: numba knows no fields of several bools
        ("bits", np.int64, 3),
        ("lowest", np.int64, 3),  # saturated counts of an increment or a rate
        ("highest", np.int64, 3),
        ("per_count", np.float64, 3),  # NaN: the unit lacks the axis
    ],
    align=True,
)
"""A `Sensor` for the kernels."""

CONSTANTS: Final = np.dtype(
    [
        ("interval_ns", np.int64),  # of one sample, rounded down,
        ("remainder", np.int64),  # and what is left of it, of `parts` to 1 ns
        ("parts", np.int64),
        ("sequence", np.int64),  # SequenceKind
        ("bits", np.int64),
        ("narrow", np.bool_),  # the sequence alone does not determine the length of a gap
        ("step", np.int64),  # of `step_parts` to a count, from a sample to the next
        ("step_parts", np.int64),
        ("span", np.float64),  # samples until the sequence begins anew
        ("totals", np.bool_),  # the unit sends running totals, or rates and increments beside them,
        ("bridges", np.bool_),  # or nothing but totals
        ("gyro", SENSOR),
        ("accelerometer", SENSOR),
        ("fault", np.int64),  # masks of the status word
        ("saturated", np.int64),
        ("warm_up", np.int64),
        ("inverted", np.int64),
        ("degc_per_count", np.float64, MAX_TEMPERATURES),  # NaN: no such channel
        ("degc_at_zero", np.float64, MAX_TEMPERATURES),
    ],
    align=True,
)
"""A profile's layout for the kernels."""

TOTALS: Final = np.dtype(
    [
        ("known", np.bool_),
        ("gyro", np.int64, 3),
        ("accelerometer", np.int64, 3),
        ("gyro_rate", np.int64, 3),  # counts per sample interval up to there
        ("accelerometer_rate", np.int64, 3),
    ],
    align=True,
)
"""Latest running totals."""

_LONG_INTERVAL: Final = int(Flag.LONG_INTERVAL)
_SATURATED: Final = int(Flag.SATURATED)
_FAULT: Final = int(Flag.FAULT)
_WARM_UP: Final = int(Flag.WARM_UP)
_VALID: Final = int(Flag.VALID)
_LOWEST: Final = -(2**63)
_HIGHEST: Final = 2**63 - 1


def constants(layout: Layout) -> Records:
    """Fill in the constants of a profile.

    Parameters
    ----------
    layout : Layout
        Layout of the profile.

    Returns
    -------
    ndarray of CONSTANTS, shape (1,)
    """
    rows = np.zeros(1, CONSTANTS)
    c = rows[0]
    sequence, interval = layout.sequence, layout.interval
    c["interval_ns"], c["parts"] = layout.interval_ns, interval.denominator
    c["remainder"] = interval.numerator % interval.denominator
    c["sequence"], c["bits"] = sequence.kind, sequence.bits
    c["step"], c["step_parts"] = sequence.step.numerator, sequence.step.denominator
    c["span"] = layout.samples_a_round
    c["narrow"] = sequence.kind is not SequenceKind.NONE and c["span"] < 1 << NARROW_BITS
    c["totals"] = any(sensor.values is Values.TOTAL for sensor in layout.sensors if any(sensor.axes))
    c["bridges"] = layout.totals
    for name, sensor in zip(("gyro", "accelerometer"), layout.sensors, strict=True):
        _fill_sensor(c[name], sensor)
    c["fault"], c["saturated"], c["warm_up"], c["inverted"] = layout.status
    channels = len(layout.temperature_names)
    c["degc_per_count"], c["degc_at_zero"] = np.nan, np.nan
    c["degc_per_count"][:channels] = layout.degc_per_count
    c["degc_at_zero"][:channels] = layout.degc_at_zero
    return rows


def _fill_sensor(c: np.void, sensor: Sensor) -> None:
    c["values"], c["in_pulses"] = sensor.values, sensor.is_counted
    c["per_count"] = sensor.per_count
    for k, axis in enumerate(sensor.axes):
        if axis is None:
            c["per_count"][k], c["bits"][k] = np.nan, 64
            c["lowest"][k], c["highest"][k] = _LOWEST, _HIGHEST
        else:
            c["is_float"][k], c["bits"][k] = axis.is_float, axis.bits
            c["lowest"][k], c["highest"][k] = _limits(axis)


def _limits(axis: Field) -> tuple[int, int]:
    """Return the values at which an axis is saturated; none for a floating-point number."""
    if axis.is_float:
        return _LOWEST, _HIGHEST
    if axis.signed:
        lowest, highest = 1 - (1 << (axis.bits - 1)), (1 << (axis.bits - 1)) - 1
    else:
        lowest, highest = 0, (1 << axis.bits) - 1
    ends = sorted(axis.sign * (end - axis.zero) for end in (lowest, highest))
    return max(ends[0], _LOWEST), min(ends[1], _HIGHEST)


@kernel
def convert_increments(frame: np.void, c: np.void, interval_ns: int, out: np.void) -> None:
    """Set the increments of a frame that has no totals, and flag those at the limit of their width."""
    out["interval_ns"], out["flags"] = interval_ns, 0
    T = interval_ns * NS
    gyro_inside = _convert(frame["gyro"], c["gyro"], T, out["gyro"])
    accelerometer_inside = _convert(frame["accelerometer"], c["accelerometer"], T, out["accelerometer"])
    if not (gyro_inside and accelerometer_inside):
        out["flags"] |= _SATURATED


@kernel
def _convert(counts: Array, sensor: np.void, T: float, out: Array) -> bool:
    """Set the increments of one sensor over an interval; return whether all are inside their limits.

    A floating-point number has no limit but must be finite.
    """
    inside = True
    if sensor["in_pulses"]:
        for axis in range(3):
            count = counts[axis]
            out[axis] = count
            inside &= sensor["lowest"][axis] < count < sensor["highest"][axis]
        return inside
    factor = T if sensor["values"] == Values.RATE else 1.0
    for axis in range(3):
        if sensor["is_float"][axis]:
            number = float(np.int64(counts[axis]).view(np.float64))
            inside &= np.isfinite(number)
        else:
            number = float(counts[axis])
            inside &= sensor["lowest"][axis] < counts[axis] < sensor["highest"][axis]
        out[axis] = np.float64(number * sensor["per_count"][axis] * factor).view(np.int64)
    return inside


@kernel
def convert_totals(
    frame: np.void, steps: int, c: np.void, interval_ns: int, latest: np.void, out: np.void
) -> bool:
    """Subtract the latest totals from those of a frame, `steps` intervals later, and replace them by these.

    Where they are not known, or too old, the frame only is a reference for the next one: `out` stays as it
    is, and the result is False.
    """
    usable: bool = latest["known"] and interval_ns <= MAX_INTERVAL_NS and (steps == 1 or c["bridges"])
    if usable:
        T = interval_ns * NS
        out["interval_ns"] = interval_ns
        out["flags"] = _LONG_INTERVAL if steps > 1 else 0
        if c["gyro"]["values"] == Values.TOTAL:
            gyro_sure = _subtract(
                frame["gyro"], latest["gyro"], latest["gyro_rate"], steps, c["gyro"], out["gyro"]
            )
        else:
            gyro_sure = _convert(frame["gyro"], c["gyro"], T, out["gyro"])
        if c["accelerometer"]["values"] == Values.TOTAL:
            accelerometer_sure = _subtract(
                frame["accelerometer"],
                latest["accelerometer"],
                latest["accelerometer_rate"],
                steps,
                c["accelerometer"],
                out["accelerometer"],
            )
        else:
            accelerometer_sure = _convert(frame["accelerometer"], c["accelerometer"], T, out["accelerometer"])
        if not (gyro_sure and accelerometer_sure):
            out["flags"] |= _SATURATED
    for axis in range(3):
        latest["gyro"][axis] = frame["gyro"][axis]
        latest["accelerometer"][axis] = frame["accelerometer"][axis]
    latest["known"] = True
    return usable


@kernel
def _subtract(total: Array, latest: Array, rate: Array, steps: int, sensor: np.void, out: Array) -> bool:
    """Set the increments of one sensor, and their rate; return whether they are unambiguous."""
    sure = True
    for axis in range(3):
        if sensor["is_float"][axis]:
            difference = np.int64(total[axis]).view(np.float64) - np.int64(latest[axis]).view(np.float64)
            out[axis] = np.float64(difference * sensor["per_count"][axis]).view(np.int64)
            sure &= np.isfinite(difference)
            continue
        bits = sensor["bits"][axis]
        counts = ahead_of(total[axis], latest[axis], bits)
        if sensor["in_pulses"]:
            out[axis] = counts
        else:
            out[axis] = np.float64(counts * sensor["per_count"][axis]).view(np.int64)
        if steps == 1:
            rate[axis] = counts
            continue
        # Across a gap totals may wrap more than once, unless the rate before it was well within their width.
        sure &= abs(rate[axis]) * steps < np.int64(1) << (bits - 2)
        rate[axis] = counts // steps
    return sure


@kernel
def convert_status(frame: np.void, c: np.void, out: np.void) -> None:
    """Copy arrival and status, convert temperatures, and add the flags that the status word gives."""
    out["arrival_ns"], out["status"] = frame["t_ns"], frame["status"]
    for k in range(MAX_TEMPERATURES):
        out["temperature_degc"][k] = c["degc_per_count"][k] * frame["temperature"][k] + c["degc_at_zero"][k]
    status = np.int64(frame["status"]) ^ c["inverted"]
    if status & c["fault"]:
        out["flags"] |= _FAULT
    if status & c["saturated"]:
        out["flags"] |= _SATURATED
    if status & c["warm_up"]:
        out["flags"] |= _WARM_UP
    if out["flags"] & (_FAULT | _SATURATED) == 0:
        out["flags"] |= _VALID
