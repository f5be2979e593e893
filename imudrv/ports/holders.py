"""Programs that have a device open."""

import os
from contextlib import suppress
from pathlib import Path


def holders(device: Path, proc: Path = Path("/proc")) -> tuple[list[str], bool]:
    """Return the other processes that have a device open, as far as this user may see them.

    Parameters
    ----------
    device : Path
        Path of the device, without symbolic links.
    proc : Path
        Folder of the processes; without it, as on other systems than Linux, none is found.

    Returns
    -------
    list of str
        Such as ``cat (process 4711)``.
    bool
        Whether all processes could be inspected.
    """
    found = []
    all_inspected = proc.is_dir()
    for process in proc.glob("[0-9]*"):
        if process.name == str(os.getpid()):
            continue
        try:
            links = [os.readlink(fd) for fd in (process / "fd").iterdir()]
        except PermissionError:
            all_inspected = False
            continue
        except OSError:
            continue  # it has ended
        if str(device) in links:
            name = "?"
            with suppress(OSError):
                name = (process / "comm").read_text().strip()
            found.append(f"{name} (process {process.name})")
    return found, all_inspected
