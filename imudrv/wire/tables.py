"""A layout as arrays, the form that the kernels of this package read."""

from typing import Final, TypeAlias

import numpy as np

from imudrv.records import Records
from imudrv.wire.check import CHECK, check_table
from imudrv.wire.layout import SEQUENCE, Field, Layout, Message

FIELD: Final = np.dtype(
    [
        ("target", np.int64),  # what it is, see `imudrv.wire.layout.Field`
        ("offset", np.int64),
        ("size", np.int64),
        ("shift", np.int64),
        ("bits", np.int64),
        ("signed", np.bool_),
        ("is_float", np.bool_),
        ("big_endian", np.bool_),
        ("zero", np.int64),
        ("sign", np.int64),
        ("place", np.int64),
        ("ticks", np.float64),
    ],
    align=True,
)
"""One number of a message."""

MULTIPLEXED: Final = np.dtype(
    [("field", FIELD), ("selector", FIELD), ("modulo", np.int64), ("value", np.int64)], align=True
)
"""One number of some messages."""

CONSTANT: Final = np.dtype([("offset", np.int64), ("value", np.int64)], align=True)
"""A byte of a message that never changes."""

KIND: Final = np.dtype(
    [
        ("can_id", np.int64),
        ("can_mask", np.int64),
        ("length", np.int64),  # bytes
        ("first_field", np.int64),  # rows of the table of fields, `end_field` excluded,
        ("end_plain", np.int64),  # plain ones first,
        ("end_field", np.int64),
        ("first_multiplexed", np.int64),  # of multiplexed ones,
        ("end_multiplexed", np.int64),
        ("first_constant", np.int64),  # of constants
        ("end_constant", np.int64),
        ("first_check", np.int64),  # and of checks
        ("end_check", np.int64),
        ("part", np.int64),  # which one of those that every sample has; -1: of none
        ("is_skipped", np.bool_),  # there is nothing in it
        ("sequence", FIELD),  # bits 0: without one
        ("plain_check", CHECK),  # kind 0: without one
    ],
    align=True,
)
"""One kind of message."""

Tables: TypeAlias = tuple[Records, Records, Records, Records, Records]
"""Rows of `KIND`, `FIELD`, `MULTIPLEXED`, `CONSTANT` and `CHECK`, those of all kinds stacked.

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
    fields: list[Field] = []
    multiplexed: list[tuple[Field, Field, int, int]] = []
    constants: list[tuple[int, int]] = []
    checks: list[np.void] = []
    part = 0
    for kind, message in zip(kinds, layout.messages, strict=True):
        kind["first_field"], kind["first_multiplexed"] = len(fields), len(multiplexed)
        kind["first_constant"], kind["first_check"] = len(constants), len(checks)
        plain = [field for field in message.fields if field.is_plain]
        fields += plain
        kind["end_plain"] = len(fields)
        fields += [field for field in message.fields if not field.is_plain]
        multiplexed += message.multiplexed
        constants += message.constants
        rest = message.checks
        if message.plain_check is not None:
            kind["plain_check"], rest = check_table(message.plain_check), rest[1:]
        checks += [check_table(check) for check in rest]
        kind["end_field"], kind["end_multiplexed"] = len(fields), len(multiplexed)
        kind["end_constant"], kind["end_check"] = len(constants), len(checks)
        kind["part"] = part if message.is_part else -1
        part += message.is_part
        _fill_kind(kind, message)
    return (
        kinds,
        np.array(fields, FIELD),
        np.array(multiplexed, MULTIPLEXED),
        np.array(constants, CONSTANT),
        np.array(checks, CHECK),
    )


def _fill_kind(kind: np.void, message: Message) -> None:
    kind["can_id"], kind["can_mask"], kind["length"] = message.can_id, message.can_mask, message.length
    kind["is_skipped"] = not (message.fields or message.multiplexed)
    for field in message.fields:
        if field.target == SEQUENCE:
            kind["sequence"] = field
