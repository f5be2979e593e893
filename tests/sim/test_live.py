"""A scenario in real time, over real ptys, sockets and buses: what arrives is what the capture holds."""

import os
import select
import signal
import socket
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from queue import Queue
from typing import Any

import can
import numpy as np
import pytest
from realtime import DEADLINE_S, free_port, until

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.records import Records
from imudrv.sim.capture import wire
from imudrv.sim.links import pty, serial, tcp
from imudrv.sim.links.base import LineOptions
from imudrv.sim.live import MOST, Pace, PacedPlayback, Played, play
from imudrv.sim.scenario import Scenario
from imudrv.url import speed_of

Make = Callable[..., Scenario]
RS422 = profiles.load("imu50-rs422")
CAN = profiles.load("imu50-can")
FAULTS = {
    "stream": {"bit_flips": 0.02, "bytes_lost": 0.02, "frame_lost": 0.02, "frame_doubled": 0.02},
    "can": {"lost": 0.02, "doubled": 0.02, "swapped": 0.02},
    "silences": [{"at_s": 0.3, "duration_s": 0.2}],
    "counter_jumps": [{"at_s": 0.7, "by": 100}],
}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    # the readers here throw nothing away when they open a port, and may be as slow as the machine is
    monkeypatch.setattr(pty, "SETTLE_S", 0.02)
    for line in (pty, serial, tcp):
        monkeypatch.setattr(line, "TIMEOUT_S", DEADLINE_S)


@pytest.fixture
def run(scenario: Make) -> Scenario:
    return scenario({"rest": {"duration_s": 1.0}}, faults=FAULTS)


def whole(scenario: Scenario, profile: profiles.Profile) -> bytes:
    pieces = [piece.data for piece in wire(scenario, profile.layout())]
    return b"".join(data for data in pieces if isinstance(data, bytes))


class Player:
    """A run in another thread, and what it says."""

    def __init__(self, pool: ThreadPoolExecutor) -> None:
        self._pool = pool
        self.said: Queue[str] = Queue()
        self.stop = threading.Event()
        self.played: Future[Played] | None = None

    def start(self, *arguments: Any, link: Path | None = None) -> str:
        """Begin; where to listen."""
        name = str(link) if link else None
        self.played = self._pool.submit(play, *arguments, self.said.put, name, self.stop)
        while self.said.empty():
            if self.played.done():
                self.played.result()
            time.sleep(0.005)
        return self.said.get().split()[-1]

    def result(self) -> Played:
        assert self.played is not None
        return self.played.result(timeout=DEADLINE_S)


@pytest.fixture
def player() -> Iterator[Player]:
    with ThreadPoolExecutor(1) as pool:
        player = Player(pool)
        yield player
        player.stop.set()


@contextmanager
def opened(path: str | Path) -> Iterator[int]:
    """A terminal, once it is there."""
    until(Path(path).exists, f"{path}")
    fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        yield fd
    finally:
        os.close(fd)


def read_to_the_end(fd: int) -> bytes:
    data = b""
    while select.select([fd], [], [], DEADLINE_S)[0]:
        try:
            piece = os.read(fd, 65536)
        except OSError:
            break
        if not piece:
            break
        data += piece
    return data


@pytest.mark.parametrize("speed", [10.0, None])
@pytest.mark.parametrize("profile", ["imu50-rs422", "imu50-rs422-acc"])
def test_a_pty_carries_the_bytes_of_the_capture(
    run: Scenario, player: Player, profile: str, speed: float | None
) -> None:
    wanted = whole(run, profiles.load(profile))
    with opened(player.start(run, profiles.load(profile), "pty", speed)) as fd:
        assert read_to_the_end(fd) == wanted
    played = player.result()
    assert (played.samples, played.sent, played.undelivered) == (1000, len(wanted), 0)
    assert (played.latest_ns is None) == (speed is None)
    assert "1000 samples" in str(played)


def test_twenty_thousand_samples_a_second_pass_a_pty_without_loss(scenario: Make, player: Player) -> None:
    run = scenario({"rest": {"duration_s": 20.0}})
    with opened(player.start(run, RS422, "pty", 20.0)) as fd:
        assert read_to_the_end(fd) == whole(run, RS422)
    assert player.result().undelivered == 0


def test_a_pty_waits_for_its_reader_however_late(run: Scenario, player: Player) -> None:
    path = player.start(run, RS422, "pty", 1000.0)
    time.sleep(0.3)
    with opened(path) as fd:
        assert read_to_the_end(fd) == whole(run, RS422)


