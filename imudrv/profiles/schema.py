"""Schema of a profile file, and its translation into a `Layout`."""

from typing import Annotated, Literal, Self

from pydantic import Field as Key
from pydantic import field_validator, model_validator

from imudrv.files.model import Model
from imudrv.records import EXTENDED, MAX_TEMPERATURES
from imudrv.units import NS_PER_S
from imudrv.wire import layout

_AXES = ("x", "y", "z")
_CLASSIC_BITS = 44
"""Bits of a classic CAN frame with an identifier of 11 bits, without its data (ISO 11898-1)."""
_FD_SLOW_BITS, _FD_FAST_BITS = 29, 30
"""Bits of a CAN FD frame at each rate, without its data; approximate, because the CRC's length varies."""
_CAN_FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)


NumberType = Literal["u8", "i8", "u16", "i16", "u24", "i24", "u32", "i32"]
Offset = Annotated[int, Key(ge=0, le=4095)]
Byte = Annotated[int, Key(ge=0, le=255)]
Hex = Annotated[str, Key(pattern=r"^[ \t]*([0-9A-Fa-f]{2}[ \t]*)+$", max_length=64)]
Name = Annotated[str, Key(pattern=r"^[A-Za-z0-9_.-]+$", max_length=64)]


class Number(Model):
    """One number of a message: its meaning, type, offset and, if it has one, its axis."""

    name: Literal["counter", "gyro", "accelerometer", "status", "temperature"]
    type: NumberType
    offset: Offset
    axis: Literal["x", "y", "z"] | None = None
    sensor: (
        Literal[
            "gyro", "accelerometer", "accelerometer_x", "accelerometer_y", "accelerometer_z", "electronics"
        ]
        | None
    ) = None
    degc_per_count: Annotated[float, Key(gt=0, le=1000)] = 1.0
    degc_at_zero: Annotated[float, Key(ge=-1000, le=1000)] = 0.0

    @model_validator(mode="after")
    def _axis_and_sensor_fit_the_name(self) -> Self:
        if (self.axis is not None) != (self.name in ("gyro", "accelerometer")):
            raise ValueError("expected 'axis' with gyro and accelerometer, and with nothing else")
        if (self.sensor is not None) != (self.name == "temperature"):
            raise ValueError("expected 'sensor' with temperature, and with nothing else")
        return self

    @property
    def bits(self) -> int:
        """Width, bits."""
        return int(self.type[1:])


class Constant(Model):
    """A byte that is the same in every message."""

    offset: Offset
    value: Byte


class Check(Model):
    """CRC or sum of the bytes `first` to `last`, inclusive; its value is at `offset`."""

    kind: Literal["crc", "sum"]
    width: Literal[8, 16, 32]
    first: Offset
    last: Offset
    offset: Offset
    polynomial: Annotated[int, Key(ge=0, le=0xFFFFFFFF)] = 0
    init: Annotated[int, Key(ge=0, le=0xFFFFFFFF)] = 0
    reflected: bool = False
    xor_out: Annotated[int, Key(ge=0, le=0xFFFFFFFF)] = 0
    prefix: Hex | None = None

    @model_validator(mode="after")
    def _is_consistent(self) -> Self:
        if self.first > self.last:
            raise ValueError(f"expected first <= last, got {self.first} > {self.last}")
        if self.kind == "crc" and self.polynomial == 0:
            raise ValueError("expected the CRC's polynomial, got none")
        if max(self.polynomial, self.init, self.xor_out) >> self.width:
            raise ValueError(f"expected polynomial, init and xor_out of {self.width} bits, got more")
        return self


