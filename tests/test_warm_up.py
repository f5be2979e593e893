"""Kernels are compiled before they are needed: by `imudrv warm`, or by the first program, which says so."""

import os
import pty
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from bench_session import SHORT
from samples import CERTIFICATE

from imudrv import profiles
from imudrv.compilation import PARTS, remove_unused
from imudrv.records import PULSES
from imudrv.wire.encode import StreamEncoder

NOTE = "compiling kernels for all later starts"

SIGNATURES = """
import sys
from numba.core.dispatcher import Dispatcher

def signatures():
    kernels = [
        value for module in list(sys.modules.values()) for value in vars(module).values()
        if isinstance(value, Dispatcher)
    ]
    return {f"{k.py_func.__module__}.{k.py_func.__qualname__}": len(k.signatures) for k in kernels}
"""

SERVICE = """
import os, pty, threading, tty
from pathlib import Path
import numpy as np
from imudrv import profiles
from imudrv.service import loop, settings
from imudrv.wire.encode import StreamEncoder
from realtime import until

profile, certificate = "{profile}", Path("unit.yaml")
layout = profiles.load(profile).layout()
samples = np.zeros(400, layout.samples_type)
samples["counter"] = np.arange(400) * layout.counter_step
wire = StreamEncoder(layout).encode(samples)
unit, port = pty.openpty()
tty.setraw(port)

def send():
    os.write(unit, b"noise" + wire[:100].tobytes())
    until(lambda: service.status.samples.good >= 99)
    certificate.write_text(certificate.read_text().replace("bias_deg_per_h: [0.0", "bias_deg_per_h: [1.0"))
    for row in wire[100:]:
        os.write(unit, row.tobytes())
        until(lambda: service.status.samples.good >= 99)
    until(lambda: service.status.samples.good >= 399)
    service.stop()

def warm_up(*arguments):
    compile_and_load(*arguments)
    before.update(signatures())
    sender.start()

before, compile_and_load, loop.warm_up = {{}}, loop.warm_up, warm_up
sender = threading.Thread(target=send)
service = loop.Service(
    settings.load(None, {{
        "port": os.ttyname(port), "profile": profile, "calibration": "unit.yaml", "status": "status",
        "outputs": ["udp://localhost:9", "file:out.i50n"], "record": "run.mcap",
    }}),
    print,
)
service.run()
sender.join()
print("later:", {{name: n for name, n in signatures().items() if n != before.get(name, 0)}})
"""

STAGES = """
import numpy as np
from imudrv import profiles
from imudrv.calibration import coefficients
from imudrv.chain import Chain
from imudrv.service.warm_up import warm_up
from imudrv.sim.scenario import nominal
from imudrv.wire.encode import CanEncoder

profile = profiles.load("{profile}")
layout = profile.layout()
samples = np.zeros(400, layout.samples_type)
samples["counter"] = np.arange(400) * layout.counter_step
samples["arrival_ns"] = np.arange(400) * layout.interval_ns
wire = CanEncoder(layout).encode(samples)
calibration = nominal(layout)
warm_up(profile, calibration, "causal", False)
before = signatures()
chain = Chain(profile, coefficients(calibration), "causal")
chain.feed(wire[:200], 0)
chain.replace_calibration(coefficients(calibration))
chain.feed(wire[200:], 0)
chain.close()
assert chain.tracker.counts.good > 300
print("later:", {{name: n for name, n in signatures().items() if n != before.get(name, 0)}})
"""


