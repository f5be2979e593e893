"""Bytes of one message to the numbers of one FRAME record, driven by the profile's field table.

Every kernel may read seven bytes past the end of the message: buffers keep `SLACK` spare bytes.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import MAX_TEMPERATURES, Records
from imudrv.wire.check import compute, compute_plain
from imudrv.wire.layout import ACCELEROMETER, GYRO, SEQUENCE, STATUS, TEMPERATURE

Bytes = NDArray[np.uint8]

SLACK: Final = 8
"""Spare bytes after the last message of a buffer: a number is read as four or eight bytes."""
_BLOCK: Final = 64


@kernel
def short_number(data: Bytes, p: int, bits: int, signed: bool, big_endian: bool) -> int:
    """Read the number of `bits` (8, 16, 24, 32) at `p`, as int64."""
    # Each by its own unsigned index: a slice would cost more than the bytes.
    q, one, two, three = np.uint64(p), np.uint64(1), np.uint64(2), np.uint64(3)
    b0, b1 = np.int64(data[q]), np.int64(data[q + one])
    b2, b3 = np.int64(data[q + two]), np.int64(data[q + three])
    if big_endian:
        word = (b0 << 24 | b1 << 16 | b2 << 8 | b3) >> (32 - bits)
    else:
        word = b0 | b1 << 8 | b2 << 16 | b3 << 24
    spare = 64 - bits
    if signed:
        return int((word << spare) >> spare)
    return int(word & ((np.int64(1) << bits) - 1))


@kernel
def word(data: Bytes, p: int, size: int, big_endian: bool) -> int:
    """Read the word of `size` bytes (1 to 8) at `p`, as int64; those of 8 bytes keep their bits."""
    if size <= 4:
        return short_number(data, p, 8 * size, False, big_endian)
    value = 0
    for k in range(size):
        value = value << 8 | int(data[np.uint64(p + (k if big_endian else size - 1 - k))])
    return int(value)


@kernel
def number(data: Bytes, p: int, field: np.void) -> int:
    """Read a field of the message at `p`, as it is on the wire; a floating-point number as its bits."""
    value = word(data, p + field["offset"], field["size"], field["big_endian"])
    spare = 64 - field["bits"]
    if field["signed"]:
        return int(value << (spare - field["shift"]) >> spare)
    return int(value >> field["shift"] & ~(np.int64(-1) << (64 - spare)) if spare else value)


@kernel
def real(bits: int, size: int) -> float:
    """Return the floating-point number of 4 or 8 bytes with these bits."""
    if size == 4:
        return float(np.uint32(bits).view(np.float32))
    return float(np.int64(bits).view(np.float64))


@kernel
def ahead_of(counter: int | np.int64, other: int | np.int64, bits: int) -> int:
    """By how much the low `bits` of `counter` are ahead of those of `other`, as a signed number of `bits`."""
    return int((counter - other) << (64 - bits) >> (64 - bits))


@kernel
def plain_check_holds(data: Bytes, p: int, kind: np.void) -> bool:
    """Whether the message at `p` carries the value of its plain check, if it has one."""
    check = kind["plain_check"]
    carried = short_number(data, p + check["offset"], check["width"], False, check["big_endian"])
    # Computed even where there is none: a branch around it would count references to the arrays.
    return bool((carried == compute_plain(data, p, check)) | (check["kind"] == 0))


@kernel
def checks_hold(data: Bytes, p: int, kind: np.void, checks: Records) -> bool:
    """Whether the message at `p` carries the values of all its checks."""
    if not plain_check_holds(data, p, kind):
        return False
    for c in range(np.uint64(kind["first_check"]), np.uint64(kind["end_check"])):
        check = checks[c]
        if word(data, p + check["offset"], check["size"], check["big_endian"]) != compute(data, p, check):
            return False
    return True


@kernel
def fill(data: Bytes, p: int, kind: np.void, fields: Records, multiplexed: Records, frame: np.void) -> None:
    """Read every field of the message at `p` into `frame`; other members keep their values."""
    # Unsigned indices spare numba's test for negative ones.
    for f in range(np.uint64(kind["first_field"]), np.uint64(kind["end_plain"])):
        field = fields[f]
        at, is_big = p + field["offset"], field["big_endian"]
        _put(short_number(data, at, field["bits"], field["signed"], is_big), field["target"], frame)
    for f in range(np.uint64(kind["end_plain"]), np.uint64(kind["end_field"])):
        _fill_field(data, p, fields[f], frame)
    for f in range(np.uint64(kind["first_multiplexed"]), np.uint64(kind["end_multiplexed"])):
        some = multiplexed[f]
        selected = number(data, p, some["selector"])
        if (selected % some["modulo"] if some["modulo"] else selected) == some["value"]:
            _fill_field(data, p, some["field"], frame)


@kernel
def fill_all(data: Bytes, begin: int, kind: np.void, fields: Records, frames: Records) -> None:
    """Read the fields of many messages of one kind without multiplexed ones.

    The message of a frame is at `frame["offset"] - begin`. Field by field takes half the time of message by
    message, in blocks that the cache holds.
    """
    for first in range(0, len(frames), _BLOCK):
        block = frames[first : first + _BLOCK]
        for f in range(np.uint64(kind["first_field"]), np.uint64(kind["end_plain"])):
            _fill_plain(data, begin, fields[f], block)
        for f in range(np.uint64(kind["end_plain"]), np.uint64(kind["end_field"])):
            for i in range(len(block)):
                _fill_field(data, block[i]["offset"] - begin, fields[f], block[i])


@kernel
def _fill_plain(data: Bytes, begin: int, field: np.void, frames: Records) -> None:
    offset, bits, target = field["offset"] - begin, field["bits"], field["target"]
    signed, is_big = field["signed"], field["big_endian"]
    for i in range(len(frames)):
        frame = frames[np.uint64(i)]
        _put(short_number(data, frame["offset"] + offset, bits, signed, is_big), target, frame)


@kernel
def hold(frame: np.void, latest: np.void) -> None:
    """Keep status and temperatures for the next frame, which may come without them."""
    latest["status"] = frame["status"]
    for channel in range(MAX_TEMPERATURES):
        latest["temperature"][channel] = frame["temperature"][channel]


@kernel
def _fill_field(data: Bytes, p: int, field: np.void, frame: np.void) -> None:
    target = field["target"]
    value = number(data, p, field)
    if field["is_float"]:
        x = real(value, field["size"])
        if target == SEQUENCE:
            value = _ticks(x * field["ticks"])
        elif target >= TEMPERATURE:
            frame["temperature"][np.uint64(target - TEMPERATURE)] = x
            return
        else:
            value = int(np.float64(field["sign"] * (x - field["zero"])).view(np.int64))
    else:
        value = field["sign"] * (value - field["zero"])
    if target == STATUS:
        mask = ~(np.int64(-1) << field["bits"]) << field["place"]
        value = int(frame["status"] & ~mask | value << field["place"])
    _put(value, target, frame)


@kernel
def _put(value: int, target: int, frame: np.void) -> None:
    """Set a number of a frame."""
    if target == SEQUENCE:
        frame["counter"] = value
    elif target < ACCELEROMETER:
        frame["gyro"][np.uint64(target - GYRO)] = value
    elif target < STATUS:
        frame["accelerometer"][np.uint64(target - ACCELEROMETER)] = value
    elif target == STATUS:
        frame["status"] = np.uint32(value)
    else:
        frame["temperature"][np.uint64(target - TEMPERATURE)] = value


@kernel
def _ticks(x: float) -> int:
    """Round a time to whole ticks; a message may hold any number, infinity and NaN among them."""
    return int(np.int64(np.rint(x))) if abs(x) < 2.0**62 else 0
