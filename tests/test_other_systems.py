"""What works, and what says in one line that it does not, where Python is as on Windows.

The processes run on this system, but without the modules, constants and calls that Windows has not; see
`other_system/sitecustomize.py`.
"""

import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from bench_session import SHORT
from realtime import DEADLINE_S, free_port
from samples import CERTIFICATE

import calib.cli as calib_cli
import imudrv
import imudrv.cli as imudrv_cli

ABSENT = Path(__file__).parent / "other_system"
SCENARIO = """
format: imu50-scenario
version: 1
seed: 5
site: {latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}
motion:
  - rest: {duration_s: 2.0}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "unit.yaml").write_text(CERTIFICATE)
    (tmp_path / "rest.yaml").write_text(SCENARIO)
    return tmp_path


def environment(folder: Path) -> dict[str, str]:
    names = {name: text for name, text in os.environ.items() if name != "XDG_RUNTIME_DIR"}
    path = f"{ABSENT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    return names | {"PYTHONPATH": path, "TMPDIR": str(folder)}


def run(folder: Path, *command: str, program: str = "imudrv") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", program, *command],
        cwd=folder,
        env=environment(folder),
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )


@contextmanager
def running(folder: Path, *command: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-m", "imudrv", *command],
        cwd=folder,
        env=environment(folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def status(folder: Path, *options: str, until: Callable[[dict], bool]) -> dict:
    """Ask a service for its status until it is right."""
    end = time.monotonic() + DEADLINE_S
    while time.monotonic() < end:
        done = run(folder, "status", "--json", *options)
        if done.returncode in (0, 3, 4) and until(found := json.loads(done.stdout)):
            return found
    raise AssertionError(f"waited in vain: {done.stdout}{done.stderr}")


def test_the_modules_are_absent(folder: Path) -> None:
    program = "import fcntl"
    done = subprocess.run([sys.executable, "-c", program], env=environment(folder), capture_output=True)
    assert b"No module named 'fcntl'" in done.stderr


def test_every_command_can_be_imported(folder: Path) -> None:
    for program, commands in (("imudrv", imudrv_cli.COMMANDS), ("calib", calib_cli.COMMANDS)):
        modules = "; ".join(f"import {program}.cli.{name.replace('-', '_')}" for name in commands)
        done = subprocess.run([sys.executable, "-c", modules], env=environment(folder), capture_output=True)
        assert done.returncode == 0, done.stderr.decode()


def test_files_are_the_same(folder: Path) -> None:
    profile = "--profile", "imu50-rs422"
    calibrated = *profile, "--calibration", "unit.yaml"
    decode = "decode", "a.raw", *profile, "-o", "a.csv"
    compensate = "compensate", "a.raw", *calibrated, "-o", "a.i50n"
    replay = "run", "--port", "replay://a.raw?speed=max", *calibrated, "--record", "a.mcap"
    for command in (
        ("sim", "rest.yaml", *profile, "-o", "a.raw", "--truth", "truth.npz"),
        decode,
        compensate,
        replay,
        ("pack", "a.mcap", "-o", "packed.mcap"),
        ("export", "packed.mcap", "--to", "csv", "-o", "b.csv"),
        ("check", "unit.yaml"),
        ("files", "--to", "files"),
    ):
        done = run(folder, *command)
        assert done.returncode == 0, done.stderr
    assert len((folder / "b.csv").read_text().splitlines()) > 2000
    outputs = folder / "a.csv", folder / "a.i50n"
    contents = [path.read_bytes() for path in outputs]
    for command in (decode, compensate):  # as this system is
        here = [sys.executable, "-m", "imudrv", *command]
        subprocess.run(here, cwd=folder, check=True, capture_output=True)
    assert [path.read_bytes() for path in outputs] == contents


def test_a_unit_on_tcp_is_served_and_the_status_asked_over_the_loopback(folder: Path) -> None:
    unit, output = f"127.0.0.1:{free_port()}", f"tcp://127.0.0.1:{free_port()}"
    service = "run", "--profile", "imu50-rs422", "--calibration", "unit.yaml"
    with (
        running(folder, "sim", "static", "--profile", "imu50-rs422", "--port", f"tcp://{unit}"),
        running(
            folder, *service, "--port", f"socket://{unit}", "--out", output, "--record", "a.mcap"
        ) as served,
    ):
        found = status(folder, until=lambda found: found["samples"]["good"] > 1000)
        assert found["pid"] == served.pid
        assert found["port"]["state"] == "streaming"
        with imudrv.receive(output, DEADLINE_S) as receiver:
            assert len(next(receiver)) > 0
        again = run(folder, *service, "--port", "loop://")
        assert again.returncode == 2
        assert "expected no other service, got one that runs" in again.stderr
        served.send_signal(signal.SIGINT)
        assert served.wait(DEADLINE_S) == 0
    assert not list(folder.glob("imu50/*"))
    assert run(folder, "export", "a.mcap", "--to", "csv", "-o", "a.csv").returncode == 0
    assert len((folder / "a.csv").read_text().splitlines()) > 1000


@pytest.mark.parametrize(("port", "state"), [("loop://", "silent"), ("COM77", "connecting")])
def test_a_port_of_pyserial_is_served_and_one_that_is_absent_is_named(
    folder: Path, port: str, state: str
) -> None:
    service = "--profile", "imu50-rs422", "--calibration", "unit.yaml", "--status", "here"
    with running(folder, "run", "--port", port, *service):
        status(
            folder,
            "--status",
            "here",
            until=lambda found: (
                found["port"]["state"] == state
                and (port == "loop://" or "there is no COM77" in found["port"]["trouble"])
            ),
        )


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (("sim", "static", "--port", "pty"), "port pty: expected a POSIX system"),
        (("sim", "static", "--port", "COM3"), "COM3: expected a POSIX system"),
        (
            ("run", "--port", "loop://", "--calibration", "unit.yaml", "--out", "serial://COM3"),
            "serial://COM3: expected a POSIX system",
        ),
    ],
    ids=["pty", "serial unit", "serial output"],
)
def test_what_does_not_work_says_so_in_one_line(folder: Path, command: tuple[str, ...], message: str) -> None:
    done = run(folder, *command, "--profile", "imu50-rs422")
    assert done.returncode == 2
    assert re.fullmatch(f"error: {message} such as Linux, got .*; .* instead\n", done.stderr)


def test_doctor_examines_what_it_can(folder: Path) -> None:
    done = run(folder, "doctor", "--port", "COM77", "--profile", "imu50-rs422")
    assert "there is no COM77" in done.stdout
    assert done.stderr == ""


def test_a_rehearsal_leads_to_a_certificate(folder: Path) -> None:
    (folder / "short.yaml").write_text(SHORT)
    options = ["--procedure", "short.yaml", "--speed", "max", "--session", "s"]
    done = run(folder, "run", "--rehearse", *options, program="calib")
    assert done.returncode == 0, done.stdout + done.stderr
    assert run(folder, "verify", "s", program="calib").returncode == 0
    assert not list(folder.glob("imu50/*"))


def test_a_session_is_open_to_one_process(folder: Path) -> None:
    program = """
