"""Bytes of one message to the numbers of one FRAME record, driven by the profile's field table.

Every kernel may read three bytes past the end of the message: buffers keep `SLACK` spare bytes.
"""

from typing import Final

import numpy as np

from imudrv.kernels import kernel
from imudrv.wire.check import KIND, OFFSET, WIDTH, compute

SLACK: Final = 4
"""Spare bytes behind the last message of a buffer: a number is read as four bytes whatever its width."""


@kernel
def read(data, p, bits, signed, big_endian):  # type: ignore[no-untyped-def]
    """Read the number of `bits` (8, 16, 24, 32) at `p`, as int64."""
    four = data[np.uint64(p) : np.uint64(p + 4)]
    b0, b1, b2, b3 = np.int64(four[0]), np.int64(four[1]), np.int64(four[2]), np.int64(four[3])
    if big_endian:
        word = (b0 << 24 | b1 << 16 | b2 << 8 | b3) >> (32 - bits)
    else:
        word = b0 | b1 << 8 | b2 << 16 | b3 << 24
    spare = 64 - bits
    if signed:
        return (word << spare) >> spare
    return word & ((np.int64(1) << bits) - 1)


@kernel
def ahead_of(counter, other, bits):  # type: ignore[no-untyped-def]
    """By how much the low `bits` of `counter` are ahead of those of `other`, as a signed number of `bits`."""
    return (counter - other) << (64 - bits) >> (64 - bits)


@kernel
def check_holds(data, p, big_endian, check, crc_table):  # type: ignore[no-untyped-def]
    """Whether the message at `p` carries the check value that its bytes give."""
    stands = read(data, p + check[OFFSET], check[WIDTH], False, big_endian)
    # Computed even where there is none: a branch around it would count references to the arrays.
    return (stands == compute(data, p, check, crc_table)) | (check[KIND] == 0)


@kernel
def fill(data, p, fields, big_endian, frame):  # type: ignore[no-untyped-def]
    """Read every field of the message at `p` into `frame`; other members stay as they are."""
    # Unsigned indices spare numba's test for negative ones.
    for f in range(np.uint64(fields.shape[0])):
        target, offset, bits, signed = fields[f, 0], fields[f, 1], fields[f, 2], fields[f, 3]
        value = read(data, p + offset, bits, signed != 0, big_endian)
        if target == 0:
            frame["counter"] = value
        elif target < 4:
            frame["gyro"][np.uint64(target - 1)] = np.int32(value)
        elif target < 7:
            frame["accelerometer"][np.uint64(target - 4)] = np.int32(value)
        elif target == 7:
            frame["status"] = np.uint32(value)
        else:
            frame["temperature"][np.uint64(target - 8)] = np.int32(value)
