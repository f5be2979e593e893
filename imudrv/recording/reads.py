"""Reads of the port out of the bytes of a recording, thousands in one call.

A live read brings one sample of some 40 bytes, so a recording is mostly messages of that size: an object of
Python for each would take longer than all that is computed from it.
"""

from typing import Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import Channel
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.recording.format import CLOCK, MAX_TIME_NS, WIRE
from imudrv.wire.fields import Bytes, word

_RECORD_HEAD: Final = 9  # kind, length
_MESSAGE_HEAD: Final = 22  # channel, sequence, two times
_LEAST: Final = _RECORD_HEAD + _MESSAGE_HEAD
_CHANNELS: Final = 1 << 16
_OPCODE: Final = int(Opcode.MESSAGE)
_STOP, _SKIP, _TAKE = range(3)
"""What to do with a message, by its channel."""


class Recorded(NamedTuple):
    """Reads as they are in the file: of CAN messages, `data` are packed.

    Parameters
    ----------
    encoding : str
        Encoding of the messages.
    data, ends, times
        See `imudrv.records.Reads`.
    places : ndarray of int64, shape (n,)
        Where the record of each read begins.
    """

    encoding: str
    data: NDArray[np.uint8]
    ends: NDArray[np.int64]
    times: NDArray[np.int64]
    places: NDArray[np.int64]


class Gatherer:
    """Gathers the reads at the beginning of a run of records."""

    def __init__(self) -> None:
        self._encoding = ""
        self._use = np.full(_CHANNELS, _STOP, np.uint8)

    def add(self, channel: Channel) -> None:
        """Add a channel: messages of unknown ones are not passed over."""
        use = _STOP if channel.topic == CLOCK else _SKIP
        if channel.topic == WIRE:
            self._encoding = self._encoding or channel.message_encoding
            use = _TAKE if channel.message_encoding == self._encoding else _STOP
        self._use[channel.id] = use

    def gather(self, records: bytes) -> tuple[int, Recorded]:
        """Take the reads from whole messages, up to the first record that needs a closer look.

        Parameters
        ----------
        records : bytes
            From the beginning of a record; the last one may be cut.

        Returns
        -------
        tuple of int and Recorded
            Number of bytes that are done with; the reads in them.
        """
        data = np.frombuffer(records, np.uint8)
        out = np.empty(data.size, np.uint8)
        ends, times, places = np.empty((3, data.size // _LEAST), np.int64)
        position, filled, count = _gather(data, self._use, out, ends, times, places)
        return position, Recorded(self._encoding, out[:filled], ends[:count], times[:count], places[:count])


@kernel
def _gather(
    data: Bytes,
    use: Bytes,
    out: Bytes,
    ends: NDArray[np.int64],
    times: NDArray[np.int64],
    places: NDArray[np.int64],
) -> tuple[int, int, int]:
    """Copy the data of messages one behind the other; see `Gatherer.gather`.

    Returns
    -------
    tuple of 3 int
        Where the first other record begins, bytes copied, number of reads.
    """
    p = filled = count = 0
    while p + _LEAST <= data.size:
        stop = p + _RECORD_HEAD + word(data, p + 1, 8, False)  # of a huge length: negative
        what = use[word(data, p + 9, 2, False)]
        if data[p] != _OPCODE or what == _STOP or stop < p + _LEAST or stop > data.size:
            break
        if what == _TAKE:
            t_ns = word(data, p + 15, 8, False)
            if t_ns < 0 or t_ns > MAX_TIME_NS:
                break
            for at in range(p + _LEAST, stop):
                out[filled] = data[at]
                filled += 1
            ends[count], times[count], places[count] = filled, t_ns, p
            count += 1
        p = stop
    return p, filled, count