from pathlib import Path
from imudrv.files.lock import FileLock
lock = FileLock(Path("lock"))
print(flush=True)
input()
"""
    command = [sys.executable, "-c", program]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=folder, env=environment(folder), **pipes) as first:
        first.stdout.readline()
        with subprocess.Popen(command, cwd=folder, env=environment(folder), **pipes) as second:
            assert "BlockingIOError" in second.communicate()[1]
        first.communicate("\n")
    with subprocess.Popen(command, cwd=folder, env=environment(folder), **pipes) as third:
        assert third.communicate("\n")[1] == ""


KEYS = """
import sys, time
from calib.bench.keys import Keyboard
with Keyboard() as keys:
    print("ready", flush=True)
    while (typed := keys.read()) != "q":
        if typed:
            print(repr(typed), flush=True)
        time.sleep(0.01)
"""


def test_keys_come_line_by_line(folder: Path) -> None:
    master, slave = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-c", KEYS], env=environment(folder), stdin=slave, stdout=subprocess.PIPE, text=True
    ) as process:
        os.close(slave)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        for typed, key in ((b"\n", "'\\n'"), (b"R\n", "'r'"), (b"s \n", "'s'")):
            os.write(master, typed)
            assert process.stdout.readline() == f"{key}\n"
        os.write(master, b"q\n")
        assert process.wait(DEADLINE_S) == 0
    os.close(master)
