"""Arguments that are either a path or what the file contains."""

import os
from typing import TypeAlias

from imudrv import profiles
from imudrv.files import settings_file
from imudrv.profiles.schema import Profile
from imudrv.site import Site

StrPath: TypeAlias = str | os.PathLike[str]


def site_of(site: StrPath | Site) -> Site:
    """Return the site, read from its file where a path is given."""
    return site if isinstance(site, Site) else settings_file.read(site, Site)


def profile_of(profile: StrPath | Profile | None) -> Profile | None:
    """Return the profile, read by its name or path where one is given."""
    if profile is None or isinstance(profile, Profile):
        return profile
    return profiles.load(os.fspath(profile))
