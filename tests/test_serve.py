"""The kernel that serves a port with a descriptor: its samples, outlets and reasons to return."""

import os
import pty
import signal
import socket
import struct
import threading
import time
import tty
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import can
import numpy as np
import pytest
from realtime import DEADLINE_S, until

from imudrv import compensate, system
from imudrv.calibration import coefficients, write_calibration
from imudrv.chain import Chain
from imudrv.hostclock import now_ns
from imudrv.ports.base import OTHER_END_GONE
from imudrv.ports.socketcan import BUS_OFF
from imudrv.profiles import load
from imudrv.profiles.schema import Profile
from imudrv.recording.reader import Recording
from imudrv.records import PULSES, Flag, Records, Timebase
from imudrv.service.clock_watch import ClockWatch
from imudrv.service.latency import Latency
from imudrv.service.loop import Service
from imudrv.service.serve import AT_ONCE, DescriptorLoop, Served, Why
from imudrv.service.settings import Settings
from imudrv.sim.scenario import NOMINAL
from imudrv.sinks.backlog import Backlog
from imudrv.sinks.base import HOUSEKEEPING_NS, Batch, Outlet, Sink, SinkState
from imudrv.units import NS_PER_S
from imudrv.wire.datagram import SIZE
from imudrv.wire.encode import CanEncoder, StreamEncoder

pytestmark = pytest.mark.skipif(not system.IS_AVAILABLE, reason="needs Linux")

PROFILE = load("imu50-rs422")
LENGTH = PROFILE.layout().messages[0].length


CAN_PROFILE = load("imu50-canfd")
CAN_FRAME = struct.Struct("=IBBxx64s")
CLASSIC_BYTES = 16


def frames(first: int, count: int) -> bytes:
    samples = np.zeros(count, PULSES)
    samples["counter"] = first + np.arange(count)
    samples["gyro"] = np.rint(100.0 * np.sin(samples["counter"] / 50.0))[:, None]
    samples["accelerometer"] = [0, 0, 20]
    return StreamEncoder(PROFILE.layout()).encode(samples).tobytes()


def can_frames(first: int, count: int) -> list[bytes]:
    samples = np.zeros(count, PULSES)
    samples["counter"] = first + np.arange(count)
    samples["gyro"] = np.rint(100.0 * np.sin(samples["counter"] / 50.0))[:, None]
    messages = CanEncoder(CAN_PROFILE.layout()).encode(samples)
    return [CAN_FRAME.pack(m["id"], m["length"], 4, bytes(m["data"])) for m in messages]


def assert_same(one: Records | bytes, other: Records | bytes) -> None:
    if isinstance(one, bytes) or isinstance(other, bytes):
        assert one == other
        return
    for name in one.dtype.names or ():
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


class Line:
    """A kernel at one end of a socket pair whose packets keep their boundaries."""

    def __init__(self, profile: Profile = PROFILE) -> None:
        self.chain = Chain(profile, coefficients(NOMINAL), "dither")
        self.latency = Latency(NS_PER_S)
        self.clocks = ClockWatch()
        self.loop = DescriptorLoop(self.chain, self.latency)
        self.unit, self.port = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.port.setblocking(False)

    def run(self, *outlets: Outlet, seconds: float = DEADLINE_S, is_impatient: bool = False) -> Served:
        stop = now_ns() + int(seconds * NS_PER_S)
        return self.loop.run(self.port.fileno(), stop, self.clocks, outlets, is_impatient)

    def next_read(self, *outlets: Outlet) -> Served:
        """Serve until something was read."""
        served = self.run(*outlets, seconds=0.02, is_impatient=True)
        while not len(served.reads):
            served = self.run(*outlets, seconds=0.02, is_impatient=True)
        return served

    def close(self) -> None:
        self.unit.close()
        self.port.close()
        self.loop.close()


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    line.close()


