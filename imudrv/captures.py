"""A recorded capture through the stages that live samples take: decode, account, compensate."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.imu.accounting import Accountant
from imudrv.imu.compensation import Compensator
from imudrv.records import Flag, Records
from imudrv.wire.decoder import CaptureDecoder
from imudrv.wire.layout import Layout

CHUNK_BYTES = 1 << 19
"""Read at once: small enough for the cache, large enough that Python's part does not show."""


class Capture:
    """A capture file and the books on it.

    Parameters
    ----------
    path : Path
        Wire bytes; for a CAN profile a candump log.
    layout : Layout
        Of its profile.

    Raises
    ------
    InputError
        There is no such file, or it is empty.
    """

    def __init__(self, path: Path, layout: Layout) -> None:
        self.path = path
        self.layout = layout
        self.decoder = CaptureDecoder(layout)
        self.accountant = Accountant(layout)
        try:
            with path.open("rb") as file:
                self._head = file.read(1 << 16)
            self.size = path.stat().st_size
        except OSError as error:
            raise InputError(f"{path}: expected a capture file, cannot read it: {error.strerror}") from error
        if not self._head:
            raise InputError(f"{path}: expected a capture of {layout.name}, got an empty file")

    def pulses(self, advance: Callable[[int], None]) -> Iterator[Records]:
        """Decode the file, piece by piece.

        Parameters
        ----------
        advance : callable
            Told the number of bytes read after each piece.

        Yields
        ------
        ndarray of PULSES
            In order.

        Raises
        ------
        InputError
            The whole file held no frame of the profile; says which shipped profile fits, if one does.
        """
        with self.path.open("rb") as file:
            while data := file.read(CHUNK_BYTES):
                yield self.accountant.feed(self.decoder.feed(data))
                advance(len(data))
        yield self.accountant.feed(self.decoder.close())
        if self.accountant.account.frames == 0:
            raise InputError(
                f"{self.path}: expected frames of {self.layout.name}, "
                f"got none in {self.size} bytes{self._hint()}"
            )

    def increments(self, compensator: Compensator, advance: Callable[[int], None]) -> Iterator[Records]:
        """Decode and compensate the file, piece by piece.

        Parameters
        ----------
        compensator : Compensator
            For this layout.
        advance : callable
            Told the number of bytes read after each piece.

        Yields
        ------
        ndarray of INCREMENTS
            In order; times count from the beginning of the capture, and are flagged as not UNIX time.
        """
        for pulses in self.pulses(advance):
            yield _unlocked(compensator.feed(pulses))
        yield _unlocked(compensator.close())

    def _hint(self) -> str:
        for name in profiles.shipped():
            layout = profiles.load(name).layout()
            if layout.name != self.layout.name and len(CaptureDecoder(layout).feed(self._head)):
                return f"; its beginning has frames of {name}: try --profile {name}"
        return "; is it the right file, and the right --profile?"


def _unlocked(increments: Records) -> Records:
    increments["flags"] |= np.uint32(Flag.CLOCK_UNLOCKED)
    return increments
