"""Captures that are no regular files: a pipe is read as its data come, a device or a folder is refused."""

import gzip
import os
import pty
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from realtime import DEADLINE_S

from calib.cli import main as calib
from imudrv import Capture, profiles
from imudrv.calibration import write_calibration
from imudrv.capture_files.source import _KEPT_BYTES
from imudrv.cli import main as imudrv
from imudrv.errors import InputError
from imudrv.sim import scenario
from imudrv.sim.capture import record
from imudrv.sim.scenario import NOMINAL

SCENARIO = """
format: imu50-scenario
version: 1
seed: 5
site: {latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}
motion: [{rest: {duration_s: 40.0}}]
"""


@pytest.fixture(scope="module")
def wire(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Captures by profile; longer than what of a pipe is kept."""
    path = tmp_path_factory.mktemp("scenario") / "rest.yaml"
    path.write_text(SCENARIO)
    run = scenario.load(str(path))
    return {
        name: b"".join(data for data, _ in record(run, profiles.load(name).layout()))
        for name in ("imu50-rs422", "imu50-can")
    }


@contextmanager
def pipe_of(data: bytes, path: Path) -> Iterator[Path]:
    """A named pipe into which a thread writes."""
    os.mkfifo(path)

    def write() -> None:
        try:
            with path.open("wb", 0) as pipe:
                pipe.write(data)
        except BrokenPipeError:
            pass

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    yield path
    thread.join(DEADLINE_S)
    assert not thread.is_alive()


@pytest.mark.parametrize("profile", ["imu50-rs422", "imu50-can"])
@pytest.mark.parametrize("pack", [bytes, gzip.compress])
@pytest.mark.parametrize("is_known", [False, True])
def test_a_pipe_gives_what_the_file_does(
    profile: str, pack: Callable[[bytes], bytes], is_known: bool, wire: dict[str, bytes], tmp_path: Path
) -> None:
    packed = pack(wire[profile])
    assert len(wire[profile]) > _KEPT_BYTES
    stored = tmp_path / {bytes: "unit.raw", gzip.compress: "unit.raw.gz"}[pack]
    stored.write_bytes(packed)
    expected = np.concatenate(list(Capture(stored, profile).pulses()))
    with pipe_of(packed, tmp_path / "pipe") as pipe:
        capture = Capture(pipe, profile if is_known else None)
        sizes: list[int] = []
        found = np.concatenate(list(capture.pulses(sizes.append)))
    for name in expected.dtype.names:
        np.testing.assert_array_equal(found[name], expected[name])
    assert capture.layout.name == profile
    assert capture.size == sum(sizes) == len(packed)


def test_a_pipe_is_decoded_while_its_data_come(wire: dict[str, bytes], tmp_path: Path) -> None:
    data = wire["imu50-rs422"]
    path = tmp_path / "pipe"
    os.mkfifo(path)
    with open(os.open(path, os.O_RDWR), "wb", 0) as other_end:  # both ends, so that opening does not wait
        threading.Thread(target=lambda: other_end.write(data[: 1 << 19]), daemon=True).start()
        pieces = Capture(path, "imu50-rs422").pulses()
        assert len(next(pieces)) > 0  # the rest of the data never came


def test_a_pipe_is_read_once(wire: dict[str, bytes], tmp_path: Path) -> None:
    with pipe_of(wire["imu50-rs422"], tmp_path / "pipe") as path:
        capture = Capture(path, "imu50-rs422")
        assert sum(map(len, capture.pulses())) == 40_000
        with pytest.raises(InputError, match="pipe: a pipe can be read once; write the data to a file first"):
            list(capture.pulses())


def test_standard_input_is_a_capture_too(wire: dict[str, bytes], tmp_path: Path) -> None:
    command = [sys.executable, "-m", "imudrv", "decode", "/dev/stdin", "-o", str(tmp_path / "out.npz")]
    done = subprocess.run(
        command, input=wire["imu50-can"], capture_output=True, check=True, timeout=DEADLINE_S
    )
    assert b"40000 good" in done.stdout


def test_a_recording_in_a_pipe_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pipe_of(b"\x89MCAP0\r\n" + bytes(100), tmp_path / "pipe") as pipe:
        assert imudrv(["decode", str(pipe), "-o", str(tmp_path / "out.npz")]) == 2
    assert "expected a file with a recording (MCAP), got a pipe" in capsys.readouterr().err


READERS = {
    "decode": (imudrv, "decode IN --profile imu50-rs422 -o out.npz"),
    "compensate": (imudrv, "compensate IN -o out.npz"),
    "export": (imudrv, "export IN --to csv -o out.csv"),
    "datagrams": (imudrv, "export IN --to csv -o out.csv"),
    "pack": (imudrv, "pack IN -o out.mcap"),
    "check": (imudrv, "check IN"),
    "doctor": (imudrv, "doctor --port replay://IN"),
    "identify": (calib, "identify IN --calibration unit.yaml --site site.yaml -o out.yaml"),
    "validate": (calib, "validate IN --calibration unit.yaml --site site.yaml"),
}


@pytest.mark.parametrize("command", READERS)
@pytest.mark.parametrize("kind", ["endless", "silent", "folder", "name too long"])
def test_what_is_no_file_is_refused_in_a_line_by_every_command_that_reads(
    command: str,
    kind: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "site.yaml").write_text("{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}")
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    master, slave = pty.openpty()
    target = {"endless": "/dev/zero", "silent": os.ttyname(slave), "folder": "/tmp"}.get(kind)
    given = "in.i50n" if command == "datagrams" else "in"
    if target is None:
        given = "n" * 300 + given
    else:
        os.symlink(target, given)
    main, line = READERS[command]
    code = main(line.replace("IN", given).split())
    os.close(master)
    os.close(slave)
    message = capsys.readouterr().err
    assert code == 2
    assert message.count("\n") == 1
    assert message.startswith(f"error: {given}: ")
    assert {"folder": "got a folder", "name too long": "File name too long"}.get(
        kind, "got a device"
    ) in message
    assert set(os.listdir()) <= {"site.yaml", "unit.yaml", given}
