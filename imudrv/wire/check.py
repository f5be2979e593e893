"""CRC and sums of a message, any width up to 32 bits, eight bytes a step.

The register of an unreflected CRC is kept at the top of 32 bits, that of a reflected one at the bottom, so
that one loop serves every width. Tables by the slicing method (Kounavis and Berry, "Novel table lookup-based
algorithms for high-performance CRC generation", IEEE Trans. Computers 57(11), 2008).
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.wire.layout import Check, CheckKind

CHECK: Final = np.dtype(
    [
        ("kind", np.int64),  # CheckKind
        ("width", np.int64),
        ("start", np.int64),
        ("stop", np.int64),
        ("offset", np.int64),
        ("init", np.int64),  # register before the first byte
        ("xor_out", np.int64),
        ("crc_table", np.uint32, (8, 256)),
    ],
    align=True,
)
"""A `Check` as the kernels read it."""


def check_table(check: Check) -> np.void:
    """Put a check into the form that the kernels read.

    Parameters
    ----------
    check : Check
        The check of a message.

    Returns
    -------
    void of CHECK
    """
    table: np.void = np.zeros(1, CHECK)[0]
    table["kind"], table["width"], table["offset"] = check.kind, check.width, check.offset
    table["start"], table["stop"] = check.start, check.stop
    table["init"], table["xor_out"] = _start_value(check), check.xor_out
    table["crc_table"] = _crc_table(check)
    return table


def _crc_table(check: Check) -> NDArray[np.uint32]:
    """Return `table[k, b]`: effect of byte `b` followed by `k` zero bytes. Zeros where there is no CRC."""
    table = np.zeros((8, 256), np.uint32)
    if check.kind not in (CheckKind.CRC, CheckKind.CRC_REFLECTED):
        return table
    reflected = check.kind is CheckKind.CRC_REFLECTED
    if reflected:
        polynomial = _reflect(check.polynomial, check.width)
    else:
        polynomial = check.polynomial << (32 - check.width)
    for byte in range(256):
        register = byte if reflected else byte << 24
        for _ in range(8):
            if reflected:
                register = (register >> 1) ^ (polynomial if register & 1 else 0)
            else:
                register = ((register << 1) & 0xFFFFFFFF) ^ (polynomial if register >> 31 else 0)
        table[0, byte] = register
    for k in range(1, 8):
        previous = table[k - 1]
        if reflected:
            table[k] = (previous >> np.uint32(8)) ^ table[0, previous & np.uint32(0xFF)]
        else:
            table[k] = (previous << np.uint32(8)) ^ table[0, previous >> np.uint32(24)]
    return table


def _start_value(check: Check) -> int:
    """Register before the first byte of the message: the initial value after the prefix."""
    if check.kind in (CheckKind.NONE, CheckKind.SUM):
        return check.init + sum(check.prefix)
    reflected = check.kind is CheckKind.CRC_REFLECTED
    table = _crc_table(check)[0]
    register = _reflect(check.init, check.width) if reflected else check.init << (32 - check.width)
    for byte in check.prefix:
        if reflected:
            register = (register >> 8) ^ int(table[(register ^ byte) & 0xFF])
        else:
            register = ((register << 8) & 0xFFFFFFFF) ^ int(table[(register >> 24) ^ byte])
    return register


def _reflect(value: int, width: int) -> int:
    return int(f"{value:0{width}b}"[::-1], 2)


@kernel
def compute(data: NDArray[np.uint8], position: int, check: np.void) -> int:
    """Compute the check value of the message at `position` of `data`; see `imudrv.wire.layout.Check`."""
    kind, width, table = check["kind"], check["width"], check["crc_table"]
    # How far the register is shifted right for its byte that meets byte 0, 1, 2, 3 of the message.
    s0, s1, s2, s3 = (0, 8, 16, 24) if kind == CheckKind.CRC_REFLECTED else (24, 16, 8, 0)
    register = np.uint32(check["init"])
    # Unsigned positions spare numba's test for a negative index at every byte: twice as fast. Loops one after
    # the other, none in a branch, spare the counting of references to the arrays.
    p, stop = np.uint64(position + check["start"]), np.uint64(position + check["stop"])
    one, step = np.uint64(1), np.uint64(8)
    while kind == CheckKind.SUM and p < stop:
        register = np.uint32(register + data[p])
        p += one
    while p + step <= stop:
        w = data[p : p + step]
        register = np.uint32(
            table[7, w[0] ^ (register >> s0 & 0xFF)]
            ^ table[6, w[1] ^ (register >> s1 & 0xFF)]
            ^ table[5, w[2] ^ (register >> s2 & 0xFF)]
            ^ table[4, w[3] ^ (register >> s3 & 0xFF)]
            ^ (table[3, w[4]] ^ table[2, w[5]] ^ table[1, w[6]] ^ table[0, w[7]])
        )
        p += step
    while p < stop:
        met = table[0, data[p] ^ (register >> s0 & 0xFF)]
        register = np.uint32((register << 8 if s0 else register >> 8) ^ met)
        p += one
    if kind == CheckKind.CRC:
        register = np.uint32(register >> (32 - width))
    return int((np.int64(register) ^ check["xor_out"]) & ((np.int64(1) << width) - 1))
