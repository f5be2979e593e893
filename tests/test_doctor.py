"""The doctor: right and wrong profiles over real ports, and a system made of files for the rest."""

import os
import resource
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from queue import Queue
from typing import Any

import numpy as np
import pytest
from realtime import DEADLINE_S, free_port

from imudrv import diagnosis, profiles
from imudrv.doctor import device, traffic
from imudrv.doctor import examine as examination
from imudrv.doctor.device import System
from imudrv.doctor.examine import examine
from imudrv.doctor.verdict import Finding, Verdict
from imudrv.errors import InputError
from imudrv.files.settings_file import parse
from imudrv.ports import Arrival, Port, PortEndedError
from imudrv.ports.base import LineErrors
from imudrv.ports.permission import permission_advice
from imudrv.profiles.line_load import line_load
from imudrv.profiles.schema import Profile, SerialLine
from imudrv.records import MESSAGE, Reason, Source, samples_type
from imudrv.sim.capture import wire
from imudrv.sim.live import play
from imudrv.sim.scenario import Scenario
from imudrv.url import split
from imudrv.wire.encode import StreamEncoder

RS422, ACC, CAN, CANFD = (
    profiles.load(name) for name in ("imu50-rs422", "imu50-rs422-acc", "imu50-can", "imu50-canfd")
)
LISTEN_S = (0.5, 2.0, 8.0, 30.0)
"""Times to listen until all has come: a busy machine may hold back samples, or bring them in bursts."""
LENGTH = RS422.messages[0].length


def scenario(duration_s: float, **sections: Any) -> Scenario:
    document = {
        "format": "imu50-scenario",
        "version": 1,
        "site": {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0},
        "motion": [{"rest": {"duration_s": duration_s}}],
        **sections,
    }
    return parse(document, Scenario, "test")


def sent(profile: Profile, duration_s: float = 1.0, **sections: Any) -> Any:
    pieces = [piece.data for piece in wire(scenario(duration_s, **sections), profile.layout())]
    return b"".join(pieces) if profile.transport == "serial" else np.concatenate(pieces)  # type: ignore[arg-type]


@pytest.fixture
def playing() -> Iterator[Callable[[Profile, str], str]]:
    """Plays a profile on a port in real time; where to listen."""
    stop = threading.Event()
    with ThreadPoolExecutor(1) as pool:

        def start(profile: Profile, target: str = "pty", **sections: Any) -> str:
            said: Queue[str] = Queue()
            pool.submit(play, scenario(600.0, **sections), profile, target, 1.0, said.put, None, stop)
            return said.get(timeout=DEADLINE_S).split()[-1]

        yield start
        stop.set()


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """A pty that somebody else speaks on: the speaker's end, and the listener's path."""
    master, slave = os.openpty()
    path = os.ttyname(slave)
    os.close(slave)
    yield master, path
    os.close(master)


def examined(
    url: str, profile: str | None, right: Callable[[dict[str, Finding]], bool]
) -> dict[str, Finding]:
    """Examine a port again, and longer, until the findings are right."""
    for listen_s in LISTEN_S:
        steps = by_name(examine(url, profile, listen_s))
        if right(steps):
            break
    return steps


def is_healthy(steps: dict[str, Finding]) -> bool:
    return all(step.verdict is not Verdict.FAIL for step in steps.values())


def by_name(steps: Any) -> dict[str, Finding]:
    return {step.name: step for step in steps}


@pytest.mark.parametrize("profile", [RS422, ACC])
def test_a_unit_of_the_right_profile_is_healthy(profile: Profile, playing: Any) -> None:
    steps = examined(playing(profile), profile.name, is_healthy)
    assert is_healthy(steps), steps
    assert list(steps)[:6] == ["device", "permission", "busy", "line load", "open", "data"]
    assert "good frames" in steps["data"].found
    assert "samples/s by the counter, 0 lost" in steps["data"].found
    assert steps["status"].found == "no bit set"
    assert "gyro 35.00 degC" in steps["temperatures"].found


