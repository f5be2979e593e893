"""Random valid profile files of every kind that the format can describe, from any source of randomness.

The fuzzer draws from numpy, the tests from hypothesis (`tests/profile_strategy.py`).
"""

from collections.abc import Sequence
from typing import Any, Final, Protocol, TypeAlias, TypeVar

T = TypeVar("T")
Mapping: TypeAlias = dict[str, Any]


class Source(Protocol):
    """Where the choices come from."""

    def pick(self, choices: Sequence[T], /) -> T:
        """Return one of the choices."""

    def integer(self, lowest: int, highest: int, /) -> int:
        """Return a whole number, ends included."""


RATES: Final = (1000, 100, 200.0, 2000, 400, 300, 600, 819.2, [4096, 5], [1000, 3])
UNITS: Final = {
    ("gyro", False): ("pulse", "rad", "deg", "arcsec"),
    ("gyro", True): ("rad/s", "deg/s", "deg/h"),
    ("accelerometer", False): ("pulse", "m/s", "g s"),
    ("accelerometer", True): ("m/s^2", "g"),
}
CAN_LENGTHS: Final = (*range(1, 9), 12, 16, 20, 24, 32, 48, 64)
ORDERS: Final = ("little", "big")
WHOLE: Final = (8, 16, 24, 32, 40, 48, 56, 64)
TICKS_PER_S: Final = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}


def profile(source: Source) -> Mapping:
    """Return the document of a random profile."""
    pick = source.pick
    is_can, is_fd = pick((False, False, True)), pick((False, True))
    room = 500 if not is_can else 64 if is_fd else 8
    rate = pick(RATES)
    document: Mapping = {
        "format": "imu50-profile",
        "version": 2,
        "name": "random",
        "transport": "can" if is_can else "serial",
        "line": {"baudrate": 921600},
        "sample_rate_hz": rate,
        "byte_order": pick(ORDERS),
    }
    if is_can:
        document["line"] = {"bitrate": 1_000_000} | ({"data_bitrate": 5_000_000} if is_fd else {})
    number_of = _sequence(source, rate, room)
    numbers: list[Mapping] = []
    for name in pick((("gyro", "accelerometer"), ("gyro", "accelerometer"), ("gyro",), ("accelerometer",))):
        document[name], axes = _sensor(source, name, room - _size(number_of))
        numbers += axes
    numbers += _extras(source, room - _size(number_of))
    messages = _messages(source, numbers, number_of, room, is_can)
    document["messages"] = [_finished(source, k, fields, room, is_can) for k, fields in enumerate(messages)]
    bits = sum(_width(n) for m in document["messages"] for n in m["fields"] if n["name"] == "status")
    if bits and pick((True, False)):
        document["status_bits"] = [
            {
                "bit": source.integer(0, bits - 1),
                "name": "a bit",
                "means": pick(("fault", "saturated", "warm_up", "nothing")),
                "when": pick(("set", "clear")),
            }
        ]
    return document


def _sequence(source: Source, rate: Any, room: int) -> Mapping | None:
    """Return the number of a sample: a counter, a time or nothing."""
    pick = source.pick
    kind = pick(("counter", "counter", "time", "none"))
    if kind == "none":
        return None
    if kind == "counter":
        counter = {"name": "counter"} | _whole(source, (8, 8, 16, 24, 32, 64) if room > 8 else (8, 16), "u")
        if pick((False, False, True)) and _width(counter) > 6:
            counter["step"] = pick((1, 2, 10))
        return counter
    rate_hz = rate[0] / rate[1] if isinstance(rate, list) else rate
    units = [
        unit
        for unit in ("ms", "us", "ns")
        if TICKS_PER_S[unit] / rate_hz in (1, 2) or TICKS_PER_S[unit] > 2 * rate_hz
    ]
    if room > 8 and pick((False, True)):
        return {"name": "time", "type": "f64", "unit": pick(("s", "ms"))}
    unit = pick(units)
    time: Mapping = {"name": "time", "type": f"u{pick((32, 40, 64) if room > 8 else (32,))}", "unit": unit}
    if pick((False, True)):
        time["step"] = TICKS_PER_S[unit] / rate_hz
    return time


def _sensor(source: Source, name: str, room: int) -> tuple[Mapping, list[Mapping]]:
    """Return the entry of a sensor, and its axes."""
    pick = source.pick
    values = pick(("increment", "total", "rate"))
    unit = pick(UNITS[name, values == "rate"])
    entry = {"values": values, "unit": unit}
    axes = []
    for axis in pick(("xyz", "xyz", "zyx", "xy", "z")):
        number: Mapping = {"name": name, "axis": axis}
        if unit != "pulse" and room >= 8 and pick((False, True)):
            number["type"] = pick(("f32", "f64"))
        else:
            sizes = [size for size in WHOLE if size <= 8 * room]
            number |= _whole(source, sizes, pick("iu"), fewest_bits=6)
            if number["type"][0] == "u" and values != "total":
                number["zero"] = source.integer(1, (1 << min(_width(number), 62)) - 1)
            elif pick((False, True)):
                number["zero"] = source.integer(-20, 20)
        if pick((False, True)):
            number["sign"] = -1
        if unit != "pulse" and pick((False, True)):
            number["per_count"] = pick((1e-6, 0.001, 2.0))
        axes.append(number)
    if unit != "pulse" and pick((False, True)):
        entry["per_count"] = pick((1e-6, 0.001, 2.0))
    return entry, axes


