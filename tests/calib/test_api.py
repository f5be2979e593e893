"""The package in a notebook: paths in, results out."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.identification import IdentificationResult
from imudrv.calibration import write_calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.files.settings_file import parse
from imudrv.profiles import load
from imudrv.sim.capture import record
from imudrv.sim.scenario import NOMINAL, Scenario
from imudrv.site import Site
from imudrv.units import MM

PROFILE = "imu50-rs422"
TRUE_MM = np.array([[24.0, -11.0, -9.0], [-23.0, 29.0, -7.0], [-1.0, -18.0, 16.0]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, site: Site) -> Path:
    """Captures of three half turns, with the unit's certificate and the site."""
    folder = tmp_path_factory.mktemp("notebook")
    settings_file.write(folder / "site.yaml", site)
    unit = parse(
        {
            **NOMINAL.model_dump(mode="json", exclude_none=True),
            "size_effect": {"r_mm": dict(zip("xyz", TRUE_MM.tolist(), strict=True)), "gauge": "centroid"},
        },
        type(NOMINAL),
        "unit",
    )
    write_calibration(folder / "unit.yaml", unit)
    for pose in ("z_up", "x_up", "y_up"):
        document = {
            "format": "imu50-scenario",
            "version": 1,
            "seed": 7,
            "site": site.model_dump(exclude_none=True, exclude={"format", "version"}),
            "start": {"pose": pose},
            "motion": [
                {"rest": {"duration_s": 42.0}},
                {"rotate": {"angle_deg": 180.0, "duration_s": 2.5}},
                {"rest": {"duration_s": 6.0}},
            ],
            "unit": {
                "calibration": unit.model_dump(mode="json", exclude_none=True),
                "noise": {"arw_deg_per_sqrt_h": 0.002, "vrw_m_s_per_sqrt_h": 0.003},
            },
        }
        wire = record(parse(document, Scenario, pose), load(PROFILE).layout())
        (folder / f"{pose}.raw").write_bytes(b"".join(data for data, _ in wire))
    return folder


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(folder)
    return folder


@pytest.fixture(scope="module")
def result(folder: Path) -> IdentificationResult:
    return calib.identify(
        [folder / f"{pose}.raw" for pose in ("z_up", "x_up", "y_up")],
        calibration=folder / "unit.yaml",
        site=folder / "site.yaml",
        profile=PROFILE,
    )


def test_the_arms_are_identified_from_paths(result: IdentificationResult) -> None:
    # noise alone: the six differences are known to some 0.02 mm, five sigma at most
    assert np.abs(result.arms.r_b / MM - TRUE_MM).max() < 0.1
    assert result.prior_calibration.name == "unit.yaml"
    assert [source.name for source in result.sources] == ["z_up.raw", "x_up.raw", "y_up.raw"]


def test_names_are_as_good_as_paths(here: Path, result: IdentificationResult) -> None:
    again = calib.identify(
        ["z_up.raw", "x_up.raw", "y_up.raw"], calibration="unit.yaml", site="site.yaml", profile=PROFILE
    )
    assert again.result.R_b.tobytes() == result.result.R_b.tobytes()
    assert again.prior_calibration == result.prior_calibration


def test_the_options_choose_the_method(here: Path, result: IdentificationResult) -> None:
    plain = calib.identify(
        ["z_up.raw", "x_up.raw", "y_up.raw"],
        calibration=result.prior_calibration,
        site=result.site,
        profile=load(PROFILE),
        options=calib.EstimationOptions("plain"),
    )
    assert plain.result.method == "plain"
    assert result.result.method == "joint"
    with pytest.raises(InputError, match="method plain: expected pivot free, six components"):
        calib.EstimationOptions("plain", pivot="fixed")


def test_one_capture_is_a_list_of_one(here: Path) -> None:
    with pytest.raises(InputError, match="Z up alone is not enough: add captures with X up and Y up"):
        calib.identify("z_up.raw", calibration="unit.yaml", site="site.yaml", profile=PROFILE)


@pytest.mark.parametrize(
    ("captures", "message"),
    [
        ([], "captures: expected one file at least, got none"),
        (["z_up.raw"], "expected a calibration, got a capture without one"),
    ],
)
def test_without_a_calibration_the_captures_have_to_contain_one(
    here: Path, captures: list[str], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        calib.identify(captures, site="site.yaml", profile=PROFILE)


def test_a_capture_is_validated_with_its_lever_arms(here: Path) -> None:
    # identification needs no arms, compensation does; with the true ones hardly any velocity is left
    settings = {"calibration": "unit.yaml", "site": Path("site.yaml"), "profile": PROFILE}
    validation = calib.validate("z_up.raw", **settings, align_s=30.0)
    assert validation.good
    assert validation.trial.name == "z_up.raw"
    assert "z_up.raw: good; velocity after the motion" in repr(validation)
    write_calibration(here / "bare.yaml", NOMINAL.without_size_effect())
    with pytest.raises(InputError, match="expected a calibration with size_effect"):
        calib.validate("z_up.raw", **{**settings, "calibration": "bare.yaml"}, align_s=30.0)


def test_the_accuracy_of_a_procedure_is_predicted(here: Path, site: Site) -> None:
    three, six = (
        calib.predict(f"{n}-rotations", site="site.yaml").differences_sigma for n in ("three", "six")
    )
    assert (six < three).all()
    procedure = calib.load_procedure("three-rotations")
    np.testing.assert_array_equal(calib.predict(procedure, site=site).differences_sigma, three)
    rotations = [calib.PlannedRotation(axis) for axis in ("+Z", "+X", "+Y")]
    slow = [replace(rotation, duration_s=5.0) for rotation in rotations]
    fast, slower = (calib.predict(plan, site=site).differences_sigma for plan in (rotations, slow))
    assert (slower > fast).all()


def test_a_session_is_opened_by_its_path(tmp_path: Path) -> None:
    for folder in (tmp_path, os.fspath(tmp_path)):
        with pytest.raises(InputError, match="session"):
            calib.Session.open(folder)


def test_results_are_short_in_a_notebook(result: IdentificationResult, site: Site) -> None:
    prediction = calib.predict("three-rotations", site=site)
    for shown in (result, result.arms, prediction):
        assert len(repr(shown)) < 250
        assert "\n" not in repr(shown)
        html = shown._repr_html_()
        assert html.count("<table>") == html.count("</table>") == 1
        assert html.count("<tr>") == (3 if shown is prediction else 4)
    assert repr(result).startswith("<IdentificationResult: unit nominal, method joint, 3 rotations, rank 6, ")
    assert repr(result).endswith("mm: usable for a certificate>")
    assert f"r_x ({result.arms.r_b[0, 0] / MM:+.3f}, " in repr(result.arms)
    assert "±" not in calib.LeverArms(result.arms.r_b, None, "given")._repr_html_()


def test_html_is_escaped(result: IdentificationResult) -> None:
    unit = result.prior_calibration.calibration.model_copy(update={"serial_number": "<b>&"})
    hostile = replace(result, prior_calibration=result.prior_calibration._replace(calibration=unit))
    assert "unit &lt;b&gt;&amp;," in hostile._repr_html_()


def test_the_package_lists_its_public_names() -> None:
    assert dir(calib) == sorted(calib.__all__)
    for name in dir(calib):
        assert getattr(calib, name).__name__ == name
    with pytest.raises(AttributeError, match="module 'calib' has no attribute 'identity'"):
        calib.identity  # noqa: B018


def test_importing_the_package_is_cheap() -> None:
    program = "import sys, calib; print({'numpy', 'numba', 'scipy', 'imudrv'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
