"""A CAN log of two units: one of them is chosen, or the log is refused; never a row with values of both."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from realtime import DEADLINE_S

from calib.cli import main as calib
from imudrv.calibration import write_calibration
from imudrv.cli import main as imudrv
from imudrv.sim.scenario import NOMINAL

UNIT = """
format: imu50-scenario
version: 1
seed: {seed}
site: {{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}}
start: {{pose: {pose}}}
motion: [{{rest: {{duration_s: 3.0}}}}]
"""
BOTH = "two.log: expected messages of one CAN channel, got those of can0 and can1; choose one, as with "
PROFILE = ("--profile", "imu50-can")
CALIBRATION = ("--calibration", "unit.yaml")
COMMANDS = {
    "decode": (imudrv, ["decode"], [*PROFILE, "-o", "out.csv"]),
    "compensate": (imudrv, ["compensate"], [*PROFILE, *CALIBRATION, "-o", "out.csv"]),
    "identify": (calib, ["identify"], [*PROFILE, *CALIBRATION, "--site", "site.yaml", "-o", "out.yaml"]),
    "validate": (
        calib,
        ["validate"],
        [*PROFILE, *CALIBRATION, "--site", "site.yaml", "--report", "out.html"],
    ),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of two units with the same counters: each alone, both together, the second one only at the end."""
    folder = tmp_path_factory.mktemp("channels")
    write_calibration(folder / "unit.yaml", NOMINAL)
    (folder / "site.yaml").write_text("{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}")
    logs = []
    for n, pose in enumerate(("z_up", "x_up")):
        (folder / f"{n}.yaml").write_text(UNIT.format(seed=n, pose=pose))
        arguments = ["sim", str(folder / f"{n}.yaml"), *PROFILE, "-o", str(folder / f"can{n}.log")]
        assert imudrv(arguments) == 0
        logs.append((folder / f"can{n}.log").read_text().replace("can0", f"can{n}").splitlines(keepends=True))
    (folder / "can1.log").write_text("".join(logs[1]))
    (folder / "two.log").write_text("".join(sorted(logs[0] + logs[1], key=lambda line: line[:20])))
    (folder / "late.log").write_text("".join([*logs[0], logs[1][-1]]))
    return folder


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same as the current folder, without what another test has left."""
    for left in folder.glob("out.*"):
        left.unlink()
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("log", ["two.log", "late.log"])
def test_a_log_of_two_units_is_refused_by_every_command_however_late_the_second_appears(
    command: str,
    log: str,
    here: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("imudrv.capture_files.source.CHUNK_BYTES", 4096)  # the log is read in 70 pieces
    main, before, after = COMMANDS[command]
    assert main([*before, log, *after]) == 2
    assert capsys.readouterr().err == f"error: {BOTH.replace('two.log', log)}--channel can0\n"
    assert not list(here.glob("*out.*"))


@pytest.mark.parametrize("channel", ["can0", "can1"])
def test_the_chosen_unit_is_decoded_as_from_a_separate_log(
    channel: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert imudrv(["decode", f"{channel}.log", *PROFILE, "-o", "out.npz"]) == 0
    with np.load("out.npz") as archive:
        alone = {name: archive[name] for name in archive}
    capsys.readouterr()
    assert imudrv(["decode", "two.log", *PROFILE, "--channel", channel, "-o", "out.npz"]) == 0
    other = {"can0": "can1", "can1": "can0"}[channel]
    message = capsys.readouterr().out
    assert "3000 samples by the counter = 3000 good" in message
    assert f"ignored: 6060 messages of channel {other}" in message
    with np.load("out.npz") as archive:
        for name, column in alone.items():
            np.testing.assert_array_equal(archive[name], column)


def test_the_shipped_log_of_two_units_gives_each_of_them_as_it_was(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs, out = data / "field" / "logs", tmp_path / "out.csv"
    assert imudrv(["decode", str(logs / "any.log"), *PROFILE, "-o", str(out)]) == 2
    assert "got those of can0 and can1" in capsys.readouterr().err
    assert not out.exists()
    for channel, unit in (("can0", "a"), ("can1", "b")):
        assert imudrv(["decode", str(logs / "any.log"), *PROFILE, "--channel", channel, "-o", str(out)]) == 0
        rows = np.genfromtxt(out, delimiter=",", names=True)
        truth = np.genfromtxt(logs / f"imu50-{unit}.truth.csv", delimiter=",", names=True)
        np.testing.assert_array_equal(rows["counter"], truth["counter"])
        for axis in "xyz":
            np.testing.assert_array_equal(rows[f"gyro_{axis}"], truth[f"g{axis}"])
            np.testing.assert_array_equal(rows[f"accelerometer_{axis}"], truth[f"a{axis}"])


@pytest.mark.parametrize("command", COMMANDS)
def test_a_channel_that_the_log_does_not_have_is_refused_with_those_it_has(
    command: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main, before, after = COMMANDS[command]
    assert main([*before, "two.log", *after, "--channel", "can7"]) == 2
    message = capsys.readouterr().err
    assert message == "error: two.log: expected messages of CAN channel 'can7', got those of can0 and can1\n"
    assert not list(here.glob("*out.*"))


@pytest.mark.parametrize("command", COMMANDS)
def test_a_channel_of_what_is_no_can_log_is_refused(
    command: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    serial = ["sim", "0.yaml", "--profile", "imu50-rs422", "-o", "unit.raw"]
    assert imudrv(serial) == 0
    service = ["run", "--port", "replay://can0.log?speed=max", *PROFILE, *CALIBRATION]
    service += ["--record", "unit.mcap", "--status", "status.sock"]
    if not Path("unit.mcap").exists():
        subprocess.run([sys.executable, "-m", "imudrv", *service], check=True, timeout=DEADLINE_S)
    capsys.readouterr()
    main, before, after = COMMANDS[command]
    for name, profile, what in (
        ("unit.raw", "imu50-rs422", "a capture of imu50-rs422"),
        ("unit.mcap", "imu50-can", "a recording"),
    ):
        arguments = [profile if a == "imu50-can" else a for a in after]
        assert main([*before, name, *arguments, "--channel", "can0"]) == 2
        message = capsys.readouterr().err
        expected = f"error: {name}: --channel can0: expected a CAN log, got {what}; leave --channel out\n"
        assert message == expected


def test_a_replay_of_two_units_is_refused_before_a_sample_is_served(here: Path) -> None:
    done = serve("replay://two.log?speed=max")
    assert done.returncode == 2
    assert f"{BOTH}?channel=can0" in done.stderr
    assert (here / "out.csv").read_text() == ""


def test_a_replay_serves_one_unit_until_the_second_one_appears(here: Path) -> None:
    done = serve("replay://late.log?speed=max")
    assert done.returncode == 2
    assert f"{BOTH.replace('two.log', 'late.log')}?channel=can0" in done.stderr
    served = (here / "out.csv").read_text().splitlines()
    (here / "out.csv").unlink()
    assert serve("replay://can0.log?speed=max").returncode == 0
    alone = (here / "out.csv").read_text().splitlines()
    assert 1000 < len(served) < len(alone)
    assert served == alone[: len(served)]


def test_a_chosen_channel_is_served_as_from_a_log_of_its_own(here: Path) -> None:
    rows = []
    for url in ("replay://two.log?speed=max&channel=can1", "replay://can1.log?speed=max"):
        done = serve(url)
        assert done.returncode == 0, done.stderr
        rows.append((here / "out.csv").read_text())
        (here / "out.csv").unlink()
    assert rows[0] == rows[1]
    assert rows[0].count("\n") == 3001


def serve(url: str) -> subprocess.CompletedProcess[str]:
    """Run the service to the end of a replay, with its increments in out.csv."""
    command = [sys.executable, "-m", "imudrv", "run", "--port", url, *PROFILE, *CALIBRATION]
    command += ["--out", "file:out.csv", "--status", "status.sock"]
    return subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S, check=False)
