"""Skeleton of a CAN profile from a DBC file: what its names and units say; all else becomes a comment."""

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

from imudrv.errors import InputError
from imudrv.files.atomic import content
from imudrv.profiles.messages import LOWEST_PDU2

FILL_IN: Final = "FILL IN"
"""Marks what the DBC does not say."""
_UNITS: Final = {
    ("gyro", "pulse"): ("increment", "pulse"),
    ("gyro", "rad/s"): ("rate", "rad/s"),
    ("gyro", "deg/s"): ("rate", "deg/s"),
    ("gyro", "dps"): ("rate", "deg/s"),
    ("gyro", "deg/h"): ("rate", "deg/h"),
    ("gyro", "rad"): ("increment", "rad"),
    ("gyro", "deg"): ("increment", "deg"),
    ("accelerometer", "pulse"): ("increment", "pulse"),
    ("accelerometer", "m/s^2"): ("rate", "m/s^2"),
    ("accelerometer", "m/s2"): ("rate", "m/s^2"),
    ("accelerometer", "g"): ("rate", "g"),
    ("accelerometer", "m/s"): ("increment", "m/s"),
}
_GUESS: Final = {"gyro": ("rate", "deg/s"), "accelerometer": ("rate", "m/s^2")}
_AXES: Final = {
    "x": "x", "y": "y", "z": "z",
    "roll": "x", "pitch": "y", "yaw": "z",
    "longitudinal": "x", "lateral": "y", "vertical": "z",
}  # fmt: skip
_SENSORS: Final = {
    "gyro": ("gyro", "gyroscope", "rate", "angular"),
    "accelerometer": ("acc", "accel", "acceleration", "accelerometer"),
}
_COUNTERS: Final = ("counter", "cnt", "seq", "sequence")
_STATUSES: Final = ("status", "flags")
_MS_PER_S: Final = 1000
_MAX_WORD: Final = 8
_WHOLE: Final = 1e-3
"""A scale in decimals has some rounding."""
_MAX_STATUS_BITS: Final = 32
_MAX_TEMPERATURES: Final = 6


class _Meaning(NamedTuple):
    """What a signal is taken for."""

    name: str
    axis: str = ""
    sensor: str = ""


class _Word(NamedTuple):
    """Bytes of a message that one or more signals share."""

    first: int
    last: int
    is_big: bool

    def overlaps(self, other: "_Word") -> bool:
        """Whether they have a byte in common."""
        return self.first <= other.last and other.first <= self.last

    def joined(self, other: "_Word") -> "_Word":
        """Return the bytes from the first to the last of both."""
        return _Word(min(self.first, other.first), max(self.last, other.last), self.is_big)


def skeleton(path: str | os.PathLike[str]) -> str:
    """Return a profile with the messages and signals of a DBC file that are sure to be an inertial unit's.

    Parameters
    ----------
    path : path-like
        The DBC file.

    Returns
    -------
    str
        Text of a profile file; what the DBC does not say is marked `FILL_IN`, other signals are comments.

    Raises
    ------
    InputError
        The package cantools is not installed, or the file is no DBC.
    """
    try:
        from cantools.database import load_string
        from cantools.database.can import Database
        from cantools.errors import Error
    except ImportError as error:
        raise InputError("from-dbc: expected the package cantools: pip install imu50[dbc]") from error
    text = content(path).decode("cp1252", errors="replace")
    try:
        # Not strict: of signals that overlap each other only those used here matter.
        database = load_string(text, "dbc", strict=False)
    except (Error, ValueError, LookupError, TypeError) as error:
        raise InputError(f"{path}: expected a DBC file: {error}") from error
    messages = database.messages if isinstance(database, Database) else []
    return "\n".join(_Skeleton(Path(path), messages).lines()) + "\n"