def test_any_reads_give_the_bits_of_the_chain_fed_by_python(line: Line) -> None:
    wire = bytearray(frames(0, 600) + frames(640, 300))
    random = np.random.default_rng(5)
    for at in random.integers(0, len(wire), 12):
        wire[at] ^= 0x20
    cuts = [0, *np.sort(random.integers(0, len(wire), 80)).tolist(), len(wire)]
    python = Chain(PROFILE, coefficients(NOMINAL), "dither")
    for begin, stop in pairwise(cuts):
        if begin == stop:
            continue
        line.unit.send(wire[begin:stop])
        served = line.next_read()
        (read,) = served.reads
        assert served.data == bytes(wire[begin:stop])
        for mine, its in zip(served.output, python.feed(served.data, int(read["t_ns"])), strict=True):
            assert_same(mine, its)
    assert line.chain.tracker.counts == python.tracker.counts
    assert line.chain.tracker.counts.lost > 40
    assert line.chain.decoder.rejected == python.decoder.rejected
    assert line.chain.decoder.rejected


def test_each_read_keeps_its_time_its_bytes_and_its_samples(line: Line) -> None:
    pieces = [frames(0, 3), frames(3, 2)[:50], frames(3, 2)[50:], frames(5, 4)]
    assert line.run(seconds=0.0).why is Why.HOUSEKEEPING
    for piece in pieces:
        line.unit.send(piece)
    served = line.run(seconds=1.0)
    assert served.why is Why.HOUSEKEEPING
    arrivals = list(served.arrivals(Timebase(7)))
    assert [arrival.data for arrival, _ in arrivals] == pieces
    assert [len(batch.pulses) for _, batch in arrivals] == [3, 1, 1, 4]
    assert all(arrival.timebase == Timebase(7) for arrival, _ in arrivals)
    assert b"".join(batch.datagrams for _, batch in arrivals) == served.output.datagrams
    times = [arrival.t_ns for arrival, _ in arrivals]
    assert times == sorted(times)
    assert abs(times[-1] - now_ns()) < DEADLINE_S * NS_PER_S
    assert line.latency.report.max_s > 0.0


def test_damage_and_impatience_and_the_end_of_the_line_return_to_python(line: Line) -> None:
    line.unit.send(frames(0, 2))
    assert line.run(is_impatient=True).why is Why.SAMPLES
    line.unit.send(b"noise" + frames(2, 1))
    assert line.run().why is Why.REJECTED
    assert sum(entry.length for entry in line.chain.decoder.rejected.values()) == 5
    line.unit.close()
    served = line.run()
    assert served.why is Why.GONE
    assert not len(served.reads)


def test_an_unplugged_pty_returns_to_python() -> None:
    line = Line()
    master, slave = pty.openpty()
    tty.setraw(slave)
    os.set_blocking(slave, False)
    os.write(master, frames(0, 5))
    line.port.close()
    stop = now_ns() + int(DEADLINE_S * NS_PER_S)
    assert len(line.loop.run(slave, stop, line.clocks, [], True).output.pulses) == 5
    os.close(master)
    assert line.loop.run(slave, stop, line.clocks, [], True).why is Why.GONE
    os.close(slave)
    line.close()


def test_a_signal_returns_to_python_and_its_handler_runs(line: Line) -> None:
    came: list[int] = []
    before = signal.signal(signal.SIGALRM, lambda number, _: came.append(number))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05, 0.05)
        while not came:
            assert line.run().why is Why.SIGNAL
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_a_clock_that_was_set_or_a_sleep_returns_before_the_bytes_are_read(line: Line) -> None:
    line.unit.send(frames(0, 2))
    known = line.clocks.timebase
    for timebase in (Timebase(3600 * NS_PER_S), Timebase(0, 12 * NS_PER_S)):
        line.clocks.timebase = timebase
        served = line.run()
        assert served.why is Why.CLOCKS
        assert not len(served.reads)
    line.clocks.timebase = known
    assert len(line.run(is_impatient=True).output.pulses) == 2


