import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import CERTIFICATE

from imudrv import profiles
from imudrv.cli import main
from imudrv.errors import InputError
from imudrv.recording.export import KINDS, export, export_datagrams
from imudrv.recording.reader import Recording
from imudrv.recording.ros2 import Convention
from imudrv.records import INCREMENTS, MESSAGE, PULSES, Arrival, Records, Source
from imudrv.sinks.base import Batch
from imudrv.sinks.recorder import Recorder
from imudrv.wire.candump import CandumpDecoder
from imudrv.wire.datagram import encode

PROFILES = Path(profiles.__file__).parent
SAMPLES = 3000
BRIDGED = 7
INVALID = [3, 4]
# Saturday 2023-11-18 23:59:58.5 UTC: half of the samples lie in the next week.
BEGIN_NS = 1_700_351_998_500_000_000


def samples() -> Records:
    rng = np.random.default_rng(5)
    increments = np.zeros(SAMPLES, INCREMENTS)
    increments["counter"] = np.arange(SAMPLES) + 100
    increments["t_ns"] = BEGIN_NS + np.arange(SAMPLES) * 1_000_000
    increments["interval_ns"] = 1_000_000
    for name, unit in (("counter", 1), ("t_ns", 1_000_000)):
        increments[name][BRIDGED:] += 2 * unit  # two samples are lost, the third one covers them
    increments["interval_ns"][BRIDGED] = 3_000_000
    increments["flags"] = 1
    increments["dtheta_b"] = rng.normal(0, 1e-4, (SAMPLES, 3)) + 7.3e-8
    increments["dv_b"] = rng.normal(0, 1e-4, (SAMPLES, 3)) + np.array([0, 0, 9.8e-3])
    increments["dv_b"][BRIDGED, 2] += 2 * 9.8e-3
    increments["flags"][INVALID] = 16
    return increments


def record(
    path: Path,
    profile: str,
    arrivals: list[Arrival],
    increments: Records,
    calibration: bytes | None = None,
) -> Recording:
    recorder = Recorder(
        path,
        layout=profiles.load(profile).layout(),
        profile=(PROFILES / f"{profile}.yaml").read_bytes(),
        calibration=calibration,
        source=Source.SIMULATOR,
        port="sim://x.yaml",
        unit="50-0017",
    )
    for arrival in arrivals:
        recorder.arrived(arrival.block)
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
    for kind, message in (("csv", "byte 76: expected I50N datagrams"), ("raw", "expected csv, npz, ")):
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
    assert len(data) == 512 + 32 * (SAMPLES + 2)
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
    rows = [struct.unpack_from("<d6i", data, 512 + 32 * n) for n in range(SAMPLES + 2)]
    seconds = np.array([row[0] for row in rows])
    # A double holds seconds of the week to 0.12 ns.
    assert seconds[0] == pytest.approx(604_798.5, abs=1e-9)
    assert seconds[1499] == pytest.approx(604_799.999, abs=1e-9)
    assert seconds[1500] == pytest.approx(0.0, abs=1e-9)
    expected = np.insert(samples(), BRIDGED, samples()[[BRIDGED, BRIDGED]])
    for name in ("dtheta_b", "dv_b"):
        expected[name][BRIDGED : BRIDGED + 3] /= 3
    dtheta = np.radians(np.array([row[1:4] for row in rows]) * gyro)
    dv = np.array([row[4:] for row in rows]) * accelerometer
    # One unit of the format: two roundings of half a unit each.
    assert np.abs(dtheta - expected["dtheta_b"]).max() < 1e-9
    assert np.abs(dv - expected["dv_b"]).max() < 1e-7
    # Sums are right to half a unit (and to the double's rounding) at every moment.
    drift = np.cumsum(dtheta, axis=0) - np.cumsum(expected["dtheta_b"], axis=0)
    assert np.abs(drift).max() < 0.51 * np.radians(gyro)
    assert np.abs(np.cumsum(dv, axis=0) - np.cumsum(expected["dv_b"], axis=0)).max() < 0.51 * accelerometer


def test_a_reader_of_imr_finds_gravity_also_where_an_interval_bridges_a_gap(
    recorded: Recording, tmp_path: Path
) -> None:
    """A reader divides each increment by the sample interval of the header."""
    done = export(recorded, "imr", tmp_path / "out.imr")
    assert done == f"{SAMPLES} samples, 2 more bridged by long intervals; 2 not valid, 0 lost and left out"
    data = (tmp_path / "out.imr").read_bytes()
    rate_hz, _, unit = struct.unpack_from("<ddd", data, 25)
    rows = np.frombuffer(data[512:], np.dtype([("time", "<f8"), ("gyro", "<i4", 3), ("dv", "<i4", 3)]))
    force = rows["dv"][:, 2] * unit * rate_hz
    # Three times the increment, 29 m/s^2, unless it is split; the noise of one sample is 0.1 m/s^2.
    assert np.abs(force - 9.8).max() < 0.6
    assert np.diff(rows["time"][: 2 * BRIDGED]) == pytest.approx(1e-3, abs=1e-9)