def run(*arguments: object, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("profile", ["imu50-rs422", "kvh1775", "hg4930"])
def test_once_the_unit_is_connected_the_service_loads_no_kernel(profile: str, tmp_path: Path) -> None:
    certificate = CERTIFICATE
    if profile != "imu50-rs422":  # it does not send pulses
        certificate = re.sub(r"scale_\w+: \[.*\]", "scale: [1.0, 1.0, 1.0]", certificate)
    (tmp_path / "unit.yaml").write_text(certificate)
    (tmp_path / "service.py").write_text(SIGNATURES + SERVICE.format(profile=profile))
    done = run("service.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "calibration" in done.stdout
    assert done.stdout.endswith("later: {}\n")


@pytest.mark.parametrize("profile", ["imu50-can", "imu50-canfd", "openimu-j1939"])
def test_once_the_kernels_of_can_are_loaded_none_is_loaded_later(profile: str, tmp_path: Path) -> None:
    (tmp_path / "stages.py").write_text(SIGNATURES + STAGES.format(profile=profile))
    done = run("stages.py", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "later: {}\n"


class Filled(NamedTuple):
    """A folder of compiled kernels, filled by the first command; what that showed on its terminal."""

    folder: Path
    shown: bytes
    output: str


DECODE = ("-m", "imudrv", "decode", "a.raw", "--profile", "imu50-rs422", "-o")


@pytest.fixture(scope="module")
def first_command(tmp_path_factory: pytest.TempPathFactory) -> Filled:
    folder = tmp_path_factory.mktemp("cache")
    samples = np.zeros(20, PULSES)
    samples["counter"] = np.arange(20)
    (folder / "a.raw").write_bytes(
        StreamEncoder(profiles.load("imu50-rs422").layout()).encode(samples).tobytes()
    )
    terminal, stderr = pty.openpty()
    with subprocess.Popen(
        [sys.executable, *DECODE, "a.csv"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "NUMBA_CACHE_DIR": str(folder)},
        stdout=subprocess.DEVNULL,
        stderr=stderr,
    ) as process:
        os.close(stderr)
        shown = b""
        try:
            while piece := os.read(terminal, 4096):
                shown += piece
        except OSError:  # its last user has closed it
            pass
    os.close(terminal)
    assert process.returncode == 0, shown
    return Filled(folder, shown, (folder / "a.csv").read_text())


def test_the_first_command_has_all_kernels_compiled_and_says_so_on_the_terminal(
    first_command: Filled, tmp_path: Path
) -> None:
    folder, shown, output = first_command
    assert b"\r" + NOTE.encode() in shown  # a progress bar of the command may be there already
    assert b": %d of %d parts" % (len(PARTS), len(PARTS)) in shown
    again = run(*DECODE, tmp_path / "b.csv", cwd=folder, NUMBA_CACHE_DIR=str(folder))
    assert (again.returncode, again.stderr) == (0, "")
    assert output == (tmp_path / "b.csv").read_text()


def test_the_warm_up_compiles_what_is_missing_says_so_once_and_then_has_nothing_to_do(
    first_command: Filled, tmp_path: Path
) -> None:
    shutil.copytree(first_command.folder, tmp_path / "cache")
    missing = [path for path in (tmp_path / "cache").rglob("*.kernel") if "candump" in path.name]
    for path in missing:
        path.unlink()
    old = tmp_path / "cache" / "imu50" / f"kernels-{'0' * 16}"
    old.mkdir()
    os.utime(old, (0, 0))
    done = run("-m", "imudrv", "warm", cwd=tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert done.returncode == 0, done.stderr
    assert done.stderr.startswith(NOTE)
    assert done.stderr.count("\n") == 1
    assert f": {len(missing)} kernels compiled" in done.stdout
    assert not old.exists()
    assert missing
    assert all(path.exists() for path in missing)
    done = run("-m", "imudrv", "warm", cwd=tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "cache"))
    assert (done.returncode, done.stderr) == (0, "")
    assert "nothing to do" in done.stdout


def test_after_the_warm_up_no_command_compiles_a_kernel(first_command: Filled, tmp_path: Path) -> None:
    cache = first_command.folder
    (tmp_path / "unit.yaml").write_text(CERTIFICATE)
    (tmp_path / "site.yaml").write_text("{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}")
    (tmp_path / "short.yaml").write_text(SHORT)
    files = sorted(cache.rglob("*.kernel"))
    for line in (
        "imudrv sim x-up --profile imu50-rs422 -o x.raw",
        "imudrv sim y-up --profile imu50-rs422 -o y.raw",
        "imudrv sim z-up --profile imu50-rs422 -o z.raw --truth truth.npz",
        "imudrv sim z-up --profile imu50-can -o z.log",
        "imudrv sim z-up --profile kvh1775 -o kvh.raw",
        "imudrv decode z.log --profile imu50-can -o z.npz",
        "imudrv decode kvh.raw --profile kvh1775 -o kvh.npz",
        "imudrv compensate z.log --profile imu50-can --calibration unit.yaml -o z.i50n",
        "imudrv compensate z.raw --calibration unit.yaml --rate-filter dither -o z.npz",
        "imudrv run --port replay://z.raw?speed=max --profile imu50-rs422 --calibration unit.yaml "
        "--record z.mcap --status status",
        "imudrv run --port replay://z.log?speed=max --profile imu50-can --calibration unit.yaml "
        "--record can.mcap --status status",
        "imudrv decode z.mcap -o mcap.npz",
        "imudrv decode can.mcap -o can.npz",
        "imudrv export z.mcap --to imr -o z.imr",
        "calib identify x.raw y.raw z.raw --profile imu50-rs422 --calibration unit.yaml --site site.yaml "
        "-o new.yaml",
        "calib run --rehearse --procedure short.yaml --speed max --session session",
        "calib validate --simulate rotation",
    ):
        done = run("-m", *line.split(), cwd=tmp_path, NUMBA_CACHE_DIR=str(cache))
        assert done.returncode == 0, f"{line}: {done.stderr}"
        assert NOTE not in done.stderr, line
        assert sorted(cache.rglob("*.kernel")) == files, line


def test_kernels_of_other_versions_are_removed_when_they_are_old(tmp_path: Path) -> None:
    this, old, young, foreign = (
        tmp_path / f"kernels-{end}" for end in ("1" * 16, "2" * 16, "3" * 16, "4" * 16 + ".bak")
    )
    for folder, days in ((this, 40), (old, 40), (young, 20), (foreign, 40)):
        folder.mkdir()
        (folder / "a.kernel").write_bytes(b"kernel")
        os.utime(folder, times=(time.time() - days * 86_400,) * 2)
    remove_unused(this)
    assert sorted(tmp_path.iterdir()) == [this, young, foreign]


def test_a_folder_that_cannot_be_written_to_is_named(tmp_path: Path) -> None:
    done = run("-m", "imudrv", "warm", cwd=tmp_path, NUMBA_CACHE_DIR="/proc/x")
    assert done.returncode == 2
    assert done.stderr.startswith("error: /proc/x/")
