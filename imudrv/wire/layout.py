"""Layout of the messages of one profile, for decoding and encoding."""

from dataclasses import dataclass
from enum import IntEnum
from fractions import Fraction
from functools import cached_property
from itertools import takewhile
from typing import Final, NamedTuple

import numpy as np

from imudrv.records import samples_type

SEQUENCE: Final = 0
GYRO: Final = 1
ACCELEROMETER: Final = 4
STATUS: Final = 7
TEMPERATURE: Final = 8
"""Targets of a field: the counter or time, three gyro and three accelerometer axes, the status, then the
temperatures."""

MAX_MESSAGES: Final = 16
"""Kinds of message that a profile may have."""
MAX_RANGES: Final = 4
"""Ranges of bytes that a check may cover."""
MAX_AROUND: Final = 32
"""Most bytes before and behind a message that a check covers and that are not sent."""
NARROW_BITS: Final = 12
"""A counter of fewer bits, or a time of fewer samples, wraps within seconds: what it says about a gap depends
on the time of arrival."""


class CheckKind(IntEnum):
    """Kind of protection of a message."""

    SUM = 1
    XOR = 2
    FLETCHER = 3
    CRC = 4
    CRC_REFLECTED = 5


class Values(IntEnum):
    """What the numbers of a sensor are."""

    INCREMENT = 0
    TOTAL = 1
    RATE = 2


class SequenceKind(IntEnum):
    """What numbers the samples of a unit."""

    NONE = 0
    COUNTER = 1
    TIME = 2


class Field(NamedTuple):
    """One number in a message: bits of a word of one to eight bytes.

    Parameters
    ----------
    target : int
        Meaning: `SEQUENCE`, `GYRO` + axis, `ACCELEROMETER` + axis, `STATUS` or `TEMPERATURE` + channel.
    offset : int
        Position of the first byte of the word.
    size : int
        Bytes of the word, 1 to 8.
    shift, bits : int
        Lowest bit of the number in the word, and its width.
    signed : bool
        Whether it is in two's complement.
    is_float : bool
        Whether the word is an IEEE 754 number of 4 or 8 bytes.
    big_endian : bool
        Byte order of the word.
    zero : int
        Number that means 0.
    sign : int
        1, or -1 for an axis that the unit counts the other way: value = sign (number - zero).
    place : int
        Lowest bit of a status field in the status word.
    ticks : float
        Of a time in floating point: ticks of the sequence in its unit.
    """

    target: int
    offset: int
    size: int
    shift: int = 0
    bits: int = 0
    signed: bool = False
    is_float: bool = False
    big_endian: bool = False
    zero: int = 0
    sign: int = 1
    place: int = 0
    ticks: float = 1.0

    @property
    def is_plain(self) -> bool:
        """Whether it is the usual one: a whole number of whole bytes, up to four."""
        others = self._replace(target=0, offset=0, size=0, bits=0, signed=False, big_endian=False, ticks=1.0)
        return others == Field(0, 0, 0) and self.size <= 4 and self.bits == 8 * self.size


class Multiplexed(NamedTuple):
    """A field that is there only while another number of the message has one value.

    Parameters
    ----------
    field : Field
        The field.
    selector : Field
        The other number; its target is ignored.
    modulo : int
        The number is taken modulo this one; 0: as it is.
    value : int
        What the number then is.
    """

    field: Field
    selector: Field
    modulo: int
    value: int


