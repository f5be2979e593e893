"""Record arrays of samples, time along the first axis: one row live, millions offline.

    bytes -> FRAME -> PULSES -> INCREMENTS

A name without a frame in it is on the sensors' own axes; ``dtheta_b`` and ``dv_b`` are in body axes.
"""

from enum import IntEnum, IntFlag
from struct import Struct
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Records: TypeAlias = NDArray[np.void]

MAX_TEMPERATURES: Final = 6
"""Largest number of temperature channels of a profile."""

EXTENDED: Final = 1 << 31
"""Bit of an identifier of 29 bits, as in SocketCAN: 150 of 11 bits and 00000150 are two identifiers."""

MESSAGE: Final = np.dtype(
    [
        ("t_ns", np.int64),  # arrival, host clock; from a log: its own time
        ("id", np.uint32),  # with `EXTENDED` if it has 29 bits
        ("length", np.uint8),  # of the data, bytes
        ("fd", np.uint8),  # 1: CAN FD
        ("data", np.uint8, 64),  # zeros after the length
    ],
    align=True,
)
"""One CAN message."""

MESSAGE_ROW: Final = Struct("=qIBB64s2x")
"""A row of `MESSAGE`, its data padded with zeros: packing one is faster than filling an array."""

FRAME: Final = np.dtype(
    [
        ("counter", np.int64),  # as on the wire: modulo 2^bits, or a time in ticks
        ("offset", np.int64),  # of the first byte in the stream (CAN: index of the completing message)
        ("t_ns", np.int64),  # arrival of the bytes that completed the frame, host clock; 0: not known
        ("gyro", np.int64, 3),  # counts, or the bits of a float64; totals modulo 2^bits
        ("accelerometer", np.int64, 3),
        ("temperature", np.float32, MAX_TEMPERATURES),  # counts; NaN: nothing was received
        ("status", np.uint32),
        ("damaged", np.int32),  # frames' worth of rejected bytes since the frame before
        ("torn", np.int32),  # samples given up since the frame before of which some messages came
    ],
    align=True,
)
"""One valid frame as received."""


def samples_type(*, gyro_pulses: bool, accelerometer_pulses: bool) -> np.dtype[np.void]:
    """Type of samples whose losses are accounted for: pulses, or increments in rad and m/s.

    Parameters
    ----------
    gyro_pulses, accelerometer_pulses : bool
        Whether the unit sends whole pulses; otherwise increments in SI units, NaN for an axis that it lacks.

    Returns
    -------
    dtype
    """
    return np.dtype(
        [
            ("counter", np.int64),  # of the unit, unwrapped; otherwise the number of the sample, from 0
            ("arrival_ns", np.int64),  # host clock
            ("elapsed_ns", np.int64),  # end of the interval by the counter, since the start of the first one
            ("interval_ns", np.int64),  # covered by the increments
            ("gyro", np.int64 if gyro_pulses else np.float64, 3),
            ("accelerometer", np.int64 if accelerometer_pulses else np.float64, 3),
            ("temperature_degc", np.float64, MAX_TEMPERATURES),  # NaN: unknown
            ("status", np.uint32),
            ("flags", np.uint32),
        ],
        align=True,
    )


PULSES: Final = samples_type(gyro_pulses=True, accelerometer_pulses=True)
"""One sample of pulse increments, its losses accounted for.

Kernels read and write samples of any unit as PULSES, increments in SI units as the bits of a float64, so that
they are compiled once.
"""

INCREMENTS: Final = np.dtype(
    [
        ("counter", np.int64),  # counts by one a sample
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
    ERROR_FRAME = 8


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


class Reads(NamedTuple):
    """Reads of a port, one after the other, with the same timebase.

    Parameters
    ----------
    data : ndarray of uint8 or of MESSAGE
        Wire bytes, or CAN messages, of all reads.
    ends : ndarray of int64, shape (n,)
        Where each read ends in the data.
    times : ndarray of int64, shape (n,)
        Time of each read, host clock, ns.
    timebase : Timebase
        Relation of the times to UNIX time.
    """

    data: NDArray[Any]
    ends: NDArray[np.int64]
    times: NDArray[np.int64]
    timebase: Timebase

    @property
    def size(self) -> int:
        """Size of the data, bytes."""
        return self.data.nbytes


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

    @property
    def size(self) -> int:
        """Size of the data, bytes."""
        return len(self.data) if isinstance(self.data, bytes) else self.data.nbytes

    @property
    def block(self) -> Reads:
        """The read as a block of one."""
        ends, times = np.array([[len(self.data)], [self.t_ns]], np.int64)
        return Reads(as_array(self.data), ends, times, self.timebase)


def as_array(data: bytes | Records) -> NDArray[Any]:
    """Return wire bytes as an array of uint8, without a copy, and CAN messages as they are."""
    return np.frombuffer(data, np.uint8) if isinstance(data, bytes) else data
