"""`imudrv files` writes what is installed beside the program."""

import shutil
import subprocess
from pathlib import Path

import pytest

import imudrv
from imudrv.cli import main
from imudrv.cli.files import FILES

SHARE = Path(imudrv.__file__).parent / "share"


def test_all_shared_files_are_written_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "a" / "b"
    assert main(["files", "--to", str(target)]) == 0
    shared = {path.name: path.read_bytes() for path in SHARE.iterdir()}
    assert {path.name: path.read_bytes() for path in target.iterdir()} == shared
    printed = capsys.readouterr().out
    assert all(name in printed for name in shared)
    assert main(["files", "--to", str(target)]) == 0  # again


def test_without_a_folder_they_are_listed_and_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["files"]) == 0
    assert set(FILES) == {line.split()[0] for line in capsys.readouterr().out.splitlines()}
    assert not list(tmp_path.iterdir())


def test_a_changed_file_is_not_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "imudrv.service").write_text("User=me\n")
    assert main(["files", "--to", str(tmp_path)]) == 2
    assert "expected no imudrv.service of another version or with changes" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["imudrv.service"]
    assert (tmp_path / "imudrv.service").read_text() == "User=me\n"


@pytest.mark.parametrize("name", ["/dev/null", "/dev/null/x", "a\0b"])
def test_a_folder_that_cannot_be_made_is_refused(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["files", "--to", name]) == 2
    assert "expected a folder to write to" in capsys.readouterr().err


def test_the_c_files_compile_where_they_were_written(tmp_path: Path) -> None:
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("needs a C compiler called cc")
    assert main(["files", "--to", str(tmp_path)]) == 0
    command = [compiler, "-std=c99", "-o", "i50n_receiver", "i50n_receiver.c"]
    assert subprocess.run(command, cwd=tmp_path, check=False).returncode == 0
