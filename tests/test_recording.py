import re
import struct
import tracemalloc
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Channel
from mcap.writer import CompressionType, Writer
from samples import CERTIFICATE, record

from imudrv import profiles
from imudrv.capture import Capture
from imudrv.errors import FaultyFileError, InputError
from imudrv.recording import reader
from imudrv.recording.format import pack_messages, unpack_messages
from imudrv.recording.pack import pack
from imudrv.recording.reader import Recording
from imudrv.recording.writer import ChunkedWriter, McapWriter
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


def test_a_recording_cut_at_any_byte_opens_up_to_the_cut(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap", 5)
    whole = (tmp_path / "run.mcap").read_bytes()
    arrivals = list(Recording(tmp_path / "run.mcap").arrivals())
    ends = [at + 9 + 22 + 44 for at in places_of(whole, 5)[: len(arrivals)]]
    path = tmp_path / "cut.mcap"
    profile = places_of(whole, 9)[0]
    with_profile = profile + 9 + struct.unpack_from("<Q", whole, profile + 1)[0]
    for size in range(len(whole)):
        path.write_bytes(whole[:size])
        if size < with_profile:
            with pytest.raises(InputError, match=r"cut\.mcap.*cut before it, there is nothing in it"):
                Recording(path)
            continue
        recording = Recording(path)
        assert recording.cut
        assert list(recording.arrivals()) == arrivals[: sum(end <= size for end in ends)]


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


def test_packing_makes_it_smaller_and_changes_nothing(tmp_path: Path) -> None:
    recorded, path = tmp_path / "run.mcap", tmp_path / "packed.mcap"
    record(recorded, 300)
    pack(recorded, path)
    assert path.stat().st_size < recorded.stat().st_size
    assert not Recording(path).cut
    assert contents(Recording(path)) == contents(Recording(recorded))
    with recorded.open("rb") as one, path.open("rb") as two:
        before, after = make_reader(one), make_reader(two, validate_crcs=True)
        live, summary = before.get_summary(), after.get_summary()
        assert live is not None
        assert summary is not None
        assert summary.chunk_indexes
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        assert live.statistics is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == live.statistics.message_count + 300
        messages = [
            [
                (c.topic, m.sequence, m.log_time, m.publish_time, m.data)
                for _, c, m in r.iter_messages()
                if c.topic != "/imu50/samples"
            ]
            for r in (before, after)
        ]
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
    with pytest.raises(InputError, match="expected a file, there is none"):
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
        Recording(path)


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


def record_of(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text_of(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text


def channel(number: int, topic: bytes) -> bytes:
    return record_of(4, struct.pack("<HH", number, 0) + text_of(topic) + text_of(b"bytes") + text_of(b""))


def message(number: int, data: bytes) -> bytes:
    return record_of(5, struct.pack("<HIQQ", number, 0, 0, 0) + data)


def chunk(compression: bytes, data: bytes, size: int | None = None) -> bytes:
    """A chunk of data that are not packed yet; `size` is what it declares."""
    packed = {b"zstd": zstandard.compress, b"lz4": lz4.frame.compress}.get(compression, bytes)(data)
    body = struct.pack("<QQQI", 0, 0, len(data) if size is None else size, 0) + text_of(compression)
    return record_of(6, body + struct.pack("<Q", len(packed)) + packed)


def beginning(recorded: Path) -> bytes:
    """A recording up to its first message."""
    data = recorded.read_bytes()
    return data[: places_of(data, 5)[0]]


def attachment(data: bytes) -> bytes:
    name = text_of(b"calibration.yaml") + text_of(b"text")
    return record_of(9, bytes(16) + name + struct.pack("<Q", len(data)) + data + bytes(4))


ZEROS = bytes(15 << 20)
LIMIT = 16 << 20
BROKEN_CHUNKS: dict[str, tuple[bytes, str]] = {
    "more than it says": (chunk(b"zstd", ZEROS, 1000), "length and check are right"),
    "less than it says": (chunk(b"zstd", bytes(9), LIMIT), "length and check are right"),
    "too large": (chunk(b"zstd", bytes(LIMIT + 1)), f"at most {LIMIT} bytes, got one of {LIMIT + 1}"),
    "no zstd": (chunk(b"zstd", b"").replace(b"\x28\xb5\x2f\xfd", b"\x28\xb5\x2f\xfe"), "unpacks"),
    "no lz4": (chunk(b"lz4", b"").replace(b"\x04\x22\x4d\x18", b"\x04\x22\x4d\x19"), "unpacks"),
    "rar": (chunk(b"rar", ZEROS[:9]), "unknown compression 'rar'"),
    "a chunk": (chunk(b"zstd", chunk(b"zstd", ZEROS)), "no chunk inside of a chunk"),
    "an attachment": (chunk(b"zstd", attachment(ZEROS)), "no attachment inside of a chunk"),
    "a large message": (chunk(b"lz4", message(1, ZEROS)), "expected a record, got kind 5"),
    "a large channel": (chunk(b"zstd", channel(9, ZEROS)), "expected a record, got kind 4"),
    "many channels": (
        chunk(b"zstd", b"".join(channel(100 + k, bytes(1 << 19)) for k in range(20))),
        "channels of at most 1048576 bytes in all",
    ),
    "another channel": (chunk(b"", channel(1, b"other")), "channel 1 as before, got another one"),
}


@pytest.mark.parametrize("name", BROKEN_CHUNKS)
def test_a_chunk_that_is_broken_or_holds_what_it_must_not_is_refused_with_its_place(
    recorded: Path, tmp_path: Path, name: str
) -> None:
    head, path = beginning(recorded), tmp_path / "bad.mcap"
    bad, expected = BROKEN_CHUNKS[name]
    path.write_bytes(head + bad)
    for read in (lambda: list(Recording(path).arrivals()), lambda: pack(path, tmp_path / "packed.mcap")):
        with pytest.raises(InputError, match=rf"at byte \d+: .*{expected}") as caught:
            read()
        place = int(re.findall(r"at byte (\d+)", str(caught.value))[0])
        assert place >= len(head)


BOMBS: dict[str, bytes] = {
    "small reads": chunk(b"zstd", message(1, bytes(40)) * (LIMIT // 71)) * 20,
    "reads": chunk(b"lz4", message(1, ZEROS[: 1 << 20]) * 15) * 20,
    "large read": chunk(b"zstd", message(1, ZEROS)),
    "channels": b"".join(chunk(b"zstd", channel(100 + k, ZEROS)) for k in range(20)),
}


@pytest.mark.parametrize("name", BOMBS)
def test_a_recording_of_any_number_of_chunks_takes_little_memory(
    recorded: Path, tmp_path: Path, name: str
) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(beginning(recorded) + BOMBS[name])
    tracemalloc.start()
    with suppress(InputError):
        for _ in Recording(path).reads():
            pass
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 64 << 20, f"{peak} bytes of memory"  # what `Recording` promises


@pytest.mark.parametrize("profile", ["imu50-rs422", "imu50-can"])
def test_a_profile_for_the_other_kind_of_line_is_refused_in_plain_words(
    recorded: Path, tmp_path: Path, profile: str
) -> None:
    path, expected = recorded, "CAN messages for imu50-can, got a recording of bytes of a serial line"
    if profile == "imu50-rs422":
        path = tmp_path / "can.mcap"
        can_recording(path, 4)
        expected = "bytes of a serial line for imu50-rs422, got a recording of CAN messages"
    with pytest.raises(InputError, match=rf"\.mcap: expected {expected}"):
        list(Recording(path).arrivals(profiles.load(profile).layout()))
    with pytest.raises(InputError, match=rf"\.mcap: expected {expected}"):
        list(Capture(path, profile).pulses())


def test_an_attachment_that_was_changed_is_reported(recorded: Path, tmp_path: Path) -> None:
    data = bytearray(recorded.read_bytes())
    at = places_of(data, 9)[0]
    data[at + 200] ^= 1
    path = tmp_path / "bad.mcap"
    path.write_bytes(data)
    with pytest.raises(
        InputError, match=rf"at byte {at}: expected a whole attachment record: its check is wrong"
    ):
        Recording(path)


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
        recorder.arrived(arrivals[-1].block)
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
    for read in (
        lambda: contents(Recording(path)),
        lambda: Recording(path).profile,
        lambda: Recording(path).origin,
        lambda: pack(path, tmp_path / "packed.mcap"),
    ):
        try:
            read()
        except InputError as error:
            assert "bad.mcap" in str(error) or isinstance(error, FaultyFileError)  # noqa: PT017


@given(st.lists(st.tuples(st.integers(0, 2**62), st.binary(max_size=90)), max_size=20), st.integers(0, 20))
@pytest.mark.parametrize("kind", [McapWriter, ChunkedWriter])
def test_messages_encoded_together_are_those_encoded_one_by_one(
    kind: type[McapWriter], messages: list[tuple[int, bytes]], cut: int
) -> None:
    files = [BytesIO(), BytesIO()]
    one_by_one, together = writers = [kind(file) for file in files]
    for writer in writers:
        writer.define(Channel(id=3, topic="x", message_encoding="", metadata={}, schema_id=0))
    for t_ns, data in messages:
        one_by_one.message(3, t_ns, data)
    for part in (messages[:cut], messages[cut:]):
        times = np.array([t_ns for t_ns, _ in part], np.int64)
        ends = np.cumsum([len(data) for _, data in part], dtype=np.int64)
        together.messages(3, times, np.frombuffer(b"".join(data for _, data in part), np.uint8), ends)
    for writer in writers:
        writer.finish()
    assert files[0].getvalue() == files[1].getvalue()


@given(st.lists(st.lists(st.tuples(st.integers(0, 64), st.integers(0, 2**29 - 1)), max_size=5), min_size=1))
def test_can_messages_pack_and_unpack(pieces: list[list[tuple[int, int]]]) -> None:
    arrays = []
    for piece in pieces:
        messages = np.zeros(len(piece), MESSAGE)
        for row, (length, identifier) in zip(messages, piece, strict=True):
            row["t_ns"], row["id"], row["length"], row["fd"] = -identifier, identifier, length, length > 8
            row["data"][:length] = np.arange(length) + identifier % 100
        arrays.append(messages)
    together, ends = np.concatenate(arrays), np.cumsum([len(messages) for messages in arrays])
    messages, message_ends, fault = unpack_messages(*pack_messages(together, ends))
    assert fault == ""
    assert np.array_equal(messages, together)
    assert message_ends.tolist() == ends.tolist()
