"""The command `calib` as a user runs it, from captures to certificate and report."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
import yaml
from realtime import DEADLINE_S
from samples import CERTIFICATE, parse_json

import calib
from calib.cli import main
from imudrv.calibration import write_calibration
from imudrv.cli import main as imudrv
from imudrv.errors import InputError
from imudrv.profiles import load
from imudrv.sim.scenario import NOMINAL, nominal

SITE = "{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}"
SCENARIO = """
format: imu50-scenario
version: 1
seed: 7
site: {site}
start: {{pose: {pose}, tilt_mrad: [0.8, -0.5], pivot_offset_mm: [40, 30, 30]}}
motion:
  - rest: {{duration_s: 42}}
  - rotate: {{angle_deg: {angle}, duration_s: 2.5, axis_tilt_mrad: [3.0, 0.0]}}
  - rest: {{duration_s: 6}}
unit:
  calibration_file: unit.yaml
  residuals: {{accelerometer_bias_ug: 50, gyro_misalignment_urad: 30}}
  noise: {{arw_deg_per_sqrt_h: 0.002, vrw_m_s_per_sqrt_h: 0.003}}
"""
TRUTH_MM = {"x": [24.0, -11.0, -9.0], "y": [-23.0, 29.0, -7.0], "z": [-1.0, -18.0, 16.0]}
UNIT = f"""{CERTIFICATE}\
size_effect:
  r_mm: {TRUTH_MM}
  gauge: centroid
