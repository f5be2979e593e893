"""Parts of a profile to those of the `Layout` that the decoder and the encoder read."""

from fractions import Fraction
from typing import Final

from imudrv.profiles.messages import Check, Message, Number, Order, Selector, SensorEntry, StatusBit
from imudrv.units import ARCSEC, DEG, DEG_PER_H, STANDARD_GRAVITY
from imudrv.wire import layout

_AXES: Final = ("x", "y", "z")
_SI: Final = {
    "pulse": 1.0,
    "rad": 1.0,
    "deg": DEG,
    "arcsec": ARCSEC,
    "m/s": 1.0,
    "g s": STANDARD_GRAVITY,
    "rad/s": 1.0,
    "deg/s": DEG,
    "deg/h": DEG_PER_H,
    "m/s^2": 1.0,
    "g": STANDARD_GRAVITY,
}
TICKS_PER_S: Final = {"s": 1, "ms": 1_000, "us": 1_000_000, "ns": 1_000_000_000}
"""Units of a time stamp."""
_STEPS: Final = 1_000_000
"""Largest denominator of a time's step in ticks."""


class Translation:
    """Translation of the messages of one profile.

    Parameters
    ----------
    messages : tuple of Message
        All kinds of message.
    status_bits : tuple of StatusBit
        Meaning of the status word, in which the status fields follow each other from the lowest bit on.
    byte_order : {'little', 'big'}
        Of the numbers that do not give their own.
    """

    def __init__(
        self, messages: tuple[Message, ...], status_bits: tuple[StatusBit, ...], byte_order: Order
    ) -> None:
        self._messages, self._status_bits, self._byte_order = messages, status_bits, byte_order
        numbers = [n for message in messages for n in message.fields]
        self.temperatures = [n for n in numbers if n.name == "temperature"]
        status = [n for n in numbers if n.name == "status"]
        self._places = {id(n): sum(other.width for other in status[:k]) for k, n in enumerate(status)}

    def sequence(self, rate: Fraction) -> layout.Sequence:
        """Return what numbers the samples."""
        numbers = [n for m in self._messages for n in m.fields if n.name in ("counter", "time")]
        if not numbers:
            return layout.Sequence()
        n = next(n for m in self._messages if m.is_part for n in m.fields if n in numbers)
        if n.name == "counter":
            bits = max(n.width for n in numbers)
            return layout.Sequence(layout.SequenceKind.COUNTER, bits, Fraction(int(n.step or 1)))
        unit = TICKS_PER_S[n.unit or "s"]
        step = unit / rate if n.step is None else Fraction(n.step).limit_denominator(_STEPS)
        if n.is_float:
            step *= Fraction(TICKS_PER_S["ns"], unit)
        return layout.Sequence(layout.SequenceKind.TIME, 64 if n.is_float else n.width, step)

    def sensor(self, name: str, entry: SensorEntry | None) -> layout.Sensor:
        """Return what the gyros or the accelerometers send."""
        if entry is None:
            return layout.Sensor(in_pulses=False)
        numbers = {n.axis: n for m in self._messages for n in m.fields if n.name == name}
        axes = [numbers.get(axis) for axis in _AXES]
        x, y, z = (None if n is None else self._field(n) for n in axes)
        scales = [(n.per_count if n else None) or entry.per_count or 1.0 for n in axes]
        x_per_count, y_per_count, z_per_count = (_SI[entry.unit] * scale for scale in scales)
        return layout.Sensor(
            values=layout.Values[entry.values.upper()],
            in_pulses=entry.unit == "pulse",
            axes=(x, y, z),
            per_count=(x_per_count, y_per_count, z_per_count),
        )

    def message(self, message: Message, *, is_can: bool) -> layout.Message:
        """Return one kind of message."""
        can_id, can_mask = message.can_id if is_can else (0, 0)
        # The encoder computes them in turn: one that covers the values of others comes behind these.
        checks = sorted(message.checks, key=lambda check: sum(map(check.covers_value_of, message.checks)))
        return layout.Message(
            message.length,
            tuple(self._field(n) for n in message.fields if n.only_while is None),
            tuple(self._multiplexed(n, n.only_while) for n in message.fields if n.only_while is not None),
            tuple(message.header.items()),
            tuple(self._check(check) for check in checks),
            can_id,
            can_mask,
            message.every,
        )

    def _field(self, n: Number) -> layout.Field:
        return self._word(n)._replace(
            target=self._target(n),
            signed=n.type[0] == "i",
            is_float=n.is_float,
            zero=n.zero,
            sign=n.sign,
            place=self._places.get(id(n), 0),
            ticks=TICKS_PER_S["ns"] / TICKS_PER_S[n.unit or "ns"],
        )

    def _word(self, n: Number | Selector) -> layout.Field:
        """Return where a number is."""
        size = int(n.type[1:]) // 8
        first, last = n.bits or (0, 8 * size - 1)
        is_big = (n.byte_order or self._byte_order) == "big"
        return layout.Field(layout.STATUS, n.offset, size, first, last - first + 1, big_endian=is_big)

    def _target(self, n: Number) -> int:
        if n.name == "temperature":
            return layout.TEMPERATURE + [t.sensor for t in self.temperatures].index(n.sensor)
        if n.axis:
            return (layout.GYRO if n.name == "gyro" else layout.ACCELEROMETER) + _AXES.index(n.axis)
        return layout.STATUS if n.name == "status" else layout.SEQUENCE

    def _multiplexed(self, n: Number, selector: Selector) -> layout.Multiplexed:
        return layout.Multiplexed(self._field(n), self._word(selector), selector.modulo or 0, selector.equals)

    def _check(self, check: Check) -> layout.Check:
        kind = layout.CheckKind[check.kind.upper()]
        if check.reflected:
            kind = layout.CheckKind.CRC_REFLECTED
        ones = (1 << check.width) - 1 if check.complement == "one" else 0
        return layout.Check(
            kind,
            check.width,
            tuple((first, last + 1) for first, last in check.covers),
            check.offset,
            (check.byte_order or self._byte_order) == "big",
            check.polynomial,
            check.init,
            check.xor_out ^ ones,
            check.word,
            check.modulo or 0,
            check.complement == "two",
            bytes.fromhex(check.prefix or ""),
            bytes.fromhex(check.suffix or ""),
        )

    def status(self) -> layout.StatusMasks:
        """Return the meaning of the status word."""

        def mask(meaning: str) -> int:
            return sum(1 << b.bit for b in self._status_bits if b.means == meaning)

        inverted = sum(1 << b.bit for b in self._status_bits if b.when == "clear")
        return layout.StatusMasks(mask("fault"), mask("saturated"), mask("warm_up"), inverted)