def test_an_unplugged_pty_reappears_under_its_link(scenario: Make, player: Player, tmp_path: Path) -> None:
    out = [{"at_s": 0.2, "duration_s": 0.1}, {"at_s": 0.6, "duration_s": 0.1}]
    run = scenario({"rest": {"duration_s": 1.0}}, faults={**FAULTS, "unplugs": out})
    link = tmp_path / "imu"
    assert player.start(run, RS422, "pty", None, link=link) == str(link)
    got, slaves = [], []
    for _ in range(3):
        with opened(link) as fd:
            slaves.append(os.readlink(link))
            got.append(read_to_the_end(fd))
    # A reader that waits for the pty gets all that the capture has: there the cable's time is a silence.
    assert b"".join(got) == whole(run, RS422)
    assert all(got)
    assert player.result().undelivered == 0
    assert not link.is_symlink()
    silent = run.model_copy(update={"faults": run.faults.model_copy(update={"unplugs": ()})})
    assert len(whole(silent, RS422)) > len(whole(run, RS422))


def test_a_reader_that_leaves_in_the_middle_of_a_write_does_not_end_the_run(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said: list[str] = []
    line = pty.SimulatedPty(LineOptions("unit", False, said.append, threading.Event()), None)
    readers = [os.open(said[0].split()[-1], os.O_RDONLY | os.O_NOCTTY)]
    ready = select.select

    def leaving(*arguments: Any) -> Any:
        while readers:
            os.close(readers.pop())
        return ready(*arguments)

    monkeypatch.setattr(select, "select", leaving)
    line.send(bytes(44))
    line.close()
    assert (line.sent, line.undelivered) == (0, 44)


def test_a_link_never_leads_to_a_closed_pty(
    scenario: Make, player: Player, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, close = tmp_path / "imu", os.close
    is_linked: list[bool] = []

    def closing(fd: int) -> None:
        if os.readlink(f"/proc/self/fd/{fd}").endswith("ptmx"):  # the unit's end
            is_linked.append(link.is_symlink())
        close(fd)

    monkeypatch.setattr(pty.os, "close", closing)
    run = scenario({"rest": {"duration_s": 0.2}}, faults={"unplugs": [{"at_s": 0.1, "duration_s": 0.05}]})
    player.start(run, RS422, "pty", 10.0, link=link)
    fd = os.open(link, os.O_RDONLY | os.O_NOCTTY)
    read_to_the_end(fd)
    player.result()
    close(fd)
    assert is_linked
    assert not any(is_linked)


def test_in_real_time_the_unit_continues_without_a_reader_and_reports_it(
    scenario: Make, player: Player
) -> None:
    run = scenario({"rest": {"duration_s": 1.0}}, faults={"unplugs": [{"at_s": 0.5, "duration_s": 0.1}]})
    with opened(player.start(run, RS422, "pty", 5.0)) as fd:
        first = read_to_the_end(fd)
    played = player.result()
    assert first == whole(run, RS422)[: 500 * 44]
    assert played.sent == len(first)
    assert played.undelivered == len(whole(run, RS422)) - len(first) == 400 * 44
    assert "17600 not delivered" in str(played)


def test_what_a_reader_leaves_at_the_end_is_not_delivered(
    scenario: Make, player: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pty, "TIMEOUT_S", 0.1)
    run = scenario({"rest": {"duration_s": 0.2}})  # 8800 bytes: more than the queue of a terminal shows
    with opened(player.start(run, RS422, "pty", 10.0)):
        played = player.result()
    assert (played.sent, played.undelivered) == (0, 8800)


def test_what_a_pty_has_not_handed_over_yet_counts_as_unread() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    for _ in range(2000):  # the kernel hands it over a little later, and later still on a busy machine
        os.write(master, bytes(440))
        assert pty.queued_bytes(slave) == 440
        os.read(slave, 440)
    os.close(master)
    os.close(slave)


def test_a_link_never_takes_the_place_of_a_file(run: Scenario, player: Player, tmp_path: Path) -> None:
    (tmp_path / "imu").write_text("precious")
    with pytest.raises(InputError, match="expected an unused name"):
        player.start(run, RS422, "pty", None, link=tmp_path / "imu")
    with pytest.raises(InputError, match="cannot be made"):
        player.start(run, RS422, "pty", None, link=tmp_path / "no" / "imu")
    assert (tmp_path / "imu").read_text() == "precious"


def test_a_serial_port_is_set_as_the_profile_says_and_closed_when_unplugged(
    scenario: Make, player: Player
) -> None:
    run = scenario({"rest": {"duration_s": 0.2}}, faults={"unplugs": [{"at_s": 0.1, "duration_s": 0.05}]})
    master, slave = os.openpty()
    path = os.ttyname(slave)
    wanted = whole(run, RS422)
    try:
        assert player.start(run, RS422, f"serial://{path}?baudrate=460800", 10.0) == path
        got = b""
        while len(got) < len(wanted) and select.select([master], [], [], DEADLINE_S)[0]:
            got += os.read(master, 65536)
        assert got == wanted
        assert player.result().undelivered == 0
    finally:
        os.close(master)
        os.close(slave)


def test_a_serial_port_that_goes_away_ends_the_run_with_a_message(scenario: Make, player: Player) -> None:
    master, slave = os.openpty()
    player.start(scenario({"rest": {"duration_s": 60.0}}), RS422, os.ttyname(slave), 1.0)
    os.read(master, 44)
    os.close(slave)
    os.close(master)
    with pytest.raises(InputError, match="the port went away"):
        player.result()


def connect(where: str) -> socket.socket:
    host, port = where.removeprefix("tcp://").rsplit(":", 1)
    connected: list[socket.socket] = []

    def connects() -> bool:
        with suppress(ConnectionRefusedError):  # unplugged just now
            connected.append(socket.create_connection((host, int(port)), timeout=DEADLINE_S))
        return bool(connected)

    until(connects, where)
    return connected[0]


def receive_to_the_end(client: socket.socket) -> bytes:
    data = b""
    while piece := client.recv(65536):
        data += piece
    return data


@pytest.mark.parametrize("speed", [10.0, None])
def test_a_tcp_client_gets_the_bytes_of_the_capture(
    run: Scenario, player: Player, speed: float | None
) -> None:
    with connect(player.start(run, RS422, "tcp://:0", speed)) as client:
        assert receive_to_the_end(client) == whole(run, RS422)
    assert player.result().undelivered == 0


def test_a_second_tcp_client_gets_the_samples_from_then_on(scenario: Make, player: Player) -> None:
    run = scenario({"rest": {"duration_s": DEADLINE_S}})
    where = player.start(run, RS422, "tcp://127.0.0.1:0", 1.0)
    with connect(where) as first:
        early = first.recv(44)
        with connect(where) as second:
            late = second.recv(44)
            player.stop.set()
            late += receive_to_the_end(second)
        early += receive_to_the_end(first)
    assert whole(run, RS422).startswith(early)
    assert late
    assert early.endswith(late)


def test_an_unplugged_tcp_server_closes_and_listens_again(scenario: Make, player: Player) -> None:
    run = scenario({"rest": {"duration_s": 1.0}}, faults={"unplugs": [{"at_s": 0.5, "duration_s": 0.1}]})
    where = player.start(run, RS422, "tcp://:0", None)
    with connect(where) as client:
        first = receive_to_the_end(client)
    with connect(where) as client:
        second = receive_to_the_end(client)
    assert first + second == whole(run, RS422)
    assert len(first) == 500 * 44


def test_a_tcp_client_that_reads_nothing_is_disconnected_without_effect_on_others(
    scenario: Make, player: Player, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tcp, "TIMEOUT_S", 3.0)  # the other one reads all the time
    run = scenario({"rest": {"duration_s": 200.0}})
    where = player.start(run, RS422, "tcp://:0", 1000.0)
    with connect(where) as deaf, connect(where) as client:
        # 8.8 MB are more than the system keeps for a connection
        got = receive_to_the_end(client)
        assert whole(run, RS422).endswith(got)
        assert player.said.get() == "a client reads nothing and was disconnected; 1 left"
        assert deaf.recv(1)
    assert player.result().undelivered > 0


def test_without_a_tcp_client_nothing_is_delivered(scenario: Make, player: Player) -> None:
    run = scenario({"rest": {"duration_s": 4.0}})  # far longer than the client needs for its first bytes
    with connect(player.start(run, RS422, "tcp://:0", 1.0)) as client:
        client.recv(44)
    played = player.result()
    assert played.sent > 0
    assert played.undelivered > 0
    assert played.sent + played.undelivered == 4 * 44_000
    assert player.said.get() == "a client disconnected; 0 left"


def messages_of(run: Scenario, profile: profiles.Profile) -> list[tuple[int, bytes, bool]]:
    pieces: list[Records] = [p.data for p in wire(run, profile.layout()) if not isinstance(p.data, bytes)]
    return [(int(m["id"]), m["data"][: m["length"]].tobytes(), bool(m["fd"])) for m in np.concatenate(pieces)]


@pytest.mark.parametrize("profile", ["imu50-can", "imu50-canfd"])
@pytest.mark.parametrize("bus", ["virtual/live", "udp_multicast/239.74.163.9"])
def test_a_can_bus_carries_the_messages_of_the_capture(
    run: Scenario, player: Player, profile: str, bus: str
) -> None:
    loaded = profiles.load(profile)
    wanted = messages_of(run, loaded)
    interface, _, channel = bus.partition("/")
    options: dict[str, Any] = {"port": free_port()} if interface == "udp_multicast" else {}
    query = "".join(f"?{name}={value}" for name, value in options.items())
    # A socket holds 277 messages, half a second of them at this speed.
    with can.Bus(interface=interface, channel=channel, ignore_config=True, **options) as listener:
        player.start(run, loaded, f"can://{bus}{query}", 0.25)
        got = []
        while len(got) < len(wanted) and (message := listener.recv(DEADLINE_S)) is not None:
            got.append((message.arbitration_id, bytes(message.data), message.is_fd))
    assert got == wanted
    played = player.result()
    assert (played.sent, played.undelivered, played.unit) == (len(wanted), 0, "messages")


def test_identifiers_of_29_bits_are_sent_as_such(run: Scenario, player: Player) -> None:
    messages = (CAN.messages[0].model_copy(update={"id": 0x18FF0150}), *CAN.messages[1:])
    profile = CAN.model_copy(update={"messages": messages})
    with can.Bus("wide", "virtual", ignore_config=True) as listener:
        player.start(run, profile, "can://virtual/wide", 2.0)
        received = [listener.recv(DEADLINE_S) for _ in range(4)]
    sent = [(m.arbitration_id, m.is_extended_id) for m in received if m is not None]
    assert sent == [(0x18FF0150, True), (0x151, False), (0x152, False), (0x153, False)]


@pytest.mark.parametrize(
    ("target", "profile", "message"),
    [
        ("pty", CAN, "expected can://INTERFACE/CHANNEL for the profile imu50-can"),
        ("can://virtual/x", RS422, "expected pty, a serial port or tcp:// for the profile imu50-rs422"),
        ("can://nonsense/x", CAN, "cannot be opened as a CAN bus"),
        ("/dev/no-such-port", RS422, "/dev/no-such-port: cannot be opened as a serial port"),
        ("serial:///dev/x?colour=red", RS422, "colour: unknown key"),
        ("serial:///dev/x?baudrate=fast", RS422, "fast"),
        ("tcp://127.0.0.1:99999", RS422, "(?i)port"),
        ("tcp://192.0.2.1:5000", RS422, "cannot listen there"),
        ("udp://127.0.0.1:5000", RS422, "begins with serial://, tcp://, or a path"),
    ],
)
def test_an_invalid_target_is_refused(
    run: Scenario, player: Player, target: str, profile: profiles.Profile, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        player.start(run, profile, target, None)


def test_a_link_goes_with_a_pty_alone(run: Scenario, player: Player, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="only with the port pty"):
        player.start(run, RS422, "tcp://:0", None, link=tmp_path / "imu")


def test_a_stopped_run_ends_with_its_counts(scenario: Make, player: Player) -> None:
    run = scenario({"rest": {"duration_s": 3600.0}})
    with opened(player.start(run, RS422, "pty", 1.0)) as fd:
        os.read(fd, 44)
        player.stop.set()
        read_to_the_end(fd)
    played = player.result()
    assert 0 < played.samples < 3600_000
    assert played.sent + played.undelivered == 44 * played.samples


def test_a_stop_ends_the_wait_for_a_reader(run: Scenario, player: Player) -> None:
    player.start(run, RS422, "pty", 1.0)
    player.stop.set()
    assert player.result().samples == 0


@contextmanager
def full_disk() -> Iterator[int]:
    """Standard output on a full disk."""
    with open("/dev/full", "w") as full:
        yield full.fileno()


@contextmanager
def stopped_terminal() -> Iterator[int]:
    """Standard output on a terminal after Ctrl-S."""
    master, slave = os.openpty()
    termios.tcflow(slave, termios.TCOOFF)
    yield slave
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize(
    ("output", "code", "message"),
    [(full_disk, 2, "stdout: cannot be written: No space left on device"), (stopped_terminal, 0, "")],
)
def test_a_command_with_a_blocked_terminal_still_sends_everything(
    output: Callable[[], AbstractContextManager[int]], code: int, message: str, run: Scenario, tmp_path: Path
) -> None:
    settings_file.write(tmp_path / "run.yaml", run)
    command = [sys.executable, "-m", "imudrv", "sim", "run.yaml", "--profile", "imu50-rs422", "--port", "pty"]
    with output() as stdout:
        process = subprocess.Popen(
            [*command, "--link", "imu"], cwd=tmp_path, stdout=stdout, stderr=subprocess.PIPE, text=True
        )
        try:
            with opened(tmp_path / "imu") as fd:
                assert read_to_the_end(fd) == whole(run, RS422)
            _, said = process.communicate(timeout=DEADLINE_S)
        finally:
            process.kill()
            process.communicate()
    assert process.returncode == code
    assert message in said


def test_a_command_without_a_standard_output_sends_all_the_same(run: Scenario, tmp_path: Path) -> None:
    settings_file.write(tmp_path / "run.yaml", run)
    command = f"{sys.executable} -m imudrv sim run.yaml --profile imu50-rs422 --port pty --link imu >&-"
    process = subprocess.Popen(command, shell=True, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    try:
        with opened(tmp_path / "imu") as fd:
            assert read_to_the_end(fd) == whole(run, RS422)
        _, said = process.communicate(timeout=DEADLINE_S)
    finally:
        process.kill()
        process.communicate()
    assert (process.returncode, said) == (0, "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_process_cleanly(number: signal.Signals, tmp_path: Path) -> None:
    program = (
        "import sys; from functools import partial; from imudrv import profiles; "
        "from imudrv.sim import live, scenario; "
        "from imudrv.sim.links import pty; pty.TIMEOUT_S = float(sys.argv[2]); "
        "print(live.play(scenario.load('static'), profiles.load('imu50-rs422'), 'pty', 1.0, "
        "partial(print, flush=True), sys.argv[1]))"
    )
    link = tmp_path / "imu"
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(link), str(DEADLINE_S)], stdout=subprocess.PIPE, text=True
    )
    try:
        with opened(link) as fd:
            os.read(fd, 44)
            process.send_signal(number)
            read_to_the_end(fd)
        said, _ = process.communicate(timeout=DEADLINE_S)
    finally:
        process.kill()
    assert process.returncode == 0
    assert " 0 not delivered" in said
    assert not link.is_symlink()


def test_playback_gives_what_is_due_and_no_more(run: Scenario) -> None:
    layout = RS422.layout()
    playback = PacedPlayback(run, layout)
    assert playback.due_ns() == 1_000_000
    assert playback.due_ns(group=10) == 10_000_000
    assert playback.take(999_999) is None
    pieces = []
    for until_ns in range(0, 2_000_000_000, 7_000_000):
        while (due := playback.take(until_ns)) is not None:
            assert due.first_ns <= due.last_ns <= until_ns
            assert due.last_ns - due.first_ns < MOST * layout.interval_ns
            pieces.append(due.data)
        assert (playback.due_ns() or 2**62) > until_ns
    assert playback.due_ns() is None
    assert b"".join(pieces) == whole(run, RS422)  # type: ignore[arg-type]


def test_deadlines_are_absolute(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [5_000]
    monkeypatch.setattr(time, "monotonic_ns", lambda: clock[0])
    pace = Pace(2.0)
    clock[0] += 1_500_000
    assert pace.now_ns() == 3_000_000
    assert pace.left_ns(4_000_000) == 500_000
    assert pace.left_ns(2_000_000) == -500_000
    assert Pace(None).now_ns() > 10**18
    assert Pace(None).left_ns(10**15) == 0


def test_a_speed_is_a_number_or_max() -> None:
    assert [speed_of(text) for text in ("1", "0.5", "10", "max")] == [1.0, 0.5, 10.0, None]
    for text in ("0", "-1", "nan", "fast", "1e9"):
        with pytest.raises(InputError, match="expected max or a number from"):
            speed_of(text)