"""
CAPTURES = ("z.raw", "x.raw", "y.raw")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Simulated captures of three poses, and of a turn that is too small; unit, site."""
    folder = tmp_path_factory.mktemp("calib")
    (folder / "site.yaml").write_text(SITE)
    (folder / "unit.yaml").write_text(UNIT)
    for name, pose, angle in (
        ("z", "z_up", 180),
        ("x", "x_up", 180),
        ("y", "y_up", 180),
        ("short", "z_up", 150),
        ("still", "z_up", 1e-9),
    ):
        (folder / f"{name}.yaml").write_text(SCENARIO.format(site=SITE, pose=pose, angle=angle))
        out = ["-o", str(folder / f"{name}.raw")]
        assert imudrv(["sim", str(folder / f"{name}.yaml"), "--profile", "imu50-rs422", *out]) == 0
    return folder


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The same, as the current folder."""
    monkeypatch.chdir(folder)
    return folder


def identify(*arguments: str) -> int:
    common = ("--profile", "imu50-rs422", "--calibration", "unit.yaml", "--site", "site.yaml")
    return main(["identify", *arguments, *common])


def test_captures_become_a_certificate_a_report_and_a_document(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert identify(*CAPTURES, "-o", "new.yaml", "--json", "r.json", "--report", "r.html") == 0
    printed = capsys.readouterr().out
    assert "Sensing points in body axes, mm, gauge centroid" in printed
    assert "Sensing points in body axes, mm, gauge x" in printed
    assert all(len(line) <= 80 for line in printed.splitlines())
    assert "\x1b" not in printed
    new = yaml.safe_load((here / "new.yaml").read_text())
    document = parse_json((here / "r.json").read_text())
    assert document["rank"] == 6
    assert document["singular_values_m_s_per_m"][5] > 4.0  # 8.8 / T and 15 / T, T = 2.5 s: all six well seen
    sigma = np.sqrt(np.diag(new["size_effect"]["covariance_mm2"])).reshape(3, 3)
    error = np.array([new["size_effect"]["r_mm"][axis] for axis in "xyz"]) - [TRUTH_MM[a] for a in "xyz"]
    assert np.abs(error / sigma).max() < 4.0  # 9 numbers: chance 6e-4
    found = new["provenance"]["inner_lever_arms"]
    assert [capture["name"] for capture in found["captures"]] == list(CAPTURES)
    assert all(len(capture["sha256"]) == 64 for capture in found["captures"])
    assert (here / "r.html").read_text().startswith("<!DOCTYPE html>")


def test_a_unit_that_sends_radians_gets_its_arms_and_keeps_the_scales_of_its_certificate(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    unit = yaml.safe_load(UNIT)
    del unit["gyro"]["scale_arcsec_per_pulse"], unit["accelerometer"]["scale_pulse_per_m_s"]
    unit["gyro"]["scale"], unit["accelerometer"]["scale"] = [1.01, 0.99, 1.002], [0.98, 1.01, 1.003]
    (tmp_path / "unit.yaml").write_text(yaml.safe_dump(unit))
    (tmp_path / "site.yaml").write_text(SITE)
    common = ["--profile", "kvh1775", "--calibration", "unit.yaml", "--site", "site.yaml"]
    for name in "zxy":
        (tmp_path / f"{name}.yaml").write_text((folder / f"{name}.yaml").read_text())
        assert imudrv(["sim", f"{name}.yaml", "--profile", "kvh1775", "-o", f"{name}.raw"]) == 0
    assert main(["identify", *CAPTURES, *common, "-o", "new.yaml"]) == 0
    new = yaml.safe_load((tmp_path / "new.yaml").read_text())
    assert (new["gyro"], new["accelerometer"]) == (unit["gyro"], unit["accelerometer"])
    sigma = np.sqrt(np.diag(new["size_effect"]["covariance_mm2"])).reshape(3, 3)
    error = np.array([new["size_effect"]["r_mm"][axis] for axis in "xyz"]) - [TRUTH_MM[a] for a in "xyz"]
    assert np.abs(error / sigma).max() < 4.0  # 9 numbers: chance 6e-4
    assert np.sqrt((error**2).mean()) < 0.05  # the requirement
    (tmp_path / "pulses.yaml").write_text(UNIT)
    common[3] = "pulses.yaml"
    assert main(["identify", *CAPTURES, *common, "-o", "refused.yaml"]) == 2
    assert "gyro: expected a calibration with gyro.scale for kvh1775" in capsys.readouterr().err


@pytest.mark.parametrize(("profile", "has"), [("fog-fg333", "gyro X"), ("exail-asterix", "gyros X, Y, Z")])
def test_a_unit_that_lacks_axes_is_refused_at_the_start(
    profile: str,
    has: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_calibration(tmp_path / "unit.yaml", nominal(load(profile).layout()))
    (tmp_path / "site.yaml").write_text(SITE)
    motion = SCENARIO.format(site=SITE, pose="z_up", angle=180).replace("calibration_file: unit.yaml", "")
    (tmp_path / "z.yaml").write_text(motion)
    assert imudrv(["sim", "z.yaml", "--profile", profile, "-o", "z.raw"]) == 0
    common = ["--profile", profile, "--calibration", "unit.yaml", "--site", "site.yaml"]
    for command in (
        ["identify", "z.raw", *common, "-o", "new.yaml"],
        ["validate", "z.raw", *common],
        ["run", "--port", "unit", *common, "--session", "session", "--hands-free"],
        ["run", "--rehearse", "--profile", profile, "--session", "session"],
    ):
        assert main(command) == 2
        message = f"calib needs three gyros and three accelerometers; {profile} has {has} only\n"
        assert capsys.readouterr().err.endswith(message)
    assert not (tmp_path / "session").exists()


def test_the_new_certificate_compensates(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert identify(*CAPTURES, "-o", "used.yaml") == 0
    arguments = [
        "compensate",
        "z.raw",
        "--profile",
        "imu50-rs422",
        "--calibration",
        "used.yaml",
        "-o",
        "z.npz",
    ]
    assert imudrv(arguments) == 0
    assert "size effect compensated" in capsys.readouterr().out


def test_recordings_bring_their_own_profile_and_calibration(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("z", "x", "y"):
        service = ["run", "--port", f"sim://{name}.yaml?speed=max", "--profile", "imu50-rs422"]
        service += ["--calibration", "unit.yaml", "--record", f"{name}.mcap", "--status", "status.sock"]
        subprocess.run(
            [sys.executable, "-m", "imudrv", *service], check=True, capture_output=True, timeout=DEADLINE_S
        )
    recordings = ["identify", "z.mcap", "x.mcap", "y.mcap", "--site", "site.yaml", "-o", "recorded.yaml"]
    assert main(recordings) == 0
    recorded = yaml.safe_load((here / "recorded.yaml").read_text())
    assert recorded["provenance"]["inner_lever_arms"]["calibration"]["name"] == "calibration in z.mcap"
    assert identify("z.raw", "x.raw", "y.raw", "-o", "captured.yaml") == 0
    assert recorded["size_effect"] == yaml.safe_load((here / "captured.yaml").read_text())["size_effect"]
    assert main([*recordings, "--unit", "50-0018"]) == 2
    assert "z.mcap: expected a recording of unit '50-0018', got one of '50-0017'" in capsys.readouterr().err
    assert main(["identify", "z.mcap", "x.raw", "--site", "site.yaml", "-o", "never.yaml"]) == 2
    assert (
        "x.raw: expected a calibration, got a capture without one; give its file" in capsys.readouterr().err
    )


def test_a_chosen_channel_of_a_log_of_two_units_is_named_in_certificate_and_report(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for pose in "xyz":
        units = []
        for channel, unit in enumerate((pose, "still")):
            arguments = ["sim", f"{unit}.yaml", "--profile", "imu50-can", "-o", "unit.log"]
            assert imudrv(arguments) == 0
            text = (here / "unit.log").read_text().replace("can0", f"can{channel}")
            units += text.splitlines(keepends=True)
        (here / f"{pose}.log").write_text("".join(sorted(units, key=lambda line: line[:20])))
    logs = ["identify", "x.log", "y.log", "z.log", "--profile", "imu50-can", "--calibration", "unit.yaml"]
    logs += ["--site", "site.yaml", "--channel", "can0", "-o", "chosen.yaml", "-v"]
    assert main(logs) == 0
    assert "z.log, imu50-can, channel can0" in capsys.readouterr().out
    provenance = yaml.safe_load((here / "chosen.yaml").read_text())["provenance"]
    captures = provenance["inner_lever_arms"]["captures"]
    assert [capture["channel"] for capture in captures] == ["can0"] * 3


def test_a_certificate_that_the_data_contradict_is_refused_but_the_report_is_there(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("calib.estimation.result.SCATTER_LIMIT", 1e-3)
    assert identify(*CAPTURES, "-o", "bad.yaml", "--json", "bad.json", "--report", "bad.html") == 2
    printed = capsys.readouterr()
    assert re.search(
        r"^  bad +No certificate is made: the velocities\s+within\s+the\s+rests", printed.out, re.MULTILINE
    )
    assert (
        "no certificate: the velocities within the rests contradict the noise of the alignments"
        in printed.err
    )
    assert not (here / "bad.yaml").exists()
    assert (here / "bad.json").exists()
    assert (here / "bad.html").exists()


def test_a_reader_who_leaves_early_does_not_cost_the_certificate(here: Path) -> None:
    options = "--profile imu50-rs422 --calibration unit.yaml --site site.yaml -o piped.yaml"
    command = f"{sys.executable} -m calib identify {' '.join(CAPTURES)} {options} | head -n 1"
    subprocess.run(command, shell=True, cwd=here, check=True, capture_output=True, timeout=DEADLINE_S)
    assert (here / "piped.yaml").exists()


def test_a_capture_that_grows_while_it_is_read_gives_nothing(here: Path) -> None:
    growing = here / "growing.raw"
    growing.write_bytes((here / "z.raw").read_bytes())

    def grow(amount: int) -> None:
        if amount > len(b"more"):
            with growing.open("ab") as capture:
                capture.write(b"more")

    files = {"calibration": here / "unit.yaml", "site": here / "site.yaml"}
    with pytest.raises(InputError, match=r"growing.raw: .* it was changed while it was read"):
        calib.identify([growing], **files, profile="imu50-rs422", advance=grow)


# Long, so that reading it takes a while.
PSINS = (
    "% clbt\n" * 50_000 + "clbt.rx = [0; 0; 0];\nclbt.ry = [-0.047; 0.04; 0.002];\nclbt.rz = [0; 0; 0.05];\n"
)


@pytest.mark.parametrize(
    ("command", "texts"),
    [
        (
            ["gauge", "replaced", "--to", "x"],
            [UNIT, UNIT.replace("24.0, -11", "23.0, -11").replace("-1.0", "0.0")],
        ),
        (
            ["import-arms", "replaced", "--from", "psins", "--calibration", "unit.yaml"],
            [PSINS, PSINS.replace("0.05", "0.06")],
        ),
    ],
)
def test_a_certificate_names_the_file_that_its_arms_are_from(
    command: list[str],
    texts: list[str],
    here: Path,
    replaced_at_random: Callable[..., AbstractContextManager[None]],
) -> None:
    def made() -> tuple[str, object]:
        (here / "made.yaml").unlink(missing_ok=True)
        assert main([*command, "-o", "made.yaml"]) == 0
        new = yaml.safe_load((here / "made.yaml").read_text())
        (how,) = new["provenance"].values()
        return how["file_sha256"], new["size_effect"]

    expected = {}
    for text in texts:
        (here / "replaced").write_text(text)
        digest, expected[digest] = made()
        assert digest == sha256(text.encode()).hexdigest()
    with replaced_at_random(here / "replaced", [text.encode() for text in texts], seed=4):
        for _ in range(30):
            digest, size_effect = made()
            assert size_effect == expected[digest]


def test_the_plain_method_and_a_gauge_by_name(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert identify(*CAPTURES, "-o", "plain.yaml", "--method", "plain", "--gauge", "y") == 0
    assert "Arms determined, not checked: no redundant rotation" in " ".join(capsys.readouterr().out.split())
    new = yaml.safe_load((here / "plain.yaml").read_text())
    assert new["size_effect"]["gauge"] == "y"
    assert new["size_effect"]["r_mm"]["y"] == [0.0, 0.0, 0.0]
    assert new["provenance"]["inner_lever_arms"]["method"] == "plain"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([*CAPTURES, "--gauge", "given"], "expected a fixed pivot for nine components of the lever arms"),
        ([*CAPTURES, "--at", "y=1,2,3"], "--at: expected with --gauge given"),
        (
            [*CAPTURES, "--gauge", "given", "--at", "w=1,2,3"],
            "--at: expected an accelerometer and three numbers",
        ),
        ([*CAPTURES, "--unit", "50-0018"], "expected the calibration of unit '50-0018'"),
        (
            [*CAPTURES, "--method", "plain", "--pivot", "fixed"],
            "method plain: expected pivot free, six components",
        ),
        (["z.raw", "x.raw", "z.raw"], "expected another capture, got that of z.raw once more"),
        (["z.raw"], "Z up alone is not enough: add captures with X up and Y up"),
        (["short.raw"], "turned 150.0 deg, expected 180 +- 5"),
        (["z.raw", "short.raw"], "turned 150.0 deg, expected 180 +- 5"),
        (["still.raw"], "at rest, no motion at all"),
        (["nothing.raw"], "nothing.raw: expected a file, there is none"),
        (["site.yaml"], "site.yaml: expected frames of imu50-rs422"),
    ],
)
def test_a_users_mistake_is_one_message_and_exit_code_2(
    arguments: list[str], said: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        identify(*arguments, "-o", "refused.yaml", "--json", "refused.json", "--report", "refused.html") == 2
    )
    printed = capsys.readouterr()
    assert said in " ".join(printed.err.split())
    assert "Traceback" not in printed.err
    assert not list(here.glob("*refused*"))


def test_another_units_certificate_is_not_written_over(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = here / "other.yaml"
    other.write_text(UNIT.replace("50-0017", "50-0018"))
    assert identify(*CAPTURES, "-o", "other.yaml") == 2
    assert "got that of '50-0018'" in capsys.readouterr().err
    assert "50-0018" in other.read_text()


def test_a_gauge_is_converted_from_file_to_file_and_back(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["gauge", "unit.yaml", "--to", "x", "-o", "in-x.yaml"]) == 0
    assert "gauge x" in capsys.readouterr().out
    in_x = yaml.safe_load((here / "in-x.yaml").read_text())["size_effect"]
    assert in_x["gauge"] == "x"
    assert in_x["r_mm"]["y"] == [-47.0, 40.0, 2.0]
    assert main(["gauge", "in-x.yaml", "--to", "given", "--at", "z=-1,-18,16", "-o", "given.yaml"]) == 0
    assert main(["gauge", "given.yaml", "--to", "centroid", "-o", "back.yaml"]) == 0
    back = yaml.safe_load((here / "back.yaml").read_text())
    assert back["size_effect"] == {"r_mm": TRUTH_MM, "gauge": "centroid"}
    assert back["provenance"]["inner_lever_arms_gauge"]["from"] == "given"
    assert main(["gauge", "unit.yaml", "--to", "given", "-o", "nine.yaml"]) == 2
    assert "expected the position of one sensing point" in capsys.readouterr().err


@pytest.mark.parametrize("program", ["kalibr", "psins"])
def test_arms_go_out_to_another_program_and_come_back(
    program: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export-arms", "unit.yaml", "--to", program]) == 0
    (here / f"{program}.txt").write_text(capsys.readouterr().out)
    arguments = [f"{program}.txt", "--from", program, "--calibration", "unit.yaml", "-o", f"{program}.yaml"]
    assert main(["import-arms", *arguments]) == 0
    capsys.readouterr()
    assert main(["gauge", f"{program}.yaml", "--to", "centroid", "-o", f"{program}-back.yaml"]) == 0
    assert yaml.safe_load((here / f"{program}-back.yaml").read_text())["size_effect"]["r_mm"] == TRUTH_MM


def test_kalibr_gets_metres_from_the_x_accelerometer(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export-arms", "unit.yaml", "--to", "kalibr"]) == 0
    accelerometers = yaml.safe_load(capsys.readouterr().out)["imu0"]["accelerometers"]
    assert accelerometers == {
        "rx_i": [0.0, 0.0, 0.0],
        "ry_i": [-0.047, 0.04, 0.002],
        "rz_i": [-0.025, -0.007, 0.025],
    }


def test_the_calibration_file_that_psins_writes_is_in_centimetres(here: Path) -> None:
    rows = "".join(
        f"r{axis} = [\r\n\t{' '.join(f'{v / 10:.8e}' for v in TRUTH_MM[axis])}\r\n\t]; \t% cm\r\n"
        for axis in "xyz"
    )
    (here / "clbt.m").write_text("Ka2 = [\r\n\t1e1 2e1 3e1\r\n\t]; \t% ug/g^2\r\n" + rows)
    arguments = ["clbt.m", "--from", "psins", "--calibration", "unit.yaml", "-o", "from-clbt.yaml"]
    assert main(["import-arms", *arguments]) == 0
    read = yaml.safe_load((here / "from-clbt.yaml").read_text())["size_effect"]
    assert read == {"r_mm": TRUTH_MM, "gauge": "given"}


def test_arms_that_are_not_there_are_missed(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "empty.txt").write_text("clbt.rx = [1; 2];\nclbt.ry = nonsense\n")
    arguments = ["--from", "psins", "--calibration", "unit.yaml", "-o", "never.yaml"]
    assert main(["import-arms", "empty.txt", *arguments]) == 2
    assert "expected rx, ry, rz as three numbers each" in capsys.readouterr().err
    assert not (here / "never.yaml").exists()


def test_the_reference_captures_through_the_real_command(reference: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "calib", "identify", *(str(reference / f"{p}_up.raw") for p in "zxy")]
    command += ["--profile", "imu50-rs422", "--calibration", str(reference / "calibration.yaml")]
    command += ["--site", str(reference / "site.yaml"), "--unit", "50-0017"]
    command += ["-o", "new.yaml", "--json", "r.json", "--report", "r.html"]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S, check=False
    )
    assert done.returncode == 0, done.stderr
    truth = yaml.safe_load((reference / "truth.yaml").read_text())["r_mm"]
    new = yaml.safe_load((tmp_path / "new.yaml").read_text())["size_effect"]
    error = np.array([new["r_mm"][a] for a in "xyz"]) - np.array([truth[a] for a in "xyz"])
    assert np.sqrt((error**2).mean()) < 0.05  # mm: what the method promises on these captures
    document = json.loads((tmp_path / "r.json").read_text())
    assert document["rank"] == 6
    assert (tmp_path / "r.html").stat().st_size < 1_500_000
    assert all(len(line) <= 80 for line in done.stdout.splitlines())


def test_dither_needs_the_arms_of_a_certificate(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_calibration(here / "arms.yaml", NOMINAL)
    arguments = ["dither", "--amplitude-arcsec", "150", "--frequency-hz", "400,405,393"]
    assert main([*arguments, "--certificate", "arms.yaml"]) == 0
    printed = capsys.readouterr().out
    assert "800 Hz   200 Hz" in printed  # twice the dither, aliased at 1 kHz
    assert main([*arguments, "--certificate", "absent.yaml"]) == 2
    assert "expected a file" in capsys.readouterr().err
