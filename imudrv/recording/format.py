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

from typing import Final

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import MESSAGE, Records
from imudrv.wire.fields import Bytes, word

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

MAX_TIME_NS: Final = 2**62
"""Largest time, and largest offset of a timebase: 146 years."""

_HEAD: Final = 14  # bytes of a packed CAN message before its data
_LONGEST: Final = 64


def pack_messages(messages: Records, ends: NDArray[np.int64]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Encode the CAN messages of several reads for a recording.

    A read becomes a byte w, at least the longest data's length, and then for each message, little-endian: i64
    time (ns), u32 identifier, u8 length, u8 CAN FD (1) or not (0), u8[w] data, zeros after the length.

    Parameters
    ----------
    messages : ndarray of MESSAGE
        Messages of all reads.
    ends : ndarray of int64, shape (n,)
        Where each read ends in them.

    Returns
    -------
    tuple of ndarray of uint8 and ndarray of int64
        Pieces, one a read, one behind the other; where each ends.
    """
    width = int(messages["length"].max(initial=0))
    packed = np.empty(messages.size, _packed_type(width))
    for name in ("t_ns", "id", "length", "fd"):
        packed[name] = messages[name]
    packed["data"] = messages["data"][:, :width]
    widths = np.full((len(ends), 1), width, np.uint8)
    return with_heads(widths, packed.view(np.uint8), packed.itemsize * ends)


def with_heads(
    heads: NDArray[np.uint8], data: NDArray[np.uint8], ends: NDArray[np.int64]
) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Put a head before each piece of some data.

    Parameters
    ----------
    heads : ndarray of uint8, shape (n, size)
        Head of each piece.
    data : ndarray of uint8
        Pieces, one behind the other.
    ends : ndarray of int64, shape (n,)
        Where each piece ends; the last one at the end of the data.

    Returns
    -------
    tuple of ndarray of uint8 and ndarray of int64
        Heads and pieces in turn; where each piece ends in them.
    """
    count, size = heads.shape
    new_ends = ends + size * np.arange(1, count + 1)
    begins = new_ends - np.diff(ends, prepend=0) - size
    is_head = np.zeros(data.size + heads.size, np.bool_)
    is_head[(begins[:, None] + np.arange(size)).ravel()] = True
    out = np.empty(is_head.size, np.uint8)
    out[is_head], out[~is_head] = heads.ravel(), data
    return out, new_ends


def unpack_messages(
    data: NDArray[np.uint8], ends: NDArray[np.int64]
) -> tuple[Records, NDArray[np.int64], str]:
    """Decode the CAN messages of several pieces of a recording.

    Parameters
    ----------
    data : ndarray of uint8
        Pieces from `pack_messages`, one behind the other.
    ends : ndarray of int64, shape (n,)
        Where each piece ends.

    Returns
    -------
    tuple of ndarray of MESSAGE, ndarray of int64 and str
        Messages of all pieces up to the first faulty one; where each piece ends in them; what is wrong with
        the faulty one, empty without any.
    """
    messages = np.zeros(data.size // _HEAD, MESSAGE)
    message_ends = np.zeros(len(ends), np.int64)
    count, good = _unpack(data, ends, messages, message_ends)
    fault = "" if good == len(ends) else f"expected CAN messages of at most {_LONGEST} bytes, got other bytes"
    return messages[:count], message_ends[:good], fault


@kernel
def _unpack(
    data: Bytes, ends: NDArray[np.int64], messages: Records, message_ends: NDArray[np.int64]
) -> tuple[int, int]:
    """Return the number of messages, and of pieces up to the first faulty one."""
    begin = count = 0
    for k in range(ends.shape[0]):
        end = ends[k]
        if begin == end or data[begin] > _LONGEST or (end - begin - 1) % (_HEAD + data[begin]):
            return count, k
        width, found = np.int64(data[begin]), count
        for p in range(begin + 1, end, _HEAD + width):
            message, length = messages[found], data[p + 12]
            if length > width:
                return count, k
            message["t_ns"], message["id"] = word(data, p, 8, False), word(data, p + 8, 4, False)
            message["length"], message["fd"] = length, data[p + 13]
            for b in range(width):
                message["data"][b] = data[p + _HEAD + b]
            found += 1
        message_ends[k] = count = found
        begin = end
    return count, ends.shape[0]


def _packed_type(width: int) -> np.dtype[np.void]:
    return np.dtype(
        [("t_ns", "<i8"), ("id", "<u4"), ("length", "u1"), ("fd", "u1"), ("data", "u1", (width,))]
    )
