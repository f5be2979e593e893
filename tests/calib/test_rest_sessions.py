"""Sessions of the sensors and the noise through a real pty, the unit in another process, at 200 Hz."""

import json
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from realtime import DEADLINE_S
from rich.console import Console

from calib.bench.entries import AcceptedRest
from calib.bench.result import uncovered_rests
from calib.bench.run import RunOptions, run
from calib.bench.session import Session
from calib.bench.state import JOURNAL
from calib.bench.technician import REHEARSED_UNIT
from calib.bench.verify import verify
from calib.noise.analysis import analyse_noise
from calib.noise.documents import result_document as noise_document
from calib.procedure.plan import load
from calib.sensors.calibrate import calibrate_sensors
from calib.sensors.certificate import certificate
from imudrv import profiles
from imudrv.calibration import read_calibration, write_calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.sim.scenario import NOMINAL
from imudrv.site import Site

FACES = """
format: imu50-procedure
version: 2
name: short-faces
kind: sensors
rest_s: 20
limits: {tilt_deg: 10}
poses:
  - {id: z-up, up: +Z, east: +X, turn_deg: 180}
  - {id: z-down, up: -Z, east: -X, turn_deg: 180}
  - {id: x-up, up: +X, east: +Y, turn_deg: 180}
  - {id: x-down, up: -X, east: -Y, turn_deg: 180}
  - {id: y-up, up: +Y, east: +Z, turn_deg: 180}
  - {id: y-down, up: -Y, east: -Z, turn_deg: 180}
"""
MINUTE = """
format: imu50-procedure
version: 2
name: minute
kind: noise
rest_s: 60
poses: [{id: z-up, up: +Z, east: +X}]
"""
STEPS = [f"{axis}-{way}{turned}" for axis in "xyz" for way in ("up", "down") for turned in ("", "-turned")]
RUN = """
import sys
from pathlib import Path
from rich.console import Console
from calib.bench.run import RunOptions, run
from imudrv.terminal import guarded
procedure, folder, profile, mistakes = sys.argv[1:]
options = {"profile": profile, "rehearse": True, "speed": "max", "mistakes": mistakes}
options = RunOptions(Path(folder), procedure=procedure, **options)
sys.exit(guarded(lambda: run(options, Console(width=200))))
"""


