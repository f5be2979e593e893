"""Channels of a recording and the encoding of their messages."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from imudrv.records import MESSAGE, Records

WIRE: Final = "/imu50/wire"


INCREMENTS: Final = "/imu50/increments"


STATUS: Final = "/imu50/status"


EVENTS: Final = "/imu50/events"


BYTES: Final = "bytes"


CAN_MESSAGES: Final = "can-messages"


DATAGRAMS: Final = "i50n"


PROFILE: Final = "profile.yaml"


CALIBRATION: Final = "calibration.yaml"


ORIGIN: Final = "imu50"
"""Name of the metadata record."""


def pack_messages(pieces: Sequence[Records]) -> list[bytes]:
    """CAN messages as a recording has them.

    Each piece becomes a byte w, the longest data's length, and then for each message, little-endian: i64
    time (ns), u32 identifier, u8 length, u8 CAN FD (1) or not (0), u8[w] data, zeros behind the length.

    Parameters
    ----------
    pieces : sequence of ndarray of MESSAGE
        At least one; packed together since that is quicker.

    Returns
    -------
    list of bytes
        One a piece.
    """
    messages = np.concatenate(pieces)
    width = int(messages["length"].max(initial=0))
    packed = np.empty(messages.size, _packed_type(width))
    for name in ("t_ns", "id", "length", "fd"):
        packed[name] = messages[name]
    packed["data"] = messages["data"][:, :width]
    data, size, first = packed.tobytes(), packed.itemsize, bytes([width])
    ends = np.cumsum([piece.size for piece in pieces]).tolist()
    return [
        first + data[(end - piece.size) * size : end * size] for end, piece in zip(ends, pieces, strict=True)
    ]


def unpack_messages(data: bytes) -> Records:
    """CAN messages from a recording.

    Parameters
    ----------
    data : bytes
        From `pack_messages`.

    Returns
    -------
    ndarray of MESSAGE

    Raises
    ------
    ValueError
        It is something else.
    """
    width = data[0] if data else 65
    if width > 64:
        raise ValueError(f"expected the length of CAN data, 0 to 64, got {width}")
    packed = np.frombuffer(data, _packed_type(width), offset=1)
    if (packed["length"] > width).any():
        raise ValueError(f"expected CAN data of at most {width} bytes, got {packed['length'].max()}")
    messages = np.zeros(packed.size, MESSAGE)
    for name in ("t_ns", "id", "length", "fd"):
        messages[name] = packed[name]
    messages["data"][:, :width] = packed["data"]
    return messages


def _packed_type(width: int) -> np.dtype[np.void]:
    return np.dtype(
        [("t_ns", "<i8"), ("id", "<u4"), ("length", "u1"), ("fd", "u1"), ("data", "u1", (width,))]
    )
