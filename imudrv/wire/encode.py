"""Samples to the bytes of a stream or to CAN messages, for the simulator and the tests."""

from itertools import groupby
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imudrv.errors import InputError
from imudrv.kernels import kernel
from imudrv.records import MESSAGE, Records
from imudrv.units import NS
from imudrv.wire.check import compute, compute_plain
from imudrv.wire.layout import (
    GYRO,
    SEQUENCE,
    STATUS,
    TEMPERATURE,
    Field,
    Layout,
    Message,
    Sensor,
    SequenceKind,
    Values,
)
from imudrv.wire.tables import FIELD, layout_tables

Ints: TypeAlias = NDArray[np.int64]
Floats: TypeAlias = NDArray[np.float64]

_AXES: Final = tuple(f"{sensor} {axis}" for sensor in ("gyro", "accelerometer") for axis in "xyz")


class _Encoder:
    """Common part of the encoders: the numbers of every field, checked, and the running totals.

    Parameters
    ----------
    layout : Layout
        Layout of the profile.
    totals : array_like, shape (6,)
        Running totals before the first sample, counts of gyro and accelerometer X Y Z.
    """

    def __init__(self, layout: Layout, totals: ArrayLike = (0, 0, 0, 0, 0, 0)) -> None:
        self._layout = layout
        self._kinds, _, _, self._constants, self._checks = layout_tables(layout)
        self._fields = [np.array(list(message.fields), FIELD) for message in layout.messages]
        self._totals = np.array(totals, np.float64)
        self._sent = 0

    def _encoded(self, samples: Records) -> list[NDArray[np.uint8]]:
        """Encode samples as the messages of each kind, one a row."""
        at = np.arange(self._sent, self._sent + samples.size)
        self._sent += samples.size
        counts = [
            self._counts(samples, sensor, values, 3 * k + axis)
            for k, (sensor, values) in enumerate(
                zip(self._layout.sensors, (samples["gyro"], samples["accelerometer"]), strict=True)
            )
            for axis in range(3)
        ]
        return [self._messages(k, samples, counts, at) for k in range(len(self._layout.messages))]

    def _counts(self, samples: Records, sensor: Sensor, values: Floats, column: int) -> Floats:
        """Return the counts of an axis: of its increments, its total or its rate.

        What rounding leaves of an increment is carried to the next one.
        """
        axis = sensor.axes[column % 3]
        if axis is None or not samples.size:
            return np.zeros(samples.size)
        counts: Floats = values[:, column % 3] / sensor.per_count[column % 3]
        if sensor.values is Values.RATE:
            counts /= np.maximum(samples["interval_ns"], 1) * NS
            return counts if axis.is_float else np.rint(counts)
        if axis.is_float and sensor.values is Values.INCREMENT:
            return counts
        if sensor.values is Values.TOTAL and not axis.is_float:
            # A total of n bits distinguishes as many increments as a signed number of n bits.
            self._require_room(samples, counts, _AXES[column], axis.bits, is_signed=True)
        before = self._totals[column]
        totals: Floats = before + np.cumsum(counts)
        self._totals[column] = totals[-1]
        if axis.is_float:
            return totals
        np.rint(totals, out=totals)
        if sensor.values is Values.TOTAL:
            return totals
        increments: Floats = np.diff(totals, prepend=np.rint(before))
        return increments

    def _messages(self, k: int, samples: Records, counts: list[Floats], at: Ints) -> NDArray[np.uint8]:
        """Encode the messages of kind `k`, one a row."""
        message, kind = self._layout.messages[k], self._kinds[k]
        rows = np.zeros((samples.size, message.length), np.uint8)
        numbers = [self._number(field, samples, counts) for field in message.fields]
        _write_fields(rows, _columns(numbers, samples.size), self._fields[k])
        self._write_multiplexed(rows, message, samples, counts, at)
        _finish_rows(rows, kind, self._constants, self._checks)
        return rows

    def _write_multiplexed(
        self, rows: NDArray[np.uint8], message: Message, samples: Records, counts: list[Floats], at: Ints
    ) -> None:
        """Write the numbers that are in some messages only, and those that decide in which."""
        for (selector, modulo), group in groupby(message.multiplexed, lambda one: (one.selector, one.modulo)):
            some = list(group)
            if any(_overlap(selector, field) for field in message.fields):
                turn = _read(rows, selector)
            else:
                values = sorted({one.value for one in some})
                turn = np.array(values)[at % len(values)]
                _write_fields(rows, turn[:, None], np.array([selector], FIELD))
            for one in some:
                there = np.flatnonzero((turn % modulo if modulo else turn) == one.value)
                number = self._number(one.field, samples, counts)[there]
                part = rows[there]
                _write_fields(part, number[:, None], np.array([one.field], FIELD))
                rows[there] = part

    def _number(self, field: Field, samples: Records, counts: list[Floats]) -> Ints:
        """Return a number of each sample as it is on the wire; a floating-point one as its bits."""
        if field.target == SEQUENCE:
            return self._position(field, samples)
        if field.target == STATUS:
            status = samples["status"].astype(np.int64) >> field.place
            if len({f.place for m in self._layout.messages for f in m.fields if f.target == STATUS}) == 1:
                self._require_room(samples, status, "status", field.bits, is_signed=False)
            return status
        if field.target >= TEMPERATURE:
            channel = field.target - TEMPERATURE
            degc = samples["temperature_degc"][:, channel]
            values = (degc - self._layout.degc_at_zero[channel]) / self._layout.degc_per_count[channel]
            values = np.nan_to_num(values)
            if field.is_float:
                return _bits(values, field.size)
            return np.rint(np.clip(values, *_limits(field.bits, field.signed))).astype(np.int64)
        values = counts[field.target - GYRO]
        if field.is_float:
            return _bits(field.sign * values + field.zero, field.size)
        whole = field.sign * values.astype(np.int64) + field.zero
        sensor = self._layout.sensors[(field.target - GYRO) // 3]
        if sensor.values is not Values.TOTAL:
            self._require_room(samples, whole, _AXES[field.target - GYRO], field.bits, is_signed=field.signed)
        return whole

    def _position(self, field: Field, samples: Records) -> Ints:
        """Return the counter of the samples, or their time."""
        if self._layout.sequence.kind is SequenceKind.COUNTER:
            counter: Ints = samples["counter"]
            return counter
        ticks = np.rint(samples["counter"] * float(self._layout.sequence.step))
        return _bits(ticks / field.ticks, field.size) if field.is_float else ticks.astype(np.int64)

    def _require_room(
        self, samples: Records, column: Ints | Floats, name: str, bits: int, *, is_signed: bool
    ) -> None:
        lowest, highest = _limits(bits, is_signed)
        outside = (column < lowest) | (column > highest)
        if outside.any():
            first = int(outside.argmax())
            raise InputError(
                f"sample {int(samples['counter'][first])}, {name}: "
                f"expected {lowest} to {highest}, the {bits} bits of profile {self._layout.name}, "
                f"got {int(column[first])}; "
                "use a profile with wider fields, or slower motion"
            )


class StreamEncoder(_Encoder):
    """Encoder of a stream profile; the running totals continue from call to call.

    Parameters
    ----------
    layout : Layout
        Layout of a stream profile.
    totals : array_like, shape (6,)
        Running totals before the first sample, counts of gyro and accelerometer X Y Z.
    """

    def encode(self, samples: Records) -> NDArray[np.uint8]:
        """Encode samples.

        Parameters
        ----------
        samples : ndarray of `imudrv.records.samples_type`, shape (n,)
            Each of one interval. Counters are sent modulo the width of their field; temperatures are rounded
            and clipped to theirs, NaN becomes 0 counts.

        Returns
        -------
        ndarray, shape (n, length)
            The messages of one sample a row, of those kinds that every sample has.

        Raises
        ------
        InputError
            A number that its field cannot hold.
        """
        encoded = self._encoded(samples)
        messages = zip(self._layout.messages, encoded, strict=True)
        return np.concatenate([rows for message, rows in messages if message.is_part], axis=1)


class CanEncoder(_Encoder):
    """Encoder of a CAN profile; the running totals continue from call to call.

    Parameters
    ----------
    layout : Layout
        Layout of a CAN profile.
    totals : array_like, shape (6,)
        Running totals before the first sample, counts of gyro and accelerometer X Y Z.
    """

    def encode(self, samples: Records) -> Records:
        """Encode samples.

        Parameters
        ----------
        samples : ndarray of `imudrv.records.samples_type`, shape (n,)
            As for `StreamEncoder.encode`; `arrival_ns` becomes the messages' time.

        Returns
        -------
        ndarray of MESSAGE
            Sample by sample, in the profile's order. A message with `every` = k goes with the samples whose
            counter is a multiple of k.

        Raises
        ------
        InputError
            A number that its field cannot hold.
        """
        encoded = self._encoded(samples)
        kinds = self._layout.messages
        every = np.array([kind.every for kind in kinds])
        is_sent = samples["counter"][:, np.newaxis] % every == 0
        place = np.cumsum(is_sent).reshape(is_sent.shape) - 1
        messages = np.zeros(np.count_nonzero(is_sent), MESSAGE)
        messages["fd"] = self._layout.fd
        for k, kind in enumerate(kinds):
            at = place[is_sent[:, k], k]
            messages["t_ns"][at] = samples["arrival_ns"][is_sent[:, k]]
            messages["id"][at] = kind.can_id
            messages["length"][at] = kind.length
            messages["data"][at, : kind.length] = encoded[k][is_sent[:, k]]
        return messages


def _columns(numbers: list[Ints], rows: int) -> Ints:
    return np.array(numbers, np.int64).reshape(len(numbers), rows).T


def _limits(bits: int, signed: bool) -> tuple[int, int]:
    return (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signed else (0, (1 << bits) - 1)


def _bits(values: Floats, size: int) -> Ints:
    """Return the bits of floating-point numbers of 4 or 8 bytes."""
    if size == 4:
        return values.astype(np.float32).view(np.uint32).astype(np.int64)
    return values.view(np.int64)


def _overlap(a: Field, b: Field) -> bool:
    return a.offset < b.offset + b.size and b.offset < a.offset + a.size


def _read(rows: NDArray[np.uint8], field: Field) -> Ints:
    """Return an unsigned number of each row."""
    order = range(field.size) if field.big_endian else range(field.size - 1, -1, -1)
    word = np.zeros(len(rows), np.int64)
    for k in order:
        word = word << 8 | rows[:, field.offset + k]
    return word if field.bits == 64 else word >> field.shift & ((1 << field.bits) - 1)


@kernel
def _write_fields(rows: NDArray[np.uint8], numbers: Ints, fields: Records) -> None:
    """Add numbers to messages of one kind, one a row; `numbers` has one column for each field."""
    for i in range(rows.shape[0]):
        row = rows[np.uint64(i)]
        for f in range(fields.shape[0]):
            field = fields[np.uint64(f)]
            value, bits = numbers[np.uint64(i), np.uint64(f)], field["bits"]
            if bits < 64:
                value &= (np.int64(1) << bits) - 1
            _write(row, field["offset"], field["size"], field["big_endian"], value << field["shift"])


@kernel
def _finish_rows(rows: NDArray[np.uint8], kind: np.void, constants: Records, checks: Records) -> None:
    """Add the constants and then the check values to messages of one kind, one a row."""
    plain = kind["plain_check"]
    for i in range(rows.shape[0]):
        row = rows[np.uint64(i)]
        for c in range(np.uint64(kind["first_constant"]), np.uint64(kind["end_constant"])):
            row[np.uint64(constants[c]["offset"])] = constants[c]["value"]
        if plain["kind"]:
            _write(row, plain["offset"], plain["size"], plain["big_endian"], compute_plain(row, 0, plain))
        for c in range(np.uint64(kind["first_check"]), np.uint64(kind["end_check"])):
            check = checks[c]
            _write(row, check["offset"], check["size"], check["big_endian"], compute(row, 0, check))


@kernel
def _write(row: NDArray[np.uint8], p: int, size: int, big_endian: bool, value: int) -> None:
    """Add the bits of `value` to the word of `size` bytes at `p`."""
    for k in range(size):
        at = p + (size - 1 - k if big_endian else k)
        row[np.uint64(at)] |= np.uint8(value >> 8 * k & 0xFF)
