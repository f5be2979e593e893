import errno
import os
from pathlib import Path

import numpy as np
import pytest

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.sinks import file, open_sink
from imudrv.sinks.file import FileSink
from imudrv.wire.datagram import SIZE


def test_datagrams_are_in_the_file_while_it_grows(batch, wait_for, tmp_path: Path) -> None:
    path = tmp_path / "out.i50n"
    sink = FileSink(f"file:{path}")
    for n in range(3):
        sink.publish(batch(n * 700, 700))
        wait_for(lambda size=(n + 1) * 700 * SIZE: path.stat().st_size == size)
    wait_for(lambda: sink.state[1:] == ("ok", True, 2100, 0, 0))
    sink.close()
    assert path.read_bytes() == batch(0, 2100).datagrams


def test_rows_of_text_read_back_to_the_same_numbers(batch, tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    sink = FileSink(f"file:{path}")
    sent = batch(0, 1000)
    sink.publish(sent)
    sink.publish(batch(1000, 1))
    sink.close()
    assert sink.state.sent == 1001
    rows = np.genfromtxt(path, delimiter=",", names=True)
    assert rows.dtype.names[:3] == ("counter", "interval_ns", "t_ns")
    assert rows["counter"].tolist() == list(range(1001))
    assert np.array_equal(rows["dtheta_x"][:1000], sent.increments["dtheta_b"][:, 0])
    assert np.array_equal(rows["dv_z"][:1000], sent.increments["dv_b"][:, 2])


def test_a_full_disk_is_reported_and_loses_the_oldest_samples_until_there_is_room(
    batch, wait_for, tmp_path: Path, monkeypatch
) -> None:
    room = 10_000
    write = os.write

    def full(descriptor: int, data: memoryview) -> int:
        """Takes a part of what does not fit, as disks do."""
        nonlocal room
        if room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = write(descriptor, data[:room])
        room -= written
        return written

    monkeypatch.setattr(os, "write", full)
    monkeypatch.setattr(file, "LIMIT", 1500)
    path = tmp_path / "out.i50n"
    sink = FileSink(f"file:{path}")
    sink.publish(batch(0, 100))
    wait_for(lambda: sink.state.sent == 100)
    for first in range(100, 3100, 500):
        sink.publish(batch(first, 500))
    wait_for(lambda: sink.state.state == "disk full")
    assert not sink.state.healthy
    assert path.stat().st_size == 100 * SIZE, "the part that went in was taken back"
    state = sink.state
    assert state.sent + state.dropped + state.queued == 3100
    assert state.dropped >= 1500
    room = 10**9
    wait_for(lambda: sink.state.queued == 0)
    assert sink.state.state == "ok"
    sink.close()
    numbers = np.frombuffer(path.read_bytes(), np.uint32).reshape(-1, SIZE // 4)[:, 2]
    assert len(numbers) == 3100 - sink.state.dropped
    assert numbers[-500:].tolist() == list(range(2600, 3100)), "the newest; a piece in hand is tried again"
    assert (np.diff(numbers.astype(int)) > 0).all()


def test_an_existing_file_is_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    path.write_text("mine")
    with pytest.raises(InputError, match=r"out\.csv: expected a new file"):
        FileSink(f"file:{path}")
    assert path.read_text() == "mine"


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("file:out.npz", "export the recording"),
        ("file:/no/such/folder/out.csv", "cannot be written: No such file"),
        ("http://somewhere", "expected udp:, tcp:, serial:, can:, zenoh:, file: at the start, got 'http'"),
    ],
)
def test_an_invalid_output_is_refused(url: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        open_sink(url, profiles.load("imu50-rs422").layout())


def test_every_output_is_opened_by_its_url(tmp_path: Path) -> None:
    layout = profiles.load("imu50-rs422").layout()
    urls = {
        "udp://127.0.0.1:9": "UdpSink",
        "tcp://:0": "TcpSink",
        "serial:///dev/no-such-port": "SerialSink",
        "can://virtual/open?profile=imu50-can": "CanSink",
        f"file:{tmp_path}/out.csv": "FileSink",
    }
    for url, name in urls.items():
        sink = open_sink(url, layout)
        assert (type(sink).__name__, sink.url, sink.state.url) == (name, url, url)
        sink.close()