def _extras(source: Source, room: int) -> list[Mapping]:
    """Return status fields and temperatures."""
    pick = source.pick
    numbers = [
        {"name": "status"} | _whole(source, (8, 16) if room > 2 else (8,), "u")
        for _ in range(pick((0, 1, 2)))
    ]
    for sensor in pick(((), ("gyro",), ("electronics", "gyro_x"))):
        kind: Mapping = {"type": "f32"} if room >= 4 and pick((False, True)) else {"type": "i16"}
        numbers.append({"name": "temperature", "sensor": sensor, "degc_per_count": pick((0.01, 1.0))} | kind)
    return [n for n in numbers if _size(n) <= room]


def _whole(source: Source, sizes: Sequence[int], sign: str, fewest_bits: int = 3) -> Mapping:
    """Return the type of a whole number, possibly of some bits of its word, possibly with a byte order."""
    size = source.pick(sizes)
    number: Mapping = {"type": f"{sign}{size}"}
    if source.pick((False, False, True)):
        width = source.integer(fewest_bits, size)
        first = source.integer(0, size - width)
        number["bits"] = [first, first + width - 1]
    if source.pick((False, True)):
        number["byte_order"] = source.pick(ORDERS)
    return number


def _size(number: Mapping | None) -> int:
    return 0 if number is None else int(number["type"][1:]) // 8


def _width(number: Mapping) -> int:
    first, last = number.get("bits", (0, 8 * _size(number) - 1))
    return int(last - first + 1)


def _messages(
    source: Source, numbers: list[Mapping], number_of: Mapping | None, room: int, is_can: bool
) -> list[list[Mapping]]:
    """Distribute the numbers of a sample to messages; what is not of a sensor goes with one that is."""
    everywhere = is_can and source.pick((False, True))
    most = 32 if is_can else source.pick((32, 32, 3))
    messages: list[list[Mapping]] = []
    used = room + 1
    for number in numbers:
        starts_one = "axis" in number or not messages
        if used + _size(number) > room or (len(messages[-1]) >= most and starts_one):
            if not starts_one:
                continue
            has_sequence = number_of is not None and (everywhere or not messages)
            messages.append([dict(number_of)] if number_of is not None and has_sequence else [])
            used = _size(number_of) * has_sequence
        messages[-1].append(number)
        used += _size(number)
    return messages


def _finished(source: Source, k: int, fields: list[Mapping], room: int, is_can: bool) -> Mapping:
    """Return a message: places of its fields, what it begins with or its identifier, checks."""
    pick = source.pick
    message: Mapping = {}
    at = 0
    if is_can:
        message["id"] = pick((0x100, 0x18FF0000)) + k
    else:
        sync = bytes([0xA0 + k, *(pick((0xA0, 0xA1, 0x00)) for _ in range(source.integer(0, 3)))])
        message["sync"], at = sync.hex(" "), len(sync)
    spare = 0 if is_can else 2
    for number in fields:
        number["offset"] = at + source.integer(0, spare)
        at = number["offset"] + _size(number)
        turn = fields[0] if fields[0]["name"] == "counter" else None
        if number["name"] == "temperature" and turn and turn.get("step", 1) == 1 and pick((False, True)):
            where = {key: turn[key] for key in ("type", "bits", "byte_order") if key in turn}
            number["only_while"] = where | {"offset": turn["offset"], "modulo": 4, "equals": pick((0, 1, 3))}
    message["fields"] = fields
    checks = []
    for _ in range(pick((0, 1, 1, 2)) if room > 8 else 0):
        check = _check(source, at)
        if at + check["offset"] + 4 < room:
            check["offset"] += at
            checks.append(check)
            at = check["offset"] + (check["width"] + 7) // 8
    if checks:
        message["checks"] = pick((checks, checks[::-1]))
    message["length"] = next(n for n in CAN_LENGTHS if n >= at) if is_can else at + source.integer(0, 1)
    return message


def _check(source: Source, length: int) -> Mapping:
    """Return a check of some of the first bytes; its offset is still relative to their end."""
    pick, integer = source.pick, source.integer
    kind = pick(("crc", "crc", "sum", "xor", "fletcher"))
    width = integer(8, 32) if kind in ("crc", "sum") else pick((16, 32)) if kind == "fletcher" else 8
    word = 2 if (kind, width) == ("fletcher", 32) or (kind == "sum" and pick((False, True))) else 1
    middle = integer(1, max(1, length - 1))
    ranges = [(0, length - 1)] if pick((False, True)) else [(0, middle - 1), (middle, length - 1)]
    covers = [
        [first, last - (last - first + 1) % word]
        for first, last in ranges
        if last - (last - first + 1) % word > first - (word == 1)
    ]
    if not covers:
        kind, width, word, covers = "xor", 8, 1, [[0, length - 1]]
    check: Mapping = {"kind": kind, "width": width, "covers": covers, "offset": integer(0, 2)}
    top = (1 << width) - 1
    if word == 2:
        check["word"] = 2
    if kind == "crc":
        check |= {"polynomial": integer(1, top), "reflected": pick((False, True))}
    if kind in ("sum", "fletcher") and pick((False, True)):
        check["modulo"] = pick((255, 256)) if width < 32 else pick((65535, 255))
    if kind != "fletcher":
        check["init"] = integer(0, top)
        if pick((False, False, True)):
            check["complement"] = pick(("one", "two"))
    check["xor_out"] = pick((0, integer(0, top)))
    for name in ("prefix", "suffix"):
        if pick((False, False, True)):
            check[name] = pick(("50 26", "000102FF"))
    if pick((False, True)):
        check["byte_order"] = pick(ORDERS)
    return check