class _Skeleton:
    """Choice of the messages of a DBC, and their text."""

    def __init__(self, path: Path, messages: list[Any]) -> None:
        self._path = path
        self._messages = messages
        self._fields: dict[str, list[tuple[Any, _Meaning, _Word]]] = {}
        self._skipped: dict[str, str] = {}
        self._status_bits = self._temperatures = 0
        self._choose()
        chosen = [signal for fields in self._fields.values() for signal, _, _ in fields]
        self._is_big = 2 * sum(s.byte_order == "big_endian" for s in chosen) > len(chosen)
        cycles = [m.cycle_time for m in self._parts if m.cycle_time]
        self._cycle_ms = min(cycles, default=0)

    def _choose(self) -> None:
        """Choose the messages with axes, each axis once, and those of the same senders with the rest."""
        senders: set[str] = set()
        axes: set[_Meaning] = set()
        for message in self._messages:
            found = [m for s in message.signals if (m := _meaning(s)) is not None and m.axis]
            if not found:
                continue
            if axes.intersection(found):
                self._skipped[message.name] = "its axes are in another message, above; choose one of the two"
            elif any(m.is_fd != message.is_fd for m in self._parts):
                self._skipped[message.name] = "a profile is either of CAN or of CAN FD; choose one of them"
            else:
                axes.update(found)
                senders.update(message.senders)
                self._fields[message.name] = []
        for message in self._messages:
            if message.name in self._skipped:
                continue
            is_of_unit = message.name in self._fields or senders.intersection(message.senders)
            if is_of_unit and (fields := list(self._placed(message))):
                self._fields[message.name] = fields
            self._skipped.setdefault(message.name, "no signal of an inertial unit is recognised")

    @property
    def _parts(self) -> list[Any]:
        """Messages that every sample has."""
        return [
            message
            for message in self._messages
            if message.name in self._fields
            and any((_meaning(s) or _Meaning("")).axis for s in message.signals)
        ]

    def _placed(self, message: Any) -> Iterator[tuple[Any, _Meaning, _Word]]:
        """Yield the signals of a message that are fields, with the word that each is in."""
        wanted = []
        for signal in message.signals:
            meaning = _meaning(signal)
            if meaning is None or signal.is_multiplexer or signal.multiplexer_ids:
                continue
            if meaning.name in ("counter", "status") and signal.is_signed:
                continue
            if meaning.name == "status":
                if self._status_bits + signal.length > _MAX_STATUS_BITS:
                    continue
                self._status_bits += signal.length
            if meaning.name == "temperature":
                if self._temperatures == _MAX_TEMPERATURES:
                    continue
                self._temperatures += 1
            wanted.append((signal, meaning))
        words: list[_Word] = []
        for signal, _ in wanted:
            word = _word(signal)
            while meeting := next((w for w in words if w.overlaps(word)), None):
                words.remove(meeting)
                word = meeting.joined(word)
            words.append(word)
        for signal, meaning in wanted:
            word = next(w for w in words if w.overlaps(_word(signal)))
            if word.is_big == (signal.byte_order == "big_endian") and word.last - word.first < _MAX_WORD:
                yield signal, meaning, word

    def lines(self) -> Iterator[str]:
        """Yield the lines of the profile."""
        parts = self._parts
        is_fd = any(message.is_fd for message in parts)
        yield f"# Skeleton of a profile, made from {self._path.name!r}. Not tried on hardware."
        yield "# Look at every line, for signals were chosen by their names and units."
        yield f"# {FILL_IN} marks what the DBC does not say."
        yield "format: imu50-profile"
        yield "version: 2"
        yield f"name: {re.sub('[^A-Za-z0-9_.-]', '-', self._path.stem)[:64] or 'unit'}"
        yield "transport: can"
        data = ", data_bitrate: 2000000" if is_fd else ""
        yield f"line: {{bitrate: 500000{data}}}  # {FILL_IN}"
        if self._cycle_ms:
            yield f"sample_rate_hz: {_MS_PER_S / self._cycle_ms:g}  # from the cycle time"
        else:
            yield f"sample_rate_hz: 100  # {FILL_IN}"
        yield f"byte_order: {'big' if self._is_big else 'little'}"
        for name in ("gyro", "accelerometer"):
            yield from self._entry(name)
        yield "messages:" if self._fields else f"messages: []  # {FILL_IN}"
        for message in self._messages:
            if message.name in self._fields:
                yield from self._message_lines(message)
        for message in self._messages:
            if message.name not in self._fields:
                yield f"  # {message.name}, id 0x{message.frame_id:X}: {self._skipped[message.name]}."
                yield from (f"  #   {_signal_text(signal)}" for signal in message.signals)
        if self._status_bits:
            yield f"status_bits: []  # {FILL_IN}: bit, name, and means: fault, saturated, warm_up or nothing"

    def _of(self, name: str) -> list[Any]:
        return [s for fields in self._fields.values() for s, meaning, _ in fields if meaning.name == name]

    def _entry(self, name: str) -> Iterator[str]:
        signals = self._of(name)
        if not signals:
            yield f"# {name}: no signal of it is recognised; {FILL_IN} if the unit has any"
            return
        units = {_unit(signal) for signal in signals}
        values, unit = _UNITS.get((name, min(units)), _GUESS[name])
        scale = "" if unit == "pulse" else f", per_count: {abs(float(signals[0].scale))!r}"
        note = ""
        if len(units) > 1 or (name, min(units)) not in _UNITS:
            note = f"  # {FILL_IN} values and unit: the DBC says {', '.join(map(repr, sorted(units)))}"
        yield f"{name}: {{values: {values}, unit: {unit}{scale}}}{note}"

    def _message_lines(self, message: Any) -> Iterator[str]:
        group = message.frame_id >> 8 & 0x3FFFF
        if message.protocol == "j1939":
            group &= 0x3FFFF if group & 0xFFFF >= LOWEST_PDU2 else 0x3FF00
            yield f"  - pgn: 0x{group:X}  # {message.name}; of any source address"
        else:
            yield f"  - id: 0x{message.frame_id:X}  # {message.name}"
            if message.is_extended_frame and message.frame_id <= 0x7FF:
                yield "    extended: true"
        yield f"    length: {message.length}"
        if message not in self._parts:
            yield from self._every(message)
        yield "    fields:"
        fields = self._fields[message.name]
        for signal, meaning, word in fields:
            keys = ", ".join(self._keys(signal, meaning, word))
            yield f"      - {{{keys}}}  # {signal.name}{_offset_note(signal, meaning)}"
        used = [signal for signal, _, _ in fields]
        yield from (f"      # {_signal_text(signal)}" for signal in message.signals if signal not in used)

    def _every(self, message: Any) -> Iterator[str]:
        """How often a message comes that not every sample has."""
        if self._cycle_ms and message.cycle_time and message.cycle_time > self._cycle_ms:
            yield f"    every: {round(message.cycle_time / self._cycle_ms)}"
        else:
            yield f"    every: 10  # {FILL_IN}: it comes with every n-th sample"

    def _keys(self, signal: Any, meaning: _Meaning, word: _Word) -> Iterator[str]:
        size = word.last - word.first + 1
        letter = "f" if signal.is_float else "i" if signal.is_signed else "u"
        yield f"name: {meaning.name}"
        yield f"type: {letter}{8 * size}"
        yield f"offset: {word.first}"
        low = _lowest_bit(signal, word)
        if signal.length != 8 * size:
            yield f"bits: [{low}, {low + signal.length - 1}]"
        if size > 1 and word.is_big != self._is_big:
            yield f"byte_order: {'big' if word.is_big else 'little'}"
        if meaning.axis:
            yield f"axis: {meaning.axis}"
            yield from self._scale_keys(signal, meaning)
        if meaning.name == "temperature":
            yield f"sensor: {meaning.sensor}"
            yield f"degc_per_count: {float(signal.scale)!r}"
            if signal.offset:
                yield f"degc_at_zero: {float(signal.offset)!r}"

    def _scale_keys(self, signal: Any, meaning: _Meaning) -> Iterator[str]:
        scale, of_all = float(signal.scale), float(self._of(meaning.name)[0].scale)
        if abs(scale) != abs(of_all):
            yield f"per_count: {abs(scale)!r}"
        if scale < 0:
            yield "sign: -1"
        if zero := round(-float(signal.offset) / scale):
            yield f"zero: {zero}"