def test_samples_that_no_interval_covers_are_counted_as_left_out(tmp_path: Path) -> None:
    increments = samples()
    increments["counter"][20:] += 5
    increments["counter"][30:] -= 10_000  # a restart loses nothing that is known
    recording = record(tmp_path / "run.mcap", "imu50-rs422", [], increments)
    for kind in ("csv", "npz", "parquet", "imr"):
        if kind == "parquet":
            pytest.importorskip("pyarrow")
        assert export(recording, kind, tmp_path / f"out.{kind}").endswith("2 not valid, 5 lost and left out")


def test_imr_of_an_interval_beyond_all_reason_is_refused(tmp_path: Path) -> None:
    increments = samples()[:3]
    increments["interval_ns"] = [1, 1, 2**32 - 1]
    (tmp_path / "out.i50n").write_bytes(encode(increments, Source.SIMULATOR))
    with pytest.raises(InputError, match="intervals of some samples, got one of 4294967295 samples"):
        export_datagrams(tmp_path / "out.i50n", "imr", tmp_path / "out.imr")


def test_imr_refuses_an_increment_that_it_cannot_hold(tmp_path: Path) -> None:
    increments = samples()[:5]
    increments["dtheta_b"][2, 1] = -2.0
    recording = record(tmp_path / "run.mcap", "imu50-rs422", [], increments)
    with pytest.raises(InputError, match=r"sample 102: expected angle increments below 64 deg.*-114\.59"):
        export(recording, "imr", tmp_path / "out.imr")
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


def test_axes_that_a_unit_lacks_are_no_numbers_in_ros2_and_have_no_place_in_imr(tmp_path: Path) -> None:
    increments = samples()[:5]
    increments["flags"], increments["dtheta_b"][:, 1:] = 1, np.nan
    increments["dv_b"] = np.nan
    recording = record(tmp_path / "run.mcap", "fog-fg333", [], increments)
    with pytest.raises(InputError, match=r"angle increments of all three axes.* export to csv or npz"):
        export(recording, "imr", tmp_path / "out.imr")
    reader = pytest.importorskip("mcap_ros2.reader")
    export(recording, "ros2", tmp_path / "ros2.mcap")
    for message in reader.read_ros2_messages(str(tmp_path / "ros2.mcap"), log_time_order=False):
        imu = message.ros_msg
        # X of the unit points to the right
        assert not np.isnan(imu.angular_velocity.y)
        assert np.isnan([imu.angular_velocity.x, imu.angular_velocity.z]).all()
        assert (imu.angular_velocity_covariance[0], imu.linear_acceleration_covariance[0]) == (0, -1)


def test_parquet_has_the_columns_of_csv_to_the_bit(recorded: Recording, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    export(recorded, "csv", tmp_path / "out.csv")
    export(recorded, "parquet", tmp_path / "out.parquet")
    table = parquet.read_table(tmp_path / "out.parquet")
    rows = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True, dtype=None)
    assert tuple(table.column_names) == rows.dtype.names
    for name in table.column_names:
        assert np.array_equal(table[name].to_numpy(), rows[name])


def test_parquet_names_the_package_that_it_needs(recorded: Recording, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"package pyarrow: pip install imu50\[parquet\]"):
        export(recorded, "parquet", tmp_path / "out.parquet")
    assert not (tmp_path / "out.parquet").exists()


def messages_of(path: Path) -> list[Any]:
    reader = pytest.importorskip("mcap_ros2.reader")
    return [message.ros_msg for message in reader.read_ros2_messages(str(path), log_time_order=False)]


def test_ros2_turns_the_axes_and_names_the_frame(recorded: Recording, tmp_path: Path) -> None:
    for name, options in (("flu", []), ("body", ["--axes", "body", "--frame-id", "imu_link"])):
        path = str(tmp_path / f"{name}.mcap")
        assert main(["export", str(recorded.path), "--to", "ros2", "-o", path, *options]) == 0
    flu, body = messages_of(tmp_path / "flu.mcap"), messages_of(tmp_path / "body.mcap")
    assert (flu[0].header.frame_id, body[0].header.frame_id) == ("imu50", "imu_link")
    for turned, own in zip(flu[:20], body[:20], strict=True):
        for name in ("angular_velocity", "linear_acceleration"):
            new, old = getattr(turned, name), getattr(own, name)
            # forward is the unit's front, Y; left is the opposite of its right, X (REP 103)
            assert (new.x, new.y, new.z) == (old.y, -old.x, old.z)


