"""The simulated unit as a port: what is read is what the capture holds, in time or as fast as it goes."""

from pathlib import Path

import numpy as np
import pytest

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.hostclock import now_ns
from imudrv.ports import Arrival, Port, PortEndedError, PortLostError, open_port
from imudrv.records import MESSAGE, Source
from imudrv.sim.capture import wire
from imudrv.sim.scenario import load

SCENARIO = """
format: imu50-scenario
version: 1
seed: 5
site: {latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}
motion:
  - rest: {duration_s: 1.0}
faults:
  stream: {bit_flips: 0.02, frame_lost: 0.02, bytes_between: 0.02}
  can: {lost: 0.02, swapped: 0.02}
  silences: [{at_s: 0.3, duration_s: 0.2}]
  unplugs: [{at_s: 0.7, duration_s: 0.1}]
"""


@pytest.fixture
def run(tmp_path: Path) -> Path:
    path = tmp_path / "run.yaml"
    path.write_text(SCENARIO)
    return path


def read_all(port: Port, timeout_s: float = 0.5) -> list[Arrival]:
    arrivals = []
    try:
        while True:
            arrivals.append(port.read(timeout_s))
    except PortEndedError:
        return arrivals
    finally:
        port.close()


@pytest.mark.parametrize("speed", ["10", "max"])
def test_the_bytes_are_those_of_the_capture(run: Path, speed: str) -> None:
    profile = profiles.load("imu50-rs422")
    port = open_port(f"sim://{run}?speed={speed}", profile)
    assert port.source == Source.SIMULATOR
    got = [arrival.data for arrival in read_all(port)]
    assert b"".join(got) == b"".join(piece.data for piece in wire(load(str(run)), profile.layout()))


@pytest.mark.parametrize("speed", ["10", "max"])
@pytest.mark.parametrize("name", ["imu50-can", "imu50-canfd"])
def test_the_messages_are_those_of_the_capture(run: Path, name: str, speed: str) -> None:
    profile = profiles.load(name)
    arrivals = read_all(open_port(f"sim://{run}?speed={speed}", profile))
    got = np.concatenate([arrival.data for arrival in arrivals])
    wanted = np.concatenate([piece.data for piece in wire(load(str(run)), profile.layout())])
    assert got.dtype == MESSAGE
    for field in ("id", "length", "fd", "data"):
        np.testing.assert_array_equal(got[field], wanted[field])
    assert np.all(np.diff(got["t_ns"]) >= 0)
    if speed == "max":
        np.testing.assert_array_equal(np.diff(got["t_ns"]), np.diff(wanted["t_ns"]))
        assert all(arrival.t_ns == arrival.data["t_ns"][-1] for arrival in arrivals)


def test_at_full_speed_the_stamps_are_those_of_the_run() -> None:
    before = now_ns()
    with_times = open_port("sim://z-up?speed=max", profiles.load("imu50-rs422"))
    begun = now_ns()
    arrivals = [with_times.read(0.0) for _ in range(10)]
    with_times.close()
    ends = np.cumsum([len(arrival.data) // 44 for arrival in arrivals]) * 1_000_000
    begins = np.array([arrival.t_ns for arrival in arrivals]) - ends
    # all from one beginning, which is that of the port
    assert np.ptp(begins) == 0
    assert before <= begins[0] <= begun


def test_in_real_time_nothing_arrives_before_it_is_due_and_a_wait_ends(run: Path) -> None:
    profile = profiles.load("imu50-can")
    before = now_ns()
    port = open_port(f"sim://{run}?speed=0.1", profile)
    # the first samples are due after 10 ms
    while (arrival := port.read(0.001)).data.size == 0:
        assert arrival.data.dtype == MESSAGE
    assert arrival.t_ns - before >= 10_000_000
    assert now_ns() >= arrival.t_ns
    port.close()


def test_a_closed_port_says_so_as_often_as_it_is_asked(run: Path) -> None:
    port = open_port(f"sim://{run}?speed=max", profiles.load("imu50-rs422"))
    port.read(0.0)
    port.close()
    port.close()
    with pytest.raises(PortLostError, match="the port is closed"):
        port.read(0.0)


def test_the_end_is_reported_every_time(run: Path) -> None:
    port = open_port(f"sim://{run}?speed=max", profiles.load("imu50-rs422"))
    read_all_but_close = 0
    for _ in range(100_000):
        try:
            port.read(0.0)
        except PortEndedError:
            read_all_but_close += 1
            if read_all_but_close == 2:
                break
    port.close()
    assert read_all_but_close == 2


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("sim://w-up", "scenario 'w-up': expected one of"),
        ("sim://z-up?speed=fast", "expected max or a number"),
        ("sim://z-up?loop=1", "expected no option but speed, got loop"),
    ],
)
def test_an_invalid_url_is_refused(url: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        open_port(url, profiles.load("imu50-rs422"))
