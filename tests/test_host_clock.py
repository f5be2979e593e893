"""The host's clock is set, or the host sleeps, while the service runs: stamps follow, intervals do not."""

import os
import pty
import tty
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from samples import CERTIFICATE

from imudrv import compensate, profiles
from imudrv.calibration import coefficients, write_calibration
from imudrv.chain import Chain
from imudrv.errors import InputError
from imudrv.hostclock import Readings, now_ns, read_clocks
from imudrv.imu.clock import ClockModel
from imudrv.recording import format
from imudrv.recording.pack import pack
from imudrv.recording.reader import Recording
from imudrv.records import PULSES, Arrival, Flag, Records, Source, Timebase
from imudrv.service.clock_watch import STEP_NS, ClockWatch
from imudrv.service.loop import Service
from imudrv.service.settings import Settings
from imudrv.sim.scenario import NOMINAL
from imudrv.sinks.base import Batch, Sink, SinkState
from imudrv.sinks.recorder import Recorder
from imudrv.wire.encode import StreamEncoder

S = 1_000_000_000
MS = 1_000_000
HOUR = 3600 * S
BEGIN = 1_700_000_000 * S


class Host:
    """Clocks that a test moves: each its own, as those of a host."""

    def __init__(self) -> None:
        self.now_ns, self.real_ns, self.awake_ns = BEGIN, BEGIN, 5 * S
        self.spread_ns = 1000

    def read(self) -> Readings:
        return Readings(self.now_ns, self.real_ns, self.awake_ns, self.spread_ns)

    def run(self, seconds: float, slew: float = 0.0) -> None:
        """Let time pass on all clocks, which NTP may slew alike."""
        passed = round(seconds * S * (1.0 + slew))
        self.now_ns += passed
        self.real_ns += passed
        self.awake_ns += passed

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * S)
        self.real_ns += round(seconds * S)


@pytest.mark.parametrize("step_ns", [HOUR, -HOUR, -S, STEP_NS])
def test_a_clock_that_is_set_is_found_once_and_its_whole_step(step_ns: int) -> None:
    host = Host()
    watch = ClockWatch(host.read)
    host.run(10)
    assert watch.poll() == ""
    host.real_ns += step_ns
    host.run(0.001)
    assert watch.poll() == f"the host's clock was set by {step_ns / S:+.3f} s"
    assert watch.timebase == Timebase(step_ns, 0)
    host.run(10)
    assert watch.poll() == ""
    assert watch.timebase == Timebase(step_ns, 0)


def test_a_sleep_is_found_and_leaves_unix_time_as_it_is() -> None:
    host = Host()
    watch = ClockWatch(host.read)
    host.run(10)
    host.sleep(12)
    assert watch.poll() == "the host slept for 12.000 s"
    assert watch.timebase == Timebase(0, 12 * S)
    host.run(10)
    assert watch.poll() == ""


def test_a_clock_that_is_set_after_a_sleep_is_reported_with_it_and_both_add_up_with_later_ones() -> None:
    host = Host()
    watch = ClockWatch(host.read)
    host.sleep(12)
    host.real_ns -= 2 * S
    assert watch.poll() == "the host slept for 12.000 s; the host's clock was set by -2.000 s"
    host.sleep(1)
    host.real_ns += 5 * S
    assert watch.poll() == "the host slept for 1.000 s; the host's clock was set by +5.000 s"
    assert watch.timebase == Timebase(3 * S, 13 * S)


@pytest.mark.parametrize("slew", [500e-6, -500e-6, 0.083])
def test_a_slew_is_no_step_because_all_clocks_follow_it(slew: float) -> None:
    host = Host()  # 500 ppm is what the kernel allows NTP, 8.3 % is what chrony takes by default
    watch = ClockWatch(host.read)
    for _ in range(3600):
        host.run(1, slew)
        assert watch.poll() == ""


def test_a_difference_that_creeps_is_followed_before_it_is_larger_than_the_smallest_step() -> None:
    host = Host()
    watch = ClockWatch(host.read)
    found = []
    for _ in range(1000):
        host.run(1)
        host.real_ns += 500_000  # 500 ppm, on a system whose monotonic clock is not slewed
        found.append(watch.poll() != "")
        assert abs(host.real_ns - host.now_ns - watch.timebase.offset_ns) < STEP_NS
    assert sum(found) == 1000 * 500_000 // STEP_NS


