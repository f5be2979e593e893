"""The public names of `imudrv` in a notebook, and the examples of all docstrings, on a simulated capture."""

import doctest
import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from realtime import DEADLINE_S
from samples import record

import imudrv
from imudrv.calibration import write_calibration
from imudrv.cli import main
from imudrv.sim.scenario import NOMINAL

SCENARIO = """
format: imu50-scenario
version: 1
seed: 5
site: {latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}
motion: [{rest: {duration_s: 1.0}}]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("notebook")
    (folder / "rest.yaml").write_text(SCENARIO)
    capture = ["-o", str(folder / "z_up.raw")]
    assert main(["sim", str(folder / "rest.yaml"), "--profile", "imu50-rs422", *capture]) == 0
    write_calibration(folder / "unit.yaml", NOMINAL)
    record(folder / "run.mcap", 30)
    return folder


@pytest.fixture
def here(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(folder)
    return folder


TOP = Path(imudrv.__file__).parents[1]
WITH_EXAMPLES = sorted(
    ".".join(path.relative_to(TOP).with_suffix("").parts).removesuffix(".__init__")
    for package in ("imudrv", "calib")
    for path in (TOP / package).rglob("*.py")
    if ">>> " in path.read_text()
)


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_the_examples_of_docstrings_are_true(here: Path, name: str) -> None:
    module = importlib.import_module(name)
    failed, tried = doctest.testmod(module, extraglobs={"imudrv": imudrv, "np": np})
    assert tried == Path(str(module.__file__)).read_text().count(">>> ")
    assert failed == 0


def test_importing_the_package_loads_no_large_library_and_the_calibration_no_kernel() -> None:
    code = (
        "import sys, imudrv; assert not {'numba', 'numpy', 'pydantic'} & set(sys.modules), 'imudrv'; "
        "import imudrv.calibration; assert 'numba' not in sys.modules, 'imudrv.calibration'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=DEADLINE_S)


def test_every_public_name_exists_and_no_other_is_listed() -> None:
    code = (
        "import imudrv, imudrv.cli; from imudrv import *; "
        "assert dir(imudrv) == sorted(imudrv.__all__); "
        "assert {type(getattr(imudrv, name)).__name__ for name in dir(imudrv)}.isdisjoint({'module'})"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=DEADLINE_S)
    with pytest.raises(AttributeError, match="'imudrv' has no attribute 'Captur'"):
        _ = imudrv.Captur  # type: ignore[attr-defined]


def test_increments_are_those_of_the_stages_one_by_one(here: Path) -> None:
    profile = imudrv.load_profile("imu50-rs422")
    capture = imudrv.Capture(here / "z_up.raw", profile)
    layout = capture.layout
    compensator = imudrv.Compensator(
        imudrv.coefficients(imudrv.read_calibration("unit.yaml")),
        layout,
        "centred",
    )
    expected = np.concatenate(list(capture.increments(compensator)))
    for given in (capture, "z_up.raw"):  # a capture can be read again, from its beginning
        more = {"profile": profile} if given == "z_up.raw" else {}
        got = imudrv.compensate(given, "unit.yaml", rate_filter="centred", **more)  # type: ignore[arg-type]
        np.testing.assert_array_equal(got, expected)
    assert capture.tracker.counts.frames == 1000


def test_progress_is_the_number_of_bytes_read(here: Path) -> None:
    read: list[int] = []
    imudrv.compensate("z_up.raw", NOMINAL, profile="imu50-rs422", advance=read.append)
    assert sum(read) == Path("z_up.raw").stat().st_size


def test_a_missing_calibration_or_a_second_profile_is_an_error_that_says_what_to_do(here: Path) -> None:
    capture = imudrv.Capture("z_up.raw", "imu50-rs422")
    with pytest.raises(imudrv.InputError, match="expected a calibration, for the file contains none; give"):
        imudrv.compensate(capture)
    with pytest.raises(imudrv.InputError, match="no profile beside a Capture"):
        imudrv.compensate(capture, "unit.yaml", profile="imu50-can")
