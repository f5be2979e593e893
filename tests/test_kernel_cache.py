"""Compiled kernels are kept, and whatever becomes of their files, a command does its work."""

import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from imudrv import profiles
from imudrv.kernels import FOLDER
from imudrv.records import PULSES
from imudrv.wire.encode import StreamEncoder

PROGRAM = """
from imudrv.kernels import kernel

@kernel
def double(x: float) -> float:
    return 2.0 * x

@kernel
def quadruple(x: float) -> float:
    return double(double(x))

print(quadruple(2.0))
"""
DONE = "8.0\n"
NOTE = "compiled kernels cannot be kept"


NO_HOME = """
from pathlib import Path

def home() -> Path:
    raise RuntimeError("Could not determine home directory.")  # for a user that the system does not know

Path.home = home
"""


def run(
    *arguments: str, cache: Path | str = "", file_limit: int = resource.RLIM_INFINITY
) -> subprocess.CompletedProcess[str]:
    """Run Python with a folder of compiled kernels of its own, and a largest size of files."""
    environment = {name: text for name, text in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        env=environment | {"XDG_CACHE_HOME": str(cache)},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (file_limit, resource.RLIM_INFINITY)),
        check=False,
    )


@pytest.fixture
def program(tmp_path: Path) -> str:
    path = tmp_path / "program.py"
    path.write_text(PROGRAM)
    return str(path)


INTERRUPTED = """
import os, signal
from llvmlite.binding import ExecutionEngine

calls, find = 0, ExecutionEngine._find_module_ptr

def interrupted(*arguments):
    global calls
    calls += 1
    if calls == {at}:
        os.kill(os.getpid(), signal.SIGINT)
    return find(*arguments)

ExecutionEngine._find_module_ptr = interrupted  # called by callbacks of LLVM
"""


def kept(cache: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in cache.rglob("*") if path.is_file()}


def test_a_kernel_is_compiled_once(program: str, tmp_path: Path) -> None:
    assert run(program, cache=tmp_path / "c").stdout == DONE
    first = {path: path.stat().st_ino for path in kept(tmp_path / "c")}
    assert len(first) == 2
    assert run(program, cache=tmp_path / "c").stdout == DONE
    assert {path: path.stat().st_ino for path in kept(tmp_path / "c")} == first


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: data[: len(data) // 2],
        lambda data: np.random.default_rng(1).bytes(len(data)),
        lambda data: data[:-200] + bytes([data[-200] ^ 1]) + data[-199:],
    ],
    ids=["empty", "truncated", "random", "one bit"],
)
def test_a_damaged_file_is_replaced(program: str, tmp_path: Path, damage: Callable[[bytes], bytes]) -> None:
    cache = tmp_path / "c"
    assert run(program, cache=cache).stdout == DONE
    whole = kept(cache)
    for path, data in whole.items():
        path.write_bytes(damage(data))
    again = run(program, cache=cache)
    assert (again.stdout, again.stderr) == (DONE, "")
    assert {path: len(data) for path, data in kept(cache).items()} == {
        path: len(data) for path, data in whole.items()
    }
    assert all(data != damage(whole[path]) for path, data in kept(cache).items())


@pytest.mark.parametrize("cache", ["/dev/null/x", "/proc/x"])
def test_without_a_folder_for_them_kernels_are_compiled_and_one_line_says_so(
    program: str, cache: str
) -> None:
    done = run(program, cache=cache)
    assert done.stdout == DONE
    assert done.stderr.startswith(f"{NOTE} ({cache}")
    assert done.stderr.count("\n") == 1


def test_a_user_without_a_home_is_told_once(program: str) -> None:
    Path(program).write_text(NO_HOME + PROGRAM)
    done = run(program)
    assert done.stdout == DONE
    assert done.stderr.startswith(f"{NOTE} (there is no home folder)")
    assert done.stderr.count("\n") == 1


def test_a_folder_in_place_of_a_file_is_like_no_folder(program: str, tmp_path: Path) -> None:
    run(program, cache=tmp_path / "c")
    for path in kept(tmp_path / "c"):
        path.unlink()
        path.mkdir()
    done = run(program, cache=tmp_path / "c")
    assert done.stdout == DONE
    assert done.stderr.count(NOTE) == 1


@pytest.mark.parametrize(
    ("at", "is_compiled"),
    [(1, True), (2, True), (3, False)],
    ids=["numba's own code", "a kernel from its file", "a kernel that is compiled"],
)
def test_ctrl_c_in_a_callback_of_the_compiler_is_not_lost(
    program: str, tmp_path: Path, at: int, is_compiled: bool
) -> None:
    if is_compiled:
        run(program, cache=tmp_path / "c")
    Path(program).write_text(INTERRUPTED.format(at=at) + PROGRAM)
    done = run(program, cache=tmp_path / "c")
    assert done.stdout == ""
    assert done.stderr.endswith("KeyboardInterrupt\n")
    Path(program).write_text(PROGRAM)
    assert run(program, cache=tmp_path / "c").stdout == DONE


def test_a_full_disk_leaves_no_part_of_a_kernel(program: str, tmp_path: Path) -> None:
    done = run(program, cache=tmp_path / "c", file_limit=1000)
    assert done.stdout == DONE
    assert done.stderr.count(NOTE) == 1
    assert not kept(tmp_path / "c")


def test_a_full_disk_of_the_kernels_is_not_blamed_on_the_output(tmp_path: Path) -> None:
    layout = profiles.load("imu50-rs422").layout()
    capture, output = tmp_path / "a.raw", tmp_path / "a.csv"
    samples = np.zeros(20, PULSES)
    samples["counter"] = np.arange(20)
    capture.write_bytes(StreamEncoder(layout).encode(samples).tobytes())
    if FOLDER is not None and FOLDER.is_dir():  # only one kernel has to be compiled
        folder = tmp_path / "c" / "imu50" / FOLDER.name
        shutil.copytree(FOLDER, folder)
        for path in folder.glob("imudrv.imu.sequence.track-*"):
            path.unlink()
    command = "-m", "imudrv", "decode", str(capture), "--profile", "imu50-rs422", "-o", str(output)
    done = run(*command, cache=tmp_path / "c", file_limit=5000)
    assert done.returncode == 0, done.stderr
    assert NOTE in done.stderr
    assert len(output.read_text().splitlines()) > 20


def test_commands_that_need_no_kernel_need_no_folder_for_them() -> None:
    done = run("-m", "imudrv", "profiles", "imu50-can", cache="/dev/null/x")
    assert (done.returncode, done.stderr) == (0, "")
