"""A layout as arrays, the form that the kernels of this package read."""

from typing import Final, TypeAlias

import numpy as np

from imudrv.records import Records
from imudrv.wire.check import CHECK, check_table
from imudrv.wire.layout import COUNTER, Layout, Message

FIELD: Final = np.dtype(
    [
        ("target", np.int64),  # what it is, see `imudrv.wire.layout.Field`
        ("offset", np.int64),
        ("bits", np.int64),
        ("signed", np.bool_),
    ],
    align=True,
)
"""One number of a message."""

CONSTANT: Final = np.dtype([("offset", np.int64), ("value", np.int64)], align=True)
"""A byte of a message that never changes."""

KIND: Final = np.dtype(
    [
        ("can_id", np.int64),
        ("length", np.int64),  # bytes
        ("big_endian", np.bool_),
        ("first_field", np.int64),  # rows of the table of fields, `end_field` excluded
        ("end_field", np.int64),
        ("first_constant", np.int64),  # and of constants
        ("end_constant", np.int64),
        ("in_every_sample", np.bool_),
        ("counter_offset", np.int64),  # 0 without a counter
        ("counter_bits", np.int64),  # 0 without a counter
        ("check", CHECK),
    ],
    align=True,
)
"""One kind of message."""


Tables: TypeAlias = tuple[Records, Records, Records]
"""Rows of `KIND`, `FIELD` and `CONSTANT`, those of all kinds stacked.

A plain tuple: a named one is 1 us slower to hand over to a kernel.
"""


def layout_tables(layout: Layout) -> Tables:
    """Put the messages of a layout into arrays.

    Parameters
    ----------
    layout : Layout
        Layout of the profile.

    Returns
    -------
    Tables
        Kinds in the layout's order.
    """
    kinds = np.zeros(len(layout.messages), KIND)
    fields = [field for message in layout.messages for field in message.fields]
    constants = [constant for message in layout.messages for constant in message.constants]
    first_field = first_constant = 0
    for kind, message in zip(kinds, layout.messages, strict=True):
        _fill_kind(kind, message, layout.big_endian)
        kind["first_field"], kind["first_constant"] = first_field, first_constant
        first_field += len(message.fields)
        first_constant += len(message.constants)
        kind["end_field"], kind["end_constant"] = first_field, first_constant
    return kinds, np.array(fields, FIELD), np.array(constants, CONSTANT)


def _fill_kind(kind: np.void, message: Message, big_endian: bool) -> None:
    kind["can_id"], kind["length"], kind["big_endian"] = message.can_id, message.length, big_endian
    kind["in_every_sample"] = message.every == 1
    for field in message.fields:
        if field.target == COUNTER:
            kind["counter_offset"], kind["counter_bits"] = field.offset, field.bits
    kind["check"] = check_table(message.check)
