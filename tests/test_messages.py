"""What commands print: any name in any locale, on an output that is closed or full."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from realtime import DEADLINE_S
from rich.text import Text
from samples import CERTIFICATE

from calib.cli import main as calib
from imudrv.calibration import write_calibration
from imudrv.cli import main as imudrv
from imudrv.sim.scenario import NOMINAL
from imudrv.terminal import console, guarded, printable

EVIL = "x\x1b[31m\r[red]:bomb:\N{RIGHT-TO-LEFT OVERRIDE}"
ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.fixture
def unit(tmp_path: Path) -> Path:
    path = tmp_path / "unit.yaml"
    write_calibration(path, NOMINAL)
    return path


def run(arguments: list[str], more: str = "", **environment: str) -> subprocess.CompletedProcess[bytes]:
    """Run a command by a shell, with redirections."""
    command = 'exec "$0" -m imudrv "$@" ' + more
    return subprocess.run(
        ["sh", "-c", command, sys.executable, *arguments],
        env={**os.environ, **environment},
        capture_output=True,
        timeout=DEADLINE_S,
        check=False,
    )


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain, 22 °C, 长沙", "plain, 22 °C, 长沙"),
        ("two\nlines", "two\nlines"),
        (EVIL, r"x\x1b[31m\r[red]:bomb:\u202e"),
        ("a\x9b\x7f\t\0", r"a\x9b\x7f\t\x00"),
        (os.fsdecode(b"x\xff"), r"x\xff"),
        ("\udcc3\udcbc", "ü"),  # what an ASCII locale makes of it
        ("\ud800", r"\ud800"),
    ],
)
def test_what_a_terminal_would_obey_is_shown_as_an_escape(text: str, shown: str) -> None:
    assert printable(text) == shown


@pytest.mark.parametrize(
    "arguments",
    [
        ["check", EVIL],
        ["decode", EVIL, "-o", "x.npz"],
        ["decode", EVIL + "2", "-o", EVIL],
        ["pack", EVIL, "-o", "x.mcap"],
        ["doctor", "--port", f"replay://{EVIL}"],
        ["sim", EVIL, "--profile", "imu50-can", "-o", "x.log"],
        ["sim", "rocking", "--profile", EVIL, "-o", "x.log"],
        ["status", "--status", EVIL],
        ["profiles", EVIL],
        [EVIL],
    ],
)
def test_a_name_cannot_control_the_terminal(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    try:
        assert imudrv(arguments) == 2
    except SystemExit as error:  # of argparse
        assert error.code == 2  # noqa: PT017
    printed = "".join(capsys.readouterr())
    assert r"\x1b[31m" in printed
    assert printable(printed) == printed


def test_a_good_file_of_any_name_is_reported_in_printable_form(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / EVIL).write_text(CERTIFICATE)
    assert imudrv(["check", EVIL]) == 0
    assert capsys.readouterr().out == r"x\x1b[31m\r[red]:bomb:\u202e: valid imu50-calibration file" + "\n"


def test_a_console_shows_names_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", io.StringIO())
    screen = console()
    screen.print(EVIL, Text("styled", "bold"))
    assert sys.stdout.getvalue() == r"x\x1b[31m\r[red]:bomb:\u202e styled" + "\n"  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", ["Ü.yaml", "长沙.yaml"])
def test_a_name_beyond_ascii_is_read_and_shown_in_an_ascii_locale(name: str, unit: Path) -> None:
    path = unit.rename(unit.with_name(name))
    done = run(["check", str(path)], **ASCII)
    shown = name.encode("ascii", "backslashreplace")
    assert (done.returncode, done.stderr) == (0, b"")
    assert done.stdout.endswith(shown + b": valid imu50-calibration file\n")
    done = run(["check", f"{path}x"], **ASCII)
    assert done.returncode == 2
    assert shown + b"x: expected a file, there is none" in done.stderr


def test_a_full_standard_output_is_reported_by_every_way_of_printing(unit: Path) -> None:
    for arguments in (["check", str(unit)], ["profiles"], ["profiles", "imu50-can"]):
        for buffered in ("", "1"):
            done = run(arguments, "> /dev/full", PYTHONUNBUFFERED=buffered)
            assert done.returncode == 2
            assert done.stderr == b"error: standard output: cannot be written: No space left on device\n"


def test_a_closed_standard_output_hides_the_text_and_no_more(unit: Path, tmp_path: Path) -> None:
    done = run(["check", str(unit)], ">&-")
    assert (done.returncode, done.stderr) == (0, b"")
    done = run(["check", str(tmp_path / "none")], ">&- 2>&- <&-")
    assert done.returncode == 2


def test_data_for_a_closed_standard_output_are_refused_and_go_to_no_other_file(tmp_path: Path) -> None:
    rest = tmp_path / "rest.yaml"
    rest.write_text(
        "{format: imu50-scenario, version: 1, seed: 5, motion: [{rest: {duration_s: 1}}], "
        "site: {latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}}"
    )
    content = rest.read_bytes()
    done = run(["sim", str(rest), "--profile", "imu50-can", "-o", "-"], "<&- >&-")
    assert done.returncode == 2
    assert done.stderr == b"error: standard output: cannot be written: it is closed\n"
    assert rest.read_bytes() == content
    done = run(["sim", str(rest), "--profile", "imu50-can", "-o", "-"], "2>&-")
    assert done.returncode == 0
    assert b"samples" not in done.stdout  # the message is lost, not mixed into the data


@pytest.mark.parametrize(
    "arguments",
    [
        ["check", "NAME"],
        ["decode", "NAME", "-o", "x.npz"],
        ["sim", "NAME", "--profile", "imu50-can", "-o", "x.log"],
        ["sim", "rocking", "--profile", "NAME", "-o", "x.log"],
        ["sim", "static", "--profile", "imu50-can", "-o", "NAME"],
        ["export", "NAME", "--to", "csv", "-o", "x.csv"],
        ["doctor", "--port", "/dev/NAME"],
        ["doctor", "--port", "replay:///NAME"],
        ["status", "--status", "NAME"],
        ["profiles", "from-dbc", "NAME"],
        ["verify", "NAME"],
        ["gauge", "NAME", "--to", "x", "-o", "x.yaml"],
        ["validate", "NAME", "--calibration", "unit.yaml", "--site", "site.yaml"],
        ["run", "--rehearse", "--hands-free", "--session", "NAME"],
    ],
)
def test_a_name_that_is_too_long_is_refused_in_a_line(
    arguments: list[str],
    unit: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(unit.parent)
    is_calib = arguments[0] in ("verify", "gauge", "validate", "run")
    main = calib if is_calib else imudrv
    assert main([argument.replace("NAME", "n" * 300) for argument in arguments]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert "n" * 300 in message
    assert message.count("\n") == 1


def test_a_system_error_without_a_name_is_our_defect(capsys: pytest.CaptureFixture[str]) -> None:
    def command() -> None:
        raise OSError(9, "Bad file descriptor")

    assert guarded(command) == 1
    assert "internal error, please report it" in capsys.readouterr().err
