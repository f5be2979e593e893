"""Settings files that come with the package, found by name; a user's own is found by its path."""

import difflib
import os
from pathlib import Path

from imudrv.errors import InputError


def names(folder: Path) -> list[str]:
    """Return the names of the files in a folder of the package."""
    return sorted(path.stem for path in folder.glob("*.yaml"))


def find(kind: str, name_or_path: str | os.PathLike[str], folder: Path, known: str = "") -> Path:
    """Return the path of a file.

    Parameters
    ----------
    kind : str
        What it is, for messages: ``profile``.
    name_or_path : path-like
        Name of a file in the folder, or path of any file.
    folder : Path
        Folder of the package.
    known : str, optional
        What is in the folder, for messages; otherwise all names.

    Returns
    -------
    Path

    Raises
    ------
    InputError
        It is neither.
    """
    name = os.fspath(name_or_path)
    shipped = names(folder)
    if name in shipped:
        return folder / f"{name}.yaml"
    if not os.path.exists(name):
        near = difflib.get_close_matches(name, shipped, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise InputError(
            f"{kind} {name!r}: expected {known or 'one of ' + ', '.join(shipped)}, "
            f"or the path of a {kind} file; there is no such file{hint}"
        )
    return Path(name)
