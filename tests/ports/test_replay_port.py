import time

import numpy as np
import pytest
from mcap.writer import Writer

from imudrv import Source, profiles
from imudrv.errors import InputError
from imudrv.ports import PortEndedError, PortLostError, open_port, replay
from imudrv.recording.format import BYTES, CAN_MESSAGES, PROFILE, WIRE, pack_messages
from imudrv.records import MESSAGE, Arrival, Records
from imudrv.wire.candump import format_candump

FRAME = 44  # bytes of imu50-rs422
MS = 1_000_000


@pytest.fixture
def capture(tmp_path):
    """1600 frames' worth of bytes and a third of one: not a multiple of anything."""
    path = tmp_path / "unit.raw"
    path.write_bytes(np.random.default_rng(1).integers(0, 256, 1600 * FRAME + 15, np.uint8).tobytes())
    return path


def _packed(messages: Records) -> bytes:
    data, _ = pack_messages(messages, np.array([len(messages)]))
    return data.tobytes()


def _messages(count):
    """Two a millisecond, 0.1 ms apart."""
    rng = np.random.default_rng(2)
    messages = np.zeros(count, MESSAGE)
    messages["t_ns"] = (
        1_700_000_000_000_000_000 + np.arange(count) // 2 * MS + np.arange(count) % 2 * MS // 10
    )
    messages["id"] = 0x150 + np.arange(count) % 2
    messages["length"] = 8
    messages["data"][:, :8] = rng.integers(0, 256, (count, 8))
    return messages


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "unit.log"
    path.write_bytes(format_candump(_messages(4000)))
    return path


