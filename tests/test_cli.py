"""The commands as a user runs them: real processes, real files, exit codes and messages."""

import argparse
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from hashlib import sha256
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from realtime import DEADLINE_S, until
from samples import CERTIFICATE

from calib import cli as calib
from imudrv import cli
from imudrv.cli import main
from imudrv.wire.datagram import DatagramDecoder

ROOT = Path(__file__).parents[1]
SCENARIO = """
format: imu50-scenario
version: 1
seed: 5
site: {latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}
motion:
  - rest: {duration_s: 1.0}
  - rotate: {angle_deg: 20.0, duration_s: 1.0}
faults:
  stream: {bit_flips: 0.01, frame_lost: 0.01, frame_doubled: 0.01}
"""


def imudrv(*arguments: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "imudrv", *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
    )


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scenario, its capture and truth, and a calibration."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "run.yaml").write_text(SCENARIO)
    (folder / "unit.yaml").write_text(CALIBRATION)
    done = imudrv(
        "sim", "run.yaml", "--profile", "imu50-rs422", "-o", "run.raw", "--truth", "truth.npz", cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return folder


CALIBRATION = f"""{CERTIFICATE}\
size_effect:
  r_mm: {{x: [24, -11, -9], y: [-23, 29, -7], z: [-1, -18, 16]}}
  gauge: centroid
"""


def test_decode_counts_every_sample_and_writes_the_documented_columns(bench: Path) -> None:
    done = imudrv("decode", "run.raw", "--profile", "imu50-rs422", "-o", "run.npz", cwd=bench)
    assert done.returncode == 0, done.stderr
    assert "2000 samples by the counter" in done.stdout
    assert "damaged" in done.stdout
    assert "missing" in done.stdout
    assert "check failed" in done.stdout
    with np.load(bench / "run.npz") as got, np.load(bench / "truth.npz") as truth:
        assert set(got) == {
            "counter",
            "interval_ns",
            "gyro",
            "accelerometer",
            "temperature_degc",
            "status",
            "flags",
        }
        assert got["gyro"].dtype == got["accelerometer"].dtype == got["counter"].dtype == np.int64
        assert got["temperature_degc"].shape == (len(got["counter"]), 4)
        assert 1900 < len(got["counter"]) < 2000  # 2 % of the frames were damaged or lost
        at = np.searchsorted(truth["counter"], got["counter"])
        turned = got["gyro"] * (0.5 / 3600 * np.pi / 180)
        # Carried quantisation: an increment is off by less than one pulse.
        np.testing.assert_allclose(turned, truth["dtheta_b"][at], rtol=0, atol=0.5 / 3600 * np.pi / 180)


def test_csv_and_npz_hold_the_same_bits(bench: Path) -> None:
    for name in ("inc.csv", "inc.npz", "inc.i50n"):
        done = imudrv(
            "compensate",
            "run.raw",
            "--profile",
            "imu50-rs422",
            "--calibration",
            "unit.yaml",
            "-o",
            name,
            cwd=bench,
        )
        assert done.returncode == 0, done.stderr
        assert "size effect compensated" in done.stdout
    header, *_ = (bench / "inc.csv").read_text().splitlines()
    assert header == "counter,interval_ns,t_ns,dtheta_x,dtheta_y,dtheta_z,dv_x,dv_y,dv_z,flags"
    text = np.loadtxt(bench / "inc.csv", delimiter=",", skiprows=1)
    datagrams = DatagramDecoder().feed((bench / "inc.i50n").read_bytes()).increments
    with np.load(bench / "inc.npz") as got:
        np.testing.assert_array_equal(text[:, 3:6], got["dtheta"])
        np.testing.assert_array_equal(text[:, 6:9], got["dv"])
        np.testing.assert_array_equal(datagrams["dv_b"], got["dv"])
        np.testing.assert_array_equal(datagrams["flags"], got["flags"])
        np.testing.assert_array_equal(datagrams["counter"], got["counter"])


def test_a_candump_log_works_for_the_can_profiles(bench: Path) -> None:
    for profile in ("imu50-can", "imu50-canfd"):
        done = imudrv("sim", "run.yaml", "--profile", profile, "-o", f"{profile}.log", cwd=bench)
        assert done.returncode == 0, done.stderr
        done = imudrv("decode", f"{profile}.log", "--profile", profile, "-o", f"{profile}.npz", cwd=bench)
        assert done.returncode == 0, done.stderr
        assert "2000 samples by the counter = 2000 good" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["decode", "nothing.raw", "--profile", "imu50-rs422", "-o", "o.npz"],
            "nothing.raw: expected a file, there is none; check the path",
        ),
        (
            ["decode", "run.raw", "--profile", "imu51", "-o", "o.npz"],
            "or the path of a profile file",
        ),
        (
            ["decode", "run.raw", "--profile", "imu50-rs422", "-o", "o.txt"],
            "expected a name ending in .csv, .npz",
        ),
        (["decode", "run.raw", "--profile", "imu50-rs422", "-o", "no/o.npz"], "cannot be written"),
        (["decode", "run.raw", "--profile", "imu50-rs422-acc", "-o", "o.npz"], "try --profile imu50-rs422"),
        (
            ["decode", "unit.yaml", "--profile", "imu50-rs422", "-o", "o.npz"],
            "bytes of text of no known form",
        ),
        (
            ["compensate", "run.raw", "--profile", "imu50-rs422", "--calibration", "run.yaml", "-o", "o.npz"],
            "imu50-calibration",
        ),
        (
            [
                "compensate",
                "run.raw",
                "--profile",
                "imu50-rs422",
                "--calibration",
                "unit.yaml",
                "--unit",
                "50-0018",
                "-o",
                "o.npz",
            ],
            "50-0017",
        ),
        (["sim", "unit.yaml", "--profile", "imu50-rs422", "-o", "o.raw"], "imu50-scenario"),
        (["check", "run.raw"], "run.raw"),
    ],
)
def test_a_mistake_of_the_user_gives_one_message_and_exit_code_2(
    arguments: list[str], said: str, bench: Path
) -> None:
    done = imudrv(*arguments, cwd=bench)
    assert done.returncode == 2
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert not list(bench.glob("o.*"))
    assert not list(bench.glob(".o.*"))


