import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from samples import CERTIFICATE, record

from imudrv import profiles
from imudrv.errors import FaultyFileError, InputError
from imudrv.recording import reader
from imudrv.recording.format import pack_messages, unpack_messages
from imudrv.recording.pack import pack
from imudrv.recording.reader import Recording
from imudrv.records import MESSAGE, Arrival, Source, Timebase
from imudrv.sinks.recorder import Recorder

PROFILES = Path(profiles.__file__).parent


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    record(path, 30)
    return path


def places_of(data: bytes, opcode: int) -> list[int]:
    """Where the records of a kind begin."""
    places = []
    at = 8
    while at < len(data) - 8:
        if data[at] == opcode:
            places.append(at)
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    return places


def contents(recording: Recording) -> tuple[list[object], ...]:
    return (
        list(recording.arrivals()),
        [row.tobytes() for piece in recording.increments() for row in piece],
        list(recording.statuses()),
        list(recording.events()),
        list(recording.calibrations()),
    )


def test_everything_recorded_is_read_again(recorded: Path) -> None:
    recording = Recording(recorded)
    assert not recording.cut
    assert recording.profile == profiles.load("imu50-rs422")
    assert recording.calibration is not None
    assert recording.calibration.serial_number == "50-0017"
    assert recording.calibration_text == CERTIFICATE
    assert recording.origin["port"] == "sim://x.yaml"
    assert recording.origin["version"] == "0.1.0"
    arrivals, increments, statuses, events, calibrations = contents(recording)
    assert arrivals == [Arrival(1000 + n, b"%044d" % n) for n in range(30)]
    assert len(increments) == 30
    assert [status for _, status in statuses] == [{"rate_hz": 1000.0}]
    assert events == [(5000, "unplugged")]
    assert [c.gyro.scale_arcsec_per_pulse[0] for _, c in calibrations] == [0.5, 0.6]
    assert calibrations[1][0] == 6000


def test_a_recording_cut_at_any_byte_opens_up_to_the_cut(recorded: Path, tmp_path: Path) -> None:
    whole = recorded.read_bytes()
    arrivals = list(Recording(recorded).arrivals())
    ends = [at + 9 + 22 + 44 for at in places_of(whole, 5)[: len(arrivals)]]
    path = tmp_path / "cut.mcap"
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        recording = Recording(path)
        assert recording.cut
        assert list(recording.arrivals()) == arrivals[: sum(end <= size for end in ends)]


