"""What a command writes to: files, links and standard output; never a device, a pipe or its own input."""

import os
import re
import socket
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from realtime import DEADLINE_S

from calib.cli import main as calib
from imudrv.calibration import read_calibration, write_calibration
from imudrv.cli import main as imudrv
from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.files.outputs import file_to_write
from imudrv.files.spool import AppendThread, Piece
from imudrv.recording.export import export
from imudrv.recording.reader import Recording
from imudrv.sim.scenario import NOMINAL

SCENARIO = """
format: imu50-scenario
version: 1
seed: 5
site: {latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}
motion: [{rest: {duration_s: 0.5}}]
unit: {calibration_file: unit.csv}
"""
COMMANDS: dict[str, tuple[Callable[[list[str]], int], str]] = {
    "decode": (imudrv, "decode run.npz --profile own.csv -o OUT"),
    "compensate": (imudrv, "compensate run.npz --profile own.csv --calibration unit.csv -o OUT"),
    "sim": (imudrv, "sim short.yaml --profile own.csv -o OUT"),
    "truth": (imudrv, "sim short.yaml --profile own.csv -o other.raw --truth OUT"),
    "pack": (imudrv, "pack run.mcap -o OUT"),
    "export": (imudrv, "export run.mcap --to raw -o OUT"),
    "imr": (imudrv, "export run.mcap --to imr -o OUT"),
    "identify": (
        calib,
        "identify run.npz --profile own.csv --calibration unit.csv --site site.yaml -o OUT",
    ),
    "json": (calib, "identify run.mcap --calibration unit.csv --site site.yaml -o other.yaml --json OUT"),
    "report": (calib, "identify run.mcap --site site.yaml -o other.yaml --report OUT"),
    "validate": (
        calib,
        "validate run.npz --profile own.csv --calibration unit.csv --site site.yaml --report OUT",
    ),
    "gauge": (calib, "gauge unit.csv --to x -o OUT"),
    "import-arms": (calib, "import-arms arms.m --from psins --calibration unit.csv -o OUT"),
}
SUFFIX = {"decode": ".csv", "compensate": ".csv", "truth": ".npz"}
"""Suffixes of the outputs that need one."""
INPUTS = ("run.npz", "run.mcap", "short.yaml", "own.csv", "unit.csv", "site.yaml", "arms.m")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Every input file, by name."""
    folder = tmp_path_factory.mktemp("made")
    write_calibration(folder / "unit.csv", NOMINAL)
    (folder / "short.yaml").write_text(SCENARIO)
    (folder / "site.yaml").write_text("{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}")
    (folder / "arms.m").write_text("".join(f"clbt.r{axis} = [0.01; 0.02; 0.03];\n" for axis in "xyz"))
    shipped = Path(__file__).parents[1] / "imudrv" / "profiles" / "imu50-rs422.yaml"
    (folder / "own.csv").write_bytes(shipped.read_bytes())
    service = "run --port sim://short.yaml?speed=max --profile own.csv --calibration unit.csv"
    for arguments in (
        "sim short.yaml --profile own.csv -o run.npz",
        f"{service} --record run.mcap --status status.sock",
    ):
        piped(arguments, folder)
    return {name: (folder / name).read_bytes() for name in INPUTS}


@pytest.fixture
def here(made: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A current folder with fresh copies of the inputs."""
    for name, content in made.items():
        (tmp_path / name).write_bytes(content)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(command: str, output: str) -> int:
    main, line = COMMANDS[command]
    return main(line.replace("OUT", output).split())


def process(arguments: str) -> list[str]:
    return [sys.executable, "-m", "imudrv", *arguments.split()]


def piped(arguments: str, folder: Path) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(process(arguments), cwd=folder, check=True, capture_output=True, timeout=DEADLINE_S)