class Message(Model):
    """One kind of message of the unit."""

    id: Annotated[int, Key(ge=0, le=0x1FFFFFFF)] | None = None
    every: Annotated[int, Key(ge=1, le=1000)] = 1
    sync: Hex | None = None
    length: Annotated[int, Key(ge=1, le=4096)]
    constants: tuple[Constant, ...] = ()
    fields: Annotated[tuple[Number, ...], Key(min_length=1, max_length=64)]
    check: Check | None = None

    @model_validator(mode="after")
    def _fits(self) -> Self:
        spans = [(n.offset, n.bits // 8, f"{n.name}{'.' + n.axis if n.axis else ''}") for n in self.fields]
        spans += [(c.offset, 1, "a constant") for c in self.constants]
        if self.sync is not None:
            spans.append((0, len(bytes.fromhex(self.sync)), "sync"))
        if self.check is not None:
            size = self.check.width // 8
            spans.append((self.check.offset, size, "check"))
            if self.check.first < self.check.offset + size and self.check.offset <= self.check.last:
                raise ValueError("expected a check outside of the bytes it covers, got one inside")
            if self.check.last >= self.length:
                raise ValueError(
                    f"expected a check of bytes 0..{self.length - 1}, got last: {self.check.last}"
                )
        end, before = 0, ""
        for offset, size, what in sorted(spans):
            if offset < end:
                raise ValueError(f"expected fields apart, got {what} at offset {offset} inside {before}")
            end, before = offset + size, what
        if end > self.length:
            raise ValueError(f"expected all within {self.length} bytes, got {before} ending at {end}")
        return self


class SerialLine(Model):
    """Settings of a serial line."""

    baudrate: Annotated[int, Key(ge=50, le=50_000_000)]
    bytesize: Literal[5, 6, 7, 8] = 8
    parity: Literal["none", "even", "odd", "mark", "space"] = "none"
    stopbits: Literal[1, 2] = 1


class CanLine(Model):
    """Settings of a CAN bus."""

    bitrate: Annotated[int, Key(ge=10_000, le=1_000_000)]
    data_bitrate: Annotated[int, Key(ge=10_000, le=20_000_000)] | None = None


class StatusBit(Model):
    """A bit of the status word: its name in messages and its effect on the samples."""

    bit: Annotated[int, Key(ge=0, le=31)]
    name: Annotated[str, Key(min_length=1, max_length=64)]
    means: Literal["fault", "saturated", "warm_up", "nothing"]


class Nominal(Model):
    """Nominal scale factors of the type of unit, for uncalibrated data."""

    gyro_arcsec_per_pulse: Annotated[float, Key(gt=0)]
    accelerometer_pulse_per_m_s: Annotated[float, Key(gt=0)]


class Profile(Model):
    """A wire format as in its file; `layout` is the form for the decoder."""

    format: Literal["imu50-profile"]
    version: Literal[1]
    name: Name
    transport: Literal["serial", "can"]
    line: SerialLine | CanLine
    sample_rate_hz: Annotated[float, Key(ge=1, le=100_000)]
    byte_order: Literal["little", "big"]
    counts: Literal["increment", "total"]
    nominal: Nominal
    messages: Annotated[tuple[Message, ...], Key(min_length=1, max_length=layout.MAX_MESSAGES)]
    status_bits: Annotated[tuple[StatusBit, ...], Key(max_length=32)] = ()

    @field_validator("status_bits")
    @classmethod
    def _no_duplicate_bits(cls, bits: tuple[StatusBit, ...]) -> tuple[StatusBit, ...]:
        if len({b.bit for b in bits}) < len(bits):
            raise ValueError("expected each bit once, got one twice")
        return bits

    @model_validator(mode="after")
    def _complete(self) -> Self:
        faults = self._serial_faults() if self.transport == "serial" else self._can_faults()
        faults += [*self._pulse_faults(), *self._counter_faults(), *self._status_and_temperature_faults()]
        if NS_PER_S % self.sample_rate_hz:
            faults.append("sample_rate_hz: expected a rate whose interval is whole nanoseconds")
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def _serial_faults(self) -> list[str]:
        faults = []
        if not isinstance(self.line, SerialLine):
            faults.append("line: expected baudrate for a serial profile")
        if len(self.messages) != 1:
            faults.append(f"messages: expected one for a serial profile, got {len(self.messages)}")
        for message in self.messages:
            if message.sync is None:
                faults.append("messages[0].sync: expected the bytes that a frame begins with")
            if message.id is not None or message.every != 1:
                faults.append("messages[0]: expected no 'id' and no 'every' in a serial profile")
        return faults

    def _can_faults(self) -> list[str]:
        faults = []
        if not isinstance(self.line, CanLine):
            faults.append("line: expected bitrate for a CAN profile")
        longest = 64 if self.fd else 8
        for i, message in enumerate(self.messages):
            if message.id is None:
                faults.append(f"messages[{i}].id: expected a CAN identifier")
            if message.sync is not None:
                faults.append(f"messages[{i}].sync: expected none in a CAN profile")
            if message.length > longest or message.length not in _CAN_FD_LENGTHS:
                faults.append(
                    f"messages[{i}].length: expected a CAN data length up to {longest}, got {message.length}"
                )
        if len({m.id for m in self.messages}) < len(self.messages):
            faults.append("messages: expected each id once, got one twice")
        return faults

    def _pulse_faults(self) -> list[str]:
        faults = []
        always = [n for m in self.messages if m.every == 1 for n in m.fields]
        for name in ("gyro", "accelerometer"):
            axes = sorted(n.axis or "" for n in always if n.name == name)
            if axes != list(_AXES):
                faults.append(
                    f"{name}: expected x, y and z once each in messages of every sample, got {axes}"
                )
        pulses = [n for n in always if n.axis]
        if len({n.bits for n in pulses}) > 1 and self.counts == "total":
            faults.append("fields: expected pulse totals of one width, got several")
        if self.counts == "increment" and any(n.type[0] == "u" for n in pulses):
            faults.append("fields: expected signed pulse increments, got an unsigned type")
        return faults

    def _counter_faults(self) -> list[str]:
        faults = []
        for i, message in enumerate(self.messages):
            counters = [n for n in message.fields if n.name == "counter"]
            if len(counters) > 1 or (message.every == 1 and not counters):
                faults.append(f"messages[{i}]: expected one counter field, got {len(counters)}")
            if any(n.type[0] != "u" for n in counters):
                faults.append(f"messages[{i}].counter: expected an unsigned type")
        always = [n for m in self.messages if m.every == 1 for n in m.fields]
        if len({n.bits for n in always if n.name == "counter"}) > 1:
            faults.append("counter: expected one width in the messages of every sample, got several")
        return faults

    def _status_and_temperature_faults(self) -> list[str]:
        faults = []
        numbers = [n for m in self.messages for n in m.fields]
        if sum(n.name == "status" for n in numbers) > 1:
            faults.append("status: expected at most one field, got several")
        sensors = [n.sensor for n in numbers if n.name == "temperature"]
        if len(set(sensors)) < len(sensors) or len(sensors) > MAX_TEMPERATURES:
            faults.append(f"temperature: expected up to {MAX_TEMPERATURES}, each sensor once, got {sensors}")
        return faults

    @property
    def fd(self) -> bool:
        """Whether the messages are CAN FD."""
        return isinstance(self.line, CanLine) and self.line.data_bitrate is not None

    @property
    def transmission_ns(self) -> int:
        """Transmission time of the messages of a sample, ns; on CAN without stuffing and arbitration."""
        lengths = [m.length for m in self.messages if m.every == 1]
        if isinstance(self.line, SerialLine):
            bits_a_byte = 1 + self.line.bytesize + (self.line.parity != "none") + self.line.stopbits
            return round(sum(lengths) * bits_a_byte * NS_PER_S / self.line.baudrate)
        if self.line.data_bitrate is None:
            return round(sum(_CLASSIC_BITS + 8 * n for n in lengths) * NS_PER_S / self.line.bitrate)
        slow = _FD_SLOW_BITS * len(lengths) / self.line.bitrate
        fast = sum(_FD_FAST_BITS + 8 * n for n in lengths) / self.line.data_bitrate
        return round((slow + fast) * NS_PER_S)

    def layout(self) -> layout.Layout:
        """Return the form for the decoder and the encoder."""
        temperatures = [n for m in self.messages for n in m.fields if n.name == "temperature"]
        numbers = [n for m in self.messages for n in m.fields]
        names: list[str] = [n.sensor or "" for n in temperatures]
        return layout.Layout(
            name=self.name,
            can=self.transport == "can",
            fd=self.fd,
            big_endian=self.byte_order == "big",
            interval_ns=round(NS_PER_S / self.sample_rate_hz),
            totals=self.counts == "total",
            counter_bits=max(n.bits for n in numbers if n.name == "counter"),
            pulse_bits=min(n.bits for n in numbers if n.axis),
            messages=tuple(_message(m, names) for m in self.messages),
            temperature_names=tuple(names),
            degc_per_count=tuple(n.degc_per_count for n in temperatures),
            degc_at_zero=tuple(n.degc_at_zero for n in temperatures),
            status=layout.StatusMasks(self._mask("fault"), self._mask("saturated"), self._mask("warm_up")),
            status_names=tuple((b.bit, b.name) for b in self.status_bits),
        )

    def _mask(self, meaning: str) -> int:
        return sum(1 << b.bit for b in self.status_bits if b.means == meaning)


def _message(message: Message, temperatures: list[str]) -> layout.Message:
    sync = bytes.fromhex(message.sync or "")
    constants = [*enumerate(sync), *((c.offset, c.value) for c in message.constants)]
    fields = []
    for n in message.fields:
        if n.name == "temperature":
            target = layout.TEMPERATURE + temperatures.index(n.sensor or "")
        elif n.axis:
            target = (layout.GYRO if n.name == "gyro" else layout.ACCELEROMETER) + _AXES.index(n.axis)
        else:
            target = layout.COUNTER if n.name == "counter" else layout.STATUS
        fields.append(layout.Field(target, n.offset, n.bits, n.type[0] == "i"))
    can_id = message.id or 0
    can_id |= EXTENDED if can_id > 0x7FF else 0
    return layout.Message(
        message.length, tuple(fields), tuple(constants), _check(message.check), can_id, message.every
    )


def _check(check: Check | None) -> layout.Check:
    if check is None:
        return layout.Check()
    if check.kind == "sum":
        kind = layout.CheckKind.SUM
    else:
        kind = layout.CheckKind.CRC_REFLECTED if check.reflected else layout.CheckKind.CRC
    return layout.Check(
        kind,
        check.width,
        check.first,
        check.last + 1,
        check.offset,
        check.polynomial,
        check.init,
        check.xor_out,
        bytes.fromhex(check.prefix or ""),
    )
