"""Schema of a profile file, version 2: what the decoder needs to know of a unit, as a table of fields."""

from collections.abc import Iterator
from fractions import Fraction
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field as Key
from pydantic import field_validator, model_validator

from imudrv.files.model import Model
from imudrv.profiles import advice
from imudrv.profiles.messages import LOWEST_PDU2, Message, Order, SensorEntry, StatusBit
from imudrv.profiles.translation import TICKS_PER_S, Translation
from imudrv.profiles.version_1 import upgraded
from imudrv.records import EXTENDED, MAX_TEMPERATURES
from imudrv.units import NS_PER_S
from imudrv.wire import layout

_UNITS: Final = {
    ("gyro", "rate"): ("rad/s", "deg/s", "deg/h"),
    ("gyro", "other"): ("pulse", "rad", "deg", "arcsec"),
    ("accelerometer", "rate"): ("m/s^2", "g"),
    ("accelerometer", "other"): ("pulse", "m/s", "g s"),
}
_CLASSIC_BITS: Final = {False: 44, True: 64}
"""Bits of a classic CAN frame without its data, with an identifier of 11 and of 29 bits (ISO 11898-1)."""
_FD_SLOW_BITS, _FD_FAST_BITS = 29, 30
"""Bits of a CAN FD frame at each rate, without its data; approximate, because the CRC's length varies."""
_CAN_FD_LENGTHS: Final = (*range(9), 12, 16, 20, 24, 32, 48, 64)

Name = Annotated[str, Key(pattern=r"^[A-Za-z0-9_.-]+$", max_length=64)]


class SerialLine(Model):
    """Settings of a serial line."""

    baudrate: Annotated[int, Key(ge=50, le=50_000_000)]
    bytesize: Literal[5, 6, 7, 8] = 8
    parity: Literal["none", "even", "odd", "mark", "space"] = "none"
    stopbits: Literal[1, 2] = 1

    @property
    def bits_a_byte(self) -> int:
        """Bits of a byte on the line: start, data, parity, stop."""
        return 1 + self.bytesize + (self.parity != "none") + self.stopbits


class CanLine(Model):
    """Settings of a CAN bus."""

    bitrate: Annotated[int, Key(ge=10_000, le=1_000_000)]
    data_bitrate: Annotated[int, Key(ge=10_000, le=20_000_000)] | None = None


class Nominal(Model):
    """Nominal scale factors of the type of unit, for uncalibrated data."""

    gyro_arcsec_per_pulse: Annotated[float, Key(gt=0)] | None = None
    accelerometer_pulse_per_m_s: Annotated[float, Key(gt=0)] | None = None


