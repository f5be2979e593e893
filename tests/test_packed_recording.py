"""Packed recordings, as the readers of others see them."""

import json
import random
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from samples import CERTIFICATE

from imudrv import profiles
from imudrv.calibration import Calibration, coefficients
from imudrv.chain import Chain
from imudrv.cli import main
from imudrv.files.atomic import atomic_write
from imudrv.files.settings_file import parse_text
from imudrv.recording.pack import pack
from imudrv.recording.reader import Recording
from imudrv.records import PULSES, Arrival, Flag, Records, Source, Timebase
from imudrv.sinks.base import Batch
from imudrv.sinks.recorder import Recorder
from imudrv.wire.datagram import encode
from imudrv.wire.encode import CanEncoder, StreamEncoder

TOPIC = "/imu50/samples"
SAMPLES = 600
LOST = 200
STEP_NS = 5_000_000_000
BEGIN_NS = 1_700_000_000_000_000_000
JOINED = ("dtheta_b", "dv_b")


def wire(profile: str) -> list[Arrival]:
    """Reads of one sample each, of which one is lost; at half time the host's clock steps."""
    layout = profiles.load(profile).layout()
    pulses = np.zeros(SAMPLES, PULSES)
    pulses["counter"] = np.arange(SAMPLES) + (1 << 32) - 300  # the published counter begins anew
    pulses["arrival_ns"] = BEGIN_NS + np.arange(SAMPLES) * 1_000_000
    pulses["interval_ns"] = 1_000_000
    pulses["gyro"] = np.random.default_rng(2).integers(-9, 9, (SAMPLES, 3))
    pulses["accelerometer"] = [1, 2, 20]
    pulses["temperature_degc"][:, :4] = 20.0 + 0.01 * np.arange(SAMPLES)[:, None] + [0, 10, 20, 30]
    pulses["status"] = 1
    encoder = CanEncoder(layout) if layout.can else StreamEncoder(layout)
    reads = []
    for n in range(SAMPLES):
        encoded = encoder.encode(pulses[n : n + 1])
        data = encoded if layout.can else encoded.tobytes()
        timebase = Timebase(STEP_NS if n >= SAMPLES // 2 else 0, 0)
        reads.append(Arrival(BEGIN_NS + n * 1_000_000, data, timebase))
    del reads[LOST]
    return reads


def record(path: Path, profile: str = "imu50-rs422") -> None:
    recorder = Recorder(
        path,
        layout=profiles.load(profile).layout(),
        profile=profiles.content(profile),
        calibration=CERTIFICATE.encode(),
        source=Source.SIMULATOR,
        port="sim://x.yaml",
        unit="50-0017",
    )
    calibration = parse_text(CERTIFICATE.encode(), Calibration, "certificate")
    chain = Chain(profiles.load(profile), coefficients(calibration), "causal", Source.SIMULATOR)
    for arrival in wire(profile):
        recorder.arrived(arrival.block)
        chain.clock.follow(arrival.timebase)
        recorder.publish(Batch(*chain.feed(arrival.data, arrival.t_ns)))
    recorder.publish(Batch(*chain.close()))
    recorder.close()


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("live") / "run.mcap"
    record(path)
    return path


@pytest.fixture(scope="module")
def packed(live: Path) -> Path:
    path = live.with_name("packed.mcap")
    pack(live, path)
    return path


def samples(path: Path) -> list[tuple[int, Any]]:
    """Times and messages of the samples, by the decoder of ROS 2."""
    decoder = pytest.importorskip("mcap_ros2.decoder")
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[decoder.DecoderFactory()])
        return [
            (message.log_time, sample)
            for _, _, message, sample in reader.iter_decoded_messages(topics=[TOPIC])
        ]


def increments(path: Path) -> Records:
    return np.concatenate(list(Recording(path).increments()))


def same(increments: Records) -> bytes:
    """All bits of increments, without the padding between them."""
    return encode(increments, Source.SIMULATOR)


def vector(of: Any) -> list[float]:
    return [of.x, of.y, of.z]


