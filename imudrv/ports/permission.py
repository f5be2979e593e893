"""Who may open a device, and how a user becomes one of them."""

import stat
from pathlib import Path
from typing import Final

RULES: Final = "99-imu50.rules"
"""Udev rules of this product, among the files of `imudrv files`."""

RULES_ADVICE: Final = f"install the udev rules {RULES}, which `imudrv files --to DIR` writes"

_GROUP_MAY: Final = stat.S_IRGRP | stat.S_IWGRP


def permission_advice(device: Path) -> str:
    """Return what gives a user permission for a device; never to join the group of root.

    Parameters
    ----------
    device : Path
        The device.

    Returns
    -------
    str
        One sentence without a capital letter and a full stop.
    """
    try:
        found, group = device.stat(), device.group()
    except (OSError, KeyError, NotImplementedError):  # a group without a name; a system without groups
        return "run as a user with permission"
    if found.st_gid == 0 or found.st_mode & _GROUP_MAY != _GROUP_MAY:
        return f"no group of users may open it: {RULES_ADVICE}"
    return f"its group is {group}: `sudo usermod -aG {group} $USER`, then log in again; or {RULES_ADVICE}"
