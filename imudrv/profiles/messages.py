"""Messages of a profile: their numbers and checks."""

import re
from typing import Annotated, Final, Literal, Self

from pydantic import AfterValidator, model_validator
from pydantic import Field as Key

from imudrv.files.model import Model
from imudrv.records import EXTENDED
from imudrv.wire import layout

NumberType = Literal[
    "u8", "u16", "u24", "u32", "u40", "u48", "u56", "u64",
    "i8", "i16", "i24", "i32", "i40", "i48", "i56", "i64",
    "f32", "f64",
]  # fmt: skip


def _hex(text: str) -> str:
    if not re.fullmatch(r"[ \t]*([0-9A-Fa-f]{2}[ \t]*)+", text):
        raise ValueError(
            f"expected bytes in hexadecimal, two digits each, as in EB 90, got text {text[:60]!r}"
        )
    return text


Offset = Annotated[int, Key(ge=0, le=4095)]
Byte = Annotated[int, Key(ge=0, le=255)]
Hex = Annotated[str, Key(max_length=96), AfterValidator(_hex)]
Order = Literal["little", "big"]
Word32 = Annotated[int, Key(ge=0, le=0xFFFFFFFF)]
PerCount = Annotated[float, Key(gt=0, le=1e9)]
SensorName = Literal[
    "gyro",
    "gyro_x",
    "gyro_y",
    "gyro_z",
    "accelerometer",
    "accelerometer_x",
    "accelerometer_y",
    "accelerometer_z",
    "electronics",
]
LOWEST_PDU2: Final = 0xF000
"""First parameter group of J1939 that is for everybody; those below have a destination in the identifier."""


class Selector(Model):
    """A number that decides whether a field is in a message: then it, modulo `modulo`, `equals` a value."""

    type: NumberType
    offset: Offset
    bits: tuple[int, int] | None = None
    byte_order: Order | None = None
    modulo: Annotated[int, Key(ge=2, le=4096)] | None = None
    equals: Annotated[int, Key(ge=0, le=0xFFFFFFFF)]

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.type[0] != "u":
            raise ValueError(f"expected an unsigned type, got {self.type}")
        _require_bits(self.type, self.bits)
        return self


class Number(Model):
    """One number of a message: its meaning, type, offset and, if it has one, its axis."""

    name: Literal["counter", "time", "gyro", "accelerometer", "status", "temperature"]
    type: NumberType
    offset: Offset
    bits: tuple[int, int] | None = None
    byte_order: Order | None = None
    zero: Annotated[int, Key(ge=-(2**62), le=2**62)] = 0
    sign: Literal[1, -1] = 1
    axis: Literal["x", "y", "z"] | None = None
    per_count: PerCount | None = None
    unit: Literal["s", "ms", "us", "ns"] | None = None
    step: Annotated[float, Key(gt=0, le=1e12)] | None = None
    sensor: SensorName | None = None
    degc_per_count: Annotated[float, Key(ge=-1000, le=1000)] = 1.0
    degc_at_zero: Annotated[float, Key(ge=-1000, le=1000)] = 0.0
    only_while: Selector | None = None

    @model_validator(mode="after")
    def _keys_fit_the_name(self) -> Self:
        of_axis = self.name in ("gyro", "accelerometer")
        if (self.axis is not None) != of_axis:
            raise ValueError("expected 'axis' with gyro and accelerometer, and with nothing else")
        if (self.sensor is not None) != (self.name == "temperature"):
            raise ValueError("expected 'sensor' with temperature, and with nothing else")
        if (self.unit is not None) != (self.name == "time"):
            raise ValueError(
                "expected 'unit' with time, and with no other field; a sensor's unit is in its entry"
            )
        if self.step is not None and self.name not in ("counter", "time"):
            raise ValueError("expected 'step' with counter or time only")
        if self.per_count is not None and not of_axis:
            raise ValueError(
                "expected 'per_count' with gyro and accelerometer only; a temperature has 'degc_per_count'"
            )
        if (self.zero or self.sign < 0) and not of_axis:
            raise ValueError(
                "expected 'zero' and 'sign' with gyro and accelerometer only; of a temperature at number 0 "
                "give 'degc_at_zero'"
            )
        if self.only_while is not None and self.name not in ("temperature", "status"):
            raise ValueError(
                "expected 'only_while' with temperature and status only; a sensor's numbers that take turns "
                "are messages of their own, distinguished by their constants"
            )
        if self.degc_per_count == 0.0:
            raise ValueError("expected a degc_per_count other than 0, got 0")
        if self.is_float and self.name in ("counter", "status"):
            raise ValueError(f"expected a whole number for {self.name}, got {self.type}")
        if self.name in ("counter", "time", "status") and self.type[0] == "i":
            raise ValueError(f"expected an unsigned type for {self.name}, got {self.type}")
        if self.name == "counter" and self.step is not None and self.step != int(self.step):
            raise ValueError(
                f"expected a whole number as the step of a counter, got {self.step:g}; a number that is the "
                "same in several samples cannot number them: leave it out"
            )
        if self.is_float and self.bits is not None:
            raise ValueError(f"expected 'bits' of a whole number, got {self.type}; leave them out")
        _require_bits(self.type, self.bits)
        return self

    @property
    def is_float(self) -> bool:
        """Whether the number is floating-point."""
        return self.type[0] == "f"

    @property
    def size(self) -> int:
        """Bytes of the word that holds it."""
        return _size(self.type)

    @property
    def width(self) -> int:
        """Width, bits."""
        return self.bits[1] - self.bits[0] + 1 if self.bits else 8 * self.size

    @property
    def label(self) -> str:
        """What messages call it."""
        return f"{self.name}{'.' + self.axis if self.axis else ''}"