def _same(one, other):
    return len(one) == len(other) and all(
        a.t_ns == b.t_ns and np.array_equal(a.data, b.data) for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("speed", ["max", "100", "1000000"])
def test_a_capture_is_replayed_complete_with_the_time_of_each_pieces_end(
    speed, capture, rs422, opened, to_the_end
):
    port = opened(f"replay://{capture}?speed={speed}", rs422)
    assert port.source is Source.REPLAY
    found = to_the_end(port)
    assert b"".join(arrival.data for arrival in found) == capture.read_bytes()
    ends = np.cumsum([len(arrival.data) for arrival in found])
    assert [arrival.t_ns for arrival in found] == [-(-int(end) // FRAME) * MS for end in ends]
    assert all(len(arrival.data) % FRAME == 0 for arrival in found[:-1])


def test_in_real_time_a_capture_is_replayed_frame_by_frame(rs422, tmp_path, opened, to_the_end):
    capture = tmp_path / "short.raw"
    capture.write_bytes(bytes(50 * FRAME))
    found = to_the_end(opened(f"replay://{capture}", rs422))
    assert [(arrival.t_ns, len(arrival.data)) for arrival in found] == [(k * MS, FRAME) for k in range(1, 51)]


@pytest.mark.parametrize("speed", ["max", "20"])
def test_a_replay_is_the_same_each_time(speed, capture, log, rs422, can_profile, opened, to_the_end):
    for path, profile in ((capture, rs422), (log, can_profile)):
        runs = [to_the_end(opened(f"replay://{path}?speed={speed}", profile)) for _ in range(2)]
        assert _same(*runs)


@pytest.mark.parametrize("speed", ["max", "50"])
def test_a_candump_log_is_replayed_complete_with_its_own_times(speed, log, can_profile, opened, to_the_end):
    found = to_the_end(opened(f"replay://{log}?speed={speed}", can_profile))
    messages = np.concatenate([arrival.data for arrival in found])
    assert np.array_equal(messages, _messages(4000))
    assert all(arrival.t_ns == arrival.data["t_ns"][-1] for arrival in found)
    assert all(arrival.data.flags.writeable for arrival in found)


def test_a_line_that_is_no_message_affects_no_other(can_profile, tmp_path, opened, to_the_end):
    lines = format_candump(_messages(6)).splitlines(keepends=True)
    log = tmp_path / "damaged.log"
    log.write_bytes(b"".join(lines[:3]) + b"(17000000 can0 #\n\xff\xfe\n" + b"".join(lines[3:])[:-1])
    found = to_the_end(opened(f"replay://{log}?speed=max", can_profile))
    assert np.array_equal(np.concatenate([arrival.data for arrival in found]), _messages(6))


def test_a_log_of_two_channels_is_refused_where_the_second_one_appears(
    can_profile, tmp_path, opened, to_the_end
):
    messages, log = _messages(4000), tmp_path / "two.log"
    log.write_bytes(format_candump(messages[:3999]) + format_candump(messages[3999:], "can1"))
    refused = r"two\.log: expected messages of one CAN channel, got those of can0 and can1; .* \?channel=can0"
    for speed in ("max", "50"):
        with pytest.raises(InputError, match=refused):
            to_the_end(opened(f"replay://{log}?speed={speed}", can_profile))
    for channel, expected in (("can0", messages[:3999]), ("can1", messages[3999:])):
        found = to_the_end(opened(f"replay://{log}?speed=max&channel={channel}", can_profile))
        assert np.array_equal(np.concatenate([arrival.data for arrival in found]), expected)
    with pytest.raises(InputError, match="of CAN channel 'can', got those of can0 and can1"):
        opened(f"replay://{log}?channel=can", can_profile)


def _recording(path, encoding, reads):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_attachment(0, 0, PROFILE, "", profiles.content("imu50-rs422"))
        channel = writer.register_channel(WIRE, encoding, 0)
        for t_ns, data, *_ in reads:
            writer.add_message(channel, t_ns, data, t_ns)
        writer.finish()
    return path


@pytest.mark.parametrize("speed", ["max", "50"])
def test_a_recording_is_replayed_read_by_read_with_its_times(speed, rs422, tmp_path, opened, to_the_end):
    start = 1_700_000_000_123_456_789
    reads = [Arrival(start + k * 3 * MS, bytes([k % 256] * (1 + k % 50))) for k in range(500)]
    path = _recording(tmp_path / "unit.mcap", BYTES, reads)
    found = to_the_end(opened(f"replay://{path}?speed={speed}", rs422))
    assert list(found) == reads


@pytest.mark.parametrize("speed", ["max", "50"])
def test_a_recording_of_messages_is_replayed_with_the_time_of_each(
    speed, can_profile, tmp_path, opened, to_the_end
):
    messages = np.split(_messages(600), 200)
    reads = [(int(part["t_ns"][-1]) + 5, _packed(part)) for part in messages]
    path = _recording(tmp_path / "unit.mcap", CAN_MESSAGES, reads)
    found = to_the_end(opened(f"replay://{path}?speed={speed}", can_profile))
    assert [arrival.t_ns for arrival in found] == [t_ns for t_ns, _ in reads]
    assert np.array_equal(np.concatenate([arrival.data for arrival in found]), _messages(600))


def test_a_recording_of_another_kind_of_unit_is_a_mistake_of_the_user(rs422, can_profile, tmp_path):
    serial = _recording(tmp_path / "serial.mcap", BYTES, [(1, b"x")])
    with pytest.raises(InputError, match="for imu50-can, got a recording of bytes of a serial line"):
        open_port(f"replay://{serial}", can_profile)
    bus = _recording(tmp_path / "can.mcap", CAN_MESSAGES, [(1, _packed(_messages(1)))])
    with pytest.raises(InputError, match="for imu50-rs422, got a recording of CAN messages"):
        open_port(f"replay://{bus}", rs422)


def test_a_recording_without_a_read_is_at_its_end(rs422, tmp_path, opened):
    path = _recording(tmp_path / "unit.mcap", BYTES, [])
    with pytest.raises(PortEndedError, match="the end of the file"):
        opened(f"replay://{path}", rs422).read(0)


def test_no_piece_is_replayed_before_its_time(rs422, tmp_path, opened, monkeypatch):
    clock = [10**18]
    monkeypatch.setattr(replay, "now_ns", lambda: clock[0])
    monkeypatch.setattr(time, "sleep", lambda s: clock.append(clock.pop() + round(s * 1e9)))
    capture = tmp_path / "slow.raw"
    capture.write_bytes(bytes(2 * FRAME))
    port = opened(f"replay://{capture}?speed=0.005", rs422)  # a frame each 0.2 s
    assert len(port.read(0).data) == FRAME
    assert port.read(0).data == b""
    early = port.read(0.04)
    assert (early.data, early.t_ns) == (b"", 1.2 * MS)
    while not port.read(0.05).data:
        pass
    assert clock[0] == 10**18 + 200 * MS


def test_a_pause_of_a_log_is_kept(can_profile, tmp_path, opened):
    messages = _messages(2)
    messages["t_ns"][1] += 3600 * 10**9
    log = tmp_path / "pause.log"
    log.write_bytes(format_candump(messages))
    port = opened(f"replay://{log}?speed=10", can_profile)
    assert port.read(0).data["id"].tolist() == [0x150]
    nothing = port.read(0).data
    assert nothing.dtype == MESSAGE
    assert nothing.size == 0


def test_the_end_is_reported_each_time_it_is_reached(capture, rs422, opened, to_the_end):
    port = opened(f"replay://{capture}?speed=max", rs422)
    to_the_end(port)
    for _ in range(2):
        with pytest.raises(PortEndedError, match="the end of the file"):
            port.read(0)


def test_a_closed_replay_is_lost_when_read(capture, rs422, opened):
    port = opened(f"replay://{capture}", rs422)
    port.close()
    port.close()
    with pytest.raises(PortLostError, match="the port is closed"):
        port.read(0)


def test_a_file_that_cannot_be_replayed_is_a_mistake_of_the_user(capture, rs422, can_profile, tmp_path):
    empty = tmp_path / "empty.raw"
    empty.touch()
    with pytest.raises(InputError, match="expected a file to replay, got an empty one"):
        open_port(f"replay://{empty}", rs422)
    with pytest.raises(InputError, match="expected a file, got a folder"):
        open_port(f"replay://{tmp_path}", rs422)
    for name, profile, kind in (
        ("unit.raw", rs422, "a capture of imu50-rs422"),
        ("unit.mcap", can_profile, "a recording"),
    ):
        with pytest.raises(InputError, match=f"channel: expected a candump log, got {kind}; leave"):
            open_port(f"replay://{tmp_path / name}?channel=can0", profile)
    with pytest.raises(InputError, match="expected no option but speed and channel, got sped"):
        open_port(f"replay://{capture}?sped=max", can_profile)
    with pytest.raises(InputError, match="expected no option but speed, got sped"):
        open_port(f"replay://{capture}?sped=max", rs422)
    size = capture.stat().st_size
    with pytest.raises(
        InputError, match=f"a candump log for the CAN profile imu50-can, got {size} bytes without"
    ):
        open_port(f"replay://{capture}", can_profile)
