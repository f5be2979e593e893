"""The decoder of a recorded capture: the stages that its profile needs, and a tally of what is no frame."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from imudrv.records import Reason, Records
from imudrv.wire.can import CanAssembler
from imudrv.wire.candump import CandumpDecoder
from imudrv.wire.layout import Layout
from imudrv.wire.stream import StreamDecoder

_SHOWN: Final = 3


@dataclass
class Rejected:
    """What one reason took away.

    Parameters
    ----------
    stretches, length : int
        How many, and how many bytes (of assembled CAN: messages) together.
    first : list of int
        Offsets of the first few.
    """

    stretches: int = 0
    length: int = 0
    first: list[int] = field(default_factory=list)


class CaptureDecoder:
    """Bytes of a capture to frames: a serial stream, or the text of a candump log.

    Parameters
    ----------
    layout : Layout
        Of the profile.
    """

    def __init__(self, layout: Layout) -> None:
        self.rejected: dict[Reason, Rejected] = {}
        self._log = CandumpDecoder() if layout.can else None
        self._messages = CanAssembler(layout) if layout.can else None
        self._stream = None if layout.can else StreamDecoder(layout)

    def feed(self, data: bytes | memoryview) -> Records:
        """Take bytes in.

        Parameters
        ----------
        data : bytes-like
            Any number of bytes.

        Returns
        -------
        ndarray of FRAME
            The frames that became complete.
        """
        if self._stream is not None:
            return self._keep(self._stream.feed(data))
        assert self._log is not None
        assert self._messages is not None
        messages, rejects = self._log.feed(data)
        self._tally(rejects)
        return self._keep(self._messages.feed(messages))

    def close(self) -> Records:
        """End of the capture.

        Returns
        -------
        ndarray of FRAME
            The frames that were held back.
        """
        if self._stream is not None:
            return self._keep(self._stream.close())
        assert self._log is not None
        assert self._messages is not None
        messages, rejects = self._log.close()
        self._tally(rejects)
        last = self._keep(self._messages.feed(messages))
        return np.concatenate([last, self._keep(self._messages.close())])

    def _keep(self, decoded: tuple[Records, Records]) -> Records:
        frames, rejects = decoded
        self._tally(rejects)
        return frames

    def _tally(self, rejects: Records) -> None:
        for reason in np.unique(rejects["reason"]):
            same = rejects[rejects["reason"] == reason]
            entry = self.rejected.setdefault(Reason(reason), Rejected())
            entry.stretches += len(same)
            entry.length += int(same["length"].sum())
            entry.first += same["offset"][: _SHOWN - len(entry.first)].tolist()
