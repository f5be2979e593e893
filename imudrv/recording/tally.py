"""What an export has counted, and what it needs of a recording."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from imudrv.errors import InputError
from imudrv.recording.reader import Recording
from imudrv.records import Flag, Records


class Exported(NamedTuple):
    """What an export wrote.

    Parameters
    ----------
    written : int
        Samples; for ``raw`` bytes, for ``candump`` messages.
    invalid : int
        Samples among them that are not valid.
    """

    written: int
    invalid: int


class Tally:
    """Counts what goes through."""

    def __init__(self) -> None:
        self.result = Exported(0, 0)

    def of(self, pieces: Iterator[Records]) -> Iterator[Records]:
        """Pass the increments on and count them."""
        for increments in pieces:
            yield increments
            invalid = np.count_nonzero(increments["flags"] & Flag.VALID == 0)
            self.result = Exported(self.result.written + increments.size, self.result.invalid + int(invalid))


def require_transport(recording: Recording, transport: str, instead: str) -> None:
    """Raise `InputError` unless the recording is of the transport."""
    came = recording.profile.transport
    if came != transport:
        raise InputError(
            f"{recording.path}: expected a recording of a {transport} unit, got {came}: {instead}"
        )
