"""The live service as users run it: real processes on real ptys, sockets and buses."""

import json
import os
import pty
import re
import signal
import socket
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from hashlib import sha256
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from realtime import DEADLINE_S, free_port, until
from samples import parse_json

from imudrv import compensate
from imudrv.calibration import write_calibration
from imudrv.errors import InputError
from imudrv.profiles import load
from imudrv.receiver import receive
from imudrv.recording.reader import Recording
from imudrv.records import PULSES, Flag
from imudrv.service.loop import Service as Driver
from imudrv.service.settings import Settings
from imudrv.service.status_socket import ask
from imudrv.sim.scenario import NOMINAL, nominal
from imudrv.terminal import INTERRUPTED
from imudrv.units import ARCSEC
from imudrv.wire.encode import StreamEncoder

LAYOUT = load("imu50-rs422").layout()


def frames(first: int, count: int) -> bytes:
    """Frames of a unit that turns a little."""
    samples = np.zeros(count, PULSES)
    samples["counter"] = first + np.arange(count)
    samples["gyro"] = pulses(samples["counter"])[:, None]
    samples["accelerometer"] = [0, 0, 20]
    samples["temperature_degc"] = 35.0
    return StreamEncoder(LAYOUT).encode(samples).tobytes()


def pulses(counter: ArrayLike) -> NDArray[np.float64]:
    """What each gyro of that unit counts in a sample."""
    return np.rint(100.0 * np.sin(np.asarray(counter) / 50.0))


WITHOUT_KERNEL = """\
import sys
import imudrv.system
from imudrv.cli import main

imudrv.system.IS_AVAILABLE = False
sys.exit(main())
"""
"""A program that is `imudrv` on a system where kernels cannot call the system."""


class Unit:
    """A unit on a pty that keeps its name when it is pulled out and put in again."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self.counter = 0
        self.plug()

    def plug(self) -> None:
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(slave))
        self._slave = slave

    def unplug(self) -> None:
        os.close(self._slave)
        os.close(self._master)
        self.link.unlink()

    def send(self, count: int) -> None:
        for _ in range(0, count, 20):
            n = min(20, count)
            data = frames(self.counter, n)
            self.counter += n
            self.write(data)

    def write(self, data: bytes) -> None:
        while data:
            try:
                data = data[os.write(self._master, data) :]
            except BlockingIOError:
                time.sleep(0.001)

    def skip(self, count: int) -> None:
        """Advance the unit's counter without sending."""
        self.counter += count