def test_compensate_names_the_calibration_that_it_used(
    bench: Path,
    capsys: pytest.CaptureFixture[str],
    replaced_at_random: Callable[..., AbstractContextManager[None]],
) -> None:
    other = CALIBRATION.replace("50-0017", "50-0018").encode()
    short = {sha256(text).hexdigest()[:12]: text for text in (CALIBRATION.encode(), other)}
    (bench / "replaced.yaml").write_text(CALIBRATION)
    command = ["compensate", str(bench / "run.raw"), "--profile", "imu50-rs422", "-o", str(bench / "r.npz")]
    with replaced_at_random(bench / "replaced.yaml", list(short.values()), seed=3):
        for _ in range(30):
            assert main([*command, "--calibration", str(bench / "replaced.yaml")]) == 0
            (used,) = re.findall(r"unit (\S+), calibration (\w+)", capsys.readouterr().out)
            assert used[0].encode() in short[used[1]]


def test_check_knows_every_kind_of_file(bench: Path) -> None:
    (bench / "site.yaml").write_text("{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}")
    shipped = ROOT / "imudrv" / "profiles" / "imu50-can.yaml"
    for name, kind in (
        ("unit.yaml", "calibration"),
        ("site.yaml", "site"),
        ("run.yaml", "scenario"),
        (str(shipped), "profile"),
    ):
        done = imudrv("check", name, cwd=bench)
        assert done.returncode == 0, done.stderr
        assert f"imu50-{kind}" in done.stdout


