"""The socket of a service: who owns it, what becomes of one that was left, and where it is by default."""

import os
import shutil
import signal
import socket
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from imudrv.errors import InputError
from imudrv.service import endpoint
from imudrv.service.endpoint import Endpoint, connect, default_folder

NOBODY = 65534
OWNER = """
import os, sys
from pathlib import Path
from imudrv.service.endpoint import Endpoint
os.setuid(int(sys.argv[2]))
owner = Endpoint(Path(sys.argv[1]))
print("ready", flush=True)
sys.stdin.read()
owner.close()
"""


@pytest.fixture(params=["unix", "tcp"])
def kind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """With Unix sockets, and without."""
    if request.param == "tcp":
        monkeypatch.delattr(socket, "AF_UNIX")
    return str(request.param)


@pytest.fixture
def everyones() -> Iterator[Path]:
    """A folder like /tmp: everyone may add files, and remove their own."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o1777)
    yield folder
    shutil.rmtree(folder)


def owner(path: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", OWNER, str(path), str(os.getuid())]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


def kill(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGKILL)
    process.communicate()


def answers(path: Path, server: Endpoint) -> bool:
    with connect(path, 1.0), server.listener.accept()[0]:
        return True


def test_a_client_finds_the_service_and_nothing_is_left_of_it(tmp_path: Path, kind: str) -> None:
    server = Endpoint(tmp_path / "s")
    assert answers(tmp_path / "s", server)
    server.close()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(OSError, match="No such file"):
        connect(tmp_path / "s", 1.0)


def test_only_the_user_can_open_a_unix_socket(tmp_path: Path) -> None:
    server = Endpoint(tmp_path / "s")
    assert stat.S_IMODE((tmp_path / "s").stat().st_mode) == 0o600
    server.close()


def test_a_live_owner_is_known_by_its_lock_even_if_it_does_not_answer(tmp_path: Path) -> None:
    process = owner(tmp_path / "s")
    try:
        for _ in range(20):  # as many clients as wait for an answer: the next one is not even connected
            client = socket.socket(socket.AF_UNIX)
            client.setblocking(False)
            client.connect_ex(str(tmp_path / "s"))
            client.detach()
        with pytest.raises(InputError, match="expected no other service, got one that runs; stop it"):
            Endpoint(tmp_path / "s")
        assert (tmp_path / "s").is_socket()
    finally:
        kill(process)


def test_the_socket_of_a_killed_owner_is_replaced(tmp_path: Path) -> None:
    kill(owner(tmp_path / "s"))
    assert (tmp_path / "s").is_socket()
    server = Endpoint(tmp_path / "s")
    assert answers(tmp_path / "s", server)
    server.close()
    assert list(tmp_path.iterdir()) == []


def test_a_socket_that_took_the_place_of_ours_is_left_alone(tmp_path: Path, kind: str) -> None:
    server = Endpoint(tmp_path / "s")
    (tmp_path / "s").unlink()
    (tmp_path / "s").write_text("of another")
    server.close()
    assert (tmp_path / "s").read_text() == "of another"


@pytest.mark.parametrize(
    "make", [Path.mkdir, lambda path: path.write_text("notes"), lambda path: path.symlink_to("x")]
)
def test_a_file_that_is_no_socket_is_left_alone(
    tmp_path: Path, kind: str, make: Callable[[Path], object]
) -> None:
    make(tmp_path / "s")
    with pytest.raises(InputError, match="s: cannot be used for the status: there is a file or folder that"):
        Endpoint(tmp_path / "s")
    assert [path.name for path in tmp_path.iterdir()] == ["s"]


@pytest.mark.parametrize("path", [Path("/nonexistent/s"), Path("/dev/null/s"), Path("x" * 300)])
def test_a_path_that_cannot_be_used_is_refused(path: Path, kind: str) -> None:
    with pytest.raises(InputError, match=r"cannot be used for the status: .*; give --status another path"):
        Endpoint(path)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs a second user, which only root can be")
@pytest.mark.parametrize("has_lock", [True, False])
def test_a_socket_left_by_another_user_is_reported(everyones: Path, has_lock: bool) -> None:
    kill(owner(everyones / "s"))
    if not has_lock:
        (everyones / "s.lock").unlink()
    command = [sys.executable, "-c", OWNER, str(everyones / "s"), str(NOBODY)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, input="")
    assert "InputError" in done.stderr
    assert "s: cannot be used for the status: " in done.stderr
    assert "ermi" in done.stderr.rpartition("status: ")[2]  # permission denied, operation not permitted


def test_sockets_of_killed_sessions_are_removed_and_those_of_live_ones_stay(tmp_path: Path) -> None:
    (tmp_path / "bus").write_text("of another program")
    kill(owner(tmp_path / "imu50-calib-4711.sock"))
    live = owner(tmp_path / "imu50-calib-4712.sock")
    server = Endpoint(tmp_path / "imu50.sock")
    names = {path.name for path in tmp_path.glob("*") if path.suffix != ".lock"}
    assert names == {"bus", "imu50-calib-4712.sock", "imu50.sock"}
    server.close()
    live.communicate("")
    assert {path.name for path in tmp_path.iterdir()} == {"bus"}


def test_the_default_folder_is_the_users_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", "/run/user/7")
    assert default_folder() == Path("/run/user/7")
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = default_folder()
    assert folder == tmp_path / f"imu50-{os.getuid()}"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert default_folder() == folder


@pytest.mark.parametrize("fault", ["mode", "owner", "link", "file"])
def test_a_default_folder_that_another_user_may_have_made_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = tmp_path / f"imu50-{os.getuid()}"
    match fault:
        case "mode":
            folder.mkdir()
            folder.chmod(0o770)
        case "owner":
            folder = tmp_path / "imu50-4711"
            folder.mkdir(mode=0o700)
            monkeypatch.setattr(os, "getuid", lambda: 4711)
        case "link":
            (tmp_path / "x").mkdir(mode=0o700)
            folder.symlink_to(tmp_path / "x")
        case "file":
            folder.touch()
    with pytest.raises(InputError, match=f"{folder}: .*; .*give --status another path"):
        endpoint.default_folder()


def test_a_socket_that_was_removed_is_made_again_and_that_of_another_is_left_alone(
    tmp_path: Path, kind: str
) -> None:
    path = tmp_path / "status.sock"
    own = Endpoint(path)
    path.unlink()
    own.renew()
    connect(path, 1.0).close()
    path.unlink()
    path.write_text("of another")
    own.renew()
    own.close()
    assert path.read_text() == "of another"
