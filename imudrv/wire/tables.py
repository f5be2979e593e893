"""A layout as arrays, the form that the kernels of this package read."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.wire.check import crc_table, start_value
from imudrv.wire.layout import Layout, Message


class Tables(NamedTuple):
    """One message as arrays; see `imudrv.wire.fields` and `imudrv.wire.check`."""

    length: int
    big_endian: bool
    constants: NDArray[np.int64]
    fields: NDArray[np.int64]
    check: NDArray[np.int64]
    crc_table: NDArray[np.uint32]


def message_tables(layout: Layout, message: Message) -> Tables:
    """Put one message of a layout into arrays.

    Parameters
    ----------
    layout : Layout
        Of the profile.
    message : Message
        One of its messages.

    Returns
    -------
    Tables
    """
    check = message.check
    row = (check.kind, check.width, check.start, check.stop, check.offset, start_value(check), check.xor_out)
    return Tables(
        message.length,
        layout.big_endian,
        np.array(message.constants, np.int64).reshape(-1, 2),
        np.array(message.fields, np.int64).reshape(-1, 4),
        np.array(row, np.int64),
        crc_table(check),
    )
