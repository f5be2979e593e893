import errno
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from numpy.typing import NDArray
from realtime import DEADLINE_S, until

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.files import spool
from imudrv.recording.reader import Recording
from imudrv.records import MESSAGE, Arrival, Reads, Source, Timebase, as_array
from imudrv.sinks import recorder as recorder_module
from imudrv.sinks.recorder import Recorder
from imudrv.wire.datagram import SIZE

PROFILES = Path(profiles.__file__).parent
HERE = list(map(str, Path(__file__).parents[:2]))
"""Folders of this module and of those that it imports, for another process."""


def open_recorder(
    path: Path, profile: str = "imu50-rs422", calibration: bytes | None = b"one: 1\n"
) -> Recorder:
    return Recorder(
        path,
        layout=profiles.load(profile).layout(),
        profile=(PROFILES / f"{profile}.yaml").read_bytes(),
        calibration=calibration,
        source=Source.SIMULATOR,
        port="sim://x.yaml",
        unit="50-0017",
    )


def test_the_library_itself_reads_all_that_was_recorded(batch, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = open_recorder(path)
    for n in range(20):
        recorder.arrived(Arrival(1000 + n, bytes([n]) * 44).block)
        recorder.publish(batch(n, 1))
    recorder.arrived(Arrival(2000, b"").block)
    recorder.status(lambda: {"rate_hz": 1000.0, "path": Path("x")})
    recorder.event(3000, "unplugged")
    recorder.calibration(4000, b"two: 2\n")
    recorder.close()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().library == "imu50 0.1.0"
        summary = reader.get_summary()
        assert summary is not None
        assert [c.topic for c in summary.channels.values()] == [
            "/imu50/wire",
            "/imu50/increments",
            "/imu50/status",
            "/imu50/events",
            "/imu50/clock",
        ]
        (origin,) = reader.iter_metadata()
        assert origin.metadata["unit"] == "50-0017"
        assert origin.metadata["source"] == "simulator"
        attachments = list(reader.iter_attachments())
        assert [(a.name, a.data[:6]) for a in attachments[1:]] == [
            ("calibration.yaml", b"one: 1"),
            ("calibration.yaml", b"two: 2"),
        ]
        assert attachments[0].data == (PROFILES / "imu50-rs422.yaml").read_bytes()
        assert attachments[2].log_time == 4000
        messages = list(reader.iter_messages(log_time_order=False))
    wire = [m for _, c, m in messages if c.topic == "/imu50/wire"]
    assert [(m.log_time, m.data) for m in wire] == [(1000 + n, bytes([n]) * 44) for n in range(20)]
    assert [m.sequence for m in wire] == list(range(20))
    increments = b"".join(m.data for _, c, m in messages if c.topic == "/imu50/increments")
    assert increments == batch(0, 20).datagrams
    documents = {
        c.topic: (s.encoding, json.loads(m.data))
        for s, c, m in messages
        if s and c.message_encoding == "json"
    }
    assert documents["/imu50/status"] == ("jsonschema", {"rate_hz": 1000.0, "path": "x"})
    assert documents["/imu50/events"] == ("jsonschema", {"text": "unplugged"})
    with path.open("rb") as file:
        assert len(list(NonSeekingReader(file).iter_messages())) == len(messages)


def test_can_messages_are_recorded_exactly(batch, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = open_recorder(path, "imu50-canfd", None)
    rng = np.random.default_rng(1)
    sent = []
    for n in range(30):
        messages = np.zeros(rng.integers(1, 4), MESSAGE)
        for row in messages:
            row["t_ns"], row["id"] = 10**18 + n, rng.integers(0, 2**29)
            row["length"], row["fd"] = rng.choice([0, 1, 8, 48, 64]), rng.integers(0, 2)
            row["data"][: row["length"]] = rng.integers(0, 256, row["length"])
        sent.append(messages)
        recorder.arrived(Arrival(10**18 + n, messages).block)
    recorder.close()
    recording = Recording(path)
    got = list(recording.arrivals())
    assert [a.t_ns for a in got] == [10**18 + n for n in range(30)]
    for arrival, messages in zip(got, sent, strict=True):
        assert np.array_equal(arrival.data, messages)
    assert recording.calibration_text is None
    assert recording.profile.name == "imu50-canfd"


@given(
    st.lists(
        st.tuples(st.integers(1, 90), st.sampled_from([Timebase(), Timebase(7)]), st.booleans()), max_size=20
    ),
    st.sampled_from(["imu50-rs422", "imu50-canfd"]),
)
@settings(deadline=None, max_examples=25)
def test_reads_are_recorded_alike_in_any_blocks(
    drawn: list[tuple[int, Timebase, bool]], profile: str
) -> None:
    """Drawn are the length of a read, its timebase, and whether a block begins with it."""
    numbers = np.arange(sum(size for size, _, _ in drawn))
    whole: NDArray[Any] = numbers.astype(np.uint8)
    if profile == "imu50-canfd":
        whole = np.zeros(len(numbers), MESSAGE)
        whole["t_ns"], whole["length"], whole["data"][:, 0] = numbers, numbers % 64 + 1, numbers
    arrivals: list[Arrival] = []
    blocks: list[list[Arrival]] = []
    begin = 0
    for k, (size, timebase, is_first) in enumerate(drawn):
        data = whole[begin : begin + size]
        arrivals.append(Arrival(1000 + k, data if data.dtype == MESSAGE else data.tobytes(), timebase))
        begin += size
        if is_first or not blocks or blocks[-1][0].timebase != timebase:
            blocks.append([])
        blocks[-1].append(arrivals[-1])
    with TemporaryDirectory() as folder:
        one_by_one = open_recorder(Path(folder) / "reads.mcap", profile)
        for arrival in arrivals:
            one_by_one.arrived(arrival.block)
        one_by_one.close()
        in_blocks = open_recorder(Path(folder) / "blocks.mcap", profile)
        in_blocks.arrived(Arrival(1, b"", Timebase(9)).block)
        for block in blocks:
            data = np.concatenate([as_array(arrival.data) for arrival in block])
            ends = np.cumsum([len(arrival.data) for arrival in block])
            times = np.array([arrival.t_ns for arrival in block])
            in_blocks.arrived(Reads(data, ends, times, block[0].timebase))
        in_blocks.close()
        for path in Path(folder).iterdir():
            got = Recording(path).arrivals()
            assert [(a.t_ns, bytes(a.data), a.timebase) for a in got] == [
                (a.t_ns, bytes(a.data), a.timebase) for a in arrivals
            ]


def test_wire_bytes_are_recorded_before_their_increments(batch, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    recorder = open_recorder(path)
    for n in range(5):
        recorder.publish(batch(n, 1))
        recorder.arrived(Arrival(n, b"x").block)
    recorder.close()
    with path.open("rb") as file:
        topics = [c.topic for _, c, _ in make_reader(file).iter_messages(log_time_order=False)]
    assert topics == ["/imu50/wire"] * 5 + ["/imu50/increments"]


def test_an_existing_recording_is_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"mine")
    with pytest.raises(InputError, match=r"run\.mcap: expected a new file.*another name"):
        open_recorder(path)
    assert path.read_bytes() == b"mine"


def test_a_full_disk_is_reported_and_leaves_the_file_intact(
    batch, wait_for, tmp_path: Path, monkeypatch
) -> None:
    room = 12_000
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
    monkeypatch.setattr(recorder_module, "QUEUE_BYTES", 300 * 140)
    path = tmp_path / "run.mcap"
    recorder = open_recorder(path)
    put = 0
    while recorder.state.healthy:
        for _ in range(20):  # far fewer than the queue holds
            recorder.arrived(Arrival(put, b"%044d" % put).block)
            recorder.publish(batch(put, 1))
            put += 1
        wait_for(lambda: recorder.state.queued == 0 or not recorder.state.healthy)
    assert recorder.state.state == "disk full"
    while "reads of the port lost" not in recorder.state.state or recorder.state.dropped < 100:
        recorder.arrived(Arrival(put, b"%044d" % put).block)
        recorder.publish(batch(put, 1))
        put += 1
    assert recorder.state.state.startswith("disk full; ")
    state = recorder.state
    assert state.sent + state.dropped + state.queued == put
    cut = Recording(path)
    assert cut.cut
    assert cut.profile.name == "imu50-rs422"
    before = [int(a.data) for a in cut.arrivals()]
    assert before == list(range(len(before)))

    room = 10**9
    wait_for(lambda: recorder.state.queued == 0)
    recorder.poll()
    recorder.close()
    assert recorder.state.healthy
    whole = Recording(path)
    assert not whole.cut
    numbers = [int(a.data) for a in whole.arrivals()]
    lost = put - len(numbers)
    assert lost > 0
    assert recorder.state.state == f"ok; {lost} reads of the port lost"
    assert numbers[: len(before)] == before
    assert numbers[-1] == put - 1
    assert all(a < b for a, b in pairwise(numbers))
    assert f"recording: {lost} reads of the port are missing before this" in [
        text for _, text in whole.events()
    ]
    samples = np.concatenate(list(whole.increments()))["counter"]
    assert len(samples) == put - recorder.state.dropped


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 128 kB, where one may be made."""
    path = tmp_path / "disk"
    path.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=128k", "tmpfs", str(path)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("needs the right to mount a small tmpfs")
    yield path
    subprocess.run(["umount", str(path)], check=True)


def test_recording_continues_when_a_full_disk_has_room_again(batch, wait_for, small_disk: Path) -> None:
    filler = small_disk / "filler"
    filler.write_bytes(bytes(60_000))
    path = small_disk / "run.mcap"
    recorder = open_recorder(path)
    put = 0

    def feed() -> None:
        nonlocal put
        recorder.arrived(Arrival(put, b"%044d" % put).block)
        recorder.publish(batch(put, 1))
        put += 1

    wait_for(lambda: feed() or recorder.state.state == "disk full")
    assert Recording(path).profile.name == "imu50-rs422"
    part = [int(a.data) for a in Recording(path).arrivals()]
    assert part == list(range(len(part)))
    filler.unlink()
    wait_for(lambda: recorder.state.queued == 0)
    recorder.close()
    assert recorder.state[1:] == ("ok", True, put, 0, 0)
    assert [int(a.data) for a in Recording(path).arrivals()] == list(range(put))


def test_a_disk_that_is_full_at_the_start_is_refused(tmp_path: Path, monkeypatch) -> None:
    def full(descriptor: int, data: memoryview) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(InputError, match=r"run\.mcap: cannot be written: disk full"):
        open_recorder(tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())


def test_a_limit_of_file_size_is_a_full_disk(tmp_path: Path) -> None:
    """The quota of another process, for it holds for the whole of one."""
    path = tmp_path / "run.mcap"
    program = f"""
import resource, sys, time
sys.path[:0] = {HERE!r}
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
from pathlib import Path
from test_recorder import open_recorder
from imudrv.ports.base import Arrival
recorder = open_recorder(Path({str(path)!r}))
n = 0
while recorder.state.state != "disk full":
    recorder.arrived(Arrival(n, b"%044d" % n).block)
    n += 1
    time.sleep(0.0005)
recorder.close()
print(recorder.state.state)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=DEADLINE_S)
    assert (done.stdout, done.stderr) == ("disk full\n", "")
    numbers = [int(a.data) for a in Recording(path).arrivals()]
    assert numbers == list(range(len(numbers)))
    assert numbers


RECORDING = """
import sys, time
sys.path[:0] = {here!r}
from pathlib import Path
from test_recorder import open_recorder
from imudrv.ports.base import Arrival
recorder = open_recorder(Path({path!r}))
n = 0
def read():
    global n
    recorder.arrived(Arrival(n, b"%044d" % n).block)
    n += 1
for line in sys.stdin:
    for _ in range(int(line)):
        read()
while True:
    read()
    time.sleep(0.0005)
"""


def test_what_was_read_reaches_the_file_at_once_and_a_kill_leaves_it_whole(tmp_path: Path) -> None:
    assert spool.PERIOD_S <= 0.25 / 2, "it is written a quarter of a second later at the latest"
    rng = random.Random(3)
    for round_ in range(4):
        path = tmp_path / f"run{round_}.mcap"
        program = RECORDING.format(here=HERE, path=str(path))
        command = [sys.executable, "-c", program]
        with subprocess.Popen(command, stdin=subprocess.PIPE, text=True) as process:
            assert process.stdin is not None
            for asked in (100, 200, 300):
                print(100, file=process.stdin, flush=True)
                until(lambda asked=asked, path=path: path.exists() and len(numbers(path)) == asked)
            process.stdin.close()  # now it reads without a pause
            until(lambda path=path: len(numbers(path)) > 300)
            time.sleep(rng.uniform(0.0, 0.4))  # at any moment
            process.send_signal(signal.SIGKILL)
        recording = Recording(path)
        assert recording.cut
        assert recording.profile.name == "imu50-rs422"
        got = numbers(path)
        assert len(got) > 300
        assert got == list(range(len(got)))


def numbers(path: Path) -> list[int]:
    return [int(arrival.data) for arrival in Recording(path).arrivals()]


@pytest.mark.parametrize("size", [1, 10])
def test_every_queue_is_bounded_and_counts_what_it_drops(
    size: int, batch, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr(recorder_module, "QUEUE_BYTES", 100 * (SIZE + 64))
    monkeypatch.setattr("imudrv.files.spool.PERIOD_S", 3600)
    recorder = open_recorder(tmp_path / "run.mcap")
    data, ends = np.zeros(size * SIZE, np.uint8), SIZE * np.arange(1, size + 1)
    for n in range(0, 1000, size):
        recorder.arrived(Reads(data, ends, n + np.arange(size), Timebase()))
        recorder.publish(batch(n, size))
    assert recorder.state[3:] == (0, 900, 100)
    assert recorder.state.state == "ok; 900 reads of the port lost"
    recorder.close()
    recording = Recording(tmp_path / "run.mcap")
    assert [a.t_ns for a in recording.arrivals()] == list(range(900, 1000))
    assert np.concatenate(list(recording.increments()))["counter"].tolist() == list(range(900, 1000))
    assert [text for _, text in recording.events()] == [
        "recording: 900 reads of the port are missing before this"
    ]