def begun(folder: Path, procedure: str, mistakes: str = "") -> subprocess.Popen[str]:
    """Begin or resume a rehearsal with a slow unit."""
    text = profiles.content("imu50-rs422").decode()
    slow = text.replace("sample_rate_hz: 1000", "sample_rate_hz: 200").replace("imu50-rs422", "slow")
    (folder.parent / "slow.yaml").write_text(slow)
    (folder.parent / "procedure.yaml").write_text(procedure)
    arguments = [
        str(folder.parent / "procedure.yaml"),
        str(folder),
        str(folder.parent / "slow.yaml"),
        mistakes,
    ]
    return subprocess.Popen(
        [sys.executable, "-c", RUN, *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def journal(folder: Path) -> list[dict[str, Any]]:
    """Complete lines of the journal, which may be growing."""
    path = folder / JOURNAL
    return [json.loads(line) for line in path.read_text().split("\n")[:-1]] if path.exists() else []


@pytest.fixture(scope="module")
def sensors(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A session with two mistakes, killed after the fourth rest and resumed; its folder and what it shows."""
    folder = tmp_path_factory.mktemp("sensors") / "session"
    first = begun(folder, FACES, "moves,wrong-pose")
    end = time.monotonic() + DEADLINE_S
    while sum(line["event"] == "rest" for line in journal(folder)) < 4:
        if first.poll() is not None or time.monotonic() > end:
            first.kill()
            raise AssertionError(first.communicate()[0])
        time.sleep(0.01)
    first.kill()
    first.communicate()
    second = begun(folder, FACES)
    shown, _ = second.communicate(timeout=DEADLINE_S)
    assert second.returncode == 0, shown
    return folder, shown


def test_a_rest_with_a_mistake_is_asked_for_again(sensors: tuple[Path, str]) -> None:
    lines = journal(sensors[0])
    (rejected,) = [line for line in lines if line["event"] == "rejected"]
    assert rejected["step_id"] == "z-up"
    assert rejected["reasons"][0]["key"] == "rest_interrupted"
    attempts = {line["step_id"]: line["attempt"] for line in lines if line["event"] == "rest"}
    assert attempts["z-up"] == 2


def test_a_kill_loses_no_accepted_rest_that_is_on_the_disk(sensors: tuple[Path, str]) -> None:
    lines = journal(sensors[0])
    asked_again = {line["step_id"] for line in lines if line["event"] == "redone"}
    rests = [line["step_id"] for line in lines if line["event"] == "rest"]
    assert sorted(rests) == sorted([*STEPS, *asked_again])
    assert len(asked_again) <= 1  # the last one may not have reached the disk
    left = [line["name"] for line in lines if line["event"] == "file" and line["left"]]
    assert left == ["run-1.mcap"]


def test_the_result_is_that_of_the_command_on_the_recordings(sensors: tuple[Path, str]) -> None:
    folder, shown = sensors
    found = calibrate_sensors(
        [folder / "run-1.mcap", folder / "run-2.mcap"],
        site=folder / "rehearsal" / "site.yaml",
        unit=REHEARSED_UNIT,
        procedure=load(str(folder.parent / "procedure.yaml")),
    )
    stored = read_calibration(folder / "certificate.yaml")
    again = certificate(found)
    assert again.model_dump(exclude={"created"}) == stored.model_dump(exclude={"created"})
    assert read_calibration(folder / "rehearsal" / "unit.yaml") == stored  # written at acceptance
    assert "SIMULATED" in (folder / "report.html").read_text()
    assert "Against the truth" in shown
    largest = float(shown.split("largest error")[1].split()[0])
    assert largest < 5.0  # of 37 numbers, with the bias of one session's gyros in it


def test_the_session_is_verified_from_its_recordings(sensors: tuple[Path, str]) -> None:
    verified = verify(sensors[0])
    assert (verified.faults, verified.unfinished) == ((), ())
    assert "the recordings give the certificate, digit for digit" in verified.notes


def test_a_rest_whose_recording_was_damaged_is_named(sensors: tuple[Path, str], tmp_path: Path) -> None:
    folder, _ = sensors
    with closing(Session.open(folder)) as session:
        rests = [a for a in session.accepted.values() if isinstance(a, AcceptedRest)]
    of_second = [rest for rest in rests if rest.recording == "run-2.mcap"]
    cut = tmp_path / "cut.mcap"
    data = (folder / "run-2.mcap").read_bytes()
    cut.write_bytes(data[: len(data) // 2])

    lacking = uncovered_rests(cut, of_second)

    assert uncovered_rests(folder / "run-2.mcap", of_second) == {}
    assert of_second[0].step_id not in lacking
    assert of_second[-1].step_id in lacking


def test_a_session_of_the_noise_ends_with_the_result_of_the_command(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    process = begun(folder, MINUTE, "bump")
    shown, _ = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0, shown
    assert "left out: motion, missing or flagged samples (places: 1)\n" in shown

    found = analyse_noise([folder / "run-1.mcap"], calibration=folder / "before.yaml")

    assert found.is_bad  # a minute at 200 Hz shows no noise beside the pulses: upper limits only
    assert "no certificate: see the verdict and the report" in shown
    assert not (folder / "certificate.yaml").exists()
    N = noise_document(found)["channels"][0]["upper_limits"]["angle_random_walk_deg_per_sqrt_h"]["value"]
    assert f"{N:.3g}" in (folder / "report.html").read_text()
    assert verify(folder).faults == ()


# Bad input


def options(folder: Path, **more: Any) -> RunOptions:
    """Options of a unit that was never calibrated."""
    settings_file.write(folder / "site.yaml", Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0))
    given = {
        "port": "/dev/ttyUSB0",
        "profile": "imu50-rs422",
        "calibration": folder / "unit.yaml",
        "site": folder / "site.yaml",
        "procedure": "six-faces-turned",
        "hands_free": True,
    }
    return RunOptions(folder / "session", **{**given, **more})


def test_a_unit_without_a_certificate_has_to_be_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected the unit's serial number \(--unit\): there is no .*unit"):
        run(options(tmp_path), Console())
    assert not (tmp_path / "session").exists()


def test_the_noise_is_written_into_a_certificate_that_exists(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected the certificate of unit '50-1' \(--calibration\)"):
        run(options(tmp_path, procedure="long-rest", unit="50-1"), Console())


def test_nominal_scale_factors_come_from_the_profile(tmp_path: Path) -> None:
    without = tmp_path / "without.yaml"
    lines = profiles.content("imu50-rs422").decode().splitlines()
    without.write_text("\n".join(line for line in lines if not line.startswith("nominal:")))
    with pytest.raises(InputError, match="expected nominal scale factors, got a profile without them"):
        run(options(tmp_path, profile=str(without), unit="50-1"), Console())


def test_the_certificate_of_another_unit_is_no_start(tmp_path: Path) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    with pytest.raises(InputError, match="expected unit 'nominal' of the certificate, got '50-1'"):
        run(options(tmp_path, unit="50-1"), Console())
