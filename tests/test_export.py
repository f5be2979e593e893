import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from imudrv import profiles
from imudrv.cli import main
from imudrv.errors import InputError
from imudrv.recording.export import KINDS, export, export_datagrams
from imudrv.recording.reader import Recording
from imudrv.records import INCREMENTS, MESSAGE, PULSES, Arrival, Records, Source
from imudrv.sinks.base import Batch
from imudrv.sinks.recorder import Recorder
from imudrv.wire.candump import CandumpDecoder
from imudrv.wire.datagram import encode

PROFILES = Path(profiles.__file__).parent
SAMPLES = 3000
# Saturday 2023-11-18 23:59:58.5 UTC: half of the samples lie in the next week.
BEGIN_NS = 1_700_351_998_500_000_000


def samples() -> Records:
    rng = np.random.default_rng(5)
    increments = np.zeros(SAMPLES, INCREMENTS)
    increments["counter"] = np.arange(SAMPLES) + 100
    increments["t_ns"] = BEGIN_NS + np.arange(SAMPLES) * 1_000_000
    increments["interval_ns"] = 1_000_000
    increments["interval_ns"][7] = 3_000_000
    increments["dtheta_b"] = rng.normal(0, 1e-4, (SAMPLES, 3)) + 7.3e-8
    increments["dv_b"] = rng.normal(0, 1e-4, (SAMPLES, 3)) + np.array([0, 0, 9.8e-3])
    increments["flags"] = 1
    increments["flags"][[3, 4]] = 16
    return increments


def record(path: Path, profile: str, arrivals: list[Arrival], increments: Records) -> Recording:
    recorder = Recorder(
        path,
        layout=profiles.load(profile).layout(),
        profile=(PROFILES / f"{profile}.yaml").read_bytes(),
        calibration=None,
        source=Source.SIMULATOR,
        port="sim://x.yaml",
        unit="50-0017",
    )
    for arrival in arrivals:
        recorder.arrived(arrival)
    for at in range(len(increments)):  # one by one, so that several messages of the recording hold them
        piece = increments[at : at + 1]
        recorder.publish(Batch(np.zeros(0, PULSES), piece, encode(piece, Source.SIMULATOR)))
    recorder.close()
    return Recording(path)


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("export") / "run.mcap"
    arrivals = [Arrival(n, bytes([n, 255 - n]) * (n + 1)) for n in range(50)]
    return record(path, "imu50-rs422", arrivals, samples())


def test_tables_have_the_recorded_increments_to_the_bit(recorded: Recording, tmp_path: Path) -> None:
    expected = samples()
    for kind in ("csv", "npz"):
        export(recorded, kind, tmp_path / f"out.{kind}")
    table = np.load(tmp_path / "out.npz")
    assert sorted(table) == ["counter", "dtheta", "dv", "flags", "interval_ns", "t_ns"]
    rows = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True, dtype=None)
    for name in ("counter", "interval_ns", "t_ns", "flags"):
        assert np.array_equal(table[name], expected[name])
        assert np.array_equal(rows[name], expected[name])
    for name in ("dtheta", "dv"):
        assert np.array_equal(table[name], expected[f"{name}_b"])
        for k, axis in enumerate("xyz"):
            assert np.array_equal(rows[f"{name}_{axis}"], expected[f"{name}_b"][:, k])


