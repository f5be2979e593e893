"""Record arrays of samples, time along the first axis: one row live, millions offline.

    bytes -> FRAME -> PULSES -> INCREMENTS

A name without a frame in it is on the sensors' own axes; ``dtheta_b`` and ``dv_b`` are in body axes.
"""

from enum import IntEnum, IntFlag
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Records: TypeAlias = NDArray[np.void]

MAX_TEMPERATURES: Final = 6
"""Largest number of temperature channels of a profile."""
NO_TEMPERATURE: Final = -(2**31)
"""Temperature counts of a channel from which nothing has been received."""

MESSAGE: Final = np.dtype(
    [
        ("t_ns", np.int64),  # arrival, host clock; from a log: its own time
        ("id", np.uint32),
        ("length", np.uint8),  # of the data, bytes
        ("fd", np.uint8),  # 1: CAN FD
        ("data", np.uint8, 64),  # zeros after the length
    ],
    align=True,
)
"""One CAN message."""

FRAME: Final = np.dtype(
    [
        ("counter", np.int64),  # as on the wire, modulo 2^bits
        ("offset", np.int64),  # of the first byte in the stream (CAN: index of the completing message)
        ("t_ns", np.int64),  # arrival of the bytes that completed the frame, host clock
        ("gyro", np.int32, 3),  # pulses, or running totals modulo 2^bits
        ("accelerometer", np.int32, 3),
        ("temperature", np.int32, MAX_TEMPERATURES),  # counts; the profile knows the unit
        ("status", np.uint32),
        ("damaged", np.int32),  # frames' worth of rejected bytes since the frame before
        ("torn", np.int32),  # CAN samples given up half-complete since the frame before
    ],
    align=True,
)
"""One valid frame as received."""

PULSES: Final = np.dtype(
    [
        ("counter", np.int64),  # unwrapped
        ("arrival_ns", np.int64),  # host clock
        ("elapsed_ns", np.int64),  # end of the interval by the counter, since the start of the first sample
        ("interval_ns", np.int64),  # covered by the pulses
        ("gyro", np.int64, 3),
        ("accelerometer", np.int64, 3),
        ("temperature_degc", np.float64, MAX_TEMPERATURES),  # NaN: unknown
        ("status", np.uint32),
        ("flags", np.uint32),
    ],
    align=True,
)
"""One sample of pulse increments, its losses accounted for."""

INCREMENTS: Final = np.dtype(
    [
        ("counter", np.int64),
        ("t_ns", np.int64),  # end of the interval
        ("interval_ns", np.int64),
        ("dtheta_b", np.float64, 3),  # rad
        ("dv_b", np.float64, 3),  # m/s
        ("flags", np.uint32),
    ],
    align=True,
)
"""One sample of compensated increments, body axes."""

REJECT: Final = np.dtype([("offset", np.int64), ("length", np.int64), ("reason", np.int64)])
"""A run of input that is not a frame."""


class Reason(IntEnum):
    """Why a run of input is not a frame."""

    NO_SYNC = 1
    CHECK_FAILED = 2
    UNFINISHED = 3
    WRONG_LENGTH = 4
    TORN = 5
    STALE = 6
    NOT_A_MESSAGE = 7


class Flag(IntFlag):
    """Flags of a sample, bit for bit those of the output datagram (ICD, section 7)."""

    VALID = 1 << 0
    MISSING_BEFORE = 1 << 1
    LONG_INTERVAL = 1 << 2
    SATURATED = 1 << 3
    FAULT = 1 << 4
    TEMPERATURE_RANGE = 1 << 5
    SIZE_EFFECT = 1 << 6
    CLOCK_UNLOCKED = 1 << 7
    WARM_UP = 1 << 8
    GAP_BY_HOST_TIME = 1 << 9
    GAP_LENGTH_UNKNOWN = 1 << 10
    CLOCK_STEPPED = 1 << 11


class Source(IntEnum):
    """Origin of the samples."""

    HARDWARE = 0
    REPLAY = 1
    SIMULATOR = 2


class Timebase(NamedTuple):
    """From times of arrival, which never step, to UNIX time, which the host's clock may set anew.

    Parameters
    ----------
    offset_ns : int
        UNIX time less time of arrival. It is 0 until the clock is first set while the process runs.
    slept_ns : int
        Total time for which the host was suspended; the times of arrival include it.
    """

    offset_ns: int = 0
    slept_ns: int = 0


class Arrival(NamedTuple):
    """Data of one read of a port.

    Parameters
    ----------
    t_ns : int
        Time of the read, host clock (`imudrv.hostclock`); in a replay the recorded time.
    data : bytes or ndarray of MESSAGE
        Wire bytes, or CAN messages each with its own `t_ns`; empty when the wait ended without any.
    timebase : Timebase
        Relation of the times to UNIX time at the read.
    """

    t_ns: int
    data: bytes | Records
    timebase: Timebase = Timebase()