class Check(NamedTuple):
    """A check of a message.

    Parameters
    ----------
    kind : CheckKind
        Kind of check.
    width : int
        Bits of the check value, 8 to 32.
    ranges : tuple of (int, int)
        Ranges of bytes that it covers, ends excluded.
    offset : int
        Position of the check value, of as many bytes as its bits need.
    big_endian : bool
        Byte order of the check value, and of the words of a sum.
    polynomial, init, xor_out : int
        Parameters in the notation of R. N. Williams, "A painless guide to CRC error detection algorithms"
        (1993), the polynomial unreflected; a sum begins with `init`, too.
    word : int
        Bytes of a number that a sum adds: 1 or 2.
    modulo : int
        Of a sum or a Fletcher check: the modulus of the sums; 0: 2^width, for Fletcher 2^(width / 2).
    negated : bool
        Whether the two's complement of the sum is sent.
    prefix, suffix : bytes
        Bytes that are covered first and last, but are not in the message.
    """

    kind: CheckKind
    width: int
    ranges: tuple[tuple[int, int], ...]
    offset: int
    big_endian: bool = False
    polynomial: int = 0
    init: int = 0
    xor_out: int = 0
    word: int = 1
    modulo: int = 0
    negated: bool = False
    prefix: bytes = b""
    suffix: bytes = b""

    @property
    def size(self) -> int:
        """Bytes of the check value."""
        return (self.width + 7) // 8

    @property
    def is_plain(self) -> bool:
        """Whether it is the usual one: a CRC or a sum of bytes, of one range that is all on the wire."""
        is_sum = self.kind is CheckKind.SUM and self.word == 1 and not self.modulo
        return (
            len(self.ranges) == 1
            and not (self.suffix or self.negated)
            and self.width % 8 == 0
            and (is_sum or self.kind >= CheckKind.CRC)
        )


class Message(NamedTuple):
    """One kind of message.

    Parameters
    ----------
    length : int
        Bytes of the whole message.
    fields : tuple of Field
        Numbers of the message; one without any is recognised and skipped.
    multiplexed : tuple of Multiplexed
        Numbers that are in some of these messages only.
    constants : tuple of (int, int)
        Offset and value of the bytes that never change (sync, id, length), in the order to test them.
    checks : tuple of Check
        Protection of the message.
    can_id, can_mask : int
        The message has this identifier in the bits of the mask; 0 in a stream.
    every : int
        The message comes with every n-th sample; a sample is complete when all messages with 1 have come.
    """

    length: int
    fields: tuple[Field, ...]
    multiplexed: tuple[Multiplexed, ...] = ()
    constants: tuple[tuple[int, int], ...] = ()
    checks: tuple[Check, ...] = ()
    can_id: int = 0
    can_mask: int = 0xFFFFFFFF
    every: int = 1

    @property
    def header(self) -> bytes:
        """The bytes at the beginning that never change."""
        values = dict(self.constants)
        return bytes(values[k] for k in takewhile(values.__contains__, range(self.length)))

    @property
    def plain_check(self) -> Check | None:
        """The first check, if it is plain; the decoder has a faster way for it."""
        return self.checks[0] if self.checks and self.checks[0].is_plain else None

    @property
    def is_part(self) -> bool:
        """Whether every sample has one of these."""
        return self.every == 1 and any(field.target < STATUS for field in self.fields)

    def has(self, target: int) -> bool:
        """Whether a field of this message fills `target`."""
        return any(field.target == target for field in self.fields)


class Sequence(NamedTuple):
    """What numbers the samples.

    Parameters
    ----------
    kind : SequenceKind
        A counter, a time, or nothing.
    bits : int
        Width of the full counter or time; 64 for a time in floating point.
    step : Fraction
        Change from a sample to the next, in counts or ticks.
    """

    kind: SequenceKind = SequenceKind.NONE
    bits: int = 64
    step: Fraction = Fraction(1)


class Sensor(NamedTuple):
    """The three gyros, or the three accelerometers.

    Parameters
    ----------
    values : Values
        What the numbers are.
    in_pulses : bool
        Whether they are pulses, whose scale is in the calibration of the unit.
    axes : tuple of Field or None
        X, Y, Z; None for an axis that the unit lacks.
    per_count : tuple of float
        Value of a count of each axis: rad and m/s, for rates rad/s and m/s^2; 1 for pulses.
    """

    values: Values = Values.INCREMENT
    in_pulses: bool = True
    axes: tuple[Field | None, Field | None, Field | None] = (None, None, None)
    per_count: tuple[float, float, float] = (1.0, 1.0, 1.0)

    @property
    def is_counted(self) -> bool:
        """Whether all three axes are whole pulses."""
        return self.in_pulses and None not in self.axes