def _size(number_type: str) -> int:
    return int(number_type[1:]) // 8


def _require_bits(number_type: str, bits: tuple[int, int] | None) -> None:
    last = 8 * _size(number_type) - 1
    if bits is not None and not 0 <= bits[0] <= bits[1] <= last:
        raise ValueError(
            f"expected bits: [first, last] from 0 to {last} of {number_type}, got {list(bits)}; of a number "
            "across bytes take a type that holds all of it"
        )


class Constant(Model):
    """A byte that is the same in every message."""

    offset: Offset
    value: Byte


class Check(Model):
    """A check of ranges of bytes, each from its first to its last; its value is at `offset`."""

    kind: Literal["crc", "sum", "xor", "fletcher"]
    width: Annotated[int, Key(ge=8, le=32)]
    covers: Annotated[tuple[tuple[Offset, Offset], ...], Key(min_length=1, max_length=layout.MAX_RANGES)]
    offset: Offset
    byte_order: Order | None = None
    polynomial: Word32 = 0
    init: Word32 = 0
    reflected: bool = False
    xor_out: Word32 = 0
    word: Literal[1, 2] = 1
    modulo: Annotated[int, Key(ge=2, le=0xFFFFFFFF)] | None = None
    complement: Literal["one", "two"] | None = None
    prefix: Hex | None = None
    suffix: Hex | None = None

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        for first, last in self.covers:
            if first > last:
                raise ValueError(
                    f"expected covers: [[first, last], ...] with first <= last, got {first} > {last}"
                )
            if self.word == 2 and (last - first) % 2 == 0:
                raise ValueError(
                    f"expected whole 16-bit words, got {last - first + 1} bytes from {first} to {last}"
                )
        if self.covers_value_of(self):
            raise ValueError("expected a check outside of the bytes it covers, got one inside")
        for name, around in (("prefix", self.prefix), ("suffix", self.suffix)):
            size = len(bytes.fromhex(around or ""))
            if size > layout.MAX_AROUND or size % self.word:
                raise ValueError(
                    f"expected a {name} of at most {layout.MAX_AROUND} bytes, whole words, got {size} bytes"
                )
        if self.kind == "crc" and self.polynomial == 0:
            raise ValueError("expected the CRC's polynomial, got none")
        if self.kind != "crc" and (self.polynomial or self.reflected):
            raise ValueError(
                f"expected 'polynomial' and 'reflected' with a crc only, got one with {self.kind}"
            )
        if self.kind not in ("sum", "fletcher") and (self.word == 2 or self.modulo):
            raise ValueError(
                f"expected 'word' and 'modulo' with sum or fletcher only, got one with {self.kind}"
            )
        if self.kind == "fletcher" and (self.width not in (16, 32) or self.word * 16 != self.width):
            raise ValueError("expected a fletcher check of width 16 over bytes, or of width 32 with word: 2")
        if self.kind == "fletcher" and (self.init or self.complement):
            raise ValueError("expected a fletcher check without 'init' and 'complement'")
        if self.kind == "xor" and self.width != 8:
            raise ValueError(f"expected an xor of bytes, width 8, got {self.width}")
        if max(self.polynomial, self.init, self.xor_out) >> self.width:
            raise ValueError(
                f"expected polynomial, init and xor_out of {self.width} bits, got more; a polynomial is "
                "written without its highest term"
            )
        return self

    @property
    def size(self) -> int:
        """Bytes of its value."""
        return (self.width + 7) // 8

    def covers_value_of(self, other: "Check") -> bool:
        """Whether the value of another check is among the bytes that it covers."""
        return any(first < other.offset + other.size and other.offset <= last for first, last in self.covers)