def test_full_buffers_return_and_nothing_is_lost(line: Line) -> None:
    count = 10_000  # more reads than the buffers hold

    def send() -> None:
        for k in range(count):
            line.unit.send(frames_of_all[k * LENGTH : (k + 1) * LENGTH])

    frames_of_all = frames(0, count)
    sender = threading.Thread(target=send)
    sender.start()
    counters, reasons = [], set()
    while line.chain.tracker.counts.good < count:
        served = line.run(seconds=5.0)
        reasons.add(served.why)
        counters += served.output.pulses["counter"].tolist()
    sender.join()
    assert counters == list(range(count))
    assert Why.FULL in reasons


def test_a_read_as_large_as_the_buffer_is_taken_whole(line: Line) -> None:
    line.close()
    stream, line.port = socket.socketpair()
    line.port.setblocking(False)
    count = AT_ONCE // LENGTH + 200
    sender = threading.Thread(target=stream.sendall, args=[frames(0, count)])
    sender.start()
    got = 0
    while got < count:
        got += len(line.run(is_impatient=True).output.pulses)
    sender.join()
    stream.close()
    assert line.chain.tracker.counts.lost == 0


@pytest.mark.parametrize("kind", ["socket", "pipe"])
def test_an_outlet_that_blocks_gets_the_rest_from_its_queue_to_the_byte(line: Line, kind: str) -> None:
    if kind == "socket":
        outlet, inlet = socket.socketpair()
        outlet.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        outlet.setblocking(False)
        write_end, read_end = outlet.detach(), inlet.detach()
    else:
        read_end, write_end = os.pipe()
        os.set_blocking(write_end, False)
    other, good = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    backlog, expected, taken, reasons = Backlog(64), b"", b"", []
    for first in range(0, 2000, 100):
        line.unit.send(frames(first, 100))
        blocked = Outlet(write_end, 256 * SIZE, is_socket=kind == "socket")
        outlets = (blocked,) if not backlog.queued else ()
        served = line.next_read(Outlet(other.fileno(), 18 * SIZE), *outlets)
        reasons.append(served.why)
        expected += served.output.datagrams
        if outlets:
            backlog.written(served.output.datagrams, served.written[1].size)
        else:
            backlog.put(served.output.datagrams, lambda data: os.write(write_end, data))
        assert served.written[0].size == len(served.output.datagrams)
        passed = 0
        while passed < len(served.output.datagrams):
            passed += len(good.recv(1 << 16))
    assert Why.OUTLET in reasons
    os.set_blocking(read_end, False)
    while len(taken) < len(expected):
        try:
            taken += os.read(read_end, 1 << 16)
        except BlockingIOError:
            backlog.flush(lambda data: os.write(write_end, data))
    assert taken == expected
    assert (backlog.sent, backlog.dropped, backlog.queued) == (len(expected) // SIZE, 0, 0)
    for descriptor in (read_end, write_end):
        os.close(descriptor)
    other.close()
    good.close()


def test_another_thread_ends_the_wait(line: Line) -> None:
    timer = threading.Timer(0.05, line.loop.pipe.wake)
    timer.start()
    assert line.run(seconds=DEADLINE_S).why is Why.WOKEN
    timer.join()
    assert line.run(seconds=0.01).why is Why.HOUSEKEEPING  # it waits anew


@pytest.fixture
def bus() -> Iterator[Line]:
    bus = Line(CAN_PROFILE)
    yield bus
    bus.close()


def test_messages_of_a_can_socket_give_the_bits_of_the_chain_fed_by_python(bus: Line) -> None:
    python = Chain(CAN_PROFILE, coefficients(NOMINAL), "dither")
    sent = can_frames(0, 300) + can_frames(310, 200)
    del sent[17::97]  # lost on the bus
    random, at = np.random.default_rng(3), 0
    while at < len(sent):
        stop = at + int(random.integers(1, 60))
        for frame in sent[at:stop]:
            bus.unit.send(frame)
        served = bus.next_read()
        assert isinstance(served.data, np.ndarray)
        assert len(served.data) == len(sent[at:stop])
        for mine, its in zip(served.output, python.feed(served.data, 0), strict=True):
            assert_same(mine, its)
        at = stop
    assert bus.chain.tracker.counts == python.tracker.counts
    assert bus.chain.tracker.counts.lost > 10
    assert bus.chain.decoder.rejected == python.decoder.rejected


def test_messages_of_a_socket_are_read_as_the_driver_defines_them(bus: Line) -> None:
    remote, error, extended = 1 << 30, 1 << 29, 1 << 31
    before = now_ns()
    bus.unit.send(CAN_FRAME.pack(0x150, 3, 0, b"abc")[:CLASSIC_BYTES])
    bus.unit.send(CAN_FRAME.pack(0x151 | remote, 0, 0, b"")[:CLASSIC_BYTES])
    bus.unit.send(CAN_FRAME.pack(error | 4, 8, 0, b"")[:CLASSIC_BYTES])
    bus.unit.send(b"no frame")
    bus.unit.send(CAN_FRAME.pack(0x18000150 | extended, 64, 4, bytes(range(64))))
    bus.unit.send(CAN_FRAME.pack(0x152, 255, 0, b"12345678")[:CLASSIC_BYTES])  # no driver sends such a length
    (messages,) = [bus.run(seconds=0.05).data]
    assert isinstance(messages, np.ndarray)
    assert messages["id"].tolist() == [0x150, 0x18000150 | extended, 0x152]
    assert messages["length"].tolist() == [3, 64, 8]
    assert messages["fd"].tolist() == [0, 1, 0]
    assert [bytes(m["data"][:4]) for m in messages] == [b"abc\0", bytes(range(4)), b"1234"]
    assert np.all(np.diff([before, *messages["t_ns"], now_ns()]) >= 0)


def test_the_end_of_a_can_bus_comes_after_its_last_messages(bus: Line) -> None:
    frames = can_frames(0, 2)
    for frame in frames:
        bus.unit.send(frame)
    bus.unit.send(CAN_FRAME.pack((1 << 29) | 0x40, 8, 0, b"")[:CLASSIC_BYTES])
    served = bus.run()
    assert (served.why, served.error, len(served.data)) == (Why.GONE, BUS_OFF, len(frames))
    bus.unit.close()
    served = bus.run()
    assert (served.why, served.error, len(served.data)) == (Why.GONE, OTHER_END_GONE, 0)


class Collected(Sink):
    """Keeps increments."""

    patience_ns = HOUSEKEEPING_NS

    def __init__(self) -> None:
        super().__init__("own")
        self.pieces: list[Records] = []
        self.samples = 0

    def publish(self, batch: Batch) -> None:
        self.pieces.append(batch.increments)
        self.samples += len(batch.increments)

    @property
    def state(self) -> SinkState:
        return SinkState(self.url, "ok", True, self.samples, 0, 0)

    def close(self) -> None:
        pass


class PairBus(can.BusABC):
    """SocketCAN bus as python-can opens it, whose socket is one end of a pair: there may be no CAN here."""

    def __init__(self, *_: object, **__: object) -> None:
        self.unit, self.socket = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        super().__init__("can0")
        opened.append(self)

    def fileno(self) -> int:
        return self.socket.fileno()

    def send(self, *_: object, **__: object) -> None:
        raise NotImplementedError

    def shutdown(self) -> None:
        super().shutdown()
        self.unit.close()
        self.socket.close()


opened: list[PairBus] = []
"""Buses of the running test."""


@pytest.mark.parametrize("is_direct", [True, False])
def test_a_can_bus_is_served_and_opened_again_after_bus_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_direct: bool
) -> None:
    monkeypatch.setattr(can, "Bus", PairBus)
    opened.clear()
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    settings = Settings(
        port="can://socketcan/can0",
        profile=CAN_PROFILE.name,
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
        record=str(tmp_path / "record.mcap"),
    )
    own, said = Collected(), list[str]()
    # With a watch of its own, the service reads the port by Python.
    service = Service(settings, said.append, [own], clock_watch=None if is_direct else ClockWatch())

    def act() -> None:
        until(lambda: len(opened) == 1, "the bus")
        for frame in can_frames(0, 500):
            opened[0].unit.send(frame)
        until(lambda: own.samples >= 498, "its samples")
        opened[0].unit.send(CAN_FRAME.pack((1 << 29) | 0x40, 8, 0, b"")[:CLASSIC_BYTES])
        until(lambda: len(opened) == 2, "the bus opened again")
        for frame in can_frames(600, 100):
            opened[1].unit.send(frame)
        until(lambda: own.samples >= 598, "samples after it")
        service.stop()

    worker = threading.Thread(target=act)
    worker.start()
    service.run()
    worker.join(DEADLINE_S)
    counts = service.status.samples
    assert (counts.good, counts.lost) == (600, 100)
    assert any("the controller is bus-off" in line for line in said)
    live = np.concatenate(own.pieces)
    assert live["counter"].tolist() == [*range(500), *range(600, 700)]
    recorded = np.concatenate(list(Recording(tmp_path / "record.mcap").increments()))
    np.testing.assert_array_equal(recorded, live)


