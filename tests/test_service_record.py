"""Recordings that another thread asks for while the service runs."""

import subprocess
import sys
from pathlib import Path
from threading import Thread
from time import sleep

import numpy as np
import pytest
from mcap.reader import make_reader
from realtime import DEADLINE_S, until

from imudrv.calibration import coefficients, write_calibration
from imudrv.chain import Chain
from imudrv.errors import InputError
from imudrv.recording.reader import Recording
from imudrv.records import Flag, Records
from imudrv.service.loop import Service
from imudrv.service.settings import Settings
from imudrv.sim.scenario import NOMINAL
from imudrv.sinks.base import Batch, Sink, SinkState
from imudrv.sinks.history import History


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


def replayed(recording: Recording) -> Records:
    """Increments that the wire of a recording gives."""
    chain = Chain(recording.profile, coefficients(NOMINAL), "causal")
    increments = [chain.feed(arrival.data, arrival.t_ns).increments for arrival in recording.arrivals()]
    return np.concatenate([*increments, chain.close().increments])


@pytest.mark.parametrize("keeps", [True, False])
def test_a_recording_starts_at_a_past_sample_of_the_history(tmp_path: Path, keeps: bool) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    settings = Settings(
        port="sim://rocking?speed=20",
        profile="imu50-rs422",
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
    )
    own = Counted()
    service = Service(settings, lambda _: None, [own], history=History() if keeps else None)

    def ask() -> None:
        wait_for(own, 3000)
        service.record(tmp_path / "past.mcap", since=1000).result(DEADLINE_S)
        wait_for(own, 1000)
        service.record(None).result(DEADLINE_S)
        service.stop()

    asking = Thread(target=ask)
    asking.start()
    service.run()
    asking.join(DEADLINE_S)
    recording = Recording(tmp_path / "past.mcap")
    published, again = np.concatenate(list(recording.increments())), replayed(recording)
    assert (np.diff(published["counter"]) == 1).all()
    assert published["counter"][-1] > 3500
    if not keeps:
        assert published["counter"][0] > 2500
        return
    assert published["counter"][0] <= 1000
    assert np.array_equal(again["counter"], published["counter"])
    whole = again["flags"] & Flag.SIZE_EFFECT != 0  # before the first of these rates are not known
    assert whole[5:].all()
    for name in ("interval_ns", "dtheta_b", "dv_b"):
        assert np.array_equal(again[name][whole], published[name][whole])


def test_a_recording_after_a_replacement_of_the_calibration_starts_with_the_new_one(tmp_path: Path) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    settings = Settings(
        port="sim://static?speed=20",
        profile="imu50-rs422",
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
    )
    own, said = Counted(), list[str]()
    service = Service(settings, said.append, [own], history=History())

    def ask() -> None:
        wait_for(own, 3000)
        write_calibration(tmp_path / "unit.yaml", NOMINAL.model_copy(update={"size_effect": None}))
        while not any("calibration replaced" in text for text in said):
            wait_for(own, 10)
        service.record(tmp_path / "past.mcap", since=1000).result(DEADLINE_S)
        wait_for(own, 1000)
        service.stop()

    asking = Thread(target=ask)
    asking.start()
    service.run()
    asking.join(DEADLINE_S)
    recording = Recording(tmp_path / "past.mcap")
    assert next(recording.increments())["counter"][0] > 3000
    assert recording.calibration is not None
    assert recording.calibration.size_effect is None


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


def test_a_request_that_the_end_overtakes_is_cancelled(tmp_path: Path) -> None:
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
    assert service.record(tmp_path / "later.mcap").cancelled()
    with pytest.raises(InputError, match="expected a file, there is none"):
        Recording(tmp_path / "late.mcap")