def test_a_reading_that_was_interrupted_says_nothing() -> None:
    host = Host()
    watch = ClockWatch(host.read)
    host.real_ns += 50 * MS  # 50 ms between the reading of one clock and the next
    host.spread_ns = 50 * MS
    assert watch.poll() == ""
    host.real_ns -= 50 * MS
    host.spread_ns = 1000
    assert watch.poll() == ""
    assert watch.timebase == Timebase()


def test_the_clocks_of_this_host_agree() -> None:
    readings = min((read_clocks() for _ in range(100)), key=lambda readings: readings.spread_ns)
    assert readings.spread_ns < MS
    # The quickest of some comparisons at the start, and one of a hundred now: far less than a millisecond,
    # unless this host's clock was set in between.
    assert abs(readings.real_ns - readings.now_ns) < MS
    assert now_ns() >= readings.now_ns


class Collected(Sink):
    """A sink that keeps the increments, and lets a test act after some of them."""

    def __init__(self, host: Host, act: Callable[[int], None]) -> None:
        super().__init__("own")
        self.pieces: list[Records] = []
        self._host, self._act = host, act
        self.samples = 0

    def publish(self, batch: Batch) -> None:
        self.pieces.append(batch.increments)
        if len(batch.pulses):
            passed = int(batch.pulses["arrival_ns"][-1]) - self._host.now_ns
            self._host.run(passed / S)
        self.samples += len(batch.pulses)
        self._act(self.samples)

    @property
    def state(self) -> SinkState:
        return SinkState(self.url, "ok", True, 0, 0, 0)

    def close(self) -> None:
        pass


def service_settings(folder: Path, port: str, profile: str, **others: str) -> Settings:
    write_calibration(folder / "unit.yaml", NOMINAL)
    return Settings(
        port=port,
        profile=profile,
        calibration=str(folder / "unit.yaml"),
        status=str(folder / "socket"),
        rate_filter="dither",  # its increments come 8 samples late
        **others,
    )


def run(service: Service) -> None:
    try:
        while service.step():
            pass
    finally:
        service.close()


def scenario(folder: Path) -> str:
    """25 s at rest: the clock locks, and again after a sleep."""
    text = (Path(profiles.__file__).parents[1] / "sim" / "scenarios" / "static.yaml").read_text()
    (folder / "short.yaml").write_text(text.replace("duration_s: 3600", "duration_s: 25"))
    return f"sim://{folder / 'short.yaml'}?speed=max"


@pytest.mark.parametrize("profile", ["imu50-rs422", "imu50-rs422-acc", "imu50-can"])
@pytest.mark.parametrize("step_ns", [HOUR, -HOUR])
def test_stamps_follow_a_step_and_a_replay_and_the_offline_command_give_the_same_bits(
    tmp_path: Path, profile: str, step_ns: int
) -> None:
    host, said = Host(), list[str]()
    steps = [15_000, 18_000]

    def act(samples: int) -> None:
        if steps and samples >= steps[0]:
            steps.pop(0)
            host.real_ns += step_ns

    sink = Collected(host, act)
    own = service_settings(tmp_path, scenario(tmp_path), profile, record=str(tmp_path / "run.mcap"))
    service = Service(own, said.append, [sink], clock_watch=ClockWatch(host.read))
    run(service)
    live = np.concatenate(sink.pieces)
    assert len(live) > 24_900

    first, second = np.flatnonzero(live["flags"] & Flag.CLOCK_STEPPED)
    assert 15_000 <= first < second
    assert (live["interval_ns"] == MS).all()
    advance = np.diff(live["t_ns"]) - MS
    # A sample to the next: the slew of the clock model, 200 ppm of 1 ms, and 1 ns of rounding.
    assert np.abs(np.delete(advance, [first - 1, second - 1])[11_000:]).max() <= 201
    assert np.abs(advance[[first - 1, second - 1]] - step_ns).max() <= 201
    assert (live["flags"][11_000:] & Flag.CLOCK_UNLOCKED == 0).all()
    words = f"the host's clock was set by {step_ns / S:+.3f} s"
    assert sum(words in line for line in said) == 2
    assert sum(words in line for line in service.status.events) == 2
    assert service.status.clock.steps == 2

    published = np.concatenate(list(Recording(tmp_path / "run.mcap").increments()))
    pack(tmp_path / "run.mcap", tmp_path / "packed.mcap")
    again = Collected(Host(), lambda _: None)
    run(
        Service(
            service_settings(tmp_path, f"replay://{tmp_path / 'run.mcap'}?speed=max", profile),
            lambda _: None,
            [again],
            clock_watch=ClockWatch(Host().read),
        )
    )
    np.testing.assert_array_equal(np.concatenate(again.pieces), live)
    for name in ("run.mcap", "packed.mcap"):
        np.testing.assert_array_equal(compensate(tmp_path / name, rate_filter="dither"), live)
    np.testing.assert_array_equal(published, live)


