"""Allan deviations against published numbers and another program; their coefficients; `calib noise`."""

import json
from itertools import pairwise
from pathlib import Path

import allantools
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from samples import CERTIFICATE, parse_json

from calib.cli import main
from calib.noise.estimates import EstimatesCovariance
from calib.noise.fit import Fit, fit, usable
from calib.noise.model import B, K, N, Q, R
from calib.noise.pyramid import BREAK, KEEP, SKIP, AllanVariance, Pyramid, default_factors
from calib.noise.stretches import StretchSplitter
from imudrv import profiles
from imudrv.calibration import read_calibration
from imudrv.records import INCREMENTS, PULSES, Arrival, Flag, Records, Source
from imudrv.sensor_calibration import GyroNoise
from imudrv.sinks.base import Batch
from imudrv.sinks.recorder import Recorder
from imudrv.units import ARCSEC, DEG_PER_SQRT_H, UG
from imudrv.wire.datagram import encode
from imudrv.wire.encode import StreamEncoder
from tools import psins_to_wire

Array = NDArray[np.float64]
LAYOUT = profiles.load("imu50-rs422").layout()
TAU = 1e-3
ARW, VRW = 0.5 * DEG_PER_SQRT_H, 3000.0 * UG  # a pulse a sample or more: the error of the count is white


def kept(n: int) -> NDArray[np.int8]:
    return np.full(n, KEEP, np.int8)


def allan(x: Array, factors: NDArray[np.int64] | None = None) -> AllanVariance:
    columns = x[:, None] if x.ndim == 1 else x
    pyramid = Pyramid(columns.shape[1], factors)
    pyramid.feed(columns, kept(len(columns)))
    return pyramid.result()


def test_the_thousand_points_of_riley_have_their_published_deviations() -> None:
    # W. J. Riley, Handbook of Frequency Stability Analysis, NIST SP 1065, 12.4: table 31
    n = [1234567890]
    while len(n) < 1000:
        n.append(16807 * n[-1] % 2147483647)
    found = np.sqrt(allan(np.array(n) / 2147483647, np.array([1, 10, 100])).variance[:, 0])
    np.testing.assert_allclose(found, [2.922319e-1, 9.159953e-2, 3.241343e-2], rtol=0.0, atol=5e-8)


def test_the_nine_points_of_nbs_have_their_published_deviations() -> None:
    # NBS Monograph 140, annex 8.E; the overlapping one of m = 2 from NIST SP 1065
    x = np.array([892.0, 809.0, 823.0, 798.0, 671.0, 644.0, 883.0, 903.0, 677.0])
    found = np.sqrt(allan(x, np.array([1, 2])).variance[:, 0])
    np.testing.assert_allclose(found, [91.22945, 85.95287], rtol=0.0, atol=5e-6)


def test_deviations_are_those_of_allantools() -> None:
    x = np.random.default_rng(1).normal(size=1_000_000)
    found = allan(x)
    phase = np.concatenate([[0.0], np.cumsum(x)])
    tau, theirs, _, _ = allantools.oadev(phase, 1.0, "phase", found.factors.astype(float))
    assert np.array_equal(tau, found.factors[: len(tau)])
    off = np.abs(np.sqrt(found.variance[: len(tau), 0]) / theirs - 1.0)
    assert off[tau < 128].max() < 1e-9
    # Those that are left out are nearly the same as their neighbours, 1/64 of tau away.
    assert off[tau < len(x) / 8].max() < 5e-3


def test_four_factors_an_octave_up_to_the_length_of_any_data() -> None:
    factors = default_factors()
    ratios = factors[1:] / factors[:-1]
    assert ratios[factors[:-1] >= 64].max() < 1.21
    assert factors[-1] > 1e11