def test_ros2_says_which_samples_are_not_valid(recorded: Recording, tmp_path: Path) -> None:
    export(recorded, "ros2", tmp_path / "out.mcap")
    unusable = [
        n
        for n, imu in enumerate(messages_of(tmp_path / "out.mcap"))
        if imu.angular_velocity_covariance[0] == imu.linear_acceleration_covariance[0] == -1
    ]
    assert unusable == INVALID


NOISE = """\
noise:
  gyro: {angle_random_walk_deg_per_sqrt_h: [0.003, 0.006, 0.009], quantisation_arcsec: [0.1, 0.2, 0.3]}
  accelerometer: {velocity_random_walk_ug_per_sqrt_hz: [10, 20, 30]}
"""


def test_the_covariances_of_ros2_are_those_of_the_noise_in_the_certificate(tmp_path: Path) -> None:
    calibration = (CERTIFICATE + NOISE).encode()
    record(tmp_path / "run.mcap", "imu50-rs422", [], samples()[:20], calibration)
    for axes in ("flu", "body"):
        convention = Convention(axes=axes)
        export(Recording(tmp_path / "run.mcap"), "ros2", tmp_path / f"{axes}.mcap", convention)
    body, flu = messages_of(tmp_path / "body.mcap"), messages_of(tmp_path / "flu.mcap")
    for n, T in ((0, 1e-3), (BRIDGED, 3e-3)):
        # Units by hand: deg/sqrt(h) to rad/sqrt(s), arcsec to rad, ug to m/s^2.
        walk, steps = np.radians([0.003, 0.006, 0.009]) / 60, np.radians([0.1, 0.2, 0.3]) / 3600
        of_rate = np.array(body[n].angular_velocity_covariance).reshape(3, 3)
        assert of_rate == pytest.approx(np.diag(walk**2 / T + 2 * steps**2 / T**2), rel=1e-12, abs=1e-30)
        of_force = np.array(body[n].linear_acceleration_covariance).reshape(3, 3)
        expected = np.diag((np.array([10, 20, 30]) * 9.80665e-6) ** 2 / T)
        assert of_force == pytest.approx(expected, rel=1e-12, abs=1e-30)
        turned = np.array(flu[n].angular_velocity_covariance).reshape(3, 3)
        assert np.diag(turned).tolist() == np.diag(of_rate)[[1, 0, 2]].tolist()


def test_ros2_refuses_a_name_that_its_readers_refuse(recorded: Recording, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected a name ending in \.mcap, which ros2 bag .* got \.bag"):
        export(recorded, "ros2", tmp_path / "out.bag")


@pytest.mark.parametrize("option", [["--frame-id", "a"], ["--axes", "flu"]])
def test_options_of_ros2_are_refused_with_other_formats(
    recorded: Recording, tmp_path: Path, option: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "out.csv")
    assert main(["export", str(recorded.path), "--to", "csv", "-o", path, *option]) == 2
    assert f"{option[0]}: expected --to ros2, got --to csv" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["npz", "imr", "ros2"])
def test_datagrams_become_what_their_recording_becomes(
    recorded: Recording, tmp_path: Path, kind: str
) -> None:
    source = tmp_path / "out.i50n"
    source.write_bytes(encode(np.concatenate(list(recorded.increments())), Source.SIMULATOR))
    one, other = (tmp_path / f"{name}{'.mcap' if kind == 'ros2' else '.' + kind}" for name in "ab")
    assert export_datagrams(source, kind, one) == export(recorded, kind, other)
    if kind == "ros2":
        assert list(map(str, messages_of(one))) == list(map(str, messages_of(other)))
    elif kind == "imr":  # but for the serial number in the header
        assert one.read_bytes()[512:] == other.read_bytes()[512:]
    else:
        assert all(np.array_equal(np.load(one)[name], np.load(other)[name]) for name in np.load(one))


def test_ros2_has_rates_over_each_samples_own_interval(recorded: Recording, tmp_path: Path) -> None:
    reader = pytest.importorskip("mcap_ros2.reader")
    path = tmp_path / "ros2.mcap"
    export(recorded, "ros2", path, Convention(axes="body"))
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
        InputError, match="--to: expected one of csv, npz, parquet, raw, candump, imr, ros2, got 'mat'"
    ):
        export(recorded, "mat", tmp_path / "out.mat")
    with pytest.raises(InputError, match=r"expected a name ending in \.csv"):
        export(recorded, "csv", tmp_path / "out.txt")


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "candump"])
def test_a_recording_without_a_sample_is_exported_too(kind: str, tmp_path: Path) -> None:
    recording = record(tmp_path / "run.mcap", "imu50-rs422", [], samples()[:0])
    path = tmp_path / f"out.{'mcap' if kind == 'ros2' else kind}"
    export(recording, kind, path)
    assert path.exists()
