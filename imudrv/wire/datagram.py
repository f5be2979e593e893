"""The output datagram `I50N`, version 1: 76 bytes per sample, one or more in a packet (ICD, section 7)."""

from fractions import Fraction
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.records import INCREMENTS, Records, Source
from imudrv.wire.check import compute_plain
from imudrv.wire.layout import SEQUENCE, Check, CheckKind, Field, Layout, Message, Sequence, SequenceKind
from imudrv.wire.stream import StreamDecoder
from imudrv.wire.tables import layout_tables

MAGIC: Final = b"I50N"


VERSION: Final = 1


DATAGRAM: Final = np.dtype(
    [
        ("magic", "S4"),
        ("version", "u1"),
        ("source", "u1"),
        ("flags", "<u2"),
        ("counter", "<u4"),
        ("interval_ns", "<u4"),
        ("t_ns", "<i8"),
        ("dtheta_b", "<f8", 3),
        ("dv_b", "<f8", 3),
        ("crc", "<u4"),
    ]
)


SIZE: Final = DATAGRAM.itemsize


_CHECKED: Final = SIZE - 4


_SAME: Final = ("flags", "counter", "interval_ns", "t_ns", "dtheta_b", "dv_b")


def encode(increments: Records, source: Source) -> bytes:
    """Encode compensated increments as datagrams.

    Parameters
    ----------
    increments : ndarray of INCREMENTS
        In order; the counter is sent modulo 2^32.
    source : Source
        Origin of the samples.

    Returns
    -------
    bytes
        76 per sample, back to back.
    """
    data = np.empty((len(increments), SIZE), np.uint8)
    fill_datagrams(increments, int(source), KINDS, data, data.view(DATAGRAM))
    return data.tobytes()


@kernel
def fill_datagrams(
    increments: Records, source: int, kinds: Records, data: NDArray[np.uint8], rows: Records
) -> None:
    """Encode increments.

    Parameters
    ----------
    increments : ndarray of INCREMENTS
        In order.
    source : int
        `Source` of the samples.
    kinds : ndarray
        `KINDS`.
    data : ndarray of uint8, shape (n, SIZE)
        Receives the datagrams.
    rows : ndarray of DATAGRAM, shape (n, 1)
        A view of `data`.
    """
    check = kinds[0]["plain_check"]
    for i in range(increments.shape[0]):
        sample, row, out = increments[i], rows[i, 0], data[i]
        for k in range(len(MAGIC)):
            out[k] = MAGIC[k]
        row["version"], row["source"] = VERSION, source
        row["flags"], row["counter"] = sample["flags"], np.uint32(sample["counter"] & 0xFFFFFFFF)
        row["interval_ns"], row["t_ns"] = sample["interval_ns"], sample["t_ns"]
        for k in range(3):
            row["dtheta_b"][k], row["dv_b"][k] = sample["dtheta_b"][k], sample["dv_b"][k]
        row["crc"] = np.uint32(compute_plain(out, 0, check))


class Received(NamedTuple):
    """Samples and rejects of a `DatagramDecoder`.

    Parameters
    ----------
    increments : ndarray of INCREMENTS
        In the order of arrival.
    source : ndarray of uint8
        `Source` of each.
    rejects : ndarray of REJECT
        Runs of bytes that are no datagram.
    """

    increments: Records
    source: NDArray[np.uint8]
    rejects: Records


_CHECK: Final = Check(
    CheckKind.CRC_REFLECTED,
    32,
    ((0, _CHECKED),),
    _CHECKED,
    polynomial=0x04C11DB7,
    init=0xFFFFFFFF,
    xor_out=0xFFFFFFFF,
)


_LAYOUT: Final = Layout(
    name="I50N",
    can=False,
    fd=False,
    interval=Fraction(1_000_000),
    sequence=Sequence(SequenceKind.COUNTER, 32),
    messages=(
        Message(
            SIZE,
            fields=(Field(SEQUENCE, 8, 4, bits=32),),
            constants=(*enumerate(MAGIC), (4, VERSION)),
            checks=(_CHECK,),
        ),
    ),
)


KINDS: Final = layout_tables(_LAYOUT)[0]
"""The datagram as a kind of message, for `fill_datagrams`."""


class DatagramDecoder:
    """Datagrams back to increments, from packets, a TCP stream or a serial line, in any pieces."""

    def __init__(self) -> None:
        self._finder = StreamDecoder(_LAYOUT)
        self._tail = np.zeros(0, np.uint8)

    def feed(self, data: bytes | bytearray | memoryview) -> Received:
        """Decode bytes.

        Parameters
        ----------
        data : bytes-like
            Any number of bytes.

        Returns
        -------
        Received
            Samples and rejects that they complete.
        """
        begin = self._finder.bytes_fed - self._finder.pending
        buffer = np.concatenate([self._tail, np.frombuffer(data, np.uint8)])
        found = self._finder.feed(data)
        self._tail = buffer[buffer.size - self._finder.pending :]
        places = (found.frames["offset"] - begin)[:, None] + np.arange(SIZE)
        rows = buffer[places].view(DATAGRAM)[:, 0] if len(places) else np.zeros(0, DATAGRAM)
        increments = np.zeros(len(rows), INCREMENTS)
        for name in _SAME:
            increments[name] = rows[name]
        return Received(increments, rows["source"], found.rejects)
