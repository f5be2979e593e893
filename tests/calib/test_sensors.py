"""Calibration of the sensors: simulated units by hand against their truth, and inputs that are not right."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.cli import main
from calib.detection.rest_bins import Noise
from calib.estimation.dither_line import DitherLine
from calib.messages import text
from calib.procedure.plan import load as load_procedure
from calib.procedure.schema import Procedure
from calib.sensors.adjustment import Free, Wander, _wander, _whole_basis, covariance_of
from calib.sensors.calibrate import SensorsOptions, calibrate_sensors, named_poses
from calib.sensors.calibrate import solve as solve_evidence
from calib.sensors.certificate import certificate, result_document
from calib.sensors.evidence import Evidence
from calib.sensors.parameters import NominalScales
from calib.sensors.prediction import PlannedPose, additions, predict_sensors, turned
from calib.sensors.rests import read_evidence
from calib.sensors.result import SensorsResult
from calib.sensors.verdict import dither_judgement
from imudrv import profiles
from imudrv.calibration import Calibration, read_calibration, write_calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.files.settings_file import parse
from imudrv.nav.attitude import rotation
from imudrv.records import Flag, Records
from imudrv.sensor_calibration import number_paths
from imudrv.site import Site
from imudrv.units import ARCSEC, UG
from imudrv.wire.encode import StreamEncoder
from tools.psins_to_wire import FLOAT_PROFILE, convert
from tools.sensors_accuracy import errors, golden_truth
from tools.sensors_units import (
    FACES,
    SITE,
    SimulatedUnit,
    new_unit,
    pulses_of,
    six_faces_turned,
    three_loops,
    write_session,
)

PROFILE = profiles.load("imu50-rs422").model_copy(update={"sample_rate_hz": 100.0})
LAYOUT = PROFILE.layout()
RATE = 100
REST_S = 24.0
UNIT = "50-0017"


def sessions(unit: SimulatedUnit) -> Records:
    return pulses_of(unit, LAYOUT)


@pytest.fixture(scope="module")
def unit() -> SimulatedUnit:
    return new_unit(7, LAYOUT, rest_s=REST_S)


@pytest.fixture(scope="module")
def session(unit: SimulatedUnit) -> Records:
    return sessions(unit)


Solve = Callable[..., SensorsResult]


@pytest.fixture
def solve(tmp_path: Path) -> Solve:
    def solve(
        *pieces: Records, site=SITE, start=None, captures=None, profile=PROFILE, **options
    ) -> SensorsResult:
        paths = []
        for k, pulses in enumerate(pieces):
            path = tmp_path / f"session-{k}.raw"
            path.write_bytes(StreamEncoder(LAYOUT).encode(pulses).tobytes())
            paths.append(path)
        return calibrate_sensors(
            captures or paths,
            site=site,
            unit=UNIT,
            profile=profile,
            start=start,
            options=SensorsOptions(**options),
        )

    return solve


@pytest.fixture(scope="module")
def result(session: Records, tmp_path_factory: pytest.TempPathFactory) -> SensorsResult:
    path = tmp_path_factory.mktemp("good") / "session.raw"
    path.write_bytes(StreamEncoder(LAYOUT).encode(session).tobytes())
    return calibrate_sensors([path], site=SITE, unit=UNIT, profile=PROFILE)


def true_numbers(unit: SimulatedUnit) -> dict[str, float]:
    """Return the numbers of the true certificate by their paths."""
    document = unit.scenario.unit.calibration.model_dump(exclude={"provenance"})
    values = {}
    for path in number_paths(document):
        place = document
        for key in path.replace("]", "").replace("[", ".").split("."):
            place = place[int(key)] if key.isdigit() else place[key]
        values[path] = place
    return values


def texts(result: SensorsResult, mark: str) -> str:
    return " ".join(one.text for one in result.verdict if one.mark == mark)


def moments(result: SensorsResult) -> list[float]:
    return [rest.start_s for rest in result.evidence.rests]


# The result


def test_every_number_of_a_new_unit_is_found_within_its_uncertainty(result, unit):
    truth = true_numbers(unit)
    assert result.mark == "good"
    assert len(result.evidence.rests) == 12
    assert len(result.evidence.links) == 11
    shown = [one for one in result.estimates if one.is_shown]
    assert len(shown) == 34  # 31, and the arms are nine of a rank of six
    errors = np.array([(one.value - truth[one.path]) / one.sigma for one in shown])
    assert all(one.observable for one in shown)
    assert np.abs(errors).max() < 4.2  # of 34 draws once in a thousand
    assert (errors**2).mean() < 2.2  # the same, for 31 independent ones
    # and that uncertainty is worth having: rests of 22 s, by hand
    sigma = {one.path: one.sigma for one in shown}
    assert sigma["gyro.scale_arcsec_per_pulse[0]"] < 1.2e-6 * 0.5
    assert sigma["gyro.C_bg[1][0]"] < 0.4 * ARCSEC
    assert sigma["gyro.bias_deg_per_h[2]"] < 0.012
    assert sigma["accelerometer.scale_pulse_per_m_s[1]"] < 2.0e-6 * 2000
    assert sigma["accelerometer.bias_ug[0]"] < 2.0  # five degrees of freedom of the wander: a third larger
    assert sigma["accelerometer.quadratic_ug_per_g2[1]"] < 1.8
    assert sigma["size_effect.r_mm.x[1]"] < 0.06
    assert sigma["skew_ms"] < 0.008


def test_the_certificate_has_the_numbers_and_their_covariance(result, tmp_path):
    write_calibration(tmp_path / "unit.yaml", certificate(result))
    read = read_calibration(tmp_path / "unit.yaml")
    values = {one.path: one for one in result.estimates}
    assert read.gyro.frame == "gyro"
    assert read.gyro.bias_deg_per_h[1] == pytest.approx(values["gyro.bias_deg_per_h[1]"].value, rel=1e-10)
    assert read.size_effect.gauge == "centroid"
    sensors = read.sensors
    assert len(sensors.rests) == 12
    assert sensors.gravity.source == "measured"
    assert sensors.not_observable == ()
    k = sensors.covariance.names.index("accelerometer.bias_ug[2]")
    assert sensors.covariance.matrix[k, k] == pytest.approx(
        values["accelerometer.bias_ug[2]"].sigma ** 2, rel=1e-6
    )
    # singular by design: the gauge, the rows of length 1, the centroid
    assert np.linalg.matrix_rank(sensors.covariance.matrix, tol=1e-14, hermitian=True) < len(
        sensors.covariance.names
    )


@pytest.mark.parametrize("off", [(0.05, -0.10), (-0.05, 0.10)])
def test_a_start_far_off_nominal_gives_the_same_result(solve, session, result, off):
    gyro, accelerometer = off
    start = nominal_certificate(0.5 * (1 + gyro), 2000.0 * (1 + accelerometer))
    found = solve(session, start=start)
    difference = [
        (a.value - b.value) / a.sigma
        for a, b in zip(result.estimates, found.estimates, strict=True)
        if a.is_shown
    ]
    assert np.abs(difference).max() < 1e-3


def nominal_certificate(arcsec: float, pulses: float) -> Calibration:
    unit = new_unit(1, LAYOUT).scenario.unit.calibration
    one = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    zero = (0.0, 0.0, 0.0)
    return unit.model_copy(
        update={
            "gyro": unit.gyro.model_copy(
                update={"scale_arcsec_per_pulse": (arcsec,) * 3, "bias_deg_per_h": zero, "C_bg": one}
            ),
            "accelerometer": unit.accelerometer.model_copy(
                update={
                    "scale_pulse_per_m_s": (pulses,) * 3,
                    "bias_ug": zero,
                    "C_ba": one,
                    "quadratic_ug_per_g2": None,
                }
            ),
            "size_effect": None,
            "skew_ms": None,
        }
    )


def test_the_axes_along_the_faces_are_the_same_unit_turned(solve):
    theta = np.array([100.0, -200.0, 150.0]) * ARCSEC  # from the gyros to the faces
    attitudes = [C @ rotation(theta, float(np.linalg.norm(theta))).T for C in six_faces_turned()]
    session = sessions(new_unit(7, LAYOUT, attitudes, rest_s=REST_S, set_down=5 * ARCSEC))
    result, faces = solve(session), solve(session, frame="faces")
    assert certificate(faces).gyro.frame == "faces"
    assert 2 * ARCSEC < faces.faces.repeatability < 8 * ARCSEC  # as they were set down
    sigma = np.sqrt(np.diag(faces.faces.theta_covariance))
    assert (sigma < 4 * ARCSEC).all()
    assert (np.abs(faces.faces.theta - theta) < 3.5 * sigma).all()
    rows = [k for k, one in enumerate(faces.estimates) if one.path.startswith("gyro.C_bg")]
    assert np.sqrt(np.diag(faces.covariance)[rows]).max() == pytest.approx(sigma.max(), rel=0.3)
    # On the sensing axes nothing changes: scales, biases, quadratic term, angles between the axes.
    for path in ("accelerometer.scale_pulse_per_m_s[0]", "accelerometer.bias_ug[1]", "skew_ms"):
        a, b = (next(e for e in r.estimates if e.path == path) for r in (result, faces))
        assert a.value == pytest.approx(b.value, rel=1e-12)
        assert a.sigma == pytest.approx(b.sigma, rel=1e-6)
    p, q = result.parameters, faces.parameters
    np.testing.assert_allclose(p.A @ p.A.T, q.A @ q.A.T, atol=1e-13)
    np.testing.assert_allclose(p.G @ p.A.T, q.G @ q.A.T, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(p.r_b, axis=1), np.linalg.norm(q.r_b, axis=1), rtol=1e-9)


def test_a_known_pivot_shows_all_nine_arms_from_it(solve):
    offset = {"x": 30.0, "y": 0.0, "z": -20.0}  # of the sensing points from the pivot
    changes = {"start": {"pivot_offset_mm": list(offset.values())}}
    unit = new_unit(8, LAYOUT, rest_s=REST_S, pivot_fixed=True, changes=changes)
    found = solve(sessions(unit), pivot="fixed")
    assert certificate(found).size_effect.gauge == "given"
    truth = true_numbers(unit)
    for one in found.estimates:
        if one.path.startswith("size_effect"):
            expected = truth[one.path] + list(offset.values())[int(one.path[-2])]
            assert abs(one.value - expected) < 4.0 * one.sigma, one.path
            assert one.sigma < 2.0


def test_a_pivot_that_is_not_fixed_is_refused(solve, session):
    carried = session.copy()
    for rest, at in enumerate(rest_starts(session)[1:]):  # 13 mm to the side after each motion
        axis = rest % 3 if rest < 4 else 2
        begin = at + 10
        carried["accelerometer"][begin : begin + 30, axis] += 3  # 0.15 m/s^2
        carried["accelerometer"][begin + 30 : begin + 60, axis] -= 3
    words = "--pivot fixed: expected an origin of the body axes that stays where it is"
    with pytest.raises(InputError, match=words):
        solve(carried, pivot="fixed")
    assert solve(session, pivot="fixed").mark == "good"


def test_slopes_per_kelvin_are_found_while_the_unit_warms_up(solve):
    slopes = {
        "reference_degc": 25.0,
        "range_degc": [10.0, 50.0],
        "gyro_bias_deg_per_h_per_k": [0.02, -0.03, 0.04],
        "gyro_scale_ppm_per_k": [3.0, -2.0, 1.0],
        "accelerometer_bias_ug_per_k": [20.0, -30.0, 10.0],
        "accelerometer_scale_ppm_per_k": [-10.0, 15.0, 20.0],
    }
    warm = new_unit(9, LAYOUT, rest_s=REST_S).scenario.unit.calibration.model_dump(mode="json")
    warm["temperature"] = slopes
    both = [*six_faces_turned(), *six_faces_turned()[::-1]]
    unit = new_unit(
        9,
        LAYOUT,
        both,
        rest_s=REST_S,
        changes={"unit": {"calibration": warm, "temperature": {"start_degc": 20.0, "slope_k_per_h": 50.0}}},
    )
    pulses = sessions(unit)
    found = solve(pulses, temperature=True)
    for one in found.estimates:
        if one.path.startswith("temperature"):
            name, k = one.path.removeprefix("temperature.").removesuffix("]").split("[")
            assert one.observable, one.path
            assert abs(one.value - slopes[name][int(k)]) < 4.0 * one.sigma, one.path
    written = certificate(found).temperature
    end = 20.0 + 50.0 / 3600e9 * pulses["elapsed_ns"][-1]
    assert written.range_degc == pytest.approx((20.0, end), abs=0.3)  # what was measured, no more
    said = texts(solve(pulses), "caution")
    # 24 rests of 24 s and their motions: 50 K/h for 12 min
    assert re.search(r"The temperature moved by (9|1\d)\.\d K and no slopes are estimated", said)
    assert re.search(r"that is 0\.0\d+ deg/h, \d\d ug and \d\d ppm; use --temperature", said)


def test_in_a_steady_room_no_slope_is_certified(solve, session):
    found = solve(session, temperature=True)
    assert certificate(found).temperature is None
    assert "temperature.gyro_bias_deg_per_h_per_k[0]" in certificate(found).sensors.not_observable
    assert any("warms up" in text for text in found.missing)


# What is missing


def test_six_faces_as_six_files_give_what_they_show_and_say_what_to_add(solve, session, unit):
    alone = [pieces(session, 2 * k, 2 * k + 1) for k in range(6)]
    found = solve(*alone)
    assert found.mark == "note"
    assert len(found.evidence.links) == 0
    shown = {one.path for one in found.estimates if one.observable}
    assert {"accelerometer.scale_pulse_per_m_s[0]", "gyro.bias_deg_per_h[2]"} <= shown
    assert not shown & {
        "gyro.scale_arcsec_per_pulse[0]",
        "skew_ms",
        "size_effect.r_mm.x[0]",
        "accelerometer.C_ba[0][2]",
    }
    assert any("four quarter turns about" in text and "gyro.scale" in text for text in found.missing)
    with pytest.raises(
        InputError, match=r"not observable and not given with --start: gyro\.scale_arcsec_per_pulse"
    ):
        certificate(found)

    start = unit.scenario.unit.calibration
    kept = certificate(solve(*alone, start=start))
    assert kept.gyro.scale_arcsec_per_pulse == pytest.approx(start.gyro.scale_arcsec_per_pulse, rel=1e-11)
    assert kept.size_effect.r_m == pytest.approx(start.size_effect.r_m)
    assert "skew_ms" in kept.sensors.not_observable
    assert "accelerometer.scale_pulse_per_m_s[1]" in kept.sensors.covariance.names
    assert "gyro.scale_arcsec_per_pulse[0]" not in kept.sensors.covariance.names


def test_a_face_missing_names_what_its_axis_is_known_to(solve, session, unit):
    found = solve(pieces(session, 0, 10))  # without -Y
    assert found.mark == "note"
    said = re.fullmatch(
        r"Without a rest with -Y up, accelerometer Y is known to (\d+) ppm in its scale factor, "
        r"(\d+) ug/g\^2 in the quadratic term\.",
        texts(found, "note"),
    )
    assert said
    value, truth = {one.path: one for one in found.estimates}, true_numbers(unit)
    for size, path, scale in zip(
        said.groups(),
        ("accelerometer.scale_pulse_per_m_s[1]", "accelerometer.quadratic_ug_per_g2[1]"),
        (2000e-6, 1.0),
        strict=True,
    ):
        assert value[path].sigma == pytest.approx(float(size) * scale, rel=0.05)
        assert abs(value[path].value - truth[path]) < 4.0 * value[path].sigma


def test_one_loop_names_what_is_missing_and_the_loop_that_shows_it(solve):
    found = solve(sessions(new_unit(7, LAYOUT, three_loops()[:5], rest_s=REST_S)))  # about X
    assert found.mark == "note"
    assert set(found.not_observable) == {
        "gyro.C_bg[2][1]",
        "accelerometer.C_ba[1][0]",
        "accelerometer.quadratic_ug_per_g2[0]",
    }
    said = texts(found, "note")
    assert "Not observable, and kept at the start or left out: gyro.C_bg[2][1]" in said
    assert re.search(
        r"Without a rest with \+X, -X up, accelerometer X is known to \d+ ppm in its scale factor\.", said
    )
    (text,) = found.missing
    assert "four quarter turns about Y" in text
    assert "accelerometer.quadratic_ug_per_g2[0]" in text


def pieces(session: Records, first: int, stop: int) -> Records:
    """Cut out the rests from number `first` to before `stop`, with a bit of motion on both sides."""
    starts = rest_starts(session)
    begin = 0 if first == 0 else starts[first] - 40
    end = starts[stop] - 40 if stop < len(starts) else len(session)
    end = min(end, starts[stop - 1] + int(REST_S * RATE) + 40)
    return session[begin:end]


def rest_starts(session: Records) -> list[int]:
    """Samples at which the rests begin: the motion is the scenario's own."""
    starts, at = [0], int(REST_S * RATE)
    quiet = np.abs(np.diff(np.cumsum(session["gyro"], axis=0)[::10], axis=0)).max(axis=1) < 60
    while True:
        moving = np.flatnonzero(~quiet[at // 10 + 2 :])
        if not len(moving):
            return starts
        begin = at // 10 + 2 + int(moving[0])
        ends = [k for k in range(begin, len(quiet) - 20) if quiet[k : k + 20].all()]
        if not ends:
            return starts
        starts.append(ends[0] * 10)
        at = ends[0] * 10 + int(0.8 * REST_S * RATE)


def test_a_wander_that_few_residuals_show_counts_for_more_than_its_likely_size(result):
    found, rng = result.adjustment, np.random.default_rng(3)
    Z = _whole_basis(Free(), len(found.attitudes))
    root = np.linalg.cholesky(covariance_of(found.system, Wander(0.0, 5.0 * UG)))
    draws = (replace(found.system, residual=root @ rng.standard_normal(len(root))) for _ in range(60))
    sizes = [_wander(one, Z, found.p, 1e-5).accelerometer / UG for one in draws]
    # 8 degrees of freedom: 5 ug sqrt(8 / 6) = 5.8, known to 4 % from 60 draws
    assert 5.1 < np.sqrt(np.mean(np.square(sizes))) < 6.5


# Rests that are none, and losses


def test_a_plate_that_sinks_is_named_and_changes_nothing_else(solve, session, result):
    sinking = [
        {"rest": {"duration_s": 6.0}},
        {"rotate": {"angle_deg": 40 / 3600, "duration_s": 12.0, "axis_n": [1, 0.3, 0]}},
        {"rest": {"duration_s": 6.0}},
    ]
    found = solve(sessions(new_unit(7, LAYOUT, rest_s=REST_S, rests={4: sinking})))
    (left,) = found.evidence.left
    assert left.what == "rest"
    # 40 arcsec in all, less what falls into the quarters at the ends
    assert "as by a tilt of" in left.reason
    assert 30 < float(left.reason.split("tilt of ")[1].split()[0]) < 42
    assert len(found.evidence.rests) == 11
    assert len(found.evidence.links) == 10
    assert found.mark == "good"
    difference = [
        (a.value - b.value) / b.sigma
        for a, b in zip(result.estimates, found.estimates, strict=True)
        if a.is_shown
    ]
    assert np.abs(difference).max() < 3.0


def test_a_knock_divides_a_rest(solve):
    knock = {
        "rock": {
            "duration_s": 0.6,
            "band_hz": [3.0, 8.0],
            "ramp_s": 0.2,
            "rate_rms_deg_per_s": [3.0, 3.0, 1.0],
        }
    }
    parts = [{"rest": {"duration_s": 24.0}}, knock, {"rest": {"duration_s": 26.0}}]
    found = solve(sessions(new_unit(7, LAYOUT, rest_s=REST_S, rests={3: parts})))
    assert len(found.evidence.rests) == 13
    assert found.poses[3] == found.poses[4] == "-Z"
    short = min(found.evidence.links, key=lambda link: link.duration_s)
    assert short.duration_s < 5.0
    assert any("knock" in one.reason and one.what == "rest" for one in found.evidence.left)
    assert found.mark == "good"


def test_a_rest_of_more_than_half_an_hour_is_divided():
    long = [{"rest": {"duration_s": 2000.0}}]
    pulses = sessions(new_unit(7, LAYOUT, six_faces_turned()[:4], rest_s=REST_S, rests={2: long}))
    nominal = NominalScales(0.5 * ARCSEC, 2000.0)
    found = read_evidence([lambda: iter(np.array_split(pulses, 5))], LAYOUT, nominal)
    assert len(found.rests) == 5
    assert [one.reason for one in found.left] == ["it is long: divided into two rests"]


def test_dither_in_the_increments_is_taken_off_the_rates(tmp_path):
    layout = profiles.load("imu50-rs422").layout()  # 1 kHz: the filter needs it
    dither = {
        "amplitude_arcsec": [20.0, 20.0, 20.0],
        "frequency_hz": [395.0, 402.0, 410.0],
        "in_increments": 1.0,
        "case_reaction": 0.01,
    }
    unit = new_unit(5, layout, rest_s=REST_S, changes={"unit": {"dither": dither}})
    path = write_session(unit, layout, tmp_path)
    found = calibrate_sensors([path], site=SITE, unit=UNIT, profile="imu50-rs422")
    assert found.evidence.is_dithered
    assert [line.axis for line in found.evidence.dither] == ["X", "Y", "Z"]
    for line, hz in zip(found.evidence.dither, dither["frequency_hz"], strict=True):
        assert abs(line.frequency_hz - hz) <= 1.0  # a window of a second
        assert abs(line.amplitude_rad / ARCSEC - 20.0) < 2.0  # the pulses of half an arcsecond
    assert not any("dither" in one.text for one in found.verdict)
    truth = true_numbers(unit)
    arms = [one for one in found.estimates if one.path.startswith("size_effect")]
    # Without the filter they are wrong by up to 0.3 mm, 21 sigma.
    assert max(abs(one.value - truth[one.path]) / one.sigma for one in arms) < 4.0


def test_the_two_ends_of_a_loop_have_their_own_names():
    for name in ("three-loops", "loops-both"):
        procedure = load_procedure(name)
        assert named_poses([rest.C_bn.T for rest in procedure.rests], procedure) == tuple(
            rest.id for rest in procedure.rests
        )


def test_dither_that_contradicts_the_motions_is_named():
    line = DitherLine("Y", 402.0, 100.0 * ARCSEC)
    evidence = Evidence((), (), (), Noise(1e-7, 1e-5), (0.0, 0.0), dither=(line,))
    (said,) = dither_judgement(evidence)
    assert said.mark == "caution"
    assert "carry dither: 100 arcsec at 402 Hz about Y. Let the unit remove it" in said.text


def test_the_turn_that_a_procedure_plans_for_a_table_is_checked_against_the_gyros(result):
    def planned(deg: float) -> Procedure:
        pose = {"up": "+Z", "east": "-X", "turn": {"about": "+Z", "deg": deg, "seconds": 4}}
        poses = [{"id": "first", "up": "+Z", "east": "+X"}, {"id": "second", **pose}]
        head = {"format": "imu50-procedure", "version": 2, "name": "table", "kind": "sensors", "rest_s": 20}
        return parse({**head, "poses": poses}, Procedure, "table")

    right, wrong = (
        [
            one.text
            for one in solve_evidence(result.inputs, result.evidence, SensorsOptions(), planned(deg)).verdict
            if "turned" in one.text
        ]
        for deg in (180.0, -180.0)
    )
    assert right == []
    (text,) = wrong
    assert text.startswith("To second: turned ")
    assert text.endswith("the sign is wrong, in the file or of the gyro.")


def test_the_golden_set_gives_the_errors_that_were_injected(data, tmp_path):
    convert(data / "imusysclbt.bin", tmp_path / "golden.raw")
    site = Site(latitude_deg=34.0, longitude_deg=106.0, height_m=0.0)
    found = calibrate_sensors(
        [tmp_path / "golden.raw"],
        site=site.model_copy(update={"gravity_m_s2": site.gravity}),
        unit="golden",
        profile=str(FLOAT_PROFILE),
        options=SensorsOptions(pivot="fixed"),
    )
    worst = {name: np.abs(values).max() for name, values in errors(found, golden_truth()).items()}
    limits = {  # of the contract
        "gyro scale, ppm": 0.5,
        "C_bg, arcsec": 0.3,
        "gyro bias, deg/h": 1e-3,
        "K, ppm": 0.5,
        "a_i, arcsec": 0.3,
        "bias, ug": 0.5,
        "k2, ug/g^2": 0.5,
        "arms, mm": 0.1,
        "skew, ms": 0.005,
    }
    assert worst.keys() == limits.keys()
    assert [name for name in worst if worst[name] > limits[name]] == []


def test_frames_lost_while_carried_cost_that_motion(solve, session, result):
    at = rest_starts(session)[5] - 2 * RATE
    found = solve(np.delete(session, slice(at, at + 30)))
    (left,) = found.evidence.left
    assert (left.what, left.reason) == (
        "motion",
        "frames are lost in it: attitude and velocity are not carried over it",
    )
    assert (len(found.evidence.rests), len(found.evidence.links)) == (12, 10)
    scales = [
        next(e.sigma for e in r.estimates if e.path == "gyro.scale_arcsec_per_pulse[1]")
        for r in (result, found)
    ]
    assert scales[1] > scales[0]


def test_a_restart_of_the_unit_costs_the_motion_and_is_named(solve, session, result):
    at = rest_starts(session)[6] - 150  # while it is carried to the seventh rest
    after = session[at + 100 :].copy()
    after["counter"] -= after["counter"][0]  # as of a unit that was switched on again
    found = solve(np.concatenate([session[:at], after]))

    assert len(found.evidence.rests) == 12
    assert [(link.before, link.after) for link in found.evidence.links] == [
        (k, k + 1) for k in range(11) if k != 5
    ]
    (left,) = found.evidence.left
    assert left.reason == "the unit restarted: attitude and velocity are not carried over it"
    assert left.start_s == pytest.approx(at / RATE, abs=0.1)
    assert found.evidence.captures == (0, 0)
    document = result_document(found)
    assert document["left_out"][0]["capture"] == "session-0.raw"
    assert len(document["sensors"]["captures"]) == 1
    change = [
        abs(a.value - b.value) / b.sigma
        for a, b in zip(result.estimates, found.estimates, strict=True)
        if a.is_shown
    ]
    assert max(change) < 2.0  # the same rests, but for one motion


def test_frames_lost_at_rest_leave_its_longer_part(solve, session):
    at = rest_starts(session)[6] + 2 * RATE
    found = solve(np.delete(session, slice(at, at + 3)))
    motion, part = found.evidence.left
    assert ("frames are lost in it" in motion.reason, "less than 20 s" in part.reason) == (True, True)
    assert len(found.evidence.rests) == 12
    assert found.evidence.rests[6].duration_s < REST_S - 3.0
    assert len(found.evidence.links) == 10  # the loss is in the motion before it


def test_a_loss_of_a_sample_or_two_at_rest_divides_it_as_well(session):
    short = session[: rest_starts(session)[4]].copy()
    short["flags"] = 1
    at = rest_starts(session)[2] + 3 * RATE
    short["flags"][at] |= int(Flag.MISSING_BEFORE)
    nominal = NominalScales(0.5 * ARCSEC, 2000.0)
    found = read_evidence([lambda: iter(np.array_split(short, 7))], LAYOUT, nominal)
    motion, part = found.left
    assert (motion.what, part.what) == ("motion", "part of a rest")
    assert "frames are lost: its longer part" in part.reason
    assert part.start_s < found.rests[2].start_s - 0.5
    assert len(found.links) == 2


@pytest.mark.parametrize(("at_rest", "what"), [(True, "rest"), (False, "motion")])
def test_saturated_samples_cost_the_rest_or_the_motion(solve, session, at_rest, what):
    spoilt = session.copy()
    begin = rest_starts(session)[5]
    at = begin + 10 * RATE if at_rest else begin - 2 * RATE
    spoilt["status"][at : at + 5] |= 1 << 10
    found = solve(spoilt)
    assert what in [one.what for one in found.evidence.left]
    assert all("5 saturated or faulted samples" in one.reason for one in found.evidence.left)
    assert len(found.evidence.rests) == (11 if at_rest else 12)
    assert len(found.evidence.links) == (9 if at_rest else 10)


def test_too_few_rests_are_refused_and_a_short_one_is_named(solve, session):
    words = r"expected at least 3 rests of 20 s in different poses, got 2\n"
    words += r"  rest at [\d.]+ to [\d.]+ s: it lasts 1\d\.\d s, less than 20 s"
    starts = rest_starts(session)
    with pytest.raises(InputError, match=words):
        solve(session[: starts[2] + 15 * RATE])


# Axes, scales, site


def swapped(session: Records, sensor: str, order: list[int], signs: list[int]) -> Records:
    out = session.copy()
    out[sensor] = session[sensor][:, order] * signs
    return out


@pytest.mark.parametrize(
    ("sensor", "order", "signs", "words"),
    [
        (
            "accelerometer",
            [1, 0, 2],
            [1, 1, 1],
            "Accelerometers X and Y are exchanged: write axis x of the field y, axis y",
        ),
        ("gyro", [0, 1, 2], [1, -1, 1], "Gyro Y is reversed: write sign: -1 for it in the profile"),
        ("accelerometer", [0, 1, 2], [1, 1, -1], "Accelerometer Z is reversed: write sign: -1"),
        ("gyro", [0, 1, 2], [-1, -1, -1], "The axes are left-handed"),
    ],
)
def test_exchanged_and_reversed_axes_are_named(solve, session, sensor, order, signs, words):
    found = solve(swapped(session, sensor, order, signs))
    assert found.mark == "bad"
    assert words in texts(found, "bad")
    with pytest.raises(InputError, match="no certificate"):
        certificate(found)
    assert result_document(found)["certificate"] is False


@pytest.mark.parametrize(
    ("sensor", "words"),
    [
        ("accelerometer", r"Accelerometer Y has 1\.30\d of its nominal scale"),
        ("gyro", r"Gyro Y has \d\.\d+ of its"),
    ],
)
def test_a_scale_far_off_nominal_is_named_with_its_ratio(solve, session, sensor, words):
    spoilt = session.copy()
    spoilt[sensor][:, 1] = np.diff(np.rint(1.3 * np.cumsum(session[sensor][:, 1])), prepend=0)
    found = solve(spoilt)
    assert found.mark == "bad"
    assert any(re.search(words, one.text) for one in found.verdict)


def test_the_scales_of_another_profile_are_named(solve, session):
    other = PROFILE.nominal.model_copy(update={"accelerometer_pulse_per_m_s": 1000.0})
    said = texts(solve(session, profile=PROFILE.model_copy(update={"nominal": other})), "bad")
    for axis in "XYZ":
        assert re.search(rf"Accelerometer {axis} has (1\.9|2\.0)\d\d of its nominal scale", said)
    assert "more than 20% off: another profile, or a faulty channel" in said


def test_the_verdict_follows_the_language(result):
    chinese = [text(one.what, "zh_CN") for one in result.verdict]
    assert any("个静止段、" in sentence for sentence in chinese)
    assert not any(re.search("[a-z]{3,} [a-z]{2,}", sentence) for sentence in chinese)


def test_without_measured_gravity_the_scales_are_uncertain_alike(solve, session, result):
    found = solve(session, site=SITE.model_copy(update={"gravity_m_s2": None}))
    assert found.mark == "note"
    assert "Gravity was not measured: normal gravity" in texts(found, "note")
    value = {one.path: one for one in found.estimates}
    assert value["accelerometer.scale_pulse_per_m_s[0]"].sigma / 2000 == pytest.approx(51e-6, rel=0.02)
    before = {one.path: one.sigma for one in result.estimates}
    for path in ("gyro.scale_arcsec_per_pulse[0]", "accelerometer.bias_ug[0]", "accelerometer.C_ba[0][1]"):
        assert value[path].sigma == pytest.approx(before[path], rel=0.02)


def test_a_wrong_latitude_is_seen_and_the_measured_rate_is_used(solve, session, unit):
    found = solve(session, site=SITE.model_copy(update={"latitude_deg": 33.2}))
    assert found.mark == "caution"
    assert "the rests show a latitude of 31.2" in texts(found, "caution")
    assert "the site says 33.20 deg" in texts(found, "caution")
    truth = true_numbers(unit)
    biases = [one for one in found.estimates if one.path.startswith("gyro.bias")]
    assert max(abs(one.value - truth[one.path]) / one.sigma for one in biases) < 4.0


def test_the_latitude_of_the_other_hemisphere_is_refused(solve, session):
    with pytest.raises(
        InputError, match=r"the latitude that force and rate of the rests show, \+31\.\d deg, got -31\.20 deg"
    ):
        solve(session, site=SITE.model_copy(update={"latitude_deg": -31.2}))


def test_compensated_increments_are_refused(solve, tmp_path):
    path = tmp_path / "increments.i50n"
    path.write_bytes(b"I50N\x01" + bytes(200))
    words = r"increments\.i50n: .*they are compensated already and hold no pulses"
    with pytest.raises(InputError, match=words):
        solve(captures=[path])


def test_the_same_capture_twice_is_refused(solve, session):
    with pytest.raises(
        InputError, match=r"session-1\.raw: expected another capture, got that of session-0\.raw once more"
    ):
        solve(session, session)


# The command


@pytest.fixture
def here(session: Records, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a session, its site and its profile, as the current one."""
    (tmp_path / "session.raw").write_bytes(StreamEncoder(LAYOUT).encode(session).tobytes())
    settings_file.write(tmp_path / "site.yaml", SITE)
    text = (Path(profiles.__file__).parent / "imu50-rs422.yaml").read_text()
    (tmp_path / "slow.yaml").write_text(re.sub("sample_rate_hz: .*", "sample_rate_hz: 100", text))
    monkeypatch.chdir(tmp_path)
    return tmp_path


COMMAND = ("sensors", "session.raw", "--profile", "slow.yaml", "--site", "site.yaml", "--unit", UNIT)


def test_the_command_writes_certificate_report_and_json(here, capsys):
    (here / "plan.yaml").write_text(PLAN)
    outputs = ["-o", "unit.yaml", "--json", "r.json", "--report", "r.html", "--procedure", "plan.yaml"]
    assert main([*COMMAND, *outputs]) == 0
    text = capsys.readouterr().out
    assert "12 rests and 11 motions; 34 of 34 numbers are observable" in text
    assert "Planned and not found: z-tilted." in text
    assert re.search(r"x-up +\d+\.\d +\d\d\.\d", text)
    assert "unit.yaml: certificate of unit 50-0017" in text
    document = json.loads((here / "r.json").read_text())
    assert document["certificate"] is True
    assert [one["pose"] for one in document["sensors"]["rests"]][:2] == ["z-up", "z-up"]
    page = (here / "r.html").read_text()
    assert page.count("data:image/svg+xml") == 3  # residuals, attitudes, temperatures
    assert read_calibration("unit.yaml").serial_number == UNIT
    assert main([*COMMAND, "-o", "unit.yaml", "--start", "unit.yaml"]) == 0  # the older one is kept
    assert len(list(here.glob("unit*.yaml"))) == 2


PLAN = """
format: imu50-procedure
version: 1
name: some poses
poses:
  - {id: z-up, up: +Z, east: +X, turn_deg: 180}
  - {id: x-up, up: +X, east: +Y, turn_deg: 180}
  - {id: z-tilted, up: +Z, east: +Y, turn_deg: 180}
"""


def test_a_bad_verdict_has_its_own_exit_code_and_leaves_the_report(here, session, capsys):
    spoilt = swapped(session, "gyro", [0, 1, 2], [1, -1, 1])
    (here / "session.raw").write_bytes(StreamEncoder(LAYOUT).encode(spoilt).tobytes())
    assert main([*COMMAND, "-o", "unit.yaml", "--report", "r.html", "--json", "r.json"]) == 3
    assert "unit.yaml: no certificate: Gyro Y is reversed" in capsys.readouterr().out
    assert not (here / "unit.yaml").exists()
    assert "Gyro Y is reversed" in (here / "r.html").read_text()
    assert json.loads((here / "r.json").read_text())["certificate"] is False


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--without", "bias"], "--without: expected quadratic or skew, got bias"),
        (
            ["--start", "other.yaml"],
            "--start: expected the calibration of unit '50-0017', got that of '50-0018'",
        ),
        (["--procedure", "nothing"], "nothing"),
    ],
)
def test_a_wrong_option_is_refused(here, capsys, more, words):
    other = new_unit(1, LAYOUT).scenario.unit.calibration
    write_calibration(here / "other.yaml", other.model_copy(update={"serial_number": "50-0018"}))
    assert main([*COMMAND, "-o", "unit.yaml", *more]) == 2
    assert words in capsys.readouterr().err


# The plan


def test_the_plan_predicts_the_uncertainty_that_is_stated_then(result):
    poses = [pose for up, east in FACES for pose in (PlannedPose(up, east), turned(PlannedPose(up, east)))]
    planned = predict_sensors([poses], site=SITE, rest_s=REST_S)
    assert (planned.rank, planned.unknowns) == (31, 31)
    stated = {one.path: one.sigma for one in result.estimates if one.is_shown}
    ratios = np.array(
        [
            sigma / stated[one.path]
            for one, sigma in zip(planned.numbers, planned.sigma, strict=True)
            if one.path in stated
        ]
    )
    # the plan knows neither the wander found then, in five degrees of freedom, nor how the hand will move
    assert 0.3 < ratios.min() < ratios.max() < 1.6
    assert 0.75 < np.median(ratios) < 1.25


@pytest.mark.parametrize(
    ("poses", "rank"),
    [
        (
            [[("+Z", "+X")], [("-Z", "-X")], [("+X", "+Y")], [("-X", "-Y")], [("+Y", "+Z")], [("-Y", "-Z")]],
            12,
        ),
        ([[("+Z", "+X"), ("+Z", "+Y"), ("+Z", "-X"), ("+Z", "-Y")]], 18),
    ],
)
def test_a_plan_that_shows_little_says_so(poses, rank):
    sessions = [[PlannedPose(*pose) for pose in session] for session in poses]
    planned = predict_sensors(sessions, site=SITE)
    assert abs(planned.rank - rank) <= 1  # of 31
    lacking = set(planned.not_observable)
    assert {"accelerometer.quadratic_ug_per_g2[0]", "accelerometer.C_ba[0][2]"} <= lacking
    attitudes = [[pose.C_nb for pose in session] for session in sessions]
    found = list(additions(attitudes, planned.not_observable, site=SITE, rest_s=60.0, free=Free()))
    assert "turn" in found[0].text
    assert set().union(*(one.paths for one in found)) == lacking  # three of them show everything