def test_each_sample_is_a_message_with_the_fields_that_it_was_published_with(packed: Path) -> None:
    shown, published = samples(packed), increments(packed)
    assert len(shown) == len(published) == SAMPLES - 1
    by_counter = {int(row["counter"]): row for row in published}
    for _, sample in shown:
        row = by_counter[sample.counter]
        assert sample.stamp.sec * 10**9 + sample.stamp.nanosec == row["t_ns"]
        assert sample.interval_ns == row["interval_ns"]
        for name in JOINED:
            assert vector(getattr(sample, name)) == row[name].tolist()
        interval_s = row["interval_ns"] * 1e-9
        # float32
        assert vector(sample.angular_rate) == pytest.approx(row["dtheta_b"] / interval_s, rel=1e-7)
        assert vector(sample.specific_force) == pytest.approx(row["dv_b"] / interval_s, rel=1e-7)
        flags = {flag for flag in Flag if getattr(sample.flags, flag.name.lower())}
        assert flags == {flag for flag in Flag if row["flags"] & flag}
    assert any(sample.flags.missing_before for _, sample in shown)


@pytest.mark.parametrize("profile", ["imu50-rs422", "imu50-canfd"])
def test_each_sample_has_the_temperatures_of_its_own_frame(tmp_path: Path, profile: str) -> None:
    record(tmp_path / "run.mcap", profile)
    pack(tmp_path / "run.mcap", tmp_path / "run.mcap")
    for _, sample in samples(tmp_path / "run.mcap"):
        n = (sample.counter + 300) % (1 << 32)
        expected = 20.0 + 0.01 * n + np.array([0.0, 10.0, 20.0, 30.0])
        shown = sample.temperature_degc
        names = (shown.gyro, shown.accelerometer_x, shown.accelerometer_y, shown.accelerometer_z)
        # Those of the frame before, 0.01 K, where increments were queued between its writing and theirs;
        # half a unit of the wire, 0.01 K, and float32.
        assert names == pytest.approx(expected, abs=0.016)


def test_samples_lie_on_the_time_of_the_other_messages_also_after_a_step_of_the_clock(packed: Path) -> None:
    for t_ns, sample in samples(packed):
        n = (sample.counter + 300) % (1 << 32)
        # The clock model follows the first arrivals within a millisecond.
        assert abs(t_ns - (BEGIN_NS + n * 1_000_000)) < 2_000_000


def test_a_packed_recording_is_read_like_the_live_one_to_the_bit(live: Path, packed: Path) -> None:
    one, other = Recording(live), Recording(packed)
    assert list(other.arrivals()) == list(one.arrivals())
    assert same(increments(packed)) == same(increments(live))
    assert list(other.calibrations()) == list(one.calibrations())
    assert (other.profile_text, other.origin) == (one.profile_text, one.origin)


