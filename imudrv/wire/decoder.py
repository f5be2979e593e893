"""Decoder from wire data to frames by profile, with counts of rejected input."""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from imudrv.records import MESSAGE, Reason, Records
from imudrv.wire.can import CanAssembler
from imudrv.wire.candump import CandumpDecoder
from imudrv.wire.layout import Layout
from imudrv.wire.stream import StreamDecoder

_SHOWN: Final = 3


@dataclass
class RejectedRuns:
    """Runs of input that were rejected for one reason.

    Parameters
    ----------
    runs, length : int
        Number of runs, and of bytes (of assembled CAN: messages) in all of them.
    first : list of int
        Offsets of the first few.
    """

    runs: int = 0
    length: int = 0
    first: list[int] = field(default_factory=list)


class FrameDecoder:
    """Wire bytes, or CAN messages, to frames.

    Parameters
    ----------
    layout : Layout
        Layout of the profile.

    Attributes
    ----------
    decoder : CanAssembler or StreamDecoder
        The decoder of the layout's transport.
    """

    def __init__(self, layout: Layout) -> None:
        self.rejected: dict[Reason, RejectedRuns] = {}
        self.decoder = CanAssembler(layout) if layout.can else StreamDecoder(layout)

    def feed(self, data: bytes | memoryview | Records, t_ns: int = 0) -> Records:
        """Decode what arrived.

        Parameters
        ----------
        data : bytes-like or ndarray of MESSAGE
            Any number of bytes, or for a CAN profile messages.
        t_ns : int
            Time of arrival of bytes; messages have their own.

        Returns
        -------
        ndarray of FRAME
            The frames that became complete.
        """
        if isinstance(self.decoder, CanAssembler) and isinstance(data, np.ndarray):
            frames, rejects = self.decoder.feed(data)
        elif isinstance(self.decoder, StreamDecoder) and not isinstance(data, np.ndarray):
            frames, rejects = self.decoder.feed(data, t_ns)
        else:
            raise TypeError("expected CAN messages for a CAN profile, bytes for any other")
        if rejects.size:
            self.count_rejects(rejects)
        return frames

    def feed_reads(
        self,
        data: NDArray[Any],
        ends: NDArray[np.int64],
        times: NDArray[np.int64],
    ) -> Records:
        """Decode several reads at once; the frames are those of feeding one read after the other.

        Parameters
        ----------
        data : ndarray of uint8 or of MESSAGE
            All their bytes, or for a CAN profile messages.
        ends : ndarray of int64, shape (n,)
            Where each read ends in the data; the last one at their end.
        times : ndarray of int64, shape (n,)
            Time of arrival of each read; messages have their own.

        Returns
        -------
        ndarray of FRAME
            The frames that became complete.
        """
        if data.dtype == MESSAGE:
            return self.feed(data)
        if not isinstance(self.decoder, StreamDecoder):
            raise TypeError("expected CAN messages for a CAN profile, got bytes")
        frames, rejects = self.decoder.feed_reads(data, ends, times)
        if rejects.size:
            self.count_rejects(rejects)
        return frames

    def close(self) -> Records:
        """End of the line.

        Returns
        -------
        ndarray of FRAME
            The frames that were held back.
        """
        frames, rejects = self.decoder.close()
        self.count_rejects(rejects)
        return frames

    def count_rejects(self, rejects: Records) -> None:
        """Count rejects by reason."""
        for reason in np.unique(rejects["reason"]):
            same = rejects[rejects["reason"] == reason]
            entry = self.rejected.setdefault(Reason(reason), RejectedRuns())
            entry.runs += len(same)
            entry.length += int(same["length"].sum())
            entry.first += same["offset"][: _SHOWN - len(entry.first)].tolist()


class CaptureDecoder:
    """Bytes of a capture to frames: a serial stream, or the text of a candump log.

    Parameters
    ----------
    layout : Layout
        Layout of the profile.
    channel : str, optional
        The channel of a candump log to read; that of the first message if absent.
    """

    def __init__(self, layout: Layout, channel: str | None = None) -> None:
        self._frames = FrameDecoder(layout)
        self.log = CandumpDecoder(channel) if layout.can else None

    @property
    def rejected(self) -> dict[Reason, RejectedRuns]:
        """Rejected runs, by reason."""
        return self._frames.rejected

    def feed(self, data: bytes | memoryview) -> Records:
        """Decode bytes.

        Parameters
        ----------
        data : bytes-like
            Any number of bytes.

        Returns
        -------
        ndarray of FRAME
            The frames that became complete.
        """
        if self.log is None:
            return self._frames.feed(data)
        messages, rejects = self.log.feed(data)
        self._frames.count_rejects(rejects)
        return self._frames.feed(messages)

    def close(self) -> Records:
        """End of the capture.

        Returns
        -------
        ndarray of FRAME
            The frames that were held back.
        """
        if self.log is None:
            return self._frames.close()
        messages, rejects = self.log.close()
        self._frames.count_rejects(rejects)
        return np.concatenate([self._frames.feed(messages), self._frames.close()])
