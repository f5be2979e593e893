"""Profiles: wire formats of units as data. Some come with the package; a user's own is read by its path.

schema       the profile file, checked completely
messages     its messages: numbers and checks
translation  to the decoder's `Layout`
advice       what to write instead of what a profile cannot say
summary      what a profile says, in a few lines
line_load    how much of the line its samples take
dbc          skeleton of a profile from a DBC file
version_1    profiles of version 1 in the words of version 2
"""

import os
from pathlib import Path
from typing import Final

from imudrv.files import shipped as shipped_files
from imudrv.files.settings_file import SettingsFile, read_file
from imudrv.profiles.schema import Profile

OWN: Final = ("imu50-rs422", "imu50-rs422-acc", "imu50-can", "imu50-canfd")
"""Shipped profiles of the 50-type unit; the others are of units of other makers."""
_FOLDER: Final = Path(__file__).parent


def shipped() -> list[str]:
    """Return the names of the profiles that come with the package."""
    return shipped_files.names(_FOLDER)


def load(name_or_path: str | os.PathLike[str]) -> Profile:
    """Read a profile, by the name of a shipped one or by the path of a file.

    Parameters
    ----------
    name_or_path : path-like
        ``imu50-rs422``, or ``my/unit.yaml``.

    Returns
    -------
    Profile
        Checked.

    Raises
    ------
    InputError
        No such profile, or one with faults.
    """
    return load_file(name_or_path).model


def load_file(name_or_path: str | os.PathLike[str]) -> SettingsFile[Profile]:
    """Read a profile together with the content of its file; see `load`."""
    return read_file(_find(name_or_path), Profile)


def content(name_or_path: str | os.PathLike[str]) -> bytes:
    """Return the content of a profile's file; see `load`."""
    return _find(name_or_path).read_bytes()


def _find(name_or_path: str | os.PathLike[str]) -> Path:
    known = f"{', '.join(OWN)}, another one that `imudrv profiles` lists"
    return shipped_files.find("profile", name_or_path, _FOLDER, known)
