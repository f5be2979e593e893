import os
import pty
import select
import tty
from pathlib import Path

import pytest

from imudrv.errors import InputError
from imudrv.sinks.backlog import LIMIT
from imudrv.sinks.serial import SerialSink
from imudrv.wire.datagram import SIZE, DatagramDecoder


class Line:
    """A pty: the sink writes to `path`, the test reads the other end."""

    def __init__(self) -> None:
        self.ours, self.theirs = pty.openpty()
        tty.setraw(self.theirs)
        self.path = os.ttyname(self.theirs)

    def read(self) -> bytes:
        ready = select.select([self.ours], [], [], 0)[0]
        return os.read(self.ours, 1 << 16) if ready else b""

    def close(self) -> None:
        os.close(self.theirs)
        os.close(self.ours)


def counters(data: bytes) -> list[int]:
    received = DatagramDecoder().feed(data)
    assert received.rejects.size == 0
    return received.increments["counter"].tolist()


def test_a_line_gets_every_sample_in_order(batch, wait_for) -> None:
    line = Line()
    sink = SerialSink(f"serial://{line.path}?baudrate=460800")
    wait_for(lambda: sink.poll() or sink.state.state == "ok")
    got = bytearray()
    for n in range(200):
        sink.publish(batch(n, 1))
        got += line.read()
    wait_for(lambda: sink.poll() or got.extend(line.read()) or len(got) == 200 * SIZE)
    assert counters(bytes(got)) == list(range(200))
    assert sink.state[1:] == ("ok", True, 200, 0, 0)
    sink.close()
    line.close()


def test_a_stuck_line_delays_nothing_else_and_loses_its_oldest_samples(batch, wait_for) -> None:
    line = Line()
    sink = SerialSink(f"serial://{line.path}")
    wait_for(lambda: sink.poll() or sink.state.state == "ok")
    samples = LIMIT + 2000  # a pty holds far less than 2000 of them
    for first in range(0, samples, 4):
        sink.publish(batch(first, 4))
    state = sink.state
    assert state.dropped > 0
    assert state.queued <= LIMIT + 1
    assert state.sent + state.dropped + state.queued == samples
    got = bytearray()
    wait_for(lambda: sink.poll() or got.extend(line.read()) or len(got) == (samples - state.dropped) * SIZE)
    numbers = counters(bytes(got))
    assert numbers == sorted(set(numbers))
    assert numbers[-LIMIT:] == list(range(samples - LIMIT, samples))
    sink.close()
    line.close()


def test_an_absent_or_unplugged_port_is_opened_once_it_exists(
    batch, wait_for, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr("imudrv.sinks.serial._RETRY_S", 0.0)
    name = tmp_path / "imu-out"
    sink = SerialSink(f"serial://{name}")
    wait_for(lambda: "there is no" in sink.state.state)
    assert not sink.state.healthy
    sink.publish(batch(0, 3))
    assert sink.state[3:] == (0, 3, 0)
    for round_ in range(2):
        line = Line()
        name.symlink_to(line.path)
        wait_for(lambda: sink.poll() or sink.state.state == "ok")
        sink.publish(batch(10 * round_, 1))
        got = bytearray()
        wait_for(lambda line=line, got=got: got.extend(line.read()) or len(got) == SIZE)
        assert counters(bytes(got)) == [10 * round_]
        name.unlink()
        line.close()
        wait_for(lambda: sink.publish(batch(7, 1)) or not sink.state.healthy)
        assert "lost" in sink.state.state or "there is no" in sink.state.state
    assert sink.state.sent == 2
    assert sink.state.queued == 0
    sink.close()


def test_closing_does_not_wait_for_a_stuck_line(batch, wait_for) -> None:
    line = Line()
    sink = SerialSink(f"serial://{line.path}")
    wait_for(lambda: sink.poll() or sink.state.state == "ok")
    sink.publish(batch(0, 2000))
    sink.close()
    assert sink.state.sent + sink.state.dropped == 2000
    assert sink.state.dropped > 0
    line.close()


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("serial://ttyUSB0", "three slashes"),
        ("serial:///dev/ttyUSB0?baudrate=fast", "baudrate: expected a whole number"),
        ("serial:///dev/ttyUSB0?speed=9600", "speed: unknown key"),
        ("serial:///dev/ttyUSB0?parity=E", "parity: expected 'none'"),
    ],
)
def test_invalid_settings_are_refused(url: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        SerialSink(url)
