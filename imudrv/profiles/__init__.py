"""Profiles: wire formats of units as data. Some come with the package; a user's own is read by its path.

schema  the profile file, checked completely, and its translation into the decoder's `Layout`
dbc     skeleton of a profile from a DBC file
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import Final

from imudrv.errors import InputError
from imudrv.files.settings_file import SettingsFile, read_file
from imudrv.profiles.schema import Profile

OWN: Final = ("imu50-rs422", "imu50-rs422-acc", "imu50-can", "imu50-canfd")
"""Shipped profiles of the 50-type unit; the others are of units of other makers."""


def shipped() -> list[str]:
    """Return the names of the profiles that come with the package."""
    return sorted(
        p.name.removesuffix(".yaml") for p in resources.files(__name__).iterdir() if p.name.endswith(".yaml")
    )


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
    with _file(name_or_path) as path:
        return read_file(path, Profile)


def content(name_or_path: str | os.PathLike[str]) -> bytes:
    """Return the content of a profile's file; see `load`."""
    with _file(name_or_path) as path:
        return path.read_bytes()


@contextmanager
def _file(name_or_path: str | os.PathLike[str]) -> Iterator[Path]:
    name = os.fspath(name_or_path)
    if name in shipped():
        with resources.as_file(resources.files(__name__) / f"{name}.yaml") as path:
            yield path
        return
    if not Path(name).exists():
        raise InputError(
            f"profile {name!r}: expected {', '.join(OWN)}, another one that `imudrv profiles` lists, "
            "or the path of a profile file; there is no such file"
        )
    yield Path(name)