def test_events_and_status_have_the_time_of_the_clock_that_was_set(tmp_path: Path) -> None:
    host, said = Host(), list[str]()
    sink = Collected(host, lambda _: None)
    own = service_settings(tmp_path, scenario(tmp_path), "imu50-rs422")
    service = Service(own, said.append, [sink], clock=lambda: host.now_ns, clock_watch=ClockWatch(host.read))
    try:
        service.step()
        host.real_ns += HOUR
        service.step()
    finally:
        service.close()
    before, after = (np.datetime64(line.split()[0].rstrip("Z"), "ms") for line in (said[0], said[-1]))
    assert "set by +3600.000 s" in said[0]
    assert after >= before >= np.datetime64((BEGIN + HOUR) // MS, "ms")
    assert service.status.t_ns == host.now_ns + HOUR


def frames(first: int, count: int) -> bytes:
    samples = np.zeros(count, PULSES)
    samples["counter"] = first + np.arange(count)
    return StreamEncoder(profiles.load("imu50-rs422").layout()).encode(samples).tobytes()


def test_a_sleep_of_12_s_is_a_gap_of_12_000_samples_and_the_stamps_are_right_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = Host()
    monkeypatch.setattr("imudrv.ports.serial.now_ns", lambda: host.now_ns)
    master, slave = pty.openpty()
    tty.setraw(slave)
    said: list[str] = []
    sink = Collected(Host(), lambda _: None)
    own = service_settings(tmp_path, os.ttyname(slave), "imu50-rs422", record=str(tmp_path / "run.mcap"))
    service = Service(own, said.append, [sink], clock=lambda: host.now_ns, clock_watch=ClockWatch(host.read))

    def play(first: int, count: int) -> None:
        for k in range(first, first + count, 50):
            host.run(0.050)
            os.write(master, frames(k, 50))
            received = sink.samples + 50
            for _ in range(1000):  # one read, or more if the system cuts the bytes
                if sink.samples < received:
                    service.step()

    try:
        play(0, 500)
        host.sleep(12.0)
        play(12_500, 11_000)
        service.step()
    finally:
        service.close()
        os.close(slave)
        os.close(master)
    live = np.concatenate(sink.pieces)
    assert live["counter"].tolist() == [*range(500), *range(12_500, 23_500)]
    assert np.flatnonzero(live["flags"] & Flag.MISSING_BEFORE).tolist() == [500]
    assert np.flatnonzero(live["flags"] & Flag.CLOCK_STEPPED).tolist() == [500]
    assert (live["interval_ns"] == MS).all()
    assert service.status.samples.lost == 12_000
    assert service.status.clock.steps == 1
    assert any("the host slept for 12.000 s" in line for line in said)
    # All 50 samples of a read arrive with the newest, which is of that moment less its time on the wire. The
    # first read after the sleep shows that only with its last sample.
    true = BEGIN + MS * (live["counter"] + 1) - profiles.load("imu50-rs422").transmission_ns
    assert np.abs(live["t_ns"] - true)[550:].max() <= MS // 2
    assert np.abs(live["t_ns"] - true)[600:].max() <= 1
    assert (live["flags"][10_500:10_700] & Flag.CLOCK_UNLOCKED == 0).any()
    np.testing.assert_array_equal(compensate(tmp_path / "run.mcap", rate_filter="dither"), live)


def recorder(path: Path) -> Recorder:
    return Recorder(
        path,
        layout=profiles.load("imu50-rs422").layout(),
        profile=profiles.content("imu50-rs422"),
        calibration=CERTIFICATE.encode(),
        source=Source.HARDWARE,
        port="/dev/ttyUSB0",
        unit="50-0017",
    )


def test_a_recording_keeps_the_timebase_of_each_read(tmp_path: Path) -> None:
    bases = [
        Timebase(),
        Timebase(),
        Timebase(HOUR),
        Timebase(HOUR),
        Timebase(HOUR, 12 * S),
        Timebase(0, 12 * S),
    ]
    arrivals = [Arrival(BEGIN + k, frames(k, 1), base) for k, base in enumerate(bases)]
    kept = recorder(tmp_path / "run.mcap")
    for arrival in arrivals:
        kept.arrived(arrival.block)
    kept.close()
    assert list(Recording(tmp_path / "run.mcap").arrivals()) == arrivals
    pack(tmp_path / "run.mcap", tmp_path / "packed.mcap")
    assert list(Recording(tmp_path / "packed.mcap").arrivals()) == arrivals


@given(
    cuts=st.lists(st.integers(0, 44 * 700), max_size=20),
    bases=st.lists(st.sampled_from([Timebase(), Timebase(HOUR), Timebase(-HOUR, 12 * S)]), min_size=1),
    flips=st.lists(st.integers(0, 44 * 700 - 1), max_size=5),
)
@settings(deadline=None, max_examples=25)
def test_live_and_offline_agree_wherever_the_steps_and_the_reads_fall(
    cuts: list[int], bases: list[Timebase], flips: list[int]
) -> None:
    wire = bytearray(frames(0, 400) + frames(900, 300))  # the first frame after the jump waits for the next
    for at in flips:
        wire[at] ^= 0x10
    edges = [0, *sorted(cuts), 44 * 400, 44 * 401, len(wire)]
    reads = [bytes(wire[a:b]) for a, b in pairwise(sorted(edges)) if a < b]
    arrivals = [Arrival(BEGIN + k * MS, data, bases[k % len(bases)]) for k, data in enumerate(reads)]
    chain = Chain(profiles.load("imu50-rs422"), coefficients(NOMINAL), "dither")
    live = []
    with TemporaryDirectory() as folder:
        kept = recorder(Path(folder) / "run.mcap")
        for arrival in arrivals:
            kept.arrived(arrival.block)
            chain.clock.follow(arrival.timebase)
            live.append(chain.feed(arrival.data, arrival.t_ns).increments)
        live.append(chain.close().increments)
        kept.close()
        offline = compensate(Path(folder) / "run.mcap", NOMINAL, rate_filter="dither")
    np.testing.assert_array_equal(offline, np.concatenate(live))


def wire_only(path: Path, clock: bytes | None) -> None:
    """A recording as earlier versions made it, without a channel for the clock, or with a message in it."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_attachment(0, 0, format.PROFILE, "", profiles.content("imu50-rs422"))
        wire = writer.register_channel(format.WIRE, format.BYTES, 0)
        if clock is not None:
            writer.add_message(writer.register_channel(format.CLOCK, "json", 0), BEGIN, clock, BEGIN)
        writer.add_message(wire, BEGIN, b"x", BEGIN)
        writer.finish()  # type: ignore[no-untyped-call]


def test_a_recording_of_an_earlier_version_is_read_with_the_times_that_it_has(tmp_path: Path) -> None:
    wire_only(tmp_path / "old.mcap", None)
    assert list(Recording(tmp_path / "old.mcap").arrivals()) == [Arrival(BEGIN, b"x", Timebase())]


@pytest.mark.parametrize(
    "clock",
    [
        b"{}",
        b"[]",
        b'{"offset_ns": 1}',
        b'{"offset_ns": 1, "slept_ns": 1.5}',
        b'{"offset_ns": true, "slept_ns": 0}',
        b'{"offset_ns": 9223372036854775808, "slept_ns": 0}',
    ],
)
def test_a_recording_with_an_impossible_timebase_is_refused(tmp_path: Path, clock: bytes) -> None:
    wire_only(tmp_path / "bad.mcap", clock)
    with pytest.raises(InputError, match=r"bad\.mcap: at byte \d+: expected .*; the file is damaged"):
        list(Recording(tmp_path / "bad.mcap").arrivals())


def test_a_timebase_at_the_limit_of_a_recording_does_no_harm() -> None:
    pulses = np.zeros(3, PULSES)
    pulses["counter"] = [1, 2, 3]
    pulses["elapsed_ns"] = pulses["counter"] * MS
    pulses["arrival_ns"] = BEGIN + pulses["elapsed_ns"]
    clock = ClockModel(MS)
    clock.follow(Timebase(2**62, 2**62))
    np.testing.assert_array_equal(clock.feed(pulses)["t_ns"], pulses["arrival_ns"] + 2**62)
