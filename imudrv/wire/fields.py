"""Bytes of one message to the numbers of one FRAME record, driven by the profile's field table.

Every kernel may read three bytes past the end of the message: buffers keep `SLACK` spare bytes.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import Records
from imudrv.wire.check import compute
from imudrv.wire.layout import ACCELEROMETER, COUNTER, GYRO, STATUS, TEMPERATURE, CheckKind

Bytes = NDArray[np.uint8]

SLACK: Final = 4
"""Spare bytes after the last message of a buffer: a number is read as four bytes whatever its width."""


@kernel
def read(data: Bytes, p: int, bits: int, signed: bool, big_endian: bool) -> int:
    """Read the number of `bits` (8, 16, 24, 32) at `p`, as int64."""
    four = data[np.uint64(p) : np.uint64(p + 4)]
    b0, b1, b2, b3 = np.int64(four[0]), np.int64(four[1]), np.int64(four[2]), np.int64(four[3])
    if big_endian:
        word = (b0 << 24 | b1 << 16 | b2 << 8 | b3) >> (32 - bits)
    else:
        word = b0 | b1 << 8 | b2 << 16 | b3 << 24
    spare = 64 - bits
    if signed:
        return int((word << spare) >> spare)
    return int(word & ((np.int64(1) << bits) - 1))


@kernel
def ahead_of(counter: int | np.int64, other: int | np.int64, bits: int) -> int:
    """By how much the low `bits` of `counter` are ahead of those of `other`, as a signed number of `bits`."""
    return int((counter - other) << (64 - bits) >> (64 - bits))


@kernel
def check_holds(data: Bytes, p: int, kind: np.void) -> bool:
    """Whether the message at `p` carries the check value of its bytes."""
    check = kind["check"]
    carried = read(data, p + check["offset"], check["width"], False, kind["big_endian"])
    # Computed even where there is none: a branch around it would count references to the arrays.
    return bool((carried == compute(data, p, check)) | (check["kind"] == CheckKind.NONE))


@kernel
def fill(data: Bytes, p: int, kind: np.void, fields: Records, frame: np.void) -> None:
    """Read every field of the message at `p` into `frame`; other members keep their values."""
    big_endian = kind["big_endian"]
    # Unsigned indices spare numba's test for negative ones.
    for f in range(np.uint64(kind["first_field"]), np.uint64(kind["end_field"])):
        field = fields[f]
        target = field["target"]
        value = read(data, p + field["offset"], field["bits"], field["signed"], big_endian)
        if target == COUNTER:
            frame["counter"] = value
        elif target < ACCELEROMETER:
            frame["gyro"][np.uint64(target - GYRO)] = np.int32(value)
        elif target < STATUS:
            frame["accelerometer"][np.uint64(target - ACCELEROMETER)] = np.int32(value)
        elif target == STATUS:
            frame["status"] = np.uint32(value)
        else:
            frame["temperature"][np.uint64(target - TEMPERATURE)] = np.int32(value)