def test_any_cut_of_the_data_gives_the_same_bits() -> None:
    rng = np.random.default_rng(2)
    x = rng.normal(size=(20_000, 2))
    actions = rng.choice(np.array([KEEP, BREAK, SKIP], np.int8), len(x), p=[0.9994, 0.0003, 0.0003])
    whole, pieces = Pyramid(2), Pyramid(2)
    whole.feed(x, actions)
    edges = [0, *np.sort(rng.integers(0, len(x), 500)).tolist(), len(x)]
    for begin, stop in pairwise(edges):
        pieces.feed(x[begin:stop], actions[begin:stop])
    one, other = whole.result(), pieces.result()
    assert one.variance.tobytes() == other.variance.tobytes()
    assert np.array_equal(one.counts, other.counts)
    assert (one.samples, one.longest) == (other.samples, other.longest)


def test_stretches_are_pooled_by_their_counts_and_never_joined() -> None:
    x = np.random.default_rng(3).normal(size=(3000, 1))
    factors = np.array([1, 7, 60])
    parts = [allan(part, factors) for part in (x[:1000], x[1000:1300], x[1301:])]
    pyramid = Pyramid(1, factors)
    actions = kept(len(x))
    actions[1000], actions[1300] = BREAK, SKIP
    pyramid.feed(x, actions)
    pooled = pyramid.result()
    counts = np.array([part.counts for part in parts])
    mean = (np.array([part.variance[:, 0] for part in parts]) * counts).sum(axis=0) / counts.sum(axis=0)
    np.testing.assert_allclose(pooled.variance[:, 0], mean, rtol=1e-12)  # another order of the sums
    assert np.array_equal(pooled.counts, counts.sum(axis=0))
    assert (pooled.samples, pooled.longest) == (2999, 1699)


def test_the_memory_does_not_depend_on_the_length() -> None:
    pyramid = Pyramid(1)
    arrays = [pyramid._history, pyramid._sums, pyramid._counts]  # noqa: SLF001
    for _ in range(5):
        pyramid.feed(np.ones((50_000, 1)), kept(50_000))
    assert [id(array) for array in arrays] == [
        id(array)
        for array in (pyramid._history, pyramid._sums, pyramid._counts)  # noqa: SLF001
    ]


def noisy(rng: np.random.Generator, n: int, tau: float, q: float, walk: float, rate_walk: float) -> Array:
    rate = np.cumsum(rate_walk * tau**0.5 * rng.normal(size=n))
    theta = np.cumsum(walk * tau**0.5 * rng.normal(size=n) + rate * tau) + q * rng.normal(size=n)
    return np.diff(theta, prepend=0.0)


def fitted(x: Array, tau: float) -> Fit:
    found = usable(allan(x))
    return fit(found, 0, tau, EstimatesCovariance(found, tau))


def test_coefficients_scatter_as_their_sigma_predicts() -> None:
    rng, tau, truth = np.random.default_rng(4), 0.05, (2e-6, 3e-6, 3e-7)
    fits = [fitted(noisy(rng, 72_000, tau, *truth), tau) for _ in range(12)]
    z = np.array([(f.value[[Q, N]] - truth[:2]) / f.sigma[[Q, N]] for f in fits])
    # 24 normal numbers: 1 +- 0.14; three sigma
    assert 0.57 < np.sqrt(np.mean(z**2)) < 1.43
    assert all(f.is_accepted for f in fits)
    # the estimates at the longest times are of few intervals and skewed, so it is no chi-square exactly
    assert 0.5 < np.mean([f.reduced_chi_square for f in fits]) < 1.5


def test_what_is_not_in_the_data_is_not_observable_and_has_a_limit() -> None:
    rng, tau = np.random.default_rng(5), 0.05
    for _ in range(6):
        found = fitted(noisy(rng, 72_000, tau, 2e-6, 3e-6, 0.0), tau)
        assert np.isnan(found.value[[B, K, R]]).all()
        assert (found.below[[B, K, R]] > 0.0).all()


def test_a_coefficient_is_above_its_95_percent_limit_in_5_percent_of_the_records() -> None:
    rng, tau, rate_walk = np.random.default_rng(8), 0.05, 1e-7  # hardly observable in a record
    fits = [fitted(noisy(rng, 20_000, tau, 2e-6, 1e-6, rate_walk), tau) for _ in range(60)]
    above = sum(f.below[K] < rate_walk for f in fits)
    assert above <= 8  # 3 +- 1.7; three sigma
    assert np.median([f.below[K] for f in fits]) < 2.0 * rate_walk


