"""Files of the user's configuration."""

import os
from pathlib import Path


def config_file(name: str) -> Path | None:
    """Return the path of a file in the user's configuration, ``~/.config/imu50``, whether it exists or not.

    Parameters
    ----------
    name : str
        Name of the file.

    Returns
    -------
    Path or None
        None for a user without a home.
    """
    folder = os.environ.get("XDG_CONFIG_HOME", "")
    if not os.path.isabs(folder):  # the standard ignores a relative one
        folder = os.path.expanduser("~/.config")
    return Path(folder) / "imu50" / name if os.path.isabs(folder) else None