class Profile(Model):
    """A wire format as in its file."""

    format: Literal["imu50-profile"]
    version: Literal[2]
    name: Name
    transport: Literal["serial", "can"]
    line: SerialLine | CanLine
    sample_rate_hz: (
        Annotated[float, Key(ge=1, le=100_000)]
        | tuple[Annotated[int, Key(ge=1, le=1_000_000_000)], Annotated[int, Key(ge=1, le=1_000_000)]]
    )
    byte_order: Order
    gyro: SensorEntry | None = None
    accelerometer: SensorEntry | None = None
    nominal: Nominal | None = None
    messages: Annotated[tuple[Message, ...], Key(min_length=1, max_length=layout.MAX_MESSAGES)]
    status_bits: Annotated[tuple[StatusBit, ...], Key(max_length=32)] = ()

    @classmethod
    def current(cls, document: Any) -> Any:
        """Return a document of version 1 in the words of this one."""
        return upgraded(document)

    @classmethod
    def advice_for_key(cls, path: str) -> str:
        """Return the nearest thing that a profile can say; see `imudrv.profiles.advice`."""
        return advice.for_key(path)

    @classmethod
    def advice_for_value(cls, path: str, value: object) -> str:
        """Return the nearest thing that a profile can say; see `imudrv.profiles.advice`."""
        return advice.for_value(path, value)

    @field_validator("status_bits")
    @classmethod
    def _no_duplicate_bits(cls, bits: tuple[StatusBit, ...]) -> tuple[StatusBit, ...]:
        if len({b.bit for b in bits}) < len(bits):
            raise ValueError("expected each bit once, got one twice")
        return bits

    @model_validator(mode="after")
    def _complete(self) -> Self:
        faults = self._serial_faults() if self.transport == "serial" else self._can_faults()
        found = [
            *faults,
            *self._header_faults(),
            *self._sensor_faults(),
            *self._sequence_faults(),
            *self._tick_faults(),
            *self._status_and_temperature_faults(),
        ]
        if not 1 <= self.rate_hz <= 100_000:
            found.append(f"sample_rate_hz: expected 1 to 100000, got {self.rate_hz:g}")
        if found:
            raise ValueError("\n".join(found))
        return self

    def _serial_faults(self) -> Iterator[str]:
        if not isinstance(self.line, SerialLine):
            yield "line: expected baudrate for a serial profile"
        for k, message in enumerate(self.messages):
            if message.sync is None:
                yield f"messages[{k}].sync: expected the bytes that a message begins with"
            if (message.id, message.pgn, message.source, message.extended) != (None,) * 4:
                yield f"messages[{k}]: expected no 'id', 'pgn', 'source' or 'extended' in a serial profile"
            if message.every != 1:
                yield f"messages[{k}].every: expected none in a serial profile; messages may come at any rate"

    def _can_faults(self) -> Iterator[str]:
        if not isinstance(self.line, CanLine):
            yield "line: expected bitrate for a CAN profile"
        longest = 64 if self.fd else 8
        for k, message in enumerate(self.messages):
            if (message.id is None) == (message.pgn is None):
                yield f"messages[{k}]: expected 'id', a CAN identifier, or 'pgn', a J1939 parameter group"
            if message.pgn is None and message.source is not None:
                yield f"messages[{k}].source: expected with 'pgn' only; it is part of 'id'"
            if message.pgn is not None and message.pgn < LOWEST_PDU2 and message.pgn & 0xFF:
                yield (
                    f"messages[{k}].pgn: expected 00 as the low byte of a group below F000, "
                    f"got {message.pgn:X}"
                )
            if message.extended is not None and (message.pgn is not None or (message.id or 0) > 0x7FF):
                yield (
                    f"messages[{k}].extended: expected with an 'id' up to 0x7FF only; "
                    "this one has 29 bits anyway"
                )
            if message.sync is not None:
                yield f"messages[{k}].sync: expected none in a CAN profile"
            if message.length > longest or message.length not in _CAN_FD_LENGTHS:
                yield (
                    f"messages[{k}].length: expected a CAN data length up to {longest}, got {message.length}"
                )

    def _header_faults(self) -> Iterator[str]:
        """Yield the messages that cannot be distinguished from one before."""
        for k, message in enumerate(self.messages):
            for j, other in enumerate(self.messages[:k]):
                one, two = message.header, other.header
                same_id = message.can_id[0] & other.can_id[1] == other.can_id[0] & message.can_id[1]
                if same_id and all(one[at] == two[at] for at in one.keys() & two.keys()):
                    how = "id or constants" if self.transport == "can" else "sync or constants"
                    yield f"messages[{k}]: expected another {how} than messages[{j}] has"
                    break

    def _sensor_faults(self) -> Iterator[str]:
        if self.gyro is None and self.accelerometer is None:
            yield "gyro, accelerometer: expected an entry of at least one of them"
        for name, entry in (("gyro", self.gyro), ("accelerometer", self.accelerometer)):
            numbers = [n for m in self.messages for n in m.fields if n.name == name]
            if entry is None:
                if numbers:
                    yield f"{name}: expected an entry that says what the numbers of its fields are"
                continue
            if not numbers:
                yield f"{name}: expected fields of it, or no entry"
            if any(n.name == name for m in self.messages if m.every > 1 for n in m.fields):
                yield f"{name}: expected all its fields in messages of every sample"
            axes = [n.axis or "" for n in numbers]
            if len(set(axes)) < len(axes):
                yield (
                    f"{name}: expected each axis once, got {', '.join(sorted(axes))}; a number in pieces "
                    "cannot be described, unless it is one word with its bytes in order"
                )
            units = _UNITS[name, "rate" if entry.values == "rate" else "other"]
            if entry.unit not in units:
                yield (
                    f"{name}.unit: expected {' or '.join(units)} for values: {entry.values}, got {entry.unit}"
                )
            for n in numbers:
                if entry.unit == "pulse" and (n.is_float or n.per_count or entry.per_count):
                    yield (
                        f"{name}: expected pulses as whole numbers without 'per_count'; "
                        "their scale is calibrated"
                    )
                    break
                if entry.values != "total" and n.type[0] == "u" and n.zero == 0:
                    yield (
                        f"{name}.{n.axis}: expected a signed type for values: {entry.values}, got {n.type}; "
                        "of a number with an offset give 'zero', as in zero: 32768"
                    )
        nominal = self.nominal
        if nominal is None:
            return
        for name, entry, given in (
            ("gyro", self.gyro, nominal.gyro_arcsec_per_pulse),
            ("accelerometer", self.accelerometer, nominal.accelerometer_pulse_per_m_s),
        ):
            if given is not None and (entry is None or entry.unit != "pulse"):
                yield f"nominal: expected a scale of the {name} only where it sends pulses"

    def _sequence_faults(self) -> Iterator[str]:
        parts = [m for m in self.messages if m.is_part]
        always = [n for m in parts for n in m.fields if n.name in ("counter", "time")]
        everywhere = [n for m in self.messages for n in m.fields if n.name in ("counter", "time")]
        if len({n.name for n in everywhere}) > 1:
            yield "counter, time: expected one of them to number the samples, got both; leave one out"
        for k, message in enumerate(self.messages):
            if sum(n.name in ("counter", "time") for n in message.fields) > 1:
                yield (
                    f"messages[{k}]: expected at most one counter or time, got more; of a counter in pieces "
                    "the lowest is enough"
                )
        if len({n.name for n in always}) == 1 and len({(n.width, n.step, n.unit) for n in always}) > 1:
            yield (
                "counter: expected one width, step and unit in the messages of every sample, got several; "
                "a counter in one of them is enough"
            )
        if everywhere and not always:
            yield "counter: expected it in a message of every sample"
        for n in always[:1]:
            if n.name == "time" and n.step is not None:
                step_s = n.step / TICKS_PER_S[n.unit or "s"]
                # Ticks are whole: a mean over many samples may differ by less than one.
                if abs(step_s * self.rate_hz - 1.0) > 0.01:
                    yield (
                        f"time.step: expected {float(TICKS_PER_S[n.unit or 's'] / self.rate_hz):g} {n.unit} "
                        f"for {self.rate_hz:g} samples/s, got {n.step:g}; change one of them"
                    )
            if n.name == "counter" and n.width < 64 and n.step is not None and n.step >= 1 << n.width:
                yield (
                    f"counter.step: expected less than {1 << n.width}, for it has {n.width} bits, "
                    f"got {n.step:g}"
                )

    def _tick_faults(self) -> Iterator[str]:
        """Yield what keeps a time in whole ticks from numbering the samples."""
        times = [
            n for m in self.messages if m.is_part for n in m.fields if n.name == "time" and not n.is_float
        ]
        for n in times[:1]:
            ticks = Fraction(TICKS_PER_S[n.unit or "s"]) / self.rate
            # Rounded times differ by up to a tick more or less, which must not be half a sample.
            if ticks < 2 and ticks != 1:
                yield (
                    "time.unit: expected a unit of which a sample takes 2 or more (or 1), got "
                    f"{float(ticks):g} {n.unit} at {self.rate_hz:g} samples/s; leave the field out, and "
                    "samples are numbered as they arrive"
                )
            if 2 * ticks > 1 << n.width:
                yield (
                    f"time: expected a number that begins anew after two samples or more, got {n.width} bits "
                    f"in {n.unit} at {self.rate_hz:g} samples/s; leave the field out, and samples are "
                    "numbered as they arrive"
                )

    def _status_and_temperature_faults(self) -> Iterator[str]:
        numbers = [n for m in self.messages for n in m.fields]
        bits = sum(n.width for n in numbers if n.name == "status")
        if bits > 32:
            yield (
                f"status: expected at most 32 bits in all, got {bits}; "
                "take those of use with bits: [first, last]"
            )
        for b in self.status_bits:
            if b.bit >= bits:
                yield f"status_bits: expected bits below {bits}, the width of the status fields, got {b.bit}"
        sensors = [n.sensor for n in numbers if n.name == "temperature"]
        if len(set(sensors)) < len(sensors) or len(sensors) > MAX_TEMPERATURES:
            yield f"temperature: expected up to {MAX_TEMPERATURES}, each sensor once, got {sensors}"

    @property
    def rate_hz(self) -> float:
        """Sample rate, Hz."""
        return float(self.rate)

    @property
    def rate(self) -> Fraction:
        """Sample rate, Hz, exactly."""
        if isinstance(self.sample_rate_hz, tuple):
            return Fraction(*self.sample_rate_hz)
        return Fraction(self.sample_rate_hz).limit_denominator(1_000_000)

    @property
    def fd(self) -> bool:
        """Whether the messages are CAN FD."""
        return isinstance(self.line, CanLine) and self.line.data_bitrate is not None

    @property
    def transmission_ns(self) -> int:
        """Transmission time of the messages of a sample, ns; on CAN without stuffing and arbitration."""
        parts = [m for m in self.messages if m.is_part]
        lengths = [m.length for m in parts]
        if isinstance(self.line, SerialLine):
            return round(sum(lengths) * self.line.bits_a_byte * NS_PER_S / self.line.baudrate)
        if self.line.data_bitrate is None:
            bits = sum(_CLASSIC_BITS[m.can_id[0] & EXTENDED != 0] + 8 * m.length for m in parts)
            return round(bits * NS_PER_S / self.line.bitrate)
        slow = _FD_SLOW_BITS * len(lengths) / self.line.bitrate
        fast = sum(_FD_FAST_BITS + 8 * n for n in lengths) / self.line.data_bitrate
        return round((slow + fast) * NS_PER_S)

    def layout(self) -> layout.Layout:
        """Return the form for the decoder and the encoder."""
        made = Translation(self.messages, self.status_bits, self.byte_order)
        return layout.Layout(
            name=self.name,
            can=self.transport == "can",
            fd=self.fd,
            interval=Fraction(NS_PER_S) / self.rate,
            sequence=made.sequence(self.rate),
            messages=tuple(made.message(m, is_can=self.transport == "can") for m in self.messages),
            gyro=made.sensor("gyro", self.gyro),
            accelerometer=made.sensor("accelerometer", self.accelerometer),
            temperature_names=tuple(n.sensor or "" for n in made.temperatures),
            degc_per_count=tuple(n.degc_per_count for n in made.temperatures),
            degc_at_zero=tuple(n.degc_at_zero for n in made.temperatures),
            status=made.status(),
            status_names=tuple((b.bit, b.name) for b in self.status_bits),
        )
