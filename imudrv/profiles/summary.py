"""What a profile says, in a few lines: for its author to compare with the vendor's table."""

from collections.abc import Iterator
from itertools import groupby
from typing import Final

from imudrv.profiles.messages import Message, Number, SensorEntry
from imudrv.profiles.schema import Profile, SerialLine
from imudrv.records import EXTENDED
from imudrv.units import NS
from imudrv.wire.layout import SequenceKind

_VALUES: Final = {"increment": "increments", "total": "running totals", "rate": "rates"}


def summary(profile: Profile) -> Iterator[tuple[str, str]]:
    """Describe a profile.

    Parameters
    ----------
    profile : Profile
        The profile.

    Yields
    ------
    tuple of str
        Subject and description.
    """
    rate = str(profile.rate) if profile.rate.denominator > 1 else f"{profile.rate_hz:g}"
    yield "samples", f"{rate} per second"
    for message in profile.messages:
        yield "message", _message(message, is_can=profile.transport == "can")
    numbers = [n for message in profile.messages for n in message.fields]
    for name, entry in (("gyro", profile.gyro), ("accelerometer", profile.accelerometer)):
        yield name, _sensor(entry, [n for n in numbers if n.name == name]) if entry else "none"
    if sensors := [n.sensor or "" for n in numbers if n.name == "temperature"]:
        yield "temperature", ", ".join(sensors)
    if bits := sum(n.width for n in numbers if n.name == "status"):
        yield "status", f"{bits} bits, {len(profile.status_bits)} of them with a meaning"
    yield "sequence", _sequence(profile)


def line(profile: Profile) -> str:
    """Return the settings of the line, such as ``115200 baud 8N1``."""
    settings = profile.line
    if isinstance(settings, SerialLine):
        parity = settings.parity[0].upper()
        return f"{settings.baudrate} baud {settings.bytesize}{parity}{settings.stopbits}"
    fd = f", data {settings.data_bitrate} bit/s" if settings.data_bitrate else ""
    return f"{settings.bitrate} bit/s{fd}"


def _message(message: Message, *, is_can: bool) -> str:
    if not is_can:
        begin = f"sync {message.sync}"
    elif message.pgn is not None:
        begin = f"pgn {message.pgn:X}"
    else:
        identifier = message.can_id[0]
        digits = 8 if identifier & EXTENDED else 3
        begin = f"id {identifier & ~EXTENDED:0{digits}X}"
    checks = " and ".join(f"{check.kind} of {check.width} bits" for check in message.checks)
    words = [begin, f"{message.length} bytes", checks or "no check"]
    if not message.fields:
        words.append("skipped")
    elif message.every > 1:
        words.append(f"one in {message.every} samples")
    return ", ".join(words)


def _sensor(entry: SensorEntry, numbers: list[Number]) -> str:
    """Return what a sensor sends; of whole numbers up to which value."""
    numbers = sorted(numbers, key=lambda n: n.axis or "")
    unit = "pulses" if entry.unit == "pulse" else entry.unit
    words = []
    for (kind, largest), alike in groupby(numbers, lambda n: (_kind(n), _largest(n, entry))):
        axes = " ".join(f"{'-' if n.sign < 0 else ''}{n.axis}" for n in alike)
        limit = f" up to {largest:.6g} {unit}" if largest and entry.values != "total" else ""
        words.append(f"{axes} {kind}{limit}")
    return f"{_VALUES[entry.values]} in {unit}: {', '.join(words)}"


def _kind(n: Number) -> str:
    return n.type if n.bits is None else f"{n.width} bits of {n.type}"


def _largest(n: Number, entry: SensorEntry) -> float:
    """Return the largest value that a number can have, in the unit; 0 for a floating-point one."""
    if n.is_float:
        return 0.0
    highest = (1 << n.width - 1 if n.type[0] == "i" else 1 << n.width) - 1
    return (highest - n.zero) * (n.per_count or entry.per_count or 1.0)


def _sequence(profile: Profile) -> str:
    layout = profile.layout()
    sequence = layout.sequence
    if sequence.kind is SequenceKind.NONE:
        return "none: samples are numbered as they arrive"
    by_time = sequence.kind is SequenceKind.TIME
    numbers = [n for m in profile.messages for n in m.fields if n.name in ("counter", "time")]
    if any(n.is_float for n in numbers):
        return f"floating-point time in {numbers[0].unit}"
    unit = f" in {numbers[0].unit}" if by_time else ""
    anew_s = 2.0**sequence.bits / float(sequence.step) * float(layout.interval) * NS
    return (
        f"{'time' if by_time else 'counter'} of {sequence.bits} bits{unit}, "
        f"{float(sequence.step):g} a sample, begins anew every {_duration(anew_s)}"
    )


def _duration(seconds: float) -> str:
    for unit, length_s in (("years", 31_557_600.0), ("days", 86_400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2.0 * length_s:
            return f"{seconds / length_s:.3g} {unit}"
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{seconds * 1e3:.3g} ms"