def test_a_rate_walk_is_not_taken_for_a_bias_instability() -> None:
    rng, tau = np.random.default_rng(6), 0.05
    found = fitted(noisy(rng, 288_000, tau, 2e-6, 3e-7, 3e-8), tau)
    assert np.isnan(found.value[B])
    assert abs(found.value[K] - 3e-8) < 4.0 * found.sigma[K]


def test_a_line_is_not_described_by_the_model() -> None:
    t = np.arange(40_000) * 0.01
    x = np.diff(1e-5 * np.sin(2.0 * np.pi * 0.31 * t), prepend=0.0)
    found = fitted(x + noisy(np.random.default_rng(7), len(x), 0.01, 0.0, 1e-7, 0.0), 0.01)
    assert not found.is_accepted


def pulses(duration_s: float, seed: int = 1, rate: float = 0.0, walk: float = VRW) -> Records:
    """Pulses of a unit with white noise, Z up; `rate`: about Z, rad/s, in the middle second of each ten."""
    n = round(duration_s / TAU)
    rng = np.random.default_rng(seed)
    samples = np.zeros(n, PULSES)
    samples["counter"] = np.arange(n)
    samples["interval_ns"], samples["flags"] = 1_000_000, Flag.VALID
    samples["elapsed_ns"] = (np.arange(n) + 1) * 1_000_000
    samples["temperature_degc"] = 30.0
    angle = np.cumsum(ARW * TAU**0.5 * rng.normal(size=(n, 3)), axis=0)
    moving = (np.arange(n) // 1000) % 10 == 5
    angle[:, 2] += np.cumsum(rate * TAU * moving)
    velocity = np.cumsum(
        walk * TAU**0.5 * rng.normal(size=(n, 3)) + np.array([0.01, -0.02, 9.8]) * TAU, axis=0
    )
    samples["gyro"] = np.diff(np.floor(angle / (0.5 * ARCSEC)), axis=0, prepend=0.0)
    samples["accelerometer"] = np.diff(np.floor(velocity * 2000.0), axis=0, prepend=0.0)
    return samples


def splitter() -> StretchSplitter:
    scales = np.repeat([0.5 * ARCSEC, 1.0 / 2000.0], 3)
    return StretchSplitter(TAU, scales, scales)


def split(samples: Records, edges: list[int]) -> tuple[Array, NDArray[np.int8], StretchSplitter]:
    one = splitter()
    parts = [one.feed(piece) for piece in np.split(samples, edges)] + [one.close()]
    values, actions = (np.concatenate(column) for column in zip(*parts, strict=True))
    return values, actions, one


def test_a_turn_ends_a_stretch_with_a_second_on_both_sides() -> None:
    _, actions, one = split(pulses(28.0, rate=0.01), [])
    assert [d.what for d in one.disturbances] == ["motion", "motion", "motion"]
    begins = [round(d.begin_s, 1) for d in one.disturbances]
    ends = [round(d.end_s, 1) for d in one.disturbances]
    assert begins == [4.0, 14.0, 24.0]
    assert ends == [7.0, 17.0, 27.0]
    assert np.count_nonzero(actions == SKIP) == 9000


def test_the_rest_after_a_motion_that_begins_slowly_is_a_rest() -> None:
    samples = pulses(40.0)
    limit = split(samples, [])[2]._limits[0]  # noqa: SLF001
    for block, times in ((250, 0.7), (251, 1.4), (252, 5.0)):
        rows = slice(block * 100, (block + 1) * 100)
        whole = np.floor(np.arange(1, 101) * times * limit * TAU / (0.5 * ARCSEC))
        samples["gyro"][rows, 0] += np.diff(whole, prepend=0.0).astype(np.int64)
    _, _, one = split(samples, [])

    (motion,) = one.disturbances
    assert motion.begin_s == pytest.approx(24.1, abs=0.11)
    assert motion.end_s == pytest.approx(26.3, abs=0.11)


def test_stretches_do_not_depend_on_how_the_samples_are_divided() -> None:
    samples = pulses(28.0, rate=0.01)
    samples["flags"][12_345] |= Flag.MISSING_BEFORE
    samples["flags"][22_222] |= Flag.FAULT
    whole = split(samples, [])
    edges = np.sort(np.random.default_rng(8).integers(0, len(samples), 200)).tolist()
    pieces = split(samples, edges)
    assert np.array_equal(whole[0], pieces[0])
    assert np.array_equal(whole[1], pieces[1])
    assert whole[2].disturbances == pieces[2].disturbances
    assert {d.what for d in whole[2].disturbances} == {"motion", "missing samples", "flagged samples"}


def test_a_unit_at_rest_is_one_stretch() -> None:
    _, actions, one = split(pulses(60.0), [])
    assert (one.disturbed, np.count_nonzero(actions)) == (0, 0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rest of two minutes, a calibration."""
    folder = tmp_path_factory.mktemp("noise")
    (folder / "unit.yaml").write_text(CERTIFICATE)
    write(folder / "rest.raw", pulses(120.0))
    return folder


def write(path: Path, samples: Records) -> None:
    path.write_bytes(StreamEncoder(LAYOUT).encode(samples).tobytes())


def noise(*arguments: str | Path) -> int:
    return main(["noise", *map(str, arguments)])


def test_a_rest_gives_its_random_walks_report_and_certificate(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document, report, new = (folder / name for name in ("n.json", "n.html", "new.yaml"))
    files = ("--json", document, "--report", report, "-o", new)
    assert noise(folder / "rest.raw", "--calibration", folder / "unit.yaml", *files) == 0
    said = capsys.readouterr().out
    assert "good" in said
    channels = parse_json(document.read_text())["channels"]
    for channel, key, truth in [
        *((one, "angle_random_walk_deg_per_sqrt_h", ARW / DEG_PER_SQRT_H) for one in channels[:3]),
        *((one, "velocity_random_walk_ug_per_sqrt_hz", VRW / UG) for one in channels[3:]),
    ]:
        walk = channel["coefficients"][key]
        assert abs(walk["value"] - truth) < 4.0 * walk["sigma"]
        assert walk["sigma"] < 0.05 * truth
    html = report.read_text()
    assert html.count("<svg") + html.count("image/svg+xml") >= 2
    old, certified = read_calibration(folder / "unit.yaml"), read_calibration(new)
    assert certified.noise is not None
    walks = certified.noise.gyro.angle_random_walk_deg_per_sqrt_h
    assert walks == pytest.approx([ARW / DEG_PER_SQRT_H] * 3, rel=0.1)
    assert certified.noise.gyro.bias_instability_deg_per_h is None  # two minutes do not show it
    assert certified.gyro == old.gyro
    assert "noise" in (certified.provenance or {})


def test_without_a_calibration_the_scale_factors_are_nominal_and_no_certificate_is_written(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert noise(folder / "rest.raw", "--profile", "imu50-rs422") == 0
    assert "nominal scale factors of the profile" in capsys.readouterr().out
    assert noise(folder / "rest.raw", "-o", folder / "none.yaml") == 2
    assert "give its file (--calibration)" in capsys.readouterr().err
    assert not (folder / "none.yaml").exists()


def recording(path: Path, samples: Records, calibration: str) -> Path:
    recorder = Recorder(
        path,
        layout=LAYOUT,
        profile=profiles.content("imu50-rs422"),
        calibration=calibration.encode(),
        source=Source.SIMULATOR,
        port="nowhere",
        unit="50-0017",
    )
    encoder = StreamEncoder(LAYOUT)
    for piece in np.split(samples, range(500, len(samples), 500)):
        increments = np.zeros(len(piece), INCREMENTS)
        increments["counter"] = piece["counter"]
        recorder.arrived(Arrival(int(piece["elapsed_ns"][-1]), encoder.encode(piece).tobytes()).block)
        recorder.publish(Batch(piece, increments, encode(increments, Source.SIMULATOR)))
    recorder.close()
    return path


def test_recordings_have_their_calibration_which_has_to_be_the_same(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = recording(tmp_path / "one.mcap", pulses(30.0), CERTIFICATE)
    assert noise(one, "-o", tmp_path / "new.yaml") == 0
    assert "nominal" not in capsys.readouterr().out
    other = recording(tmp_path / "other.mcap", pulses(30.0, seed=2), CERTIFICATE.replace("2000.0", "2001.0"))
    assert noise(one, other) == 2
    assert "expected recordings made with one calibration" in capsys.readouterr().err


def test_three_seconds_are_too_short(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert noise(folder / "rest.raw", "--from", "10", "--to", "13") == 2
    said = capsys.readouterr().err
    assert "expected at least 20 s at rest without a gap, got 3.0 s" in said
    assert "averaging time of 0.38 s at most" in said


def test_a_gap_each_minute_pools_the_stretches_between(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples = pulses(200.0)
    write(tmp_path / "gaps.raw", samples[np.arange(len(samples)) % 60_000 >= 20])
    assert noise(tmp_path / "gaps.raw", "--profile", "imu50-rs422", "--json", tmp_path / "n.json") == 0
    assert "left out: motion, missing or flagged samples in 3 places" in capsys.readouterr().out
    document = json.loads((tmp_path / "n.json").read_text())
    assert document["at_rest_s"] == pytest.approx(199.9, abs=0.1)
    # an eighth of a minute, and the next lower of four factors an octave
    assert 60.0 / 8.0 / 1.2 < document["channels"][0]["fitted_tau_s"][1] <= 60.0 / 8.0


@pytest.mark.parametrize(("swing", "words"), [(0.0, "pulses come too regularly"), (4.0, "vibration")])
def test_regular_pulses_are_told_from_a_vibration(
    tmp_path: Path, swing: float, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    samples = pulses(60.0, walk=5.0 * UG)  # a pulse of 50 ug s: two minutes of noise
    beside = swing * np.sin(2.0 * np.pi * 3.1 * np.arange(len(samples)) * TAU)
    samples["accelerometer"] += np.diff(np.rint(beside), prepend=0.0).astype(np.int64)[:, None]
    write(tmp_path / "rest.raw", samples)
    assert noise(tmp_path / "rest.raw", "--profile", "imu50-rs422", "--json", tmp_path / "n.json") == 0
    (said,) = [
        one
        for one in json.loads((tmp_path / "n.json").read_text())["verdicts"]
        if one["reason"].startswith("accelerometer X, accelerometer Y, accelerometer Z: ")
    ]
    assert words in said["reason"]
    assert said["verdict"] == ("caution" if swing else "note")
    assert "UPPER LIMITS" in capsys.readouterr().out


def test_a_moving_unit_is_refused_with_upper_limits(
    tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    samples = pulses(40.0)
    swing = 1000.0 * np.sin(2.0 * np.pi * 0.4 * np.arange(len(samples)) * TAU)  # pulses: 0.14 deg
    for sensor in ("gyro", "accelerometer"):
        samples[sensor] += np.diff(np.rint(swing), prepend=0.0).astype(np.int64)[:, None]
    write(tmp_path / "moves.raw", samples)
    new = tmp_path / "new.yaml"
    assert noise(tmp_path / "moves.raw", "--calibration", folder / "unit.yaml", "-o", new) == 3
    said = capsys.readouterr().out
    assert "not the noise of a unit at rest" in said
    assert "UPPER LIMITS" in said
    assert "COEFFICIENTS" not in said
    assert f"{new}: not written" in said
    assert not new.exists()


def test_compensated_increments_are_refused(
    tmp_path: Path, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "increments.i50n"
    path.write_bytes(b"I50N\x01" + bytes(1000))
    assert noise(path, "--calibration", folder / "unit.yaml") == 2
    assert "they are compensated already and hold no pulses" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--from", "30", "--to", "20"), "a begin before the end, got 1 of them and 30 to 20 s"),
        (("--profile", "fdilink"), "expected frames of fdilink"),
        (("-o", "rest.raw"), "rest.raw"),
    ],
)
def test_bad_arguments_are_named(
    folder: Path,
    more: tuple[str, ...],
    message: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(folder)
    assert noise("rest.raw", "--calibration", "unit.yaml", *more) == 2
    assert message in capsys.readouterr().err


def test_a_dead_sensor_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    samples = pulses(30.0)
    samples["gyro"][:, 1] = 0
    write(tmp_path / "dead.raw", samples)
    assert noise(tmp_path / "dead.raw", "--profile", "imu50-rs422") == 2
    assert "gyro Y: expected increments with noise, got the same ones" in capsys.readouterr().err


def test_the_same_capture_twice_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert noise(folder / "rest.raw", folder / "rest.raw") == 2
    assert "expected another capture" in capsys.readouterr().err


def test_a_signed_certificate_is_not_copied_with_its_signature(folder: Path) -> None:
    document = yaml.safe_load((folder / "unit.yaml").read_text())
    signature = {"public_key": "A" * 43 + "=", "ed25519": "A" * 86 + "=="}
    (folder / "signed.yaml").write_text(yaml.safe_dump(document | {"signature": signature}, sort_keys=False))
    assert (
        noise(folder / "rest.raw", "--calibration", folder / "signed.yaml", "-o", folder / "copy.yaml") == 0
    )
    assert read_calibration(folder / "copy.yaml").signature is None


PARKED = pytest.mark.parametrize("window", [(600, 960), (1020, 1500)])
"""Where the laser-gyro unit in its car was quietest, s."""


@PARKED
def test_a_parked_car_is_not_at_rest(
    data: Path, tmp_path: Path, window: tuple[int, int], capsys: pytest.CaptureFixture[str]
) -> None:
    raw, document = tmp_path / "car.raw", tmp_path / "n.json"
    psins_to_wire.convert(data / "lasergyro.imu", raw)
    times = ("--from", str(window[0]), "--to", str(window[1]))
    assert noise(raw, "--profile", psins_to_wire.PROFILE, *times, "--json", document) == 3
    assert "not the noise of a unit at rest" in capsys.readouterr().out
    found = json.loads(document.read_text())
    walks = [one["upper_limits"]["angle_random_walk_deg_per_sqrt_h"] for one in found["channels"][:3]]
    # a unit of this class has some 0.005 deg/sqrt(h); the car shakes it ten times as much at most
    assert all(0.005 < walk["estimate"] < walk["value"] < 0.05 for walk in walks)
    vertical = found["channels"][5]
    walk = vertical["upper_limits"]["velocity_random_walk_ug_per_sqrt_hz"]
    deviation = vertical["allan_deviation_si"][found["tau_s"].index(walk["tau_s"])]
    assert walk["estimate"] == pytest.approx(deviation * walk["tau_s"] ** 0.5 / UG)


@PARKED
def test_a_parked_car_has_the_known_random_walks_at_most(data: Path, window: tuple[int, int]) -> None:
    # the smallest sigma sqrt(tau) of the whole window, motion included, up to an eighth of its length
    rows = psins_to_wire.read(data / "lasergyro.imu")[100 * window[0] : 100 * window[1]]
    found = allan(np.concatenate([rows["gyro"] * 0.1, rows["accelerometer"] * 125.0], axis=1))
    found = found.part(found.factors <= len(rows) / 8)
    walks = np.sqrt((found.variance * found.factors[:, None] / 0.01).min(axis=0))
    assert walks[:3].max() / 60.0 <= 0.045  # arcsec/sqrt(s) to deg/sqrt(h)
    assert walks[5] <= 46.0


def test_coefficients_of_a_sensor_are_three_numbers_or_absent() -> None:
    with pytest.raises(ValueError, match="angle_random_walk"):
        GyroNoise.model_validate({"angle_random_walk_deg_per_sqrt_h": [0.002, None, 0.002]})
    assert GyroNoise().bias_instability_deg_per_h is None