@pytest.mark.parametrize("happens", ["deleted", "renamed"])
def test_a_recording_that_is_deleted_or_renamed_is_a_failure_and_a_new_one_is_begun(
    tmp_path: Path, happens: str
) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    path = tmp_path / "run.mcap"
    settings = Settings(
        port="sim://static?speed=20",
        profile="imu50-rs422",
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
        record=str(path),
        sync_s=0.1,
    )
    own, warned = Counted(), list[str]()
    service = Service(settings, lambda _: None, [own], warn=warned.append)

    def act() -> None:
        wait_for(own, 500)
        if happens == "deleted":
            path.unlink()
        else:
            path.rename(tmp_path / "moved.mcap")
        until(lambda: service.status.recording and not service.status.recording.healthy, "the failure")
        until(path.exists, "the new recording")
        wait_for(own, own.samples + 500)
        service.stop()

    acting = Thread(target=act)
    acting.start()
    service.run()
    acting.join(DEADLINE_S)
    assert any(f"run.mcap was {happens} while it was written" in line for line in warned)
    assert service.status.health == "fail"
    counters = np.concatenate(list(Recording(path).increments()))["counter"]
    assert (np.diff(counters) == 1).all()
    assert counters[-1] == own.samples - 1
    if happens == "renamed":
        before = np.concatenate(list(Recording(tmp_path / "moved.mcap").increments()))["counter"]
        np.testing.assert_array_equal(np.concatenate([before, counters]), np.arange(own.samples))


def test_a_recording_continues_under_another_name_if_its_own_is_taken(tmp_path: Path) -> None:
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    path = tmp_path / "run.mcap"
    settings = Settings(
        port="sim://static?speed=20",
        profile="imu50-rs422",
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
        record=str(path),
    )
    own = Counted()
    service = Service(settings, lambda _: None, [own])

    def act() -> None:
        wait_for(own, 500)
        (tmp_path / "other").write_text("of another program")
        (tmp_path / "other").replace(path)
        until((tmp_path / "run-2.mcap").exists, "the new recording")
        wait_for(own, own.samples + 500)
        service.stop()

    acting = Thread(target=act)
    acting.start()
    service.run()
    acting.join(DEADLINE_S)
    assert path.read_text() == "of another program"
    counters = np.concatenate(list(Recording(tmp_path / "run-2.mcap").increments()))["counter"]
    assert counters[-1] == own.samples - 1


SHORT = """\
format: imu50-scenario
version: 1
seed: 5
site: {latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}
motion: [{rest: {duration_s: 1}}]
"""


def short_run(folder: Path, own: Counted, warn: list[str], **options: object) -> Path:
    """Record one second of a unit; return the recording."""
    write_calibration(folder / "unit.yaml", NOMINAL)
    (folder / "short.yaml").write_text(SHORT)
    settings = Settings(
        port=f"sim://{folder / 'short.yaml'}?speed=max",
        profile="imu50-rs422",
        calibration=str(folder / "unit.yaml"),
        status=str(folder / "socket"),
        record=str(folder / "run.mcap"),
        **options,
    )
    Service(settings, lambda _: None, [own], warn=warn.append).run()
    return folder / "run.mcap"


def is_indexed(path: Path) -> bool:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return bool(summary.chunk_indexes)


@pytest.mark.parametrize("packs", [True, False])
def test_a_run_ends_by_packing_its_recording_unless_it_shall_not(tmp_path: Path, packs: bool) -> None:
    path = short_run(tmp_path, Counted(), [], pack=packs)
    assert is_indexed(path) == packs
    assert sum(map(len, Recording(path).increments())) == 1000
    assert not Recording(path).cut


def test_a_recording_is_packed_when_the_outputs_are_closed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, closed = Counted(), list[bool]()
    monkeypatch.setattr("imudrv.service.loop.pack", lambda *_: closed.append(own.closed))
    short_run(tmp_path, own, [])
    assert closed == [True]


@pytest.mark.parametrize("error", [InputError("disk full"), KeyboardInterrupt()])
def test_a_recording_that_cannot_be_packed_stays_as_it_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def fail(*_: Path) -> None:
        raise error

    monkeypatch.setattr("imudrv.service.loop.pack", fail)
    warned: list[str] = []
    path = short_run(tmp_path, Counted(), warned)
    assert not Recording(path).cut
    assert len(warned) == 1
    assert "run.mcap: is complete, but" in warned[0]


SLOW = """
import time
from pathlib import Path
from imudrv.recording import pack, writer
def sleep(*_):
    print("packing", flush=True)
    time.sleep(600)
writer.ChunkedWriter.finish = sleep
pack.pack(Path("run.mcap"), Path("run.mcap"))
"""


def test_a_kill_while_it_is_packed_leaves_the_recording(tmp_path: Path) -> None:
    path = short_run(tmp_path, Counted(), [], pack=False)
    content = path.read_bytes()
    with subprocess.Popen([sys.executable, "-c", SLOW], cwd=tmp_path, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"packing\n"
        process.kill()
    assert path.read_bytes() == content
