"""Recordings that another thread asks for while the service runs."""

from pathlib import Path
from threading import Thread
from time import sleep

import numpy as np
import pytest

from imudrv.calibration import write_calibration
from imudrv.errors import InputError
from imudrv.recording import Recording
from imudrv.service import Service
from imudrv.settings import Settings
from imudrv.sim.scenario import NOMINAL
from imudrv.sinks.base import Batch, Sink, SinkState

DEADLINE_S = 60.0


class Counted(Sink):
    """A sink of the caller's own."""

    def __init__(self) -> None:
        super().__init__("own")
        self.samples = 0
        self.closed = False

    def publish(self, batch: Batch) -> None:
        self.samples += len(batch.increments)

    @property
    def state(self) -> SinkState:
        return SinkState(self.url, "ok", True, self.samples, 0, 0)

    def close(self) -> None:
        self.closed = True


def test_one_recording_follows_another_between_two_reads_and_nothing_is_lost_between_them(
    tmp_path: Path,
) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    settings = Settings(
        port="sim://static?speed=20",
        profile="imu50-rs422",
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
    )
    own = Counted()
    service = Service(settings, lambda _: None, [own])
    refused: list[BaseException | None] = []

    def ask() -> None:
        service.record(tmp_path / "first.mcap").result(DEADLINE_S)
        wait_for(own, 1000)
        second = service.record(tmp_path / "second.mcap")
        second.result(DEADLINE_S)
        assert not Recording(tmp_path / "first.mcap").cut
        wait_for(own, 2000)
        refused.append(service.record(tmp_path / "first.mcap").exception(DEADLINE_S))
        service.record(None).result(DEADLINE_S)
        service.stop()

    asking = Thread(target=ask)
    asking.start()
    service.run()
    asking.join(DEADLINE_S)
    assert own.closed
    first, second = (
        np.concatenate(list(Recording(tmp_path / f"{name}.mcap").increments()))["counter"]
        for name in ("first", "second")
    )
    assert (np.diff(first) == 1).all()
    assert (np.diff(second) == 1).all()
    assert second[0] == first[-1] + 1
    assert not Recording(tmp_path / "second.mcap").cut
    (error,) = refused
    assert isinstance(error, InputError)
    assert "expected a new file" in str(error)


def wait_for(own: Counted, more: int) -> None:
    begun = own.samples
    while own.samples < begun + more:
        sleep(0.01)


def test_a_recording_has_the_calibration_in_use_while_its_file_is_away(tmp_path: Path) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    settings = Settings(
        port="sim://static?speed=20",
        profile="imu50-rs422",
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
    )
    service = Service(settings, lambda _: None)
    (tmp_path / "unit.yaml").unlink()
    request = service.record(tmp_path / "run.mcap")
    request.add_done_callback(lambda _: service.stop())
    service.run()
    assert request.exception() is None
    assert Recording(tmp_path / "run.mcap").calibration == NOMINAL


def test_a_request_that_the_end_overtakes_is_given_up(tmp_path: Path) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    settings = Settings(
        port=str(tmp_path / "nothing"),
        profile="imu50-rs422",
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
    )
    service = Service(settings, lambda _: None)
    service.stop()
    request = service.record(tmp_path / "late.mcap")
    service.run()
    assert request.cancelled()
    with pytest.raises(InputError, match="cannot read it"):
        Recording(tmp_path / "late.mcap")
