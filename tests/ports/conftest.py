import time
from collections.abc import Callable, Iterator

import pytest
from realtime import DEADLINE_S

from imudrv import load_profile
from imudrv.ports import Arrival, Port, PortEndedError, open_port
from imudrv.profiles.schema import Profile


@pytest.fixture(scope="session")
def rs422() -> Profile:
    return load_profile("imu50-rs422")


@pytest.fixture(scope="session")
def can_profile() -> Profile:
    return load_profile("imu50-can")


@pytest.fixture(scope="session")
def canfd() -> Profile:
    return load_profile("imu50-canfd")


@pytest.fixture
def opened() -> Iterator[Callable[[str, Profile], Port]]:
    """Opens ports and closes them after the test."""
    ports: list[Port] = []

    def open_and_keep(url: str, profile: Profile) -> Port:
        ports.append(open_port(url, profile))
        return ports[-1]

    yield open_and_keep
    for port in ports:
        port.close()


@pytest.fixture
def arrivals() -> Callable[[Port, int], list[Arrival]]:
    """Reads until so many bytes or messages have come; fails if they do not."""

    def collect(port: Port, count: int) -> list[Arrival]:
        deadline = time.monotonic() + DEADLINE_S
        found: list[Arrival] = []
        while sum(len(arrival.data) for arrival in found) < count:
            assert time.monotonic() < deadline
            arrival = port.read(0.2)
            if len(arrival.data):
                found.append(arrival)
        return found

    return collect


@pytest.fixture
def to_the_end() -> Callable[[Port], list[Arrival]]:
    """Reads until the port says that there will never be more."""

    def collect(port: Port) -> list[Arrival]:
        found: list[Arrival] = []
        while True:
            try:
                arrival = port.read(0.2)
            except PortEndedError:
                return found
            if len(arrival.data):
                found.append(arrival)

    return collect