def make(kind: str, path: Path) -> None:
    """Make what is no file; as a device that of /dev/null, under a name of its own."""
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(path.name)
    else:
        try:
            os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))
        except PermissionError:
            pytest.skip("only root may make a device")


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("kind", ["device", "pipe", "socket", "folder"])
@pytest.mark.parametrize("link", [False, True])
def test_an_output_that_is_no_file_is_refused_and_not_changed(
    command: str, kind: str, link: bool, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suffix = SUFFIX.get(command, "")
    name = output = f"it{suffix}"
    make(kind, here / name)
    if link:
        output = f"link{suffix}"
        os.symlink(name, output)
    before, files = os.stat(name), set(os.listdir())
    assert run(command, output) == 2
    message = capsys.readouterr().err
    assert message == f"error: {output}: expected a file, got a {kind}; choose another name\n"
    after = os.stat(name)
    assert (after.st_ino, after.st_mode, after.st_rdev) == (before.st_ino, before.st_mode, before.st_rdev)
    assert set(os.listdir()) == files


@pytest.mark.parametrize(
    ("command", "name"),
    [
        (command, name)
        for command, (_, line) in COMMANDS.items()
        for name in INPUTS
        if name in line or (name == "unit.csv" and "short.yaml" in line)  # the scenario names it
    ],
)
@pytest.mark.parametrize("way", ["itself", "symbolic link", "hard link"])
def test_an_output_that_is_an_input_is_refused_under_whatever_name(
    command: str, name: str, way: str, here: Path, made: dict[str, bytes], capsys: pytest.CaptureFixture[str]
) -> None:
    output = name
    if way != "itself" or command == "truth":
        output = f"link{SUFFIX.get(command, '')}"
        (os.link if way == "hard link" else os.symlink)(name, output)
    assert run(command, output) == 2
    message = capsys.readouterr().err
    assert message == (
        f"error: {output}: expected an output apart from its input {name}, got the same file; "
        "choose another name\n"
    )
    assert {path: (here / path).read_bytes() for path in made} == made


def test_an_export_in_a_program_does_not_replace_its_recording(here: Path, made: dict[str, bytes]) -> None:
    with pytest.raises(InputError, match="expected an output apart from its input run"):
        export(Recording(Path("run.mcap")), "raw", here / "run.mcap")
    assert (here / "run.mcap").read_bytes() == made["run.mcap"]


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("command", ["decode", "sim", "truth", "pack", "export", "gauge"])
def test_a_symbolic_link_is_followed(command: str, there: bool, here: Path) -> None:
    output, name = f"link{SUFFIX.get(command, '')}", f"far{SUFFIX.get(command, '')}"
    (here / "elsewhere").mkdir()
    target = here / "elsewhere" / name
    if there:
        target.write_bytes((here / "unit.csv").read_bytes())
    before = target.read_bytes() if there else b""
    os.symlink(f"elsewhere/{name}", output)
    assert run(command, output) == 0
    assert os.readlink(output) == f"elsewhere/{name}"
    assert target.read_bytes() != before
    assert not target.is_symlink()
    if command == "gauge":
        assert read_calibration(target).size_effect.gauge == "x"  # type: ignore[union-attr]
        kept = [path for path in target.parent.iterdir() if path != target]
        assert [path.read_bytes() for path in kept] == [before] * there


def test_an_output_in_a_missing_folder_is_refused_with_the_name_of_the_folder(here: Path) -> None:
    expected = "no/it: cannot be written: expected the folder no, there is none; make it first"
    with pytest.raises(InputError, match=expected), atomic_write(Path("no/it")):
        pass


def test_a_circular_link_is_refused(here: Path) -> None:
    os.symlink("it", "it")
    with pytest.raises(InputError, match="it: cannot be written: Too many levels"), atomic_write(here / "it"):
        pass


@pytest.mark.parametrize(
    "arguments",
    [
        "decode run.npz --profile own.csv -o OUT.csv",
        "compensate run.npz --profile own.csv --calibration unit.csv -o OUT.csv",
        "sim short.yaml --profile own.csv -o OUT.raw",
        "sim short.yaml --profile imu50-can -o OUT.log",
        "export run.mcap --to csv -o OUT.csv",
        "export run.mcap --to raw -o OUT.raw",
    ],
)
def test_standard_output_gets_what_the_file_would_and_nothing_else(arguments: str, here: Path) -> None:
    to_file = piped(arguments, here)
    output = re.findall(r"OUT\.\w+", arguments)[0]
    content = (here / output).read_bytes()
    done = piped(arguments.replace(output, "-"), here)
    assert done.stdout == content
    assert done.stderr == to_file.stdout.replace(output.encode(), b"-")
    assert not os.path.lexists("-")


def test_standard_output_has_a_second_name(here: Path) -> None:
    # Only a command that refuses this name for its suffix otherwise: a test must not replace the real thing.
    to_file = piped("decode run.npz --profile own.csv -o out.csv", here)
    content = (here / "out.csv").read_bytes()
    done = piped("decode run.npz --profile own.csv -o /dev/stdout", here)
    assert done.stdout == content
    assert done.stderr == to_file.stdout.replace(b"out.csv", b"/dev/stdout")
    with (here / "redirected").open("wb") as file:
        command = process("decode run.npz --profile own.csv -o /dev/stdout")
        subprocess.run(command, stdout=file, stderr=subprocess.DEVNULL, check=True, timeout=DEADLINE_S)
    assert (here / "redirected").read_bytes() == content
    with pytest.raises(InputError, match="cannot go to standard output"):
        file_to_write(Path("/dev/stdout"))


@pytest.mark.parametrize(
    "command", ["pack", "imr", "identify", "json", "report", "validate", "gauge", "import-arms"]
)
def test_options_invalid_on_standard_output_are_refused_in_a_line(
    command: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = set(os.listdir())
    assert run(command, "-") == 2
    message = capsys.readouterr()
    assert message.out == ""
    assert message.err == "error: -: expected a file, for this output cannot go to standard output\n"
    assert set(os.listdir()) == files


def test_a_full_standard_output_is_reported_and_a_closed_pipe_is_no_fault(here: Path) -> None:
    command = process("decode run.npz --profile own.csv -o -")
    with open("/dev/full", "wb") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, timeout=DEADLINE_S, check=False)
    assert (done.returncode, done.stderr) == (
        2,
        b"error: standard output: cannot be written: No space left on device\n",
    )
    begun = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert begun.stdout is not None
    begun.stdout.close()  # as head does
    _, errors = begun.communicate(timeout=DEADLINE_S)
    assert (begun.returncode, errors) == (0, b"")


def test_an_output_that_is_redirected_onto_its_input_is_refused(here: Path, made: dict[str, bytes]) -> None:
    with (here / "run.npz").open("ab") as file:
        command = process("decode run.npz --profile own.csv -o -")
        done = subprocess.run(command, stdout=file, stderr=subprocess.PIPE, timeout=DEADLINE_S, check=False)
    assert done.returncode == 2
    assert b"-: expected an output apart from its input run.npz" in done.stderr
    assert (here / "run.npz").read_bytes() == made["run.npz"]


def test_a_live_file_cannot_be_a_pipe_or_standard_output(here: Path) -> None:
    os.mkfifo("pipe")
    for name, what in (("pipe", "got a pipe"), ("-", "cannot go to standard output")):
        with pytest.raises(InputError, match=f"{name}: expected a file.*{what}"):
            AppendThread(Path(name), b"head", lambda: Piece(b"", 0, False))
    assert stat.S_ISFIFO(os.stat("pipe").st_mode)
    assert not os.path.lexists("-")


def test_a_live_file_goes_to_where_a_link_points(here: Path) -> None:
    os.symlink("far", "link")
    AppendThread(Path("link"), b"head", lambda: Piece(b"", 0, False)).close()
    assert os.readlink("link") == "far"
    assert (here / "far").read_bytes() == b"head"