def _offset_note(signal: Any, meaning: _Meaning) -> str:
    """Say that an offset is no whole number of counts."""
    zero = -float(signal.offset) / float(signal.scale)
    if not meaning.axis or abs(zero - round(zero)) < _WHOLE:
        return ""
    return f"; {FILL_IN}: its offset of {signal.offset:g} is no whole number of counts"


def _words(name: str) -> list[str]:
    """Split the name of a signal, such as `GyroX`, `gyro_x` or `YAW_RATE2`, into its words."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def _meaning(signal: Any) -> _Meaning | None:
    """Return what a signal is, if its name and unit leave no doubt."""
    if not float(signal.scale):
        return None
    words = _words(signal.name)
    axes = {axis for word in words if (axis := _AXES.get(word))}
    axis = axes.pop() if len(axes) == 1 else ""
    sensors = [name for name, known in _SENSORS.items() if any(word in known for word in words)]
    sensor = sensors[0] if len(sensors) == 1 else ""
    if any(word.startswith("temp") for word in words):
        place = f"{sensor}_{axis}" if sensor and axis else sensor
        return _Meaning("temperature", sensor=place) if place and float(signal.scale) > 0 else None
    if sensor and axis and (not signal.unit or (sensor, _unit(signal)) in _UNITS):
        return _Meaning(sensor, axis)
    if any(word in _COUNTERS for word in words):
        return _Meaning("counter")
    return _Meaning("status") if any(word in _STATUSES for word in words) else None


def _unit(signal: Any) -> str:
    unit = (
        (signal.unit or "").strip().lower().replace("°", "deg").replace("²", "^2").replace("pulses", "pulse")
    )
    return unit.replace("sec", "s").replace("degrees", "deg").replace("degree", "deg")


def _signal_text(signal: Any) -> str:
    """Describe a signal that is no field."""
    kind = "float" if signal.is_float else "signed" if signal.is_signed else "unsigned"
    unit = f" of {signal.unit!r}" if signal.unit else ""
    order = signal.byte_order.replace("_", " ")
    text = (
        f"{signal.name}: {kind}, {signal.length} bits from bit {signal.start}, {order}, "
        f"scale {signal.scale:g}{unit}, offset {signal.offset:g}"
    )
    if signal.is_multiplexer:
        return f"{text}; says which of the multiplexed signals the message has"
    if signal.multiplexer_ids:
        values = ", ".join(map(str, signal.multiplexer_ids))
        return f"{text}; only while {signal.multiplexer_signal} is {values}: give only_while, or constants"
    if any(word in ("check", "checksum", "crc", "chk") for word in _words(signal.name)):
        return f"{text}; {FILL_IN} as one of the checks of the message"
    return text


def _position(signal: Any) -> int:
    """Bits of the message before the highest bit of a big-endian signal."""
    return int(8 * (signal.start // 8) + 7 - signal.start % 8)


def _word(signal: Any) -> _Word:
    """Return the bytes that a signal touches."""
    is_big = signal.byte_order == "big_endian"
    first = _position(signal) if is_big else signal.start
    return _Word(first // 8, (first + signal.length - 1) // 8, is_big)


def _lowest_bit(signal: Any, word: _Word) -> int:
    """Return where the lowest bit of a signal is in its word."""
    if word.is_big:
        return int(8 * (word.last + 1) - _position(signal) - signal.length)
    return int(signal.start - 8 * word.first)
