"""Errors of this product.

A message says what was expected, what was found, where, and what to do. The command line turns `InputError`
into exit code 2; any other exception that escapes is a defect of this product.
"""

from collections.abc import Sequence

from imudrv.wording import counted


class Imu50Error(Exception):
    """Base of all errors that this product raises on purpose."""


class InputError(Imu50Error):
    """A file, an option or a value that the user gave cannot be used."""


class FaultyFileError(InputError):
    """A settings file with faults; all of them are reported at once.

    Parameters
    ----------
    path : str
        The file.
    faults : sequence of str
        One sentence a fault, each beginning with the place inside the file.
    """

    def __init__(self, path: str, faults: Sequence[str]) -> None:
        self.path = path
        self.faults = tuple(faults)
        super().__init__("\n  ".join([f"{path}: {counted(len(self.faults), 'fault')}", *self.faults]))