class Service:
    """A running `imudrv run`; `has_kernel`: whether the kernel may serve its port."""

    has_kernel = True

    def __init__(
        self, folder: Path, *arguments: object, stdin: int = subprocess.DEVNULL, stdout: int = subprocess.PIPE
    ) -> None:
        self.socket = folder / "status.sock"
        start = ["-m", "imudrv"] if self.has_kernel else ["-c", WITHOUT_KERNEL]
        self.process = subprocess.Popen(
            [sys.executable, *start, "run", *map(str, arguments), "--status", str(self.socket)],
            cwd=folder,
            stdin=stdin,
            stdout=stdout,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.said: list[str] = []
        self.warned: list[str] = []
        self._listeners = [
            threading.Thread(target=lines.extend, args=[stream])
            for lines, stream in ((self.said, self.process.stdout), (self.warned, self.process.stderr))
            if stream is not None
        ]
        for listener in self._listeners:
            listener.start()
        if self.process.stdout is not None:
            until(lambda: self.said or self.process.poll() is not None, "the first line")
            assert self.logged("serving"), self.said + self.warned

    def status(self) -> dict[str, Any]:
        return ask(self.socket)

    def good(self) -> int:
        return int(self.status()["samples"]["good"])

    def notices(self) -> str:
        return " ".join(self.status()["notices"])

    def serves(self) -> bool:
        assert self.process.poll() is None, "it has ended"
        try:
            return bool(self.status())
        except InputError:
            return False

    def logged(self, words: str) -> bool:
        return any(words in line for line in [*self.said, *self.warned])

    def command(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a command that asks this service."""
        command = [sys.executable, "-m", "imudrv", *arguments, "--status", str(self.socket)]
        return subprocess.run(command, capture_output=True, text=True, timeout=DEADLINE_S)

    def stop(self, number: int = signal.SIGTERM) -> int:
        self.process.send_signal(number)
        return self.ended()

    def ended(self) -> int:
        code = self.process.wait(DEADLINE_S)
        for listener in self._listeners:
            listener.join()
        return code


@contextmanager
def serving(
    folder: Path, *arguments: object, stdin: int = subprocess.DEVNULL, stdout: int = subprocess.PIPE
) -> Iterator[Service]:
    service = Service(folder, *arguments, stdin=stdin, stdout=stdout)
    try:
        yield service
    finally:
        if service.process.poll() is None:
            service.process.kill()
            service.ended()
        for stream in (service.process.stdout, service.process.stderr):
            if stream is not None:
                stream.close()


@contextmanager
def repeating(write: Callable[[], object]) -> Iterator[None]:
    """Write to a line every 20 ms, on average: a unit that lags is at a wrong rate after a while."""
    stop = threading.Event()

    def repeat() -> None:
        due_s = time.monotonic()
        while not stop.wait(max(0.0, due_s - time.monotonic())):
            write()
            due_s += 0.02

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


@contextmanager
def simulated(folder: Path, profile: str) -> Iterator[None]:
    """A unit at rest in a process of its own, on the pty that `serial` names."""
    command = ["sim", "static", "--profile", profile, "--port", "pty", "--link", str(folder / "unit")]
    process = subprocess.Popen(
        [sys.executable, "-m", "imudrv", *command], cwd=folder, stdout=subprocess.DEVNULL
    )
    try:
        until((folder / "unit").exists, "the simulated unit")
        yield
    finally:
        process.kill()
        process.wait()


@pytest.fixture(params=["kernel", "python"], autouse=True)
def loop(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Which loop serves: that of the kernel, or that of Python."""
    monkeypatch.setattr(Service, "has_kernel", request.param == "kernel")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    return tmp_path


def serial(folder: Path) -> list[object]:
    return ["--port", folder / "unit", "--profile", "imu50-rs422", "--calibration", "unit.yaml"]


def test_every_sample_is_sent_in_order_and_equals_that_of_the_offline_command(folder: Path) -> None:
    unit = Unit(folder / "unit")
    out = f"udp://127.0.0.1:{free_port()}"
    with (
        receive(out, timeout_s=DEADLINE_S) as receiver,
        serving(folder, *serial(folder), "--out", out, "--record", "run.mcap") as service,
    ):
        got = []
        for _ in range(10):
            unit.send(200)
            received = 0
            while received < 200:
                got.append(next(receiver))
                received += len(got[-1])
        assert service.stop() == 0
    live = np.concatenate(got)
    assert live["counter"].tolist() == list(range(2000))
    assert receiver.counts.lost == 0

    command = [sys.executable, "-m", "imudrv", "compensate", "run.mcap", "-o", "offline.npz"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=DEADLINE_S)
    assert done.returncode == 0, done.stderr
    assert "2000 samples by the counter = 2000 good; 0 duplicate" in done.stdout
    with np.load(folder / "offline.npz") as offline:
        for name, column in (("dtheta", "dtheta_b"), ("dv", "dv_b"), ("t_ns", "t_ns"), ("flags", "flags")):
            np.testing.assert_array_equal(offline[name], live[column], err_msg=name)
    recorded = np.concatenate(list(Recording(folder / "run.mcap").increments()))
    for name in live.dtype.names or ():
        np.testing.assert_array_equal(recorded[name], live[name], err_msg=name)


def test_an_unplug_is_reported_and_after_the_replug_the_stream_continues_with_the_gap_flagged(
    folder: Path,
) -> None:
    unit = Unit(folder / "unit")
    with serving(folder, *serial(folder), "--record", "run.mcap") as service:
        unit.send(300)
        until(lambda: service.good() == 300, "the first 300 samples")
        unit.unplug()
        until(lambda: service.logged("port lost"), "the loss reported")
        until(lambda: service.status()["health"] == "fail", "the loss in the status")
        unit.skip(50)
        unit.plug()
        until(lambda: service.logged("port is back"), "the port again")
        unit.send(300)
        until(lambda: service.good() == 600, "the other 300 samples")
        status = service.status()
        assert status["samples"]["missing"] == 50
        assert status["samples"]["closes"]
        until(lambda: service.status()["port"]["reconnects"] == 1, "the reconnect counted")
        assert service.stop() == 0
    increments = np.concatenate(list(Recording(folder / "run.mcap").increments()))
    flagged = increments["flags"] & Flag.MISSING_BEFORE != 0
    assert increments["counter"][flagged].tolist() == [350]


def test_silence_is_reported_and_nothing_exits(folder: Path) -> None:
    unit = Unit(folder / "unit")
    with serving(folder, *serial(folder)) as service:
        until(lambda: service.logged("silent"), "silence reported")
        unit.send(100)
        until(lambda: service.logged("the unit is back"), "the unit received again")
        until(lambda: service.good() == 100, "its samples")
        assert service.stop(signal.SIGINT) == 0
        assert service.logged("100 good")
    assert not service.socket.exists()


def test_bytes_without_a_frame_are_a_failure_until_frames_resume(folder: Path) -> None:
    unit = Unit(folder / "unit")
    garbage = bytes(range(1, 200))  # no sync in it
    with serving(folder, *serial(folder)) as service:
        # A busy machine may hold back the data for a moment, which is another state: each one must come.
        with repeating(lambda: unit.send(20)):
            until(lambda: service.good() > 500, "good frames")
            until(lambda: service.command("status").returncode != 4, "health")
        with repeating(lambda: unit.write(garbage)):
            until(lambda: service.status()["health"] == "fail", "the failure in the status")
            said = (
                r"port unreadable: [\d.]+ k?B/s come, no frame of imu50-rs422: "
                "sync EB 90 never seen; no shipped profile fits"
            )
            until(lambda: re.match(f"fail\n{said}", service.command("status").stdout), "what has failed")
            until(lambda: service.command("status").returncode == 4, "the failure as an exit code")
            until(lambda: "unreadable" in service.command("monitor").stdout, "the failure on the monitor")
            until(lambda: re.search(said, "".join(service.warned)), "the event")
        with repeating(lambda: unit.send(20)):
            until(lambda: service.status()["port"]["state"] == "streaming", "the frames read again")
            until(lambda: service.status()["health"] != "fail", "health again")
        assert service.stop() == 0


def test_a_wrong_profile_is_a_failure_from_the_start_and_the_right_one_is_named(folder: Path) -> None:
    with simulated(folder, "imu50-rs422-acc"), serving(folder, *serial(folder)) as service:
        said = (
            r"fail\nport unreadable: [\d.]+ kB/s come, no frame of imu50-rs422: sync EB 90 seen \d+ times, "
            "check never right; this looks like imu50-rs422-acc: start with --profile imu50-rs422-acc"
        )
        until(lambda: re.match(said, service.command("status").stdout), "the right profile")
        until(lambda: service.command("status").returncode == 4, "the failure as an exit code")
        assert service.good() == 0
        assert service.stop() == 0


def test_a_unit_that_changes_to_another_format_is_a_failure_and_the_format_is_named(folder: Path) -> None:
    unit = Unit(folder / "unit")
    samples = np.zeros(20, PULSES)
    samples["counter"] = np.arange(20)
    totals = StreamEncoder(load("imu50-rs422-acc").layout()).encode(samples).tobytes()
    with serving(folder, *serial(folder)) as service:
        with repeating(lambda: unit.send(20)):
            until(lambda: service.good() > 500, "good frames")
        with repeating(lambda: unit.write(totals)):
            until(lambda: service.logged("this looks like imu50-rs422-acc"), "the format")
            assert service.command("status").returncode == 4
        assert service.stop() == 0


def sampled_at(ratio: float, data: bytes) -> bytes:
    """What a receiver at another baud rate makes of bytes; `ratio`: its rate by that of the sender."""
    bits = np.array([[0, *(byte >> np.arange(8) & 1), 1] for byte in data]).ravel()
    received, at = bytearray(), 0.0  # bits of the sender
    while at + 10 / ratio < len(bits):
        if bits[int(at)]:
            at += 1 / ratio / 16  # as a receiver looks for a start bit
            continue
        middles = at + (np.arange(8) + 1.5) / ratio
        received.append(int(np.packbits(bits[middles.astype(int)], bitorder="little")[0]))
        at += 9.5 / ratio
    return bytes(received)


def test_a_receiver_at_the_senders_rate_gets_its_bytes() -> None:
    assert sampled_at(1.0, frames(0, 20)).startswith(frames(0, 19))


@pytest.mark.parametrize("ratio", [0.125, 0.5, 2.0])
def test_a_wrong_baud_rate_is_a_failure(ratio: float, folder: Path) -> None:
    unit = Unit(folder / "unit")
    garbled = sampled_at(ratio, frames(0, 40))
    with serving(folder, *serial(folder)) as service:
        with repeating(lambda: unit.write(garbled)):
            until(lambda: service.logged("check baud rate and profile"), "the failure")
            answer = service.command("status")
            assert answer.returncode == 4
            assert "come, no frame of imu50-rs422: sync EB 90 " in answer.stdout
        assert service.stop() == 0


def test_frames_whose_counter_stands_still_are_a_failure(folder: Path) -> None:
    unit = Unit(folder / "unit")
    same = frames(7, 1) * 20
    with serving(folder, *serial(folder)) as service:
        with repeating(lambda: unit.write(same)):
            until(lambda: service.logged("none continues the counter"), "the failure")
            assert service.command("status").returncode == 4
        assert service.stop() == 0


@pytest.mark.parametrize("are_frames", [True, False])
def test_a_program_that_has_the_port_open_is_named_until_it_ends(are_frames: bool, folder: Path) -> None:
    unit = Unit(folder / "unit")

    def send() -> None:
        if are_frames:
            unit.send(20)
            unit.skip(20)
        else:
            unit.write(bytes(range(1, 200)))

    with serving(folder, *serial(folder)) as service:
        with repeating(send):
            with (
                (folder / "unit").open("rb") as port,
                subprocess.Popen(["sleep", "600"], stdin=port) as other,
            ):
                try:
                    name = f"sleep (process {other.pid})"
                    until(lambda: name in str(service.status()["port"]["users"]), "the other program")
                    until(lambda: service.logged(name), "the line printed")
                    answer = service.command("status")
                    assert answer.returncode in (3, 4)
                    assert name in answer.stdout
                finally:
                    other.kill()
            until(lambda: name not in str(service.status()["port"]["users"]), "its end")
        assert service.stop() == 0


def test_a_unit_at_half_the_rate_of_its_profile_is_a_failure_and_its_increments_are_not_valid(
    folder: Path,
) -> None:
    text = (resources.files("imudrv.profiles") / "imu50-rs422.yaml").read_text("utf-8")
    (folder / "slow.yaml").write_text(text.replace("sample_rate_hz: 1000", "sample_rate_hz: 500"))
    with simulated(folder, "slow.yaml"), serving(folder, *serial(folder)) as service:
        until(lambda: service.logged("the unit counts"), "the rate")
        until(lambda: service.status()["port"]["trouble"], "the rate in the status")
        until(lambda: "VALID" not in service.status()["last"]["flags"], "increments not valid")
        status = service.status()
        assert status["health"] == "fail"
        assert status["port"]["state"] == "wrong rate"
        reason = "port wrong rate: expected 1000 samples/s of imu50-rs422, the unit counts "
        assert status["reasons"][0].startswith(reason)
        assert any(status["reasons"][0] in line for line in service.warned)
        assert service.command("status").returncode == 4
        assert "wrong rate" in service.command("monitor").stdout
        assert service.stop() == 0


def test_the_rate_of_a_simulated_unit_at_another_speed_is_not_checked(folder: Path) -> None:
    arguments = ["--port", "sim://static?speed=10", *serial(folder)[2:]]
    with serving(folder, *arguments) as service:
        until(lambda: service.good() > 60_000, "six seconds' samples")  # a rate is judged after four
        assert service.status()["port"]["trouble"] == ""
        assert service.stop() == 0


def test_a_calibration_is_replaced_while_running_and_a_bad_one_is_refused(folder: Path) -> None:
    unit = Unit(folder / "unit")
    with serving(folder, *serial(folder), "--record", "run.mcap") as service:
        unit.send(200)
        before = service.status()["calibration"]["sha256"]
        calibration = (folder / "unit.yaml").read_text()
        (folder / "unit.yaml").write_text(calibration.replace("[0.5, 0.5, 0.5]", "[0.5, 0.5, half]"))
        until(lambda: service.status()["calibration"]["refused"], "the bad file refused")
        assert "scale_arcsec_per_pulse[2]" in service.status()["calibration"]["refused"]
        assert service.status()["calibration"]["sha256"] == before

        (folder / "unit.yaml").write_text(calibration.replace("[0.5, 0.5, 0.5]", "[1.0, 1.0, 1.0]"))
        service.process.send_signal(signal.SIGHUP)
        until(lambda: service.status()["calibration"]["exchanges"] == 1, "the good one taken")
        status = service.status()["calibration"]
        assert status["sha256"] != before
        assert status["refused"] == ""
        unit.send(200)
        until(lambda: service.good() == 400, "all samples")
        assert service.stop() == 0
    increments = np.concatenate(list(Recording(folder / "run.mcap").increments()))
    assert increments["counter"].tolist() == list(range(400))
    # The pulses have a period of 314 samples, so sums over the two halves distinguish the scales.
    again = [c for _, c in Recording(folder / "run.mcap").calibrations()]
    assert [c.gyro.scale_arcsec_per_pulse[0] for c in again] == [0.5, 1.0]
    angle = pulses(np.arange(400))
    scale = increments["dtheta_b"][:, 0][angle != 0] / angle[angle != 0]
    assert np.unique(np.round(scale / scale[0], 9)).tolist() == [1.0, 2.0]


def good_pair(folder: Path) -> dict[str, bytes]:
    """Contents of two good certificates, by the unit's serial number: its gyros have scales of 0.5 and 1."""
    contents = {}
    for serial_number, scale in (("a", 0.5), ("b", 1.0)):
        gyro = NOMINAL.gyro.model_copy(update={"scale_arcsec_per_pulse": (scale, scale, scale)})
        update = {"serial_number": serial_number, "gyro": gyro}
        write_calibration(folder / "other.yaml", NOMINAL.model_copy(update=update))
        contents[serial_number] = (folder / "other.yaml").read_bytes()
    (folder / "unit.yaml").write_bytes(contents["a"])
    return contents


def test_constants_and_sha256_agree_however_the_calibration_file_is_replaced(
    folder: Path, replaced_at_random: Callable[..., AbstractContextManager[None]]
) -> None:
    contents = good_pair(folder)
    units = {sha256(content).hexdigest(): serial_number for serial_number, content in contents.items()}
    unit = Unit(folder / "unit")
    with serving(folder, *serial(folder), "--record", "run.mcap") as service:
        for seed in range(2):
            exchanges = service.status()["calibration"]["exchanges"]
            with replaced_at_random(folder / "unit.yaml", list(contents.values()), seed, removed=0.2):
                status = service.status()
                while status["calibration"]["exchanges"] < exchanges + 4:
                    assert status["unit"] == units[status["calibration"]["sha256"]]
                    unit.send(20)
                    status = service.status()
            left = sha256((folder / "unit.yaml").read_bytes()).hexdigest()
            until(lambda left=left: service.status()["calibration"]["sha256"] == left, "the last file taken")
            unit.send(200)
            while abs(angle := pulses(unit.counter - 1)) < 50:
                unit.send(20)
            until(lambda: service.status()["last"]["counter"] == unit.counter - 1, "the samples")
            scale = service.status()["last"]["dtheta_b"][0] / angle
            assert scale / ARCSEC == pytest.approx({"a": 0.5, "b": 1.0}[units[left]], rel=1e-9)  # rounding
        assert service.stop() == 0
    replaced = [t.split()[-1] for _, t in Recording(folder / "run.mcap").events() if "replaced" in t]
    attached = [c.serial_number for _, c in Recording(folder / "run.mcap").calibrations()]
    short = {digest[:12]: name for digest, name in units.items()}
    assert attached == ["a", *(short[digest] for digest in replaced)]


def test_at_the_start_constants_and_sha256_agree_too(
    folder: Path, replaced_at_random: Callable[..., AbstractContextManager[None]]
) -> None:
    contents = good_pair(folder)
    units = {sha256(content).hexdigest(): serial_number for serial_number, content in contents.items()}
    settings = Settings(
        port=str(folder / "unit"),
        profile="imu50-rs422",
        calibration=str(folder / "unit.yaml"),
        status=str(folder / "socket"),
    )
    with replaced_at_random(folder / "unit.yaml", list(contents.values()), seed=11):
        for _ in range(40):
            service = Driver(settings, lambda _: None)
            status = service.status
            service.close()
            assert status.unit == units[status.calibration.sha256]


def test_a_closed_pipe_loses_only_the_printed_text(folder: Path) -> None:
    unit = Unit(folder / "unit")
    reader, stdout = os.pipe()
    with serving(folder, *serial(folder), stdout=stdout) as service:
        os.close(stdout)
        assert b"serving" in os.read(reader, 1000)
        os.close(reader)  # as `head -1` does
        unit.send(100)
        until(lambda: service.good() == 100, "the first samples")
        unit.unplug()
        until(lambda: service.status()["port"]["state"] == "lost", "the end of the port")
        unit.plug()  # which is an event on stdout
        until(
            lambda: "stdout: cannot be written: Broken pipe; lost lines: " in service.notices(), "a warning"
        )
        unit.send(100)
        until(lambda: service.good() == 200, "the other samples")
        assert service.stop() == 0


def test_a_full_disk_loses_only_the_redirected_text(folder: Path) -> None:
    unit = Unit(folder / "unit")
    with open("/dev/full", "w") as full, serving(folder, *serial(folder), stdout=full.fileno()) as service:
        until(service.serves, "the status")
        unit.send(100)
        until(lambda: service.good() == 100, "the samples")
        assert "stdout: cannot be written: No space left on device; lost lines: " in service.notices()
        assert service.stop() == 0


def test_a_stopped_terminal_delays_only_the_text(folder: Path) -> None:
    unit = Unit(folder / "unit")
    master, slave = pty.openpty()
    os.set_blocking(master, False)
    text = bytearray()

    def printed(words: bytes, times: int = 1) -> bool:
        with suppress(BlockingIOError):
            text.extend(os.read(master, 4096))
        return text.count(words) == times

    out = f"udp://127.0.0.1:{free_port()}"
    with (
        receive(out, timeout_s=DEADLINE_S) as receiver,
        serving(folder, *serial(folder), "--out", out, stdout=slave) as service,
    ):
        until(lambda: printed(b"serving"), "its first line")
        termios.tcflow(slave, termios.TCOOFF)  # Ctrl-S
        counters: list[int] = []
        for reconnects in range(1, 4):
            unit.send(100)
            while len(counters) < unit.counter:
                counters += next(receiver)["counter"].tolist()
            unit.unplug()
            until(lambda: service.status()["port"]["state"] == "lost", "the loss")
            unit.plug()
            until(lambda n=reconnects: service.status()["port"]["reconnects"] == n, "the port again")
        until(lambda: "stdout: accepts no text" in service.notices(), "a warning")
        assert counters == list(range(300))
        termios.tcflow(slave, termios.TCOON)
        until(lambda: printed(b"port is back", 3), "what was held back")
        until(lambda: not service.notices(), "the end of the warning")
        termios.tcflow(slave, termios.TCOOFF)
        assert service.stop() == 0
    os.close(master)
    os.close(slave)


def test_a_sighup_while_it_starts_does_not_end_it(folder: Path) -> None:
    unit = Unit(folder / "unit")
    with (
        open(os.devnull, "w") as nothing,
        serving(folder, *serial(folder), stdout=nothing.fileno()) as service,
    ):
        until(service.socket.exists, "the first steps of its start")
        service.process.send_signal(signal.SIGHUP)
        until(service.serves, "the end of its start")
        unit.send(100)
        until(lambda: service.good() == 100, "the samples")
        assert service.stop() == 0


def test_the_exit_code_differs_when_the_terminal_was_closed(folder: Path) -> None:
    unit = Unit(folder / "unit")
    master, slave = pty.openpty()
    with serving(folder, *serial(folder), stdin=slave) as service:
        os.close(slave)
        unit.send(100)
        until(lambda: service.good() == 100, "the samples")
        os.close(master)
        assert service.stop(signal.SIGHUP) == INTERRUPTED
        assert service.logged("100 good")


def test_a_calibration_of_another_unit_is_refused_at_the_start(folder: Path) -> None:
    command = [sys.executable, "-m", "imudrv", "run", *map(str, serial(folder)), "--unit", "50-0018"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=DEADLINE_S)
    assert done.returncode == 2
    assert "nominal" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_tcp_client_that_stops_reading_loses_its_own_samples_only(folder: Path) -> None:
    unit = Unit(folder / "unit")
    port = free_port()
    with (
        serving(folder, *serial(folder), "--out", f"tcp://127.0.0.1:{port}") as service,
        socket.socket() as stuck,
    ):
        stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stuck.connect(("127.0.0.1", port))
        with receive(f"tcp://127.0.0.1:{port}", timeout_s=DEADLINE_S) as reader:
            until(lambda: "2 clients" in service.status()["sinks"][0]["state"], "two clients")
            total, sent = 0, 0
            while service.status()["sinks"][0]["dropped"] == 0:
                unit.send(1000)
                sent += 1000
                while total < sent:
                    total += len(next(reader))
                assert sent < 400_000, "the stuck client's queue has no bound"
            assert reader.counts.lost == 0
            until(lambda: service.good() == sent, "all of them counted")
        assert service.stop() == 0


def test_an_absent_receiver_has_no_effect(folder: Path) -> None:
    unit = Unit(folder / "unit")
    with serving(folder, *serial(folder), "--out", f"udp://127.0.0.1:{free_port()}") as service:
        seen: list[dict[str, Any]] = []

        def is_reported() -> bool:
            seen.append(service.status())
            return seen[-1]["sinks"][0]["state"] == "nobody listens"

        with repeating(lambda: unit.send(20)):  # the network answers what is sent
            until(is_reported, "the state")
        assert seen[-1]["health"] in ("warn", "fail")
        until(lambda: service.good() == unit.counter, "all samples")
        assert service.stop() == 0


@pytest.mark.parametrize("profile", ["kvh1775", "witmotion", "exail-asterix"])
def test_a_unit_of_another_maker_is_served_and_healthy(profile: str, tmp_path: Path) -> None:
    write_calibration(tmp_path / "unit.yaml", nominal(load(profile).layout()))
    arguments = ["--port", tmp_path / "unit", "--profile", profile, "--calibration", "unit.yaml"]
    with simulated(tmp_path, profile), serving(tmp_path, *arguments) as service:
        second = round(load(profile).rate_hz)
        until(lambda: service.good() > 6 * second, "six seconds' samples")  # a rate is judged after four
        until(lambda: service.status()["clock"]["locked"], "the clock")
        as_json = service.command("status", "--json")
        status = parse_json(as_json.stdout)
        assert (as_json.returncode, status["reasons"]) == (0, [])
        assert status["samples"]["lost_last_s"] == 0
        assert status["unit_status"]["faults"] == []
        up = status["last"]["dv_b"][2]
        if any(load(profile).layout().accelerometer.axes):
            # At rest, g for a sample; dither shakes the case by 1 m/s^2 at 1 kHz. Other units: factor 10.
            assert up == pytest.approx(9.79 / second, rel=0.3)
        else:
            assert up is None or np.isnan(up)
        assert service.stop() == 0


def test_a_status_for_scripts_and_one_for_people(folder: Path) -> None:
    unit = Unit(folder / "unit")
    with serving(folder, *serial(folder)) as service:
        unit.send(100)
        until(lambda: service.good() == 100, "the samples")
        until(lambda: service.status()["port"]["state"] == "silent", "silence")

        as_json = service.command("status", "--json")
        assert as_json.returncode == 4
        assert json.loads(as_json.stdout)["samples"]["good"] == 100
        assert service.command("status").stdout.startswith("fail\nport silent")
        assert "100 good" in service.command("monitor").stdout
        second = subprocess.run(
            [
                sys.executable,
                "-m",
                "imudrv",
                "run",
                *map(str, serial(folder)),
                "--status",
                str(service.socket),
            ],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=DEADLINE_S,
        )
        assert second.returncode == 2
        assert "expected no other service" in second.stderr
        assert service.stop() == 0
    gone = service.command("status")
    assert gone.returncode == 2
    assert "expected a running service" in gone.stderr


def test_the_service_manager_is_notified(folder: Path) -> None:
    unit = Unit(folder / "unit")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(folder / "notify"))
        manager.settimeout(DEADLINE_S)
        os.environ["NOTIFY_SOCKET"], os.environ["WATCHDOG_USEC"] = str(folder / "notify"), "300000"
        try:
            with serving(folder, *serial(folder)) as service:
                assert manager.recv(100) == b"READY=1"
                assert manager.recv(100) == b"WATCHDOG=1"
                unit.send(20)
                service.process.terminate()
                rest = set()  # read at once: the socket holds few messages
                while (message := manager.recv(100)) != b"STOPPING=1":
                    rest.add(message)
                assert rest <= {b"WATCHDOG=1"}
                assert service.ended() == 0
        finally:
            del os.environ["NOTIFY_SOCKET"], os.environ["WATCHDOG_USEC"]


def test_a_replay_of_a_capture_gives_what_the_offline_command_gives(folder: Path) -> None:
    (folder / "run.raw").write_bytes(frames(0, 3000)[:-10])
    arguments = ["--port", "replay://run.raw?speed=max", *serial(folder)[2:], "--out", "file:live.i50n"]
    with serving(folder, *arguments) as service:
        assert service.ended() == 0
        assert service.logged("2999 samples by the counter = 2999 good")
    command = [sys.executable, "-m", "imudrv", "compensate", "run.raw", *map(str, serial(folder)[2:])]
    subprocess.run(
        [*command, "-o", "offline.i50n"], cwd=folder, check=True, timeout=DEADLINE_S, capture_output=True
    )
    live, offline = (np.fromfile(folder / f"{n}.i50n", "u1").reshape(-1, 76) for n in ("live", "offline"))
    # All but source, flags and time, which a replay has and a capture has not, and the check over them.
    for part in (slice(8, 16), slice(24, 72)):
        np.testing.assert_array_equal(live[:, part], offline[:, part])


SET_BY_A_FILE = """\
import mmap, time

real_ns = time.time_ns
with open({path!r}, "r+b") as file:
    step_ns = memoryview(mmap.mmap(file.fileno(), 0)).cast("q")

time.time_ns = lambda: real_ns() + step_ns[0]
"""
"""A clock that the file sets, read from memory: a slow reading of the clocks is not used."""


def test_a_clock_that_is_set_by_an_hour_is_logged_flagged_and_followed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = folder / "step"
    step.write_bytes(bytes(8))
    (folder / "sitecustomize.py").write_text(SET_BY_A_FILE.format(path=str(step)))
    monkeypatch.setenv("PYTHONPATH", str(folder), prepend=os.pathsep)
    unit = Unit(folder / "unit")
    out = f"udp://127.0.0.1:{free_port()}"
    with (
        receive(out, timeout_s=DEADLINE_S) as receiver,
        serving(folder, *serial(folder), "--out", out, "--record", "run.mcap") as service,
    ):
        with repeating(lambda: unit.send(20)):
            until(lambda: service.good() > 200, "samples")
            with step.open("r+b") as file:
                file.write((3600 * 10**9).to_bytes(8, sys.byteorder))
            until(lambda: service.logged("the host's clock was set by +3600.000 s"), "the event")
            good = service.good()
            until(lambda: service.good() > good + 200, "more samples")
            status = service.status()
        assert service.stop() == 0
        assert status["clock"]["steps"] == 1
        assert any("set by +3600.000 s" in event for event in status["events"])
        live = np.concatenate([next(receiver) for _ in range(10)])
        while live["counter"][-1] < good + 200:
            live = np.concatenate([live, next(receiver)])
    (first,) = np.flatnonzero(live["flags"] & Flag.CLOCK_STEPPED)
    assert (live["interval_ns"] == 1_000_000).all()
    advance = np.diff(live["t_ns"])
    assert np.delete(advance, first - 1).min() > 0
    assert np.argmax(advance) == first - 1
    # This run takes a minute at most, an hour is 60 of them.
    assert 3540 * 10**9 < advance[first - 1] < 3660 * 10**9
    assert status["last"]["t_ns"] > live["t_ns"][0] + 3540 * 10**9
    offline = compensate(folder / "run.mcap")
    np.testing.assert_array_equal(offline[: len(live)], live)