def test_check_says_what_it_understood_of_a_profile(bench: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shipped = ROOT / "imudrv" / "profiles"
    expected = {
        "kvh1775": [
            "line:          serial, 921600 baud 8N1, 39.1 % of it used",  # 360 bits a sample
            "samples:       1000 per second",
            "message:       sync FE 81 FF 55, 36 bytes, crc of 32 bits",
            "gyro:          increments in rad: x y z f32",
            "temperature:   gyro",
            "status:        8 bits, 6 of them with a meaning",
            "sequence:      counter of 7 bits, 1 a sample, begins anew every 128 ms",
        ],
        # 1 count is 200 / 2^15 and 200 / 2^31 deg/s; 65536 samples of 5 ms
        "tamagawa-fog-serial": [
            "gyro:          rates in deg/s: x y i16 up to 199.994 deg/s, z i32 up to 200 deg/s",
            "sequence:      counter of 16 bits, 1 a sample, begins anew every 5.46 min",
        ],
        "stim300-91-totals": ["gyro:          running totals in deg: x y z u24"],
        "novatel-rawimusx": ["x -y z i32", "sequence:      floating-point time in s"],
        "hg4930": [
            "sync 0E 01, 20 bytes, sum of 16 bits, skipped",
            "none: samples are numbered as they arrive",
        ],
        "hipnuc": ["sequence:      time of 32 bits in ms, 2.5 a sample, begins anew every 49.7 days"],
        "imu50-can": ["id 152, 8 bytes, no check, one in 100 samples", "increments in pulses: x y z i16"],
        "openimu-j1939": ["can, 250000 bit/s, 12.8 % of it used", "pgn F02A, 8 bytes"],  # 320 bits in 10 ms
        "exail-asterix": ["accelerometer: none"],
    }
    for name, lines in expected.items():
        assert main(["check", str(shipped / f"{name}.yaml")]) == 0
        printed = capsys.readouterr().out
        assert all(line in printed for line in lines), printed


@pytest.mark.parametrize(
    ("name", "line", "slow", "words"),
    [
        # 44 bytes of 10 bits, 1000 times a second
        (
            "imu50-rs422",
            "baudrate: 921600",
            "baudrate: 115200",
            "line.baudrate: expected at least 440000 baud for 1000 samples/s, got 115200, of which "
            "they take 382 %",
        ),
        # 273 bits at worst, 1000 times a second
        ("imu50-can", "bitrate: 1000000", "bitrate: 250000", "line.bitrate: expected at least 272700 bit/s"),
    ],
)
def test_check_refuses_a_line_too_slow_for_the_samples(
    name: str, line: str, slow: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "imudrv" / "profiles" / f"{name}.yaml").read_text()
    assert line in text
    (tmp_path / "unit.yaml").write_text(text.replace(line, slow))
    assert main(["check", str(tmp_path / "unit.yaml")]) == 2
    errors = capsys.readouterr().err
    assert words in errors
    assert "set a faster line or a lower rate" in errors


def test_check_refuses_a_mirror_matrix(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "unit.yaml").write_text(
        CERTIFICATE.replace("C_bg: [[1, 0, 0], [0, 1, 0]", "C_bg: [[0, 1, 0], [1, 0, 0]")
    )
    assert main(["check", str(tmp_path / "unit.yaml")]) == 2
    assert "gyro.C_bg: expected right-handed axes, determinant > 0, got -1" in capsys.readouterr().err


def test_ctrl_c_leaves_no_half_file(bench: Path) -> None:
    (bench / "long.yaml").write_text(SCENARIO.replace("duration_s: 1.0}", "duration_s: 30000.0}", 1))
    process = subprocess.Popen(
        [sys.executable, "-m", "imudrv", "sim", "long.yaml", "--profile", "imu50-rs422", "-o", "long.raw"],
        cwd=bench,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )

    def is_in_the_middle() -> bool:
        assert process.poll() is None
        return any(half.stat().st_size for half in bench.glob(".long.raw.*"))

    until(is_in_the_middle)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 130, errors
    assert b"Traceback" not in errors
    assert not list(bench.glob("*long.raw*"))


def test_ctrl_c_while_a_command_is_imported_gives_no_traceback(tmp_path: Path) -> None:
    (tmp_path / "commands").mkdir()
    (tmp_path / "commands" / "slow.py").write_text("raise KeyboardInterrupt")
    program = (
        "import sys; from imudrv.terminal import run_program\n"
        "sys.exit(run_program('commands', '', {'slow': ''}, ['slow']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, timeout=DEADLINE_S
    )
    assert (done.returncode, done.stderr) == (130, b"interrupted\n")


def test_real_laser_gyro_pulses_are_unchanged_by_encoding_and_decoding(data: Path, tmp_path: Path) -> None:
    source = data / "lasergyro.imu"
    tool = [sys.executable, str(ROOT / "tools" / "psins_to_wire.py"), str(source), "-o", "real.raw"]
    subprocess.run(tool, cwd=tmp_path, check=True, timeout=DEADLINE_S)
    done = imudrv(
        "decode", "real.raw", "--profile", ROOT / "tools" / "psins-100hz.yaml", "-o", "real.npz", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    assert "184718 samples by the counter = 184718 good;" in done.stdout
    lines = [line for line in source.read_text().splitlines() if line and not line.startswith("%")]
    rows = np.loadtxt(lines[3:], np.int64)
    with np.load(tmp_path / "real.npz") as got:
        np.testing.assert_array_equal(got["gyro"], rows[:, :3])
        np.testing.assert_array_equal(got["accelerometer"], rows[:, 3:])
        quiet = got["gyro"] * (0.1 / 3600.0)  # deg
        rate_deg_per_h = np.linalg.norm(quiet.sum(axis=0)) / (len(quiet) * 0.01) * 3600.0
    # Earth rate is 15.04 deg/h; data/README.md gives 14.85 for this log, to the digits shown.
    assert rate_deg_per_h == pytest.approx(14.85, abs=0.005)


HEAVY = {"numpy", "numba", "scipy", "pydantic", "rich", "yaml", "matplotlib"}


@pytest.mark.parametrize(
    ("program", "arguments", "code"),
    [
        ("imudrv", ["--help"], 0),
        ("imudrv", ["--version"], 0),
        ("imudrv", ["status", "--status", "absent.sock"], 2),
        ("imudrv", ["monitr"], 2),
        ("calib", ["--help"], 0),
        ("calib", ["--version"], 0),
    ],
)
def test_help_version_and_status_load_no_numerical_library(
    program: str, arguments: list[str], code: int, tmp_path: Path
) -> None:
    command = [sys.executable, "-X", "importtime", "-m", program, *arguments]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=DEADLINE_S, check=False
    )
    assert done.returncode == code
    loaded = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert f"{program}.cli" in loaded
    assert not loaded & HEAVY


@pytest.mark.parametrize("kind", ["calibration", "site", "profile", "scenario"])
def test_a_file_is_checked_without_a_compiler(bench: Path, kind: str) -> None:
    files = {
        "calibration": bench / "unit.yaml",
        "site": bench / "site.yaml",
        "profile": ROOT / "imudrv" / "profiles" / "imu50-can.yaml",
        "scenario": bench / "run.yaml",
    }
    files["site"].write_text("{format: imu50-site, latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}")
    command = [sys.executable, "-X", "importtime", "-m", "imudrv", "check", str(files[kind])]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "valid" in done.stdout
    assert not re.findall(r"\| +(numba|llvmlite|scipy)$", done.stderr, re.MULTILINE)


@pytest.mark.parametrize(
    ("main", "commands"), [(main, cli.COMMANDS), (calib.main, calib.COMMANDS)], ids=["imudrv", "calib"]
)
def test_the_help_of_every_command_has_an_example_that_it_accepts(
    main: Callable[[list[str]], int], commands: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    for name in commands:
        with pytest.raises(SystemExit) as end:
            main([name, "--help"])
        assert end.value.code == 0
        text = " ".join(capsys.readouterr().out.split())
        program, command, *example = shlex.split(text.rpartition("example: ")[2].partition(" > ")[0])
        assert (program, command) == (main.__module__.partition(".")[0], name)
        parser = argparse.ArgumentParser()
        import_module(f"{main.__module__}.{name.replace('-', '_')}").add_arguments(parser)
        parser.parse_args(example)


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"imudrv {version('imu50')}\n"


@pytest.mark.parametrize("program", [main, calib.main], ids=["imudrv", "calib"])
def test_help_lists_the_exit_codes_of_every_command(
    program: Callable[[list[str]], int], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        program(["--help"])
    table = capsys.readouterr().out.partition("exit codes of every command:")[2]
    assert re.findall(r"^  (\d+) ", table, re.MULTILINE) == ["0", "1", "2", "3", "4", "130"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "tcsh"])
def test_a_shell_completes_commands_and_their_options(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--print-completion", shell]) == 0
    completion = capsys.readouterr().out
    for word in ("compensate", "rate-filter", "plot"):
        assert word in completion
