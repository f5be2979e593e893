"""Findings as files: what the certificate keeps, what it refuses, and the JSON document."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from calib.certificate import (
    PROVENANCE_CONVERTED,
    PROVENANCE_IDENTIFIED,
    certificate,
    check_target,
    lever_arms_of,
    with_lever_arms,
    write,
)
from calib.detection.acceptance import RotationLimits
from calib.estimation.noise import SensorNoise
from calib.estimation.priors import Priors
from calib.estimation.result import (
    CENTROID_BASIS,
    ChiSquare,
    LeverArmEstimate,
    ParameterEstimate,
    RunResult,
    TurnResult,
)
from calib.identification import IdentificationResult, PriorCalibration
from calib.lever_arms.gauge import convert
from calib.messages import verbatim
from calib.result_file import result_document, write_json
from imudrv.calibration import Calibration, read_calibration, write_calibration
from imudrv.errors import InputError
from imudrv.sim.scenario import NOMINAL
from imudrv.site import Site
from imudrv.units import MM

R = np.array([[23.5, -11.25, -9.0], [-22.75, 29.0, -7.0], [-0.75, -17.75, 16.0]]) * MM
SPREAD = CENTROID_BASIS * [1e-5, 1.1e-5, 1.2e-5, 1.8e-5, 1.9e-5, 2e-5]
WHEN = datetime(2026, 11, 25, 12, 0, tzinfo=UTC)


def identification(**changes: object) -> IdentificationResult:
    of_run = RunResult(
        label="z",
        turns=(TurnResult("z", True, np.array([0.2, -0.1, 0.0]), np.zeros((3, 9)), np.zeros(3)),),
        H_rest=1e-4,
        rate_filter="dither",
        lines=(),
        t_s=np.arange(4.0),
        v_n=np.full((4, 2), 1e-3),
        fitted_n=np.full((4, 2), 0.5e-3),
    )
    result = LeverArmEstimate(
        method="joint",
        gauge="centroid",
        R_b=R,
        covariance=SPREAD @ SPREAD.T,
        rank=6,
        direction_sigma=np.array([1e-5, 1.1e-5, 1.2e-5, 1.8e-5, 1.9e-5, 2e-5, 1.0, 1.0, 1.0]),
        singular_values=np.array([8.0, 8.0, 8.0, 4.7, 4.7, 4.7, 0.0, 0.0, 0.0]),
        reason=verbatim("rank 6"),
        scatter=ChiSquare(90.0, 100, 200),
        redundancy=ChiSquare(5.0, 6),
        dither_error=0.01,
        noise=SensorNoise(1e-6, 1e-5, 200),
        parameters=(ParameterEstimate("accelerometer_bias_x", 1e-4, 2e-4, 5e-4),),
        correlation=np.full((9, 1), 0.1),
        leave_one_out=(),
        runs=(of_run,),
        notes=(),
    )
    return IdentificationResult(
        result=replace(result, **changes),  # type: ignore[arg-type]
        prior_calibration=PriorCalibration(unit(), "unit.yaml", "ab" * 32),
        site=Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0),
        limits=RotationLimits(),
        priors=Priors(),
        sources=(),
        created=WHEN,
        software="imu50 test",
    )


def unit(serial_number: str = "50-0017") -> Calibration:
    provenance = {
        "static": "turntable, 2026-11-01",
        PROVENANCE_IDENTIFIED: "an earlier one",
        PROVENANCE_CONVERTED: "an earlier one",
    }
    return NOMINAL.model_copy(update={"serial_number": serial_number, "provenance": provenance})


def test_a_certificate_read_from_its_file_has_the_same_arms_covariance_and_gauge(tmp_path: Path) -> None:
    found = identification()
    path = tmp_path / "new.yaml"
    write(path, certificate(found, found.arms), None)
    read = read_calibration(path, "50-0017")
    assert read.created == WHEN
    assert read.size_effect is not None
    assert read.size_effect.gauge == "centroid"
    back = lever_arms_of(read, "new.yaml")
    # the file has nanometres, and 1e-9 mm^2
    np.testing.assert_allclose(back.r_b, R, rtol=0, atol=0.51e-9)
    assert back.covariance is not None
    np.testing.assert_allclose(back.covariance, SPREAD @ SPREAD.T, rtol=0, atol=0.51e-15)
    assert np.linalg.matrix_rank(back.covariance, tol=1e-13) == 6


def test_the_certificate_keeps_the_static_calibration_and_has_the_provenance_of_the_arms() -> None:
    found = identification()
    new = certificate(found, found.arms)
    assert new.gyro == found.prior_calibration.calibration.gyro
    assert new.accelerometer == found.prior_calibration.calibration.accelerometer
    assert new.provenance is not None
    assert new.provenance["static"] == "turntable, 2026-11-01"
    assert PROVENANCE_CONVERTED not in new.provenance  # of arms that are no more
    how = new.provenance[PROVENANCE_IDENTIFIED]
    assert isinstance(how, dict)
    assert how["calibration"] == {"name": "unit.yaml", "sha256": "ab" * 32}
    assert how["rank"] == 6
    assert how["scatter"]["chi_square"] == 90.0
    assert how["redundancy"]["degrees_of_freedom"] == 6
    assert how["site"] == {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0}
    assert how["differences_mm"] == {
        "x_minus_y": pytest.approx([46.25, -40.25, -2.0]),
        "x_minus_z": pytest.approx([24.25, 6.5, -25.0]),
    }
    assert how["residual_scatter_mm_s"] == {"z": 0.0}  # a constant offset is none


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scatter": ChiSquare(250.0, 100, 200)}, r"expected chi-square of about 100, got 250"),
        ({"redundancy": ChiSquare(60.0, 6)}, r"the turns contradict each other: .*of about 6, got 60\.0"),
        (
            {"dither_error": 8.0},
            r"the gyro increments carry dither.*0\.0001 m/s per m .*\(z\).*costs 8 sigma",
        ),
    ],
)
def test_nothing_is_certified_that_the_data_contradict(changes: dict[str, object], message: str) -> None:
    found = identification(**changes)
    with pytest.raises(InputError, match=f"no certificate: .*{message}"):
        certificate(found, found.arms)


def test_as_many_equations_as_unknowns_contradict_nothing() -> None:
    found = identification(
        scatter=None,
        redundancy=ChiSquare(0.0, 0),
        method="plain",
        parameters=(),
        correlation=np.zeros((9, 0)),
    )
    assert certificate(found, found.arms).size_effect is not None


def test_another_units_certificate_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "other.yaml"
    write_calibration(path, unit("50-0018"))
    before = path.read_bytes()
    found = identification()
    with pytest.raises(InputError, match="got that of '50-0018'"):
        write(path, certificate(found, found.arms), None)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_is_no_certificate_is_not_written_over(tmp_path: Path) -> None:
    path = tmp_path / "notes.yaml"
    path.write_text("remember: the milk\n")
    with pytest.raises(
        InputError, match=r"expected the certificate of unit '50-0017', or no file yet, got a file that is no"
    ):
        check_target(path, unit())


def test_the_units_own_certificate_is_kept_beside_the_new_one(tmp_path: Path) -> None:
    path = tmp_path / "unit.yaml"
    write_calibration(path, unit())
    before = path.read_bytes()
    found = identification()
    write(path, certificate(found, found.arms), None)
    (kept,) = set(tmp_path.iterdir()) - {path}
    assert kept.read_bytes() == before


def test_a_gauge_converted_to_and_fro_through_calibrations_is_the_same_to_a_nanometre() -> None:
    found = identification()
    first = certificate(found, found.arms)
    for gauge in ("x", "z", "centroid"):
        first = with_lever_arms(
            first, convert(lever_arms_of(first, "it"), gauge), PROVENANCE_CONVERTED, {"to": gauge}
        )  # type: ignore[arg-type]
    back = lever_arms_of(first, "it")
    np.testing.assert_allclose(back.r_b, R, rtol=0, atol=3e-9)  # rounded to nm three times
    assert back.covariance is not None
    np.testing.assert_allclose(back.covariance, SPREAD @ SPREAD.T, rtol=0, atol=1e-14)
    assert first.provenance is not None
    assert PROVENANCE_IDENTIFIED in first.provenance


def test_a_calibration_without_arms_has_none_to_convert() -> None:
    bare = NOMINAL.model_copy(update={"size_effect": None})
    with pytest.raises(InputError, match=r"bare.yaml: expected a calibration with size_effect"):
        lever_arms_of(bare, "bare.yaml")


def test_the_json_document_has_the_whole_result_with_units_in_its_names(tmp_path: Path) -> None:
    found = identification(runs=())
    path = tmp_path / "r.json"
    write_json(path, result_document(found, convert(found.arms, "x")))
    document = json.loads(path.read_text())
    assert document["format"] == "imu50-identification"
    assert document["version"] == 1
    assert document["gauge"] == "x"
    np.testing.assert_allclose(document["r_mm"]["y"], (R[1] - R[0]) / MM, rtol=0, atol=1e-12)
    assert len(document["singular_values_m_s_per_m"]) == 9
    assert document["rank"] == 6
    assert np.shape(document["covariance_mm2"]) == (9, 9)
    assert np.shape(document["differences_covariance_mm2"]) == (6, 6)
    assert np.shape(document["correlation_of_differences_with_parameters"]) == (6, 1)
    assert document["parameters_si"][0]["name"] == "accelerometer_bias_x"