@pytest.mark.parametrize("command", ["decode", "compensate", "export --to csv"])
def test_commands_make_the_same_of_it(
    live: Path, packed: Path, tmp_path: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, path in (("live", live), ("packed", packed)):
        first, *rest = command.split()
        assert main([first, str(path), *rest, "-o", str(tmp_path / f"{name}.csv")]) == 0
    assert (tmp_path / "packed.csv").read_bytes() == (tmp_path / "live.csv").read_bytes()


def test_it_has_an_index_statistics_and_a_schema_for_each_channel(live: Path, packed: Path) -> None:
    for path in (live, packed):
        with path.open("rb") as file:
            summary = make_reader(file, validate_crcs=True).get_summary()
            messages = list(make_reader(file).iter_messages())
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == len(messages)
        counts = {c.id: sum(1 for _, other, _ in messages if other.id == c.id) for _, c, _ in messages}
        assert summary.statistics.channel_message_counts == counts
        times = [message.log_time for _, _, message in messages]
        statistics = summary.statistics
        assert (statistics.message_start_time, statistics.message_end_time) == (min(times), max(times))
        assert all(summary.schemas[c.schema_id].name for c in summary.channels.values())
        assert bool(summary.chunk_indexes) == (path == packed)
        assert all(chunk.message_index_offsets for chunk in summary.chunk_indexes)


def test_samples_of_a_time_are_found_by_the_index(packed: Path) -> None:
    with packed.open("rb") as file:
        found = list(
            make_reader(file).iter_messages(
                [TOPIC], starting_at=BEGIN_NS + 100_000_000, ending_before=BEGIN_NS + 110_000_000
            )
        )
    assert 9 <= len(found) <= 11


def test_packing_it_again_changes_nothing(packed: Path, tmp_path: Path) -> None:
    pack(packed, tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == packed.read_bytes()


def test_a_recording_cut_at_a_random_byte_packs_and_opens(live: Path, tmp_path: Path) -> None:
    whole, path = live.read_bytes(), tmp_path / "cut.mcap"
    rng = random.Random(4)
    begin = whole.index(b"calibration.yaml")
    for _ in range(20):
        path.write_bytes(whole[: rng.randrange(begin + 2000, len(whole))])
        before = list(Recording(path).arrivals()), list(map(same, Recording(path).increments()))
        pack(path, path)
        assert (list(Recording(path).arrivals()), list(map(same, Recording(path).increments()))) == before
        assert not Recording(path).cut
        assert len(samples(path)) == sum(map(len, Recording(path).increments()))


KILLED = """
import os, signal, sys
from pathlib import Path
from imudrv.recording import pack

pack.ChunkedWriter.finish = lambda writer: os.kill(os.getpid(), signal.SIGKILL)
pack.pack(Path(sys.argv[1]), Path(sys.argv[1]))
"""


def test_a_kill_while_packing_leaves_the_recording_and_the_next_start_removes_the_rest(
    live: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    path = folder / "run.mcap"
    shutil.copy(live, path)
    assert subprocess.run([sys.executable, "-c", KILLED, path]).returncode == -signal.SIGKILL
    assert path.read_bytes() == live.read_bytes()
    (left,) = folder.glob(".run.mcap.*")
    with atomic_write(folder / "other") as file:
        file.write(b"of a live process")
        assert not left.exists()
        (partial,) = folder.glob(".*")
        assert main(["pack", str(path), "-o", str(folder / "packed.mcap")]) == 0
        assert partial.exists()
    assert {one.name for one in folder.iterdir()} == {"run.mcap", "packed.mcap", "other"}


NODE = """
const { McapIndexedReader } = require("@mcap/core");
const { loadDecompressHandlers } = require("@mcap/support");
const { open } = require("fs/promises");
(async () => {
  const handle = await open(process.argv[1], "r");
  const readable = {
    size: async () => BigInt((await handle.stat()).size),
    read: async (offset, size) => {
      const buffer = new Uint8Array(Number(size));
      await handle.read(buffer, 0, Number(size), Number(offset));
      return buffer;
    },
  };
  const decompressHandlers = await loadDecompressHandlers();
  const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers });
  const counts = {};
  for await (const message of reader.readMessages()) {
    const topic = reader.channelsById.get(message.channelId).topic;
    counts[topic] = (counts[topic] ?? 0) + 1;
  }
  const schemas = [...reader.channelsById.values()].map((c) => reader.schemasById.get(c.schemaId).name);
  console.log(JSON.stringify({ counts, schemas }));
})();
"""


def test_the_indexed_reader_of_npm_finds_every_message(packed: Path) -> None:
    """With node, and the packages @mcap/core and @mcap/support where NODE_PATH leads to them."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node")
    asked = [node, "-e", 'require("@mcap/core"); require("@mcap/support")']
    if subprocess.run(asked, capture_output=True, check=False).returncode:
        pytest.skip("needs the npm packages @mcap/core and @mcap/support in a folder of NODE_PATH")
    done = subprocess.run([node, "-e", NODE, str(packed)], capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    with packed.open("rb") as file:
        topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert found["counts"] == {topic: topics.count(topic) for topic in set(topics)}
    assert found["counts"][TOPIC] == SAMPLES - 1
    assert "imu50/msg/Sample" in found["schemas"]
