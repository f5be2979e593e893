"""Channels of a recording, an MCAP file (https://mcap.dev/spec), and the encoding of their messages.

=====================  ==========================================================================
channel                a message
=====================  ==========================================================================
``/imu50/wire``        one read of the port at its host time: ``bytes`` as received, or
                       ``can-messages`` (see `pack_messages`)
``/imu50/clock``       ``json``: the `Timebase` of the reads that follow; the default one until the first
``/imu50/increments``  ``i50n``: datagrams back to back
``/imu50/status``      ``json``: status of the service
``/imu50/events``      ``json``: ``{"text": ...}``, an event of the service
=====================  ==========================================================================

The attachments ``profile.yaml`` and ``calibration.yaml`` make a recording self-contained; a calibration that
was exchanged later is attached again at its time. The metadata record ``imu50`` is the recording's origin.

The times of all messages are on the scale of the arrivals, which does not step; those within datagrams are
UNIX time.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np

from imudrv.records import MESSAGE, Records

WIRE: Final = "/imu50/wire"
INCREMENTS: Final = "/imu50/increments"
CLOCK: Final = "/imu50/clock"
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
    """Encode CAN messages for a recording.

    Each piece becomes a byte w, the longest data's length, and then for each message, little-endian: i64
    time (ns), u32 identifier, u8 length, u8 CAN FD (1) or not (0), u8[w] data, zeros after the length.

    Parameters
    ----------
    pieces : sequence of ndarray of MESSAGE
        At least one; encoded together because that is faster.

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
    """Decode CAN messages of a recording.

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
        The data are no such messages.
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