def test_a_recording_that_was_cut_before_its_profile_says_so(recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(recorded.read_bytes()[:100])
    with pytest.raises(InputError, match=r"cut\.mcap.*cut before it, there is nothing in it"):
        _ = Recording(path).profile
    assert Recording(path).origin == {}
    assert Recording(path).calibration is None


@pytest.mark.parametrize("compression", list(CompressionType))
def test_chunks_of_any_compression_are_read(
    recorded: Path, tmp_path: Path, compression: CompressionType
) -> None:
    path = tmp_path / "chunked.mcap"
    with recorded.open("rb") as source, path.open("wb") as target:
        reader = make_reader(source)
        writer = Writer(target, compression=compression, chunk_size=500)
        writer.start()
        for attachment in reader.iter_attachments():
            writer.add_attachment(**vars(attachment))
        ids = {}
        for _, channel, message in reader.iter_messages(log_time_order=False):
            if channel.id not in ids:
                ids[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, 0)
            writer.add_message(ids[channel.id], message.log_time, message.data, message.log_time)
        writer.finish()
    assert contents(Recording(path)) == contents(Recording(recorded))
    whole = path.read_bytes()
    chunks = places_of(whole, 6)
    path.write_bytes(whole[: chunks[len(chunks) // 2] + 50])
    part = list(Recording(path).arrivals())
    assert 0 < len(part) < 30
    assert part == list(Recording(recorded).arrivals())[: len(part)]


def test_packing_makes_it_smaller_and_changes_nothing(recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "packed.mcap"
    pack(recorded, path)
    assert path.stat().st_size < recorded.stat().st_size
    assert not Recording(path).cut
    assert contents(Recording(path)) == contents(Recording(recorded))
    with recorded.open("rb") as one, path.open("rb") as two:
        before, after = make_reader(one), make_reader(two, validate_crcs=True)
        summary = after.get_summary()
        assert summary is not None
        assert summary.chunk_indexes
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        assert summary.statistics is not None
        assert summary.statistics.message_count == 33
        messages = [[(c.topic, vars(m)) for _, c, m in r.iter_messages()] for r in (before, after)]
        assert messages[0] == messages[1]
        assert list(before.iter_attachments()) == list(after.iter_attachments())
        assert list(before.iter_metadata()) == list(after.iter_metadata())


def test_a_cut_recording_is_packed_up_to_its_cut_and_in_place(recorded: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(recorded.read_bytes()[:-900])
    before = contents(Recording(path))
    assert Recording(path).cut
    pack(path, path)
    assert not Recording(path).cut
    assert contents(Recording(path)) == before
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "other"
    with pytest.raises(InputError, match="expected a recording, cannot read it: No such file"):
        Recording(path)
    path.write_bytes(b"\xeb\x90\x50\x26" * 100)
    with pytest.raises(InputError, match=r"expected a recording \(MCAP\), got another kind of file"):
        Recording(path)
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(
        InputError, match=r"expected a recording with its profile\.yaml, got none: it is not from this driver"
    ):
        _ = Recording(path).profile


@pytest.mark.parametrize("opcode", [1, 3, 4, 5, 9, 12])
def test_a_record_of_absurd_length_is_not_read_but_reported_with_its_place(
    recorded: Path, tmp_path: Path, opcode: int
) -> None:
    data = bytearray(recorded.read_bytes())
    at = places_of(data, opcode)[0]
    struct.pack_into("<Q", data, at + 1, 1 << 40)
    path = tmp_path / "bad.mcap"
    path.write_bytes(data)
    with pytest.raises(InputError, match=rf"bad\.mcap: at byte {at}: expected a record.*damaged"):
        list(Recording(path).arrivals())


def test_a_chunk_that_unpacks_to_more_than_it_says_is_refused(recorded: Path, tmp_path: Path) -> None:
    bomb = zlib.compress(b"")  # any bytes; the claims are what matters
    path = tmp_path / "bad.mcap"

    def chunk(compression: bytes, size: int, data: bytes) -> bytes:
        body = struct.pack("<QQQII", 0, 0, size, 0, len(compression)) + compression
        body += struct.pack("<Q", len(data)) + data
        return struct.pack("<BQ", 6, len(body)) + body

    zeros = zstandard.compress(bytes(1 << 26))
    for record_, message in (
        (chunk(b"zstd", 1000, zeros), "length and check are right"),
        (chunk(b"zstd", 1 << 40, zeros), "at most"),
        (chunk(b"zstd", 1000, bomb), "unpacks"),
        (chunk(b"lz4", 1000, bomb), "unpacks"),
        (chunk(b"rar", 1000, bomb), "unknown compression 'rar'"),
        (chunk(b"", 1 << 10, chunk(b"", 0, b"")), "length and check are right"),
        (chunk(b"", len(chunk(b"", 0, b"")), chunk(b"", 0, b"")), "no chunk inside of a chunk"),
    ):
        path.write_bytes(recorded.read_bytes()[:8] + record_)
        with pytest.raises(InputError, match=rf"at byte 8: .*{message}"):
            list(Recording(path).arrivals())


def test_an_attachment_that_was_changed_is_reported(recorded: Path, tmp_path: Path) -> None:
    data = bytearray(recorded.read_bytes())
    at = places_of(data, 9)[0]
    data[at + 200] ^= 1
    path = tmp_path / "bad.mcap"
    path.write_bytes(data)
    with pytest.raises(
        InputError, match=rf"at byte {at}: expected a whole attachment record: its check is wrong"
    ):
        _ = Recording(path).profile


def can_recording(path: Path, reads: int) -> list[Arrival]:
    """Record reads of CAN messages of all lengths, and changes of the timebase between them."""
    rng, name = np.random.default_rng(3), "imu50-can"
    recorder = Recorder(
        path,
        layout=profiles.load(name).layout(),
        profile=profiles.content(name),
        calibration=None,
        source=Source.SIMULATOR,
        port="sim://x.yaml",
        unit="",
    )
    arrivals = []
    for n in range(reads):
        messages = np.zeros(rng.integers(1, 5), MESSAGE)
        messages["t_ns"], messages["length"] = 1000 + n, rng.choice([0, 6, 8, 64], len(messages))
        messages["data"] = rng.integers(0, 256, (len(messages), 64))
        messages["data"][np.arange(64) >= messages["length"][:, None]] = 0
        arrivals.append(Arrival(1000 + n, messages, Timebase(n // 7, 0)))
        recorder.arrived(arrivals[-1])
    recorder.close()
    return arrivals


@pytest.mark.parametrize("size", [1, 50, 100, 333, 1 << 18])
def test_reads_are_the_same_whatever_of_the_file_is_in_memory(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    monkeypatch.setattr(reader, "_BUFFER_BYTES", size)
    assert list(Recording(recorded).arrivals()) == [Arrival(1000 + n, b"%044d" % n) for n in range(30)]
    path = tmp_path / "can.mcap"
    arrivals = can_recording(path, 40)
    found = list(Recording(path).arrivals())
    assert [(a.t_ns, a.timebase) for a in found] == [(a.t_ns, a.timebase) for a in arrivals]
    for one, other in zip(found, arrivals, strict=True):
        assert np.array_equal(one.data, other.data)


def test_reads_before_a_damaged_one_come_before_the_error(tmp_path: Path) -> None:
    path = tmp_path / "can.mcap"
    can_recording(path, 40)
    content = bytearray(path.read_bytes())
    at = [place for place in places_of(content, 5) if content[place + 9] == 1][23]
    content[at + 31] = 65  # the length of the data
    path.write_bytes(content)
    arrivals = Recording(path).arrivals()
    assert [next(arrivals).t_ns for _ in range(23)] == list(range(1000, 1023))
    with pytest.raises(InputError, match=rf"at byte {at}: expected CAN messages of at most 64 bytes"):
        next(arrivals)


@pytest.mark.parametrize("damage", [0x00, 0x80])
def test_a_time_that_no_clock_has_is_reported(recorded: Path, tmp_path: Path, damage: int) -> None:
    content = bytearray(recorded.read_bytes())
    at = places_of(content, 5)[3]
    content[at + 31 - 9] = 0x40 + damage  # the upper byte of its time
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match=rf"at byte {at}: expected a time up to"):
        list(Recording(path).arrivals())


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_whatever_is_damaged_it_is_read_or_reported(
    recorded: Path, tmp_path: Path, data: st.DataObject
) -> None:
    content = bytearray(recorded.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / "bad.mcap"
    path.write_bytes(content)
    recording = Recording(path)
    for read in (
        lambda: contents(recording),
        lambda: recording.profile,
        lambda: recording.origin,
        lambda: pack(path, tmp_path / "packed.mcap"),
    ):
        try:
            read()
        except InputError as error:
            assert "bad.mcap" in str(error) or isinstance(error, FaultyFileError)  # noqa: PT017


@given(st.lists(st.lists(st.tuples(st.integers(0, 64), st.integers(0, 2**29 - 1)), max_size=5), min_size=1))
def test_can_messages_pack_and_unpack(pieces: list[list[tuple[int, int]]]) -> None:
    arrays = []
    for piece in pieces:
        messages = np.zeros(len(piece), MESSAGE)
        for row, (length, identifier) in zip(messages, piece, strict=True):
            row["t_ns"], row["id"], row["length"], row["fd"] = -identifier, identifier, length, length > 8
            row["data"][:length] = np.arange(length) + identifier % 100
        arrays.append(messages)
    packed = pack_messages(arrays)
    ends = np.cumsum([len(piece) for piece in packed])
    messages, message_ends, fault = unpack_messages(np.frombuffer(b"".join(packed), np.uint8), ends)
    assert fault == ""
    assert np.array_equal(messages, np.concatenate(arrays))
    assert message_ends.tolist() == np.cumsum([len(messages) for messages in arrays]).tolist()