@pytest.mark.parametrize("is_direct", [True, False])
def test_calibrations_and_recordings_are_exchanged_under_load_and_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_direct: bool
) -> None:
    monkeypatch.setattr(system, "IS_AVAILABLE", is_direct)
    write_calibration(tmp_path / "unit.yaml", NOMINAL)
    master, slave = pty.openpty()
    tty.setraw(slave)
    settings = Settings(
        port=os.ttyname(slave),
        profile=PROFILE.name,
        calibration=str(tmp_path / "unit.yaml"),
        status=str(tmp_path / "socket"),
        rate_filter="dither",
    )
    own, said = Collected(), list[str]()
    service = Service(settings, said.append, [own], in_real_time=False)  # a busy machine plays at any rate
    count, is_over = 0, threading.Event()

    def play() -> None:
        nonlocal count
        until(lambda: any("serving" in line for line in said), "the start")
        while not is_over.is_set():
            os.write(master, frames(count, 1))
            count += 1
            time.sleep(0.0005)

    def act() -> None:
        until(lambda: own.samples > 200, "samples")
        service.record(tmp_path / "first.mcap").result(DEADLINE_S)
        for k in range(1, 4):
            gyro = NOMINAL.gyro.model_copy(update={"scale_arcsec_per_pulse": (k, k, k)})
            write_calibration(tmp_path / "unit.yaml", NOMINAL.model_copy(update={"gyro": gyro}))
            until(lambda k=k: sum("replaced" in line for line in said) == k, "the calibration")
            before = own.samples
            until(lambda before=before: own.samples > before + 200, "more samples")
        service.record(tmp_path / "second.mcap").result(DEADLINE_S)
        before = own.samples
        until(lambda: own.samples > before + 200, "more samples")
        is_over.set()
        player.join()
        until(lambda: service.status.samples.good == count, "all samples")
        service.stop()

    player, worker = threading.Thread(target=play), threading.Thread(target=act)
    player.start()
    worker.start()
    service.run()
    worker.join(DEADLINE_S)
    os.close(master)
    os.close(slave)
    live = np.concatenate(own.pieces)
    assert live["counter"].tolist() == list(range(count))
    assert np.all(live["flags"] & Flag.VALID)
    recordings = [Recording(tmp_path / f"{name}.mcap") for name in ("first", "second")]
    first, second = (np.concatenate(list(recording.increments())) for recording in recordings)
    np.testing.assert_array_equal(np.concatenate([first, second]), live[first["counter"][0] :])
    # The second recording has one calibration, and by it alone its wire gives its increments again.
    again = compensate(tmp_path / "second.mcap", rate_filter="dither")
    same = again[np.isin(again["counter"], second["counter"])][20:]
    np.testing.assert_array_equal(same["dv_b"], second["dv_b"][second["counter"] >= same["counter"][0]])