def test_a_file_of_datagrams_becomes_the_same_table(
    recorded: Recording, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sent = encode(np.concatenate(list(recorded.increments())), Source.SIMULATOR)
    source = tmp_path / "out.i50n"
    source.write_bytes(sent + sent[:40])  # cut
    export(recorded, "csv", tmp_path / "recording.csv")
    export_datagrams(source, "csv", tmp_path / "file.csv")
    assert (tmp_path / "file.csv").read_bytes() == (tmp_path / "recording.csv").read_bytes()
    assert main(["export", str(source), "--to", "npz", "-o", str(tmp_path / "file.npz")]) == 0
    assert len(np.load(tmp_path / "file.npz")["counter"]) == SAMPLES
    source.write_bytes(sent[:76] + b"x" + sent)
    for kind, message in (("csv", "byte 76: expected I50N datagrams"), ("imr", "expected csv or npz")):
        assert main(["export", str(source), "--to", kind, "-o", str(tmp_path / "bad.csv")]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "bad.csv").exists()


def test_raw_is_the_bytes_of_the_wire(recorded: Recording, tmp_path: Path) -> None:
    expected = b"".join(bytes([n, 255 - n]) * (n + 1) for n in range(50))
    export(recorded, "raw", tmp_path / "out.raw")
    assert (tmp_path / "out.raw").read_bytes() == expected


def test_candump_has_every_message(tmp_path: Path) -> None:
    messages = np.zeros(40, MESSAGE)
    messages["t_ns"] = BEGIN_NS + np.arange(40) * 1000
    messages["id"], messages["length"] = 0x150, 8
    messages["data"][:, :8] = np.arange(320).reshape(40, 8) % 256
    arrivals = [Arrival(BEGIN_NS, piece) for piece in np.split(messages, 8)]
    recording = record(tmp_path / "run.mcap", "imu50-can", arrivals, samples()[:0])
    export(recording, "candump", tmp_path / "out.log")
    decoded, rejects = CandumpDecoder().feed((tmp_path / "out.log").read_bytes())
    assert rejects.size == 0
    assert np.array_equal(decoded, messages)
    with pytest.raises(InputError, match=r"expected a recording of a serial unit, got can: --to candump"):
        export(recording, "raw", tmp_path / "out.raw")
    assert not (tmp_path / "out.raw").exists()


def test_imr_reads_back_by_its_manual_and_its_sums_do_not_drift(recorded: Recording, tmp_path: Path) -> None:
    path = tmp_path / "out.imr"
    export(recorded, "imr", path)
    data = path.read_bytes()
    assert len(data) == 512 + 32 * SAMPLES
    # Field by field at the offsets of NovAtel's table, packed.
    assert data[:8] == b"$IMURAW\0"
    assert data[8] == 0, "little-endian"
    version, is_dtheta, is_dv, rate, gyro, accelerometer = struct.unpack_from("<diiddd", data, 9)
    assert (version, is_dtheta, is_dv, rate) == (8.8, 1, 1, 1000.0)
    time_kind, corrected, bias = struct.unpack_from("<iid", data, 49)
    assert (time_kind, corrected, bias) == (1, 0, 0.0)
    assert data[65:97].rstrip(b"\0") == b"IMU50 50-0017"
    assert data[101:133].rstrip(b"\0") == b"imudrv 0.1.0"
    assert data[133:512] == bytes(379)
    rows = [struct.unpack_from("<d6i", data, 512 + 32 * n) for n in range(SAMPLES)]
    seconds = np.array([row[0] for row in rows])
    # A double holds seconds of the week to 0.12 ns.
    assert seconds[0] == pytest.approx(604_798.5, abs=1e-9)
    assert seconds[1499] == pytest.approx(604_799.999, abs=1e-9)
    assert seconds[1500] == pytest.approx(0.0, abs=1e-9)
    expected = samples()
    dtheta = np.radians(np.array([row[1:4] for row in rows]) * gyro)
    dv = np.array([row[4:] for row in rows]) * accelerometer
    # One unit of the format: two roundings of half a unit each.
    assert np.abs(dtheta - expected["dtheta_b"]).max() < 1e-9
    assert np.abs(dv - expected["dv_b"]).max() < 1e-7
    # Sums are right to half a unit (and to the double's rounding) at every moment.
    drift = np.cumsum(dtheta, axis=0) - np.cumsum(expected["dtheta_b"], axis=0)
    assert np.abs(drift).max() < 0.51 * np.radians(gyro)
    assert np.abs(np.cumsum(dv, axis=0) - np.cumsum(expected["dv_b"], axis=0)).max() < 0.51 * accelerometer


def test_imr_refuses_an_increment_that_it_cannot_hold(tmp_path: Path) -> None:
    increments = samples()[:5]
    increments["dtheta_b"][2, 1] = -2.0
    recording = record(tmp_path / "run.mcap", "imu50-rs422", [], increments)
    with pytest.raises(InputError, match=r"sample 102: expected angle increments below 64 deg.*-114\.59"):
        export(recording, "imr", tmp_path / "out.imr")
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


def test_axes_that_a_unit_lacks_are_no_numbers_in_ros2_and_have_no_place_in_imr(tmp_path: Path) -> None:
    increments = samples()[:5]
    increments["dtheta_b"][:, 1:] = np.nan
    increments["dv_b"] = np.nan
    recording = record(tmp_path / "run.mcap", "fog-fg333", [], increments)
    with pytest.raises(InputError, match=r"angle increments of all three axes.* export to csv or npz"):
        export(recording, "imr", tmp_path / "out.imr")
    reader = pytest.importorskip("mcap_ros2.reader")
    export(recording, "ros2", tmp_path / "ros2.mcap")
    for message in reader.read_ros2_messages(str(tmp_path / "ros2.mcap"), log_time_order=False):
        imu = message.ros_msg
        assert not np.isnan(imu.angular_velocity.x)
        assert np.isnan([imu.angular_velocity.y, imu.angular_velocity.z]).all()
        assert (imu.angular_velocity_covariance[0], imu.linear_acceleration_covariance[0]) == (0, -1)


def test_ros2_has_rates_over_each_samples_own_interval(recorded: Recording, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap_ros2.reader")
    path = tmp_path / "ros2.mcap"
    export(recorded, "ros2", path)
    expected = samples()
    count = 0
    for n, message in enumerate(reader.read_ros2_messages(str(path), log_time_order=False)):
        imu, sample = message.ros_msg, expected[n]
        assert message.channel.topic == "/imu/data_raw"
        assert message.schema.name == "sensor_msgs/msg/Imu"
        assert imu.header.stamp.sec * 10**9 + imu.header.stamp.nanosec == sample["t_ns"]
        interval_s = sample["interval_ns"] * 1e-9
        rate, force = imu.angular_velocity, imu.linear_acceleration
        assert [rate.x, rate.y, rate.z] == (sample["dtheta_b"] / interval_s).tolist()
        assert [force.x, force.y, force.z] == (sample["dv_b"] / interval_s).tolist()
        assert imu.orientation_covariance[0] == -1
        count += 1
    assert count == SAMPLES


def test_ros2_names_the_package_that_it_needs(recorded: Recording, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mcap_ros2.writer", None)
    with pytest.raises(InputError, match=r"mcap-ros2-support: pip install imu50\[ros2\]"):
        export(recorded, "ros2", tmp_path / "out.mcap")


def test_an_unknown_kind_is_refused(recorded: Recording, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match="--to: expected one of csv, npz, raw, candump, imr, ros2, got 'mat'"
    ):
        export(recorded, "mat", tmp_path / "out.mat")
    with pytest.raises(InputError, match=r"expected a name ending in \.csv"):
        export(recorded, "csv", tmp_path / "out.txt")


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "candump"])
def test_a_recording_without_a_sample_is_exported_too(kind: str, tmp_path: Path) -> None:
    recording = record(tmp_path / "run.mcap", "imu50-rs422", [], samples()[:0])
    export(recording, kind, tmp_path / f"out.{kind}")
    assert (tmp_path / f"out.{kind}").exists()