def test_the_command_reports_each_step_and_the_result(playing: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    port = playing(RS422)

    def is_reported_healthy(listen_s: float) -> bool:
        said.clear()
        monkeypatch.setattr(examination, "LISTEN_S", listen_s)
        return examination.doctor(port, "imu50-rs422", said.append)

    assert any(map(is_reported_healthy, LISTEN_S)), said
    assert said[0].startswith("  ok  device: /dev/pts/")
    assert said[-1] == "healthy"
    said.clear()
    assert not examination.doctor("/dev/no-such-port", "imu50-rs422", said.append)
    assert said[0].startswith("fail  device: /dev/no-such-port does not exist\n        -> ")
    assert said[-1].startswith("not healthy")


def test_for_a_wrong_profile_the_right_one_is_named(playing: Any) -> None:
    steps = examined(playing(ACC), "imu50-rs422", lambda steps: "looks like" in steps["data"].found)
    data = steps["data"]
    assert data.verdict is Verdict.FAIL
    assert "bytes, no frame of imu50-rs422: sync EB 90 seen" in data.found
    assert "times, check never right; this" in data.found
    assert data.found.endswith("this looks like imu50-rs422-acc at 460800")
    assert data.fix == "use --profile imu50-rs422-acc"


def test_without_a_profile_the_right_one_is_found(playing: Any) -> None:
    steps = examined(playing(ACC), None, lambda steps: "profile" in steps and is_healthy(steps))
    assert steps["profile"].found == "the data fits imu50-rs422-acc: --profile imu50-rs422-acc"
    assert steps["data"].verdict is Verdict.OK


def test_a_line_that_damages_frames_is_a_failure(playing: Any) -> None:
    path = playing(RS422, faults={"stream": {"bit_flips": 0.2}})
    data = examined(path, "imu50-rs422", lambda steps: "damaged" in steps["data"].found)["data"]
    assert data.verdict is Verdict.FAIL
    assert "x check failed" in data.found
    assert "damaged" in data.found
    assert "cable" in data.fix


def test_silence_is_reported(line: tuple[int, str]) -> None:
    data = by_name(examine(line[1], "imu50-rs422", 0.1))["data"]
    assert data.verdict is Verdict.FAIL
    assert "silence: nothing received in 0.1 s" in data.found
    assert "power" in data.fix


def test_garbage_fits_nothing(line: tuple[int, str]) -> None:
    noise = np.random.default_rng(1).bytes(2000)
    stop = threading.Event()

    def speak() -> None:
        while not stop.wait(0.02):
            os.write(line[0], noise)

    with ThreadPoolExecutor(1) as pool:
        pool.submit(speak)
        data = examined(line[1], "imu50-rs422", lambda steps: "silence" not in steps["data"].found)["data"]
        stop.set()
    assert data.verdict is Verdict.FAIL
    assert "no shipped profile fits at any usual baud rate" in data.found


def test_a_port_that_is_lost_meanwhile_is_reported() -> None:
    with ThreadPoolExecutor(1) as pool:
        said: Queue[str] = Queue()
        pool.submit(play, scenario(0.3), RS422, "pty", 1.0, said.put)
        data = by_name(examine(said.get(timeout=DEADLINE_S).split()[-1], "imu50-rs422", DEADLINE_S))["data"]
    assert data.verdict is Verdict.FAIL
    assert "plug, cable and adapter" in data.fix


class FakeLine(Port):
    """A serial line whose unit speaks one profile at one rate; at others noise arrives."""

    def __init__(self, url: str, baudrate: int, right: int, profile: Profile) -> None:
        super().__init__(url, Source.REPLAY)
        noise = np.random.default_rng(baudrate).bytes(4000)
        self._pieces = [sent(profile, 0.2) if baudrate == right else noise]

    def read(self, timeout_s: float) -> Arrival:
        if not self._pieces:
            raise PortEndedError("over")
        return Arrival(1, self._pieces.pop())

    def close(self) -> None:
        self._pieces.clear()


@pytest.mark.parametrize(
    ("unit", "rate", "found", "fix"),
    [
        (ACC, 460_800, "imu50-rs422-acc at 460800", "use --profile imu50-rs422-acc"),
        (RS422, 115_200, "imu50-rs422 at 115200", "use ?baudrate=115200 in the URL"),
        (ACC, 2_000_000, "acc at 2000000", "use --profile imu50-rs422-acc and ?baudrate=2000000 in the URL"),
    ],
)
def test_a_wrong_rate_is_found_by_trying(
    monkeypatch: pytest.MonkeyPatch, unit: Profile, rate: int, found: str, fix: str
) -> None:
    opened = []

    def open_fake(url: str, profile: Profile) -> Port:
        baudrate = int(split(url).options.get("baudrate", profile.line.baudrate))  # type: ignore[union-attr]
        opened.append(baudrate)
        if baudrate == 115_201:
            raise InputError("no such rate")
        return FakeLine(url, baudrate, rate, unit)

    monkeypatch.setattr(examination, "open_port", open_fake)
    monkeypatch.setattr(examination, "BAUDRATES", (115_201, *examination.BAUDRATES))
    data = by_name(examine("rfc2217://box:1", "imu50-rs422", 0.1))["data"]
    assert data.found.endswith(found)
    assert data.fix == fix
    assert opened[0] == 921_600
    assert opened[-1] == rate
    assert opened.count(921_600) == 1


@pytest.fixture
def system(tmp_path: Path) -> System:
    """An empty one."""
    for name in ("sys", "proc", "dev"):
        (tmp_path / name).mkdir()
    return System(tmp_path / "sys", tmp_path / "proc", tmp_path / "dev")


def put(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n")


def adapter(system: System, latency_ms: int, control: str) -> None:
    """An FTDI adapter, as the kernel shows one."""
    put(system.sys / "bus/usb-serial/devices/ttyUSB0/latency_timer", str(latency_ms))
    usb_device = system.sys / "devices/usb1/1-2"
    put(usb_device / "idVendor", "0403")
    put(usb_device / "power/control", control)
    (usb_device / "1-2:1.0/ttyUSB0").mkdir(parents=True)
    tty = system.sys / "class/tty/ttyUSB0"
    tty.mkdir(parents=True)
    (tty / "device").symlink_to(usb_device / "1-2:1.0/ttyUSB0")


def test_a_slow_latency_timer_and_autosuspend_are_reported_with_their_fix(system: System) -> None:
    adapter(system, 16, "auto")
    steps = by_name(device.usb("ttyUSB0", system))
    timer, sleep = steps["latency timer"], steps["USB autosuspend"]
    assert timer.verdict is sleep.verdict is Verdict.WARN
    assert "16 ms" in timer.found
    assert timer.fix.startswith("echo 1 | sudo tee ")
    assert "devices/ttyUSB0/latency_timer" in timer.fix
    assert "99-imu50.rules" in timer.fix
    assert sleep.fix.startswith("echo on | sudo tee ")
    assert "usb1/1-2/power/control" in sleep.fix


def test_a_quick_adapter_is_ok_and_a_pty_has_no_such_settings(system: System) -> None:
    adapter(system, 1, "on")
    assert {step.verdict for step in device.usb("ttyUSB0", system)} == {Verdict.OK}
    assert list(device.usb("pts0", system)) == []


@pytest.mark.parametrize(("flags", "verdict"), [("0x10002040", Verdict.OK), ("0x10000040", Verdict.WARN)])
def test_the_low_latency_flag_of_a_built_in_port_is_reported(
    system: System, flags: str, verdict: Verdict
) -> None:
    put(system.sys / "class/tty/ttyS0/flags", flags)
    (step,) = device.usb("ttyS0", system)
    assert step.verdict is verdict


def test_for_a_device_that_does_not_exist_those_that_do_are_named(system: System) -> None:
    by_id = system.dev / "serial/by-id"
    by_id.mkdir(parents=True)
    for name in ("ttyUSB0", "ttyUSB1"):
        (system.dev / name).touch()
    (by_id / "usb-FTDI_A1").symlink_to(system.dev / "ttyUSB0")
    (step, *rest) = examine(str(system.dev / "ttyUSB5"), "imu50-rs422", 0.1, system)
    assert step.verdict is Verdict.FAIL
    assert step.fix == f"use one of {by_id / 'usb-FTDI_A1'}, {system.dev / 'ttyUSB1'}"
    # and nothing is opened or listened to
    assert [step.name for step in rest] == ["line load", "real-time priority", "locked memory"]


def test_for_a_device_without_permission_the_way_to_it_is_named(
    line: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    steps = by_name(examine(line[1], "imu50-rs422", 0.1))
    assert steps["permission"].verdict is Verdict.FAIL
    assert steps["permission"].fix == permission_advice(Path(line[1]))
    assert "99-imu50.rules" in steps["permission"].fix
    assert "open" not in steps


def test_another_program_on_the_port_is_named(line: tuple[int, str]) -> None:
    program = (
        f"import os, sys; os.open({line[1]!r}, os.O_RDWR | os.O_NOCTTY); print(flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        step = by_name(examine(line[1], "imu50-rs422", 0.1))["busy"]
        other.communicate(b"")
    assert step.verdict is Verdict.FAIL
    assert f"(process {other.pid})" in step.found


@pytest.mark.parametrize(
    ("flags", "verdict", "words"),
    [(None, Verdict.FAIL, "no CAN interface can0, but vcan3"), ("0x40080", Verdict.FAIL, "down")],
)
def test_a_can_interface_that_is_not_ready_is_reported(
    system: System, flags: str | None, verdict: Verdict, words: str
) -> None:
    put(system.sys / "class/net/vcan3/flags", "0x1")
    if flags:
        put(system.sys / "class/net/can0/flags", flags)
    (step, *_) = examine("can://socketcan/can0", "imu50-can", 0.1, system)
    assert step.verdict is verdict
    assert words in step.found
    assert step.fix


def test_a_can_interface_that_is_up_is_ok(system: System) -> None:
    put(system.sys / "class/net/can0/flags", "0x40081")
    (step, *_) = examine("can://socketcan/can0", "imu50-can", 0.1, system)
    assert step.verdict is Verdict.OK


@pytest.mark.parametrize("profile", [CAN, CANFD])
def test_a_unit_on_a_bus_is_healthy_and_its_identifiers_are_counted(profile: Profile, playing: Any) -> None:
    bus = f"can://udp_multicast/239.74.163.11?port={free_port()}"
    playing(profile, bus)
    steps = examined(bus, profile.name, lambda steps: steps["data"].verdict is Verdict.OK)
    assert steps["data"].verdict is Verdict.OK, steps
    assert ("150 " if profile is CAN else "158 ") in steps["data"].found


def test_for_a_unit_with_another_can_profile_the_right_one_is_named(
    playing: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = "can://virtual/doctor"
    monkeypatch.setattr(examination, "_TRY_S", 3.0)
    playing(CANFD, bus)
    steps = examined(bus, "imu50-can", lambda steps: "looks like" in steps["data"].found)
    assert steps["data"].verdict is Verdict.FAIL
    assert steps["data"].found == (
        "0 messages, no frame of imu50-can: 0 messages with its identifiers, no complete sample; "
        "this looks like imu50-canfd"
    )
    assert steps["data"].fix == "use --profile imu50-canfd"


def test_a_silent_bus_is_reported() -> None:
    data = by_name(examine("can://virtual/silent", "imu50-can", 0.1))["data"]
    assert data.verdict is Verdict.FAIL
    assert "silence" in data.found
    assert "termination" in data.fix


def test_a_profile_decodes_a_section_with_any_start_and_end() -> None:
    data = sent(RS422, 0.5)
    summary = diagnosis.decode_traffic(RS422, data[17:-3])
    assert summary.fits
    assert summary.is_clean
    assert summary.counts.good == 498
    assert summary.rejected == {}


def test_the_best_profile_is_the_one_that_reads_most() -> None:
    every = [profiles.load(name) for name in profiles.OWN]
    for profile in map(profiles.load, profiles.OWN):
        found = diagnosis.best_profile(every, sent(profile, 0.3))
        assert found is not None
        assert found.name == profile.name
    assert diagnosis.best_profile(every, b"") is None
    assert diagnosis.best_profile(every, np.zeros(0, MESSAGE)) is None


def test_a_few_frames_in_noise_are_no_fit() -> None:
    frames, noise = sent(RS422, 0.1), np.random.default_rng(1)
    data = b"".join(frames[n * LENGTH : (n + 1) * LENGTH] + noise.bytes(1000) for n in range(20))
    found = diagnosis.find_mismatch(ACC, data, [RS422])
    assert found.fitting is None
    assert not diagnosis.decode_traffic(RS422, data).fits
    assert "check right only 20 x, as by chance" in diagnosis.find_mismatch(RS422, data, []).found


def test_a_wrong_crc_is_distinguished_from_a_wrong_frame() -> None:
    frames = bytearray(sent(RS422, 0.1))
    frames[43::44] = bytes(b ^ 1 for b in frames[43::44])
    summary = diagnosis.decode_traffic(RS422, bytes(frames))
    assert Reason.CHECK_FAILED in summary.rejected
    step = traffic.check_mismatch(diagnosis.Mismatch(RS422, summary, None), True)
    assert "sync EB 90 seen 100 times, check never right" in step.found


def test_errors_that_the_driver_counts_are_a_step_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    class ErringLine(FakeLine):
        def line_errors(self) -> LineErrors:
            return LineErrors(framing=0 if self._pieces else 120)

    monkeypatch.setattr(examination, "open_port", lambda url, _: ErringLine(url, 1, 2, RS422))
    steps = by_name(examine("rfc2217://box:1", "imu50-rs422", 0.1))
    assert steps["line errors"].verdict is Verdict.FAIL
    assert steps["line errors"].found == "120 framing errors"
    assert "baud rate" in steps["line errors"].fix
    assert traffic.check_line_errors(LineErrors(overrun=2)).verdict is Verdict.WARN


def test_a_fault_of_the_unit_and_another_rate_are_reported() -> None:
    summary = replace(diagnosis.decode_traffic(RS422, sent(RS422, 0.2)), set_bits=("power", "warm-up"))
    steps = by_name(traffic.check_traffic(RS422, summary, 0.5, True))
    assert steps["status"].verdict is Verdict.WARN
    assert steps["status"].found == "power, warm-up"
    assert steps["rate"].verdict is Verdict.FAIL
    assert "expected 1000 samples/s, the unit counts 400" in steps["rate"].found
    assert "rate" not in by_name(traffic.check_traffic(RS422, summary, 0.5, False))


def test_bits_that_mean_good_are_reported_while_they_are_clear() -> None:
    kvh = profiles.load("kvh1775")
    samples = np.zeros(100, samples_type(gyro_pulses=False, accelerometer_pulses=False))
    samples["counter"] = np.arange(100)
    samples["status"] = 0x77  # six axes valid

    def bits() -> tuple[str, ...]:
        data = StreamEncoder(kvh.layout()).encode(samples).tobytes()
        return diagnosis.decode_traffic(kvh, data).set_bits

    assert bits() == ()
    samples["status"][50] = 0x36
    assert bits() == ("gyro X invalid", "accelerometer Z invalid")


def test_the_line_load_is_that_of_the_interface_document() -> None:
    # 44 bytes of 10 bits a millisecond (ICD, section 2)
    assert line_load(RS422) == pytest.approx(0.477, abs=0.001)
    # two messages of 135 bits at worst and two a tenth of a second: ISO 11898-1
    assert line_load(CAN) == pytest.approx(2.02 * 135e-3, rel=1e-9)
    # with identifiers of 29 bits a message of 8 bytes has up to 157 bits, and 3 idle ones
    assert line_load(profiles.load("openimu-j1939")) == pytest.approx(2 * 160 * 100 / 250e3, rel=1e-9)
    assert 0.1 < line_load(CANFD) < 0.3
    slow = RS422.model_copy(update={"line": SerialLine(baudrate=115_200)})
    step = by_name(examine("/dev/no-such-port?baudrate=115200", "imu50-rs422", 0.1))["line load"]
    assert line_load(slow) > 1.0
    assert step.verdict is Verdict.FAIL
    assert "of 115200 baud" in step.found


def test_limits_that_are_too_low_are_reported_with_their_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(resource, "getrlimit", lambda limit: (0, 0))
    steps = by_name(device.limits())
    assert {step.verdict for step in steps.values()} == {Verdict.WARN}
    assert "rtprio 50' into /etc/security/limits.d" in steps["real-time priority"].fix
    assert "LimitMEMLOCK=infinity" in steps["locked memory"].fix
    unlimited = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    monkeypatch.setattr(resource, "getrlimit", lambda limit: unlimited)
    assert {step.verdict for step in device.limits()} == {Verdict.OK}


def test_a_wrong_url_or_profile_is_refused() -> None:
    with pytest.raises(InputError, match=r"expected imu50-rs422, .*imu50-can"):
        list(examine("/dev/ttyUSB0", "imu51", 0.1))
    with pytest.raises(InputError):
        list(examine("nonsense", None, 0.1))
    with pytest.raises(InputError, match="expected a port for the can profile"):
        list(examine("loop://", "imu50-can", 0.1))


def test_a_simulated_unit_can_be_examined_too() -> None:
    steps = by_name(examine("sim://z-up?speed=max", None, 0.2))
    assert steps["profile"].found.startswith("the data fits imu50-rs422:")
    assert steps["data"].verdict is Verdict.OK
