"""Arguments that are either a path or what the file contains, and the check of the unit described."""

import os
from typing import TypeAlias

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.profiles.schema import Profile
from imudrv.site import Site
from imudrv.wire.layout import Layout

StrPath: TypeAlias = str | os.PathLike[str]


def site_of(site: StrPath | Site) -> Site:
    """Return the site, read from its file where a path is given."""
    return site if isinstance(site, Site) else settings_file.read(site, Site)


def profile_of(profile: StrPath | Profile | None) -> Profile | None:
    """Return the profile, read by its name or path where one is given."""
    if profile is None or isinstance(profile, Profile):
        return profile
    return profiles.load(os.fspath(profile))


def require_six_axes(layout: Layout) -> Layout:
    """Return the layout of a unit that has all the sensors that identification and validation need.

    Parameters
    ----------
    layout : Layout
        Layout of the profile.

    Returns
    -------
    Layout
        The same.

    Raises
    ------
    InputError
        The unit lacks a gyro or an accelerometer.
    """
    if any(layout.missing_axes):
        sensors = []
        for name, sensor in (("gyro", layout.gyro), ("accelerometer", layout.accelerometer)):
            axes = [letter for letter, axis in zip("XYZ", sensor.axes, strict=True) if axis]
            if axes:
                sensors.append(f"{name}{'s' if len(axes) > 1 else ''} {', '.join(axes)}")
        has = " and ".join(sensors)
        raise InputError(f"calib needs three gyros and three accelerometers; {layout.name} has {has} only")
    return layout
