import json
import os
import pty
import subprocess
import sys
import tty
from pathlib import Path

import numpy as np
import pytest

from imudrv.calibration import write_calibration
from imudrv.cli import main as imudrv
from imudrv.errors import InputError
from imudrv.hostclock import now_ns
from imudrv.profiles import load
from imudrv.records import PULSES
from imudrv.service.loop import Service
from imudrv.service.settings import Settings
from imudrv.service.status import Status, UnitStatus
from imudrv.service.status_socket import StatusServer, ask
from imudrv.sim.scenario import NOMINAL
from imudrv.sinks.base import HOUSEKEEPING_NS
from imudrv.units import NS_PER_S
from imudrv.wire.encode import StreamEncoder


class Clock:
    """A clock that the test sets."""

    def __init__(self) -> None:
        self.t_ns = now_ns()

    def __call__(self) -> int:
        return self.t_ns


def test_an_event_is_published_at_once_and_the_rate_is_still_over_a_whole_second(tmp_path: Path) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    master, slave = pty.openpty()
    tty.setraw(slave)
    settings = Settings(
        port=os.ttyname(slave),
        profile="imu50-rs422",
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
    )
    clock = Clock()
    service = Service(settings, lambda _: None, clock=clock)
    try:
        service.step()
        samples = np.zeros(100, PULSES)
        samples["counter"] = np.arange(100)
        wire = StreamEncoder(load("imu50-rs422").layout()).encode(samples).tobytes()
        os.write(master, wire)  # 100 frames of 38 bytes are less than a pty holds
        for _ in range(10):  # one read, or more if the system cuts the bytes
            service.step()
        clock.t_ns += NS_PER_S - HOUSEKEEPING_NS
        os.close(slave)
        os.close(master)
        service.step()
        assert "port lost" in service.status.events[-1]
        lost, *_ = service.status.reasons("en")
        assert lost.startswith("port lost: ")
        assert service.status.reasons("zh_CN")[0] == lost.replace("port lost: ", "端口已断开：")
        assert service.status.rate_hz == 0.0
        clock.t_ns += HOUSEKEEPING_NS
        service.step()
        assert service.status.samples.good == 100
        assert service.status.rate_hz == 100.0
    finally:
        service.close()


def test_a_status_is_the_same_after_json_and_one_of_another_program_is_refused(tmp_path: Path) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    settings = Settings(
        port="sim://static?speed=max",
        profile="imu50-rs422",
        calibration=str(tmp_path / "unit.yaml"),
        outputs=(f"file:{tmp_path / 'out.i50n'}",),
        record=str(tmp_path / "run.mcap"),
        status=str(tmp_path / "socket"),
    )
    service = Service(settings, lambda _: None)
    try:
        service.step()
    finally:
        service.close()
    document = service.status.to_json()
    assert document["samples"]["good"] > 0
    assert document["recording"]["url"].endswith("run.mcap")
    assert Status.from_json(document) == service.status
    del document["port"]["state"]
    with pytest.raises(InputError, match=r"status: port\.state: Field required; restart the service"):
        Status.from_json(document)


def test_a_status_of_another_version_is_refused(tmp_path: Path) -> None:
    server = StatusServer(tmp_path / "socket", lambda: b'{"format": "imu50-status", "version": 2}\n')
    server.start()
    with pytest.raises(InputError, match=r"socket: expected imu50-status version 1, got b'.*\"version\": 2"):
        ask(tmp_path / "socket")
    server.close()
    assert not (tmp_path / "socket").exists()


@pytest.mark.parametrize(
    "change", [{"health": "good"}, {"health": []}, {"reasons": None}, {"reasons": [1]}, {"reasons": "dead"}]
)
def test_a_status_without_health_or_reasons_is_refused(
    change: dict[str, object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    status = {"format": "imu50-status", "version": 1, "health": "ok", "reasons": [], **change}
    server = StatusServer(tmp_path / "socket", lambda: json.dumps(status).encode())
    server.start()
    code = imudrv(["status", "--status", str(server.path)])
    server.close()
    assert code == 2
    assert "expected a status with health and reasons" in capsys.readouterr().err


@pytest.mark.parametrize("options", [[], ["--json"]])
def test_the_exit_code_of_the_health_survives_a_reader_that_has_gone(
    tmp_path: Path, options: list[str]
) -> None:
    events = ["one of the many lines of a long status"] * 1000  # more than a buffer holds
    document = {"format": "imu50-status", "version": 1, "health": "fail", "reasons": [], "events": events}
    server = StatusServer(tmp_path / "socket", lambda: json.dumps(document).encode() + b"\n")
    server.start()
    reader, writer = os.pipe()
    os.close(reader)  # as `head` does when it has its lines
    command = [sys.executable, "-m", "imudrv", "status", "--status", str(server.path), *options]
    process = subprocess.Popen(command, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    _, errors = process.communicate()
    server.close()
    assert (process.returncode, errors) == (4, b"")


@pytest.mark.parametrize(
    ("profile", "word", "bits", "faults"),
    [
        ("imu50-rs422", 0b11, ["warm-up", "gyro X fault"], ["gyro X fault"]),
        ("kvh1775", 0x77, [], []),
        (
            "kvh1775",
            0x36,
            ["gyro X invalid", "accelerometer Z invalid"],
            ["gyro X invalid", "accelerometer Z invalid"],
        ),
    ],
)
def test_a_bit_that_means_good_is_a_fault_while_it_is_clear(
    profile: str, word: int, bits: list[str], faults: list[str]
) -> None:
    assert UnitStatus.of(word, load(profile).layout()) == UnitStatus(word, bits, faults)
