"""Pulses to the bytes of a stream or to CAN messages, for the simulator and the tests."""

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from imudrv.errors import InputError
from imudrv.kernels import kernel
from imudrv.records import MAX_TEMPERATURES, MESSAGE, Records
from imudrv.wire.check import compute
from imudrv.wire.layout import ACCELEROMETER, COUNTER, GYRO, STATUS, TEMPERATURE, CheckKind, Field, Layout
from imudrv.wire.tables import layout_tables

_TARGETS: Final = TEMPERATURE + MAX_TEMPERATURES
_PULSES: Final = slice(GYRO, STATUS)
_NAMES: Final = (
    "counter",
    *(f"{sensor} {axis}" for sensor in ("gyro", "accelerometer") for axis in "xyz"),
    "status",
)


class _Encoder:
    """Common part of the encoders: the numbers of every field, checked, and the running totals.

    Parameters
    ----------
    layout : Layout
        Layout of the profile.
    totals : array_like of int, shape (6,)
        Running totals before the first sample, gyro and accelerometer X Y Z; for profiles with totals.
    """

    def __init__(self, layout: Layout, totals: ArrayLike = (0, 0, 0, 0, 0, 0)) -> None:
        self._layout = layout
        self._tables = layout_tables(layout)
        self._totals = np.array(totals, np.int64)

    def _numbers(self, pulses: Records) -> NDArray[np.int64]:
        """Return the number of each target, shape (n, `_TARGETS`), one column for each target."""
        numbers = np.zeros((pulses.size, _TARGETS), np.int64)
        numbers[:, COUNTER] = pulses["counter"]
        numbers[:, GYRO:ACCELEROMETER] = pulses["gyro"]
        numbers[:, ACCELEROMETER:STATUS] = pulses["accelerometer"]
        numbers[:, STATUS] = pulses["status"]
        for message in self._layout.messages:
            for field in message.fields:
                if field.target >= TEMPERATURE:
                    self._put_temperature(numbers, pulses, field)
                elif field.target != COUNTER:
                    self._require_room(numbers, field)
        if self._layout.totals and pulses.size:
            numbers[:, _PULSES] = self._totals + np.cumsum(numbers[:, _PULSES], axis=0)
            self._totals = numbers[-1, _PULSES].copy()
        return numbers

    def _messages(self, numbers: NDArray[np.int64], k: int) -> NDArray[np.uint8]:
        """Encode `numbers` as messages of kind `k`, one a row."""
        kinds, fields, constants = self._tables
        rows = np.zeros((len(numbers), kinds[k]["length"]), np.uint8)
        _write_rows(rows, numbers, kinds[k], fields, constants)
        return rows

    def _put_temperature(self, numbers: NDArray[np.int64], pulses: Records, field: Field) -> None:
        channel = field.target - TEMPERATURE
        degc = pulses["temperature_degc"][:, channel]
        counts = (degc - self._layout.degc_at_zero[channel]) / self._layout.degc_per_count[channel]
        lowest, highest = _limits(field.bits, field.signed)
        numbers[:, field.target] = np.rint(np.clip(np.nan_to_num(counts), lowest, highest))

    def _require_room(self, numbers: NDArray[np.int64], field: Field) -> None:
        column = numbers[:, field.target]
        # A total of n bits distinguishes as many increments as a signed number of n bits.
        is_total = self._layout.totals and field.target != STATUS
        lowest, highest = _limits(field.bits, field.signed or is_total)
        outside = (column < lowest) | (column > highest)
        if outside.any():
            first = int(outside.argmax())
            raise InputError(
                f"sample {int(numbers[first, COUNTER])}, {_NAMES[field.target]}: "
                f"expected {lowest} to {highest}, the {field.bits} bits of profile {self._layout.name}, "
                f"got {int(column[first])}; "
                "use a profile with wider fields, or slower motion"
            )


class StreamEncoder(_Encoder):
    """Encoder of a stream profile; the running totals continue from call to call.

    Parameters
    ----------
    layout : Layout
        Layout of a stream profile.
    totals : array_like of int, shape (6,)
        Running totals before the first sample, gyro and accelerometer X Y Z; for profiles with totals.
    """

    def encode(self, pulses: Records) -> NDArray[np.uint8]:
        """Encode samples.

        Parameters
        ----------
        pulses : ndarray of PULSES, shape (n,)
            Each of one interval. Counters are sent modulo the width of their field; temperatures are rounded
            and clipped to theirs, NaN becomes 0 counts.

        Returns
        -------
        ndarray, shape (n, length)
            One frame a row.

        Raises
        ------
        InputError
            A number that its field cannot hold.
        """
        return self._messages(self._numbers(pulses), 0)


class CanEncoder(_Encoder):
    """Encoder of a CAN profile; the running totals continue from call to call.

    Parameters
    ----------
    layout : Layout
        Layout of a CAN profile.
    totals : array_like of int, shape (6,)
        Running totals before the first sample, gyro and accelerometer X Y Z; for profiles with totals.
    """

    def encode(self, pulses: Records) -> Records:
        """Encode samples.

        Parameters
        ----------
        pulses : ndarray of PULSES, shape (n,)
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
        numbers = self._numbers(pulses)
        kinds = self._layout.messages
        every = np.array([kind.every for kind in kinds])
        is_sent = pulses["counter"][:, np.newaxis] % every == 0
        place = np.cumsum(is_sent).reshape(is_sent.shape) - 1
        messages = np.zeros(np.count_nonzero(is_sent), MESSAGE)
        messages["fd"] = self._layout.fd
        for k, kind in enumerate(kinds):
            at = place[is_sent[:, k], k]
            messages["t_ns"][at] = pulses["arrival_ns"][is_sent[:, k]]
            messages["id"][at] = kind.can_id
            messages["length"][at] = kind.length
            messages["data"][at, : kind.length] = self._messages(numbers[is_sent[:, k]], k)
        return messages


def _limits(bits: int, signed: bool) -> tuple[int, int]:
    return (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if signed else (0, (1 << bits) - 1)


@kernel
def _write_rows(
    rows: NDArray[np.uint8], numbers: NDArray[np.int64], kind: np.void, fields: Records, constants: Records
) -> None:
    """Write messages of one kind, one a row."""
    check, big_endian = kind["check"], kind["big_endian"]
    for i in range(rows.shape[0]):
        row = rows[np.uint64(i)]
        for c in range(np.uint64(kind["first_constant"]), np.uint64(kind["end_constant"])):
            row[np.uint64(constants[c]["offset"])] = constants[c]["value"]
        for f in range(np.uint64(kind["first_field"]), np.uint64(kind["end_field"])):
            field = fields[f]
            value = numbers[np.uint64(i), np.uint64(field["target"])]
            _write(row, field["offset"], field["bits"], big_endian, value)
        if check["kind"] != CheckKind.NONE:
            _write(row, check["offset"], check["width"], big_endian, compute(row, 0, check))


@kernel
def _write(row: NDArray[np.uint8], p: int, bits: int, big_endian: bool, value: int) -> None:
    """Write the low `bits` (8, 16, 24, 32) of `value` at `p`."""
    for shift in range(0, bits, 8):
        at = p + (bits - 8 - shift if big_endian else shift) // 8
        row[np.uint64(at)] = value >> shift & 0xFF
