"""Layout of the messages of one profile, for decoding and encoding."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

COUNTER: Final = 0
GYRO: Final = 1
ACCELEROMETER: Final = 4
STATUS: Final = 7
TEMPERATURE: Final = 8
"""Targets of a field: the counter, three gyro and three accelerometer axes, the status, then temperatures."""

MAX_MESSAGES: Final = 16
"""Kinds of message that a profile may have."""


class CheckKind(IntEnum):
    """Kind of protection of a message."""

    NONE = 0
    SUM = 1
    CRC = 2
    CRC_REFLECTED = 3


class Field(NamedTuple):
    """One number in a message.

    Parameters
    ----------
    target : int
        Meaning: `COUNTER`, `GYRO` + axis, `ACCELEROMETER` + axis, `STATUS` or `TEMPERATURE` + channel.
    offset : int
        Position of its first byte.
    bits : int
        Width: 8, 16, 24 or 32.
    signed : bool
        Whether it is in two's complement.
    """

    target: int
    offset: int
    bits: int
    signed: bool


class Check(NamedTuple):
    """The check of a message.

    Parameters
    ----------
    kind : CheckKind
        Kind of check.
    width : int
        Bits of the check value: 8, 16 or 32.
    start, stop : int
        Range of bytes that it covers, `stop` excluded.
    offset : int
        Position of the check value.
    polynomial, init, xor_out : int
        Parameters of the CRC in the notation of R. N. Williams, "A painless guide to CRC error detection
        algorithms" (1993); unreflected.
    prefix : bytes
        Bytes that are covered first, but are not in the message.
    """

    kind: CheckKind = CheckKind.NONE
    width: int = 8
    start: int = 0
    stop: int = 0
    offset: int = 0
    polynomial: int = 0
    init: int = 0
    xor_out: int = 0
    prefix: bytes = b""


class Message(NamedTuple):
    """One kind of message: a stream has one, a CAN profile one or more.

    Parameters
    ----------
    length : int
        Bytes of the whole message.
    fields : tuple of Field
        Numbers of the message.
    constants : tuple of (int, int)
        Offset and value of the bytes that never change (sync, id, length), in the order to test them.
    check : Check
        Protection of the message.
    can_id : int
        CAN identifier, with `imudrv.records.EXTENDED` if it has 29 bits; 0 in a stream.
    every : int
        The message comes with every n-th sample; a sample is complete when all messages with 1 have come.
    """

    length: int
    fields: tuple[Field, ...]
    constants: tuple[tuple[int, int], ...] = ()
    check: Check = Check()
    can_id: int = 0
    every: int = 1

    def has(self, target: int) -> bool:
        """Whether a field of this message fills `target`."""
        return any(field.target == target for field in self.fields)


class StatusMasks(NamedTuple):
    """Masks of the status word, by their meaning for the driver."""

    fault: int = 0
    saturated: int = 0
    warm_up: int = 0


_NO_MASKS: Final = StatusMasks()


@dataclass(frozen=True)
class Layout:
    """Layout of a profile.

    Parameters
    ----------
    name : str
        Name of the profile.
    can : bool
        Whether the unit sends CAN messages; otherwise a byte stream of one kind of message.
    fd : bool
        Whether the CAN messages are CAN FD.
    big_endian : bool
        Byte order of every number.
    interval_ns : int
        Sample interval, ns.
    totals : bool
        Whether the pulses are running totals; otherwise increments.
    counter_bits, pulse_bits : int
        Widths of the full counter and of the narrowest pulse field.
    messages : tuple of Message
        Kinds of message that the unit sends.
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
    big_endian: bool
    interval_ns: int
    totals: bool
    counter_bits: int
    pulse_bits: int
    messages: tuple[Message, ...]
    temperature_names: tuple[str, ...] = ()
    degc_per_count: tuple[float, ...] = ()
    degc_at_zero: tuple[float, ...] = ()
    status: StatusMasks = _NO_MASKS
    status_names: tuple[tuple[int, str], ...] = ()

    @property
    def pulse_limit(self) -> int:
        """Largest pulse increment of one interval that the wire can carry."""
        return (1 << (self.pulse_bits - 1)) - 1