class Message(Model):
    """One kind of message of the unit; one without fields is recognised and skipped."""

    id: Annotated[int, Key(ge=0, le=0x1FFFFFFF)] | None = None
    extended: bool | None = None
    pgn: Annotated[int, Key(ge=0, le=0x3FFFF)] | None = None
    source: Byte | None = None
    every: Annotated[int, Key(ge=1, le=1000)] = 1
    sync: Hex | None = None
    length: Annotated[int, Key(ge=1, le=4096)]
    constants: Annotated[tuple[Constant, ...], Key(max_length=256)] = ()
    fields: Annotated[tuple[Number, ...], Key(max_length=64)] = ()
    checks: Annotated[tuple[Check, ...], Key(max_length=4)] = ()

    @model_validator(mode="after")
    def _fits(self) -> Self:
        spans = [(c.offset, 1, "a constant") for c in self.constants]
        if self.sync is not None:
            spans.append((0, len(bytes.fromhex(self.sync)), "sync"))
        spans += [(check.offset, check.size, "check") for check in self.checks]
        words: dict[tuple[int, int], list[Number]] = {}
        for n in self.fields:
            if n.only_while is None:
                words.setdefault((n.offset, n.size), []).append(n)
        for (offset, size), sharing in words.items():
            spans.append((offset, size, sharing[0].label))
            _require_apart(sharing)
        for check in self.checks:
            for _, last in check.covers:
                if last >= self.length:
                    raise ValueError(f"expected a check of bytes 0..{self.length - 1}, got one up to {last}")
        end, before = 0, ""
        for offset, size, what in sorted(spans):
            if offset < end:
                raise ValueError(f"expected fields apart, got {what} at offset {offset} inside {before}")
            end, before = offset + size, what
        for n in self.fields:
            if n.only_while is not None:
                end = max(end, n.offset + n.size, n.only_while.offset + _size(n.only_while.type))
        if end > self.length:
            raise ValueError(
                f"expected all within {self.length} bytes, got {before or 'a field'} ending at {end}"
            )
        return self

    @property
    def is_part(self) -> bool:
        """Whether every sample has one of these."""
        return self.every == 1 and any(n.axis or n.name in ("counter", "time") for n in self.fields)

    @property
    def header(self) -> dict[int, int]:
        """Bytes that never change, by their offset: those of the sync first."""
        sync = dict(enumerate(bytes.fromhex(self.sync or "")))
        return sync | {c.offset: c.value for c in self.constants}

    @property
    def can_id(self) -> tuple[int, int]:
        """Identifier with `EXTENDED`, and the mask of the bits that count."""
        if self.pgn is not None:
            # Priority and, where any is possible, the source address do not count (SAE J1939-21).
            mask = EXTENDED | (0x03FFFF00 if self.pgn >= LOWEST_PDU2 else 0x03FF0000)
            identifier = EXTENDED | self.pgn << 8
            return (identifier, mask) if self.source is None else (identifier | self.source, mask | 0xFF)
        identifier = self.id or 0
        is_extended = identifier > 0x7FF if self.extended is None else self.extended
        return identifier | EXTENDED * is_extended, 0xFFFFFFFF


def _require_apart(sharing: list[Number]) -> None:
    """Refuse bits that two fields of one word have in common, and words of two byte orders."""
    if len({n.byte_order for n in sharing}) > 1:
        raise ValueError(f"expected one byte order of the fields at offset {sharing[0].offset}, got two")
    end = -1
    for n in sorted(sharing, key=lambda n: n.bits or (0, 0)):
        first, last = n.bits or (0, 8 * n.size - 1)
        if first <= end:
            raise ValueError(
                f"expected fields apart, got {n.label} at offset {n.offset} inside another field"
            )
        end = last


class SensorEntry(Model):
    """What the numbers of the gyros, or of the accelerometers, are."""

    values: Literal["increment", "total", "rate"]
    unit: Literal["pulse", "rad", "deg", "arcsec", "m/s", "g s", "rad/s", "deg/s", "deg/h", "m/s^2", "g"]
    per_count: PerCount | None = None


class StatusBit(Model):
    """A bit of the status word: its name in messages, and its effect on samples while it is set or clear."""

    bit: Annotated[int, Key(ge=0, le=31)]
    name: Annotated[str, Key(min_length=1, max_length=64)]
    means: Literal["fault", "saturated", "warm_up", "nothing"]
    when: Literal["set", "clear"] = "set"
