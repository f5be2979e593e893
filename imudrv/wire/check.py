"""Checks of a message: CRC, sums, XOR, Fletcher, any width up to 32 bits; a CRC eight bytes a step.

The register of an unreflected CRC is kept at the top of 32 bits, that of a reflected one at the bottom, so
that one loop serves every width. Tables by the slicing method (Kounavis and Berry, "Novel table lookup-based
algorithms for high-performance CRC generation", IEEE Trans. Computers 57(11), 2008). Fletcher's check is two
running sums (J. G. Fletcher, "An arithmetic checksum for serial transmissions", IEEE Trans. Communications
30(1), 1982), the first one in the upper half of the value.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.wire.layout import MAX_AROUND, MAX_RANGES, Check, CheckKind

CHECK: Final = np.dtype(
    [
        ("kind", np.int64),  # CheckKind
        ("width", np.int64),
        ("size", np.int64),  # bytes of the value
        ("offset", np.int64),
        ("big_endian", np.bool_),
        ("ranges", np.int64),  # number of
        ("start", np.int64, MAX_RANGES),
        ("stop", np.int64, MAX_RANGES),
        ("init", np.int64),  # register before the first byte
        ("second", np.int64),  # the second one of Fletcher's check
        ("xor_out", np.int64),
        ("word", np.int64),
        ("modulo", np.int64),
        ("negated", np.bool_),
        ("after", np.int64),  # bytes of the suffix
        ("suffix", np.uint8, MAX_AROUND),
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
    for name in ("kind", "width", "size", "offset", "big_endian", "xor_out", "word", "negated"):
        table[name] = getattr(check, name)
    sums = check.width // 2 if check.kind is CheckKind.FLETCHER else check.width
    table["modulo"] = check.modulo or 1 << sums
    table["ranges"] = len(check.ranges)
    for k, (start, stop) in enumerate(check.ranges):
        table["start"][k], table["stop"][k] = start, stop
    table["after"] = len(check.suffix)
    table["suffix"][: len(check.suffix)] = list(check.suffix)
    table["crc_table"] = _crc_table(check)
    table["init"] = _register(check)
    if check.prefix:  # else no kernel need be loaded
        prefix = np.array(list(check.prefix), np.uint8)
        table["init"], table["second"] = _absorb(prefix, 0, prefix.size, table, table["init"], 0)
    return table


def _register(check: Check) -> int:
    """Return the initial value as the register holds it."""
    if check.kind is CheckKind.CRC:
        return check.init << (32 - check.width)
    return _reflect(check.init, check.width) if check.kind is CheckKind.CRC_REFLECTED else check.init


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


def _reflect(value: int, width: int) -> int:
    return int(f"{value:0{width}b}"[::-1], 2)


@kernel
def compute_plain(data: NDArray[np.uint8], position: int, check: np.void) -> int:
    """Compute the value of a plain check, or something if there is none.

    A branch around it, or a loop over ranges, would count references to the arrays: a fifth of the decoding.
    """
    start, stop = position + check["start"][0], position + check["stop"][0]
    value = _absorb_bytes(data, start, stop, check, check["init"])
    if check["kind"] == CheckKind.CRC:
        value >>= 32 - check["width"]
    return int((value ^ check["xor_out"]) & ((np.int64(1) << check["width"]) - 1))


@kernel
def compute(data: NDArray[np.uint8], position: int, check: np.void) -> int:
    """Compute the check value of the message at `position` of `data`; see `imudrv.wire.layout.Check`."""
    kind, width = check["kind"], check["width"]
    first, second = check["init"], check["second"]
    for k in range(np.uint64(check["ranges"])):
        start, stop = position + check["start"][k], position + check["stop"][k]
        first, second = _absorb(data, start, stop, check, first, second)
    if check["after"]:
        first, second = _absorb(check["suffix"], 0, check["after"], check, first, second)
    if kind == CheckKind.CRC:
        value = first >> (32 - width)
    elif kind == CheckKind.CRC_REFLECTED or kind == CheckKind.XOR:
        value = first
    elif kind == CheckKind.FLETCHER:
        value = first % check["modulo"] << (width // 2) | second % check["modulo"]
    else:
        value = first % check["modulo"]
    if check["negated"]:
        value = -value
    return int((value ^ check["xor_out"]) & ((np.int64(1) << width) - 1))


@kernel
def _absorb(
    data: NDArray[np.uint8], start: int, stop: int, check: np.void, first: int, second: int
) -> tuple[int, int]:
    """Add bytes to the registers of any check; sums are reduced at the end only."""
    kind, big_endian = check["kind"], check["big_endian"]
    a, b = int(first), int(second)
    if kind == CheckKind.XOR:
        for k in range(np.uint64(start), np.uint64(stop)):
            a ^= int(data[k])
        return a, b
    if kind >= CheckKind.CRC or (kind == CheckKind.SUM and check["word"] == 1):
        return _absorb_bytes(data, start, stop, check, a), b
    for at in range(start, stop, check["word"]):
        p = np.uint64(at)
        number = int(data[p])
        if check["word"] == 2:
            other = int(data[p + np.uint64(1)])
            number = number << 8 | other if big_endian else other << 8 | number
        a += number
        b += a
    return a, b


@kernel
def _absorb_bytes(data: NDArray[np.uint8], start: int, end: int, check: np.void, first: int) -> int:
    """Add bytes to the register of a CRC or of a sum of bytes."""
    kind, table = check["kind"], check["crc_table"]
    # How far the register is shifted right for its byte that meets byte 0, 1, 2, 3 of the message.
    s0, s1, s2, s3 = (0, 8, 16, 24) if kind == CheckKind.CRC_REFLECTED else (24, 16, 8, 0)
    register = np.uint32(first)
    # Unsigned positions spare numba's test for a negative index at every byte: twice as fast. Loops one after
    # the other, none in a branch, spare the counting of references to the arrays.
    p, stop = np.uint64(start), np.uint64(end)
    one, two, three, four = np.uint64(1), np.uint64(2), np.uint64(3), np.uint64(4)
    five, six, seven, step = np.uint64(5), np.uint64(6), np.uint64(7), np.uint64(8)
    while kind == CheckKind.SUM and p < stop:
        register = np.uint32(register + data[p])
        p += one
    while p + step <= stop:
        # What does not depend on the register comes first: it is ready before that.
        register = np.uint32(
            table[3, data[p + four]]
            ^ table[2, data[p + five]]
            ^ table[1, data[p + six]]
            ^ table[0, data[p + seven]]
            ^ table[4, data[p + three] ^ (register >> s3 & 0xFF)]
            ^ table[5, data[p + two] ^ (register >> s2 & 0xFF)]
            ^ table[6, data[p + one] ^ (register >> s1 & 0xFF)]
            ^ table[7, data[p] ^ (register >> s0 & 0xFF)]
        )
        p += step
    while p < stop:
        met = table[0, data[p] ^ (register >> s0 & 0xFF)]
        register = np.uint32((register << 8 if s0 else register >> 8) ^ met)
        p += one
    return int(register)