class StatusMasks(NamedTuple):
    """Masks of the status word, by their meaning for the driver; `inverted` bits apply when clear."""

    fault: int = 0
    saturated: int = 0
    warm_up: int = 0
    inverted: int = 0


_NO_MASKS: Final = StatusMasks()
_NO_SENSOR: Final = Sensor()


@dataclass(frozen=True)
class Layout:
    """Layout of a profile.

    Parameters
    ----------
    name : str
        Name of the profile.
    can : bool
        Whether the unit sends CAN messages; otherwise a byte stream.
    fd : bool
        Whether the CAN messages are CAN FD.
    interval : Fraction
        Sample interval, ns.
    sequence : Sequence
        What numbers the samples.
    messages : tuple of Message
        Kinds of message that the unit sends.
    gyro, accelerometer : Sensor
        What the sensors send.
    temperature_names : tuple of str
        Sensor of each temperature channel.
    degc_per_count, degc_at_zero : tuple of float
        Scale and origin of each temperature channel.
    status : StatusMasks
        Meaning of the status word.
    status_names : tuple of (int, str)
        Bit and name, for people.
    """

    name: str
    can: bool
    fd: bool
    interval: Fraction
    sequence: Sequence
    messages: tuple[Message, ...]
    gyro: Sensor = _NO_SENSOR
    accelerometer: Sensor = _NO_SENSOR
    temperature_names: tuple[str, ...] = ()
    degc_per_count: tuple[float, ...] = ()
    degc_at_zero: tuple[float, ...] = ()
    status: StatusMasks = _NO_MASKS
    status_names: tuple[tuple[int, str], ...] = ()

    @cached_property
    def interval_ns(self) -> int:
        """Sample interval, rounded down to whole ns."""
        return int(self.interval)

    @property
    def counter_step(self) -> int:
        """Change of a sample's `counter` from one to the next."""
        return int(self.sequence.step) if self.sequence.kind is SequenceKind.COUNTER else 1

    def active_bits(self, status: int) -> dict[int, str]:
        """Return mask and name of the bits of a status word that apply: set, or clear if inverted."""
        active = status ^ self.status.inverted
        return {1 << bit: name for bit, name in self.status_names if active >> bit & 1}

    @property
    def samples_a_round(self) -> Fraction:
        """Samples until the counter or time begins anew; 1 without one: a gap may then have any length."""
        if self.sequence.kind is SequenceKind.NONE:
            return Fraction(1)
        return Fraction(2**self.sequence.bits) / self.sequence.step

    @property
    def sensors(self) -> tuple[Sensor, Sensor]:
        """Gyros and accelerometers."""
        return self.gyro, self.accelerometer

    @property
    def samples_type(self) -> np.dtype[np.void]:
        """Type of the unit's samples, see `imudrv.records.samples_type`."""
        return samples_type(
            gyro_pulses=self.gyro.is_counted, accelerometer_pulses=self.accelerometer.is_counted
        )

    @property
    def missing_axes(self) -> tuple[list[int], list[int]]:
        """Axes that the unit lacks, 0 to 2: of the gyros and of the accelerometers."""
        gyro, accelerometer = ([k for k in range(3) if sensor.axes[k] is None] for sensor in self.sensors)
        return gyro, accelerometer

    @property
    def totals(self) -> bool:
        """Whether all that the unit sends are running totals, which bridge a gap."""
        return all(sensor.values is Values.TOTAL for sensor in self.sensors if any(sensor.axes))

    @property
    def is_ordered(self) -> bool:
        """Whether the messages of a sample belong together by their order, for they have no common number."""
        parts = [message for message in self.messages if message.is_part]
        return len(parts) > 1 and not (self.can and all(message.has(SEQUENCE) for message in parts))

    @property
    def pulse_limit(self) -> int:
        """Largest increment of one interval, in counts, that every axis can carry."""
        axes = [axis for sensor in self.sensors for axis in sensor.axes if axis and not axis.is_float]
        return min((1 << (axis.bits - 1)) - 1 for axis in axes)
