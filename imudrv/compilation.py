"""Compilation of all kernels ahead of use, by processes of their own.

Compiled kernels are loaded in milliseconds. To compile all takes the better part of a minute on one core, and
a process that has compiled keeps tens of megabytes for it. So a program that misses a kernel for the first
time has all of them compiled, by two processes, and then loads what it needs. Other users of the package
compile each kernel where they call it.

What is compiled is in `imudrv.kernel_parts`, which only those processes import.
"""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

PARTS: Final = (
    "frames",
    "samples",
    "compensation",
    "messages",
    "simulation",
    "clock",
    "encoding",
    "navigation",
    "live_bytes",
    "live_messages",
    "logs",
    "recordings",
    "bench",
    "allan_deviations",
)
"""Functions of `imudrv.kernel_parts`: the long ones and those that others are made of come first."""

DONE: Final = b"."
"""Written by a process when it is done with a part,"""
COMPILING: Final = b"c"
"""and when it begins to compile a kernel."""

_PROCESSES: Final = 2

_UNUSED_S: Final = 28 * 86_400.0
"""Kernels of another version are removed if none was added for this time, s."""

_is_program = False


def compile_all_at_first_miss() -> None:
    """Have all kernels compiled when this process first misses one."""
    global _is_program
    _is_program = True


def missed_a_kernel(folder: Path) -> bool:
    """Have all kernels compiled if this is a program's first miss.

    Parameters
    ----------
    folder : Path
        Where compiled kernels are kept.

    Returns
    -------
    bool
        Whether it is worth looking for the kernel again.
    """
    global _is_program
    if not _is_program:
        return False
    _is_program = False
    if not can_keep(folder):
        return False
    compile_all()
    remove_unused(folder)
    return True


def can_keep(folder: Path) -> bool:
    """Make the folder of compiled kernels; return whether this user can write to it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)


def remove_unused(folder: Path) -> None:
    """Remove the kernels of other versions to which none was added for four weeks.

    Safe beside other programs: a kernel that is not there is compiled.

    Parameters
    ----------
    folder : Path
        Folder of this version's kernels, which stays; those of other versions are beside it.
    """
    for other in folder.parent.glob("kernels-" + "[0-9a-f]" * 16):
        with suppress(OSError):  # another program removes it, too
            if other.name != folder.name and time.time() - other.lstat().st_mtime > _UNUSED_S:
                shutil.rmtree(other, ignore_errors=True)


def compile_all() -> bool:
    """Compile all kernels that are missing, and say so on stderr if there is one.

    Returns
    -------
    bool
        Whether all parts are done; otherwise a process was killed, or could not keep its kernels.
    """
    # The search path of this process; its current folder alone is not a part of it.
    program = f"import sys; sys.path[:] = {sys.path!r}; from imudrv.kernel_parts import main; main()"
    to_do, give = os.pipe()
    take, done = os.pipe()
    os.write(give, bytes(range(len(PARTS))))
    os.close(give)
    processes: list[subprocess.Popen[bytes]] = []
    with open(take, "rb", buffering=0) as events, _progress() as advance:
        try:
            for _ in range(min(_PROCESSES, os.cpu_count() or 1)):
                command = [sys.executable, "-c", program]
                process = subprocess.Popen(command, stdin=to_do, stdout=done, stderr=subprocess.DEVNULL)
                processes.append(process)
            os.close(to_do)
            os.close(done)  # the processes have it: `events` ends with them
            finished, compiling = 0, False
            while event := events.read(1):
                finished += event == DONE
                compiling |= event == COMPILING
                if compiling:
                    advance(finished)
        finally:
            for process in processes:
                process.terminate()
                process.wait()
    return finished == len(PARTS)


@contextmanager
def _progress() -> Iterator[Callable[[int], None]]:
    """Yield a function that shows the number of finished parts: on a terminal anew, elsewhere once."""
    stream, said = sys.__stderr__, False  # a progress bar of the command may have taken the other one

    def advance(finished: int) -> None:
        nonlocal said
        if stream is None:
            return
        if stream.isatty():
            stream.write(f"\rcompiling kernels for all later starts: {finished} of {len(PARTS)} parts ")
        elif not said:
            stream.write(f"compiling kernels for all later starts: {len(PARTS)} parts\n")
        stream.flush()
        said = True

    try:
        yield advance
    finally:
        if said and stream is not None and stream.isatty():
            stream.write("\r\x1b[K")
            stream.flush()
