"""Contents of a frame to a row of PULSES: pulse increments, temperatures, flags.

A unit sends increments, or running totals modulo 2^bits. The difference of two totals is a signed number of
that width. Across lost samples it still holds all their pulses, in one long interval.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import MAX_TEMPERATURES, NO_TEMPERATURE, Flag, Records
from imudrv.wire.fields import ahead_of
from imudrv.wire.layout import Layout

Array = NDArray[np.int64]

MAX_INTERVAL_NS: Final = 2**32 - 1
"""Longest interval that the output datagram can carry; a longer gap in totals is not recovered."""

CONSTANTS: Final = np.dtype(
    [
        ("interval_ns", np.int64),  # of one sample
        ("counter_bits", np.int64),
        ("pulse_bits", np.int64),
        ("pulse_limit", np.int64),  # increments of this size are saturated
        ("totals", np.bool_),  # the unit sends running totals
        ("fault", np.int64),  # masks of the status word
        ("saturated", np.int64),
        ("warm_up", np.int64),
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
        ("gyro_rate", np.int64, 3),  # pulses per sample interval up to there
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
    c["interval_ns"], c["totals"], c["counter_bits"] = layout.interval_ns, layout.totals, layout.counter_bits
    c["pulse_bits"], c["pulse_limit"] = layout.pulse_bits, layout.pulse_limit
    c["fault"], c["saturated"], c["warm_up"] = layout.status
    channels = len(layout.temperature_names)
    c["degc_per_count"], c["degc_at_zero"] = np.nan, np.nan
    c["degc_per_count"][:channels] = layout.degc_per_count
    c["degc_at_zero"][:channels] = layout.degc_at_zero
    return rows


@kernel
def convert_increments(frame: np.void, c: np.void, out: np.void) -> None:
    """Copy the increments of a frame and flag those at the limit of their width."""
    out["interval_ns"], out["flags"] = c["interval_ns"], 0
    for axis in range(3):
        gyro, accelerometer = frame["gyro"][axis], frame["accelerometer"][axis]
        out["gyro"][axis], out["accelerometer"][axis] = gyro, accelerometer
        if max(abs(np.int64(gyro)), abs(np.int64(accelerometer))) >= c["pulse_limit"]:
            out["flags"] |= _SATURATED


@kernel
def convert_totals(frame: np.void, steps: int, c: np.void, latest: np.void, out: np.void) -> bool:
    """Subtract the latest totals from those of a frame, `steps` intervals later, and replace them by these.

    Where they are not known, or too old, the frame only is a reference for the next one: `out` stays as it
    is, and the result is False.
    """
    interval_ns = steps * c["interval_ns"]
    usable: bool = latest["known"] and interval_ns <= MAX_INTERVAL_NS
    if usable:
        bits = c["pulse_bits"]
        gyro_sure = _subtract(frame["gyro"], latest["gyro"], latest["gyro_rate"], steps, bits, out["gyro"])
        accelerometer_sure = _subtract(
            frame["accelerometer"],
            latest["accelerometer"],
            latest["accelerometer_rate"],
            steps,
            bits,
            out["accelerometer"],
        )
        out["interval_ns"] = interval_ns
        out["flags"] = _LONG_INTERVAL if steps > 1 else 0
        if not (gyro_sure and accelerometer_sure):
            out["flags"] |= _SATURATED
    for axis in range(3):
        latest["gyro"][axis] = frame["gyro"][axis]
        latest["accelerometer"][axis] = frame["accelerometer"][axis]
    latest["known"] = True
    return usable


@kernel
def _subtract(total: Array, latest: Array, rate: Array, steps: int, bits: int, out: Array) -> bool:
    """Set the pulses of one sensor, and their rate; return whether they are unambiguous."""
    sure = True
    for axis in range(3):
        # Across a gap totals may wrap more than once, unless the rate before it was well within their width.
        if steps > 1 and abs(rate[axis]) * steps >= np.int64(1) << (bits - 2):
            sure = False
        out[axis] = ahead_of(np.int64(total[axis]), latest[axis], bits)
        rate[axis] = out[axis] // steps
    return sure


@kernel
def convert_status(frame: np.void, c: np.void, out: np.void) -> None:
    """Copy arrival and status, convert temperatures, and add the flags that the status word gives."""
    out["arrival_ns"], out["status"] = frame["t_ns"], frame["status"]
    for k in range(MAX_TEMPERATURES):
        counts = frame["temperature"][k]
        if counts == NO_TEMPERATURE:
            out["temperature_degc"][k] = np.nan
        else:
            out["temperature_degc"][k] = c["degc_per_count"][k] * counts + c["degc_at_zero"][k]
    status = np.int64(frame["status"])
    if status & c["fault"]:
        out["flags"] |= _FAULT
    if status & c["saturated"]:
        out["flags"] |= _SATURATED
    if status & c["warm_up"]:
        out["flags"] |= _WARM_UP
    if out["flags"] & (_FAULT | _SATURATED) == 0:
        out["flags"] |= _VALID
