"""The report of a session is a calibration certificate: who, what, where, how uncertain."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from calib.bench.entries import CertificateFile, EmbeddedFile, Plan, from_json, to_json
from calib.bench.run import RunOptions, run
from calib.identification import IdentificationResult, PriorCalibration, identify
from calib.lever_arms.gauge import convert
from calib.messages import message
from calib.reports.certificate import Particulars, document
from calib.reports.document import Document, Table
from calib.reports.html import as_html
from calib.reports.pdf import BROWSERS, write_pdf
from imudrv.bench import Bench, Instrument, UnitKind
from imudrv.cli import main as imudrv
from imudrv.errors import InputError
from imudrv.profiles import load as load_profile
from imudrv.sim.capture import record
from imudrv.sim.scenario import NOMINAL, Rest, Rotate, Scenario, Segment, Start
from imudrv.site import Site
from imudrv.terminal import console
from imudrv.units import MM

SITE = Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0)
BENCH = Bench(
    laboratory="Laboratory <1>",
    customer="Flight test",
    unit=UnitKind(maker="Example", type="50"),
    instruments=(Instrument(name="gravity survey", certificate="G-1", valid_until="2027-01-31"),),
)


@pytest.fixture(scope="module")
def identification(tmp_path_factory: pytest.TempPathFactory) -> IdentificationResult:
    """A half turn in each of three poses, of the simulated unit."""
    folder, captures = tmp_path_factory.mktemp("certificate"), []
    layout = load_profile("imu50-rs422").layout()
    rest, turn = Segment(rest=Rest(duration_s=40.0)), Segment(rotate=Rotate(angle_deg=180.0, duration_s=2.5))
    for pose in ("z_up", "x_up", "y_up"):
        scenario = Scenario(
            format="imu50-scenario",
            version=1,
            seed=3,
            site=SITE,
            start=Start(pose=pose),
            motion=(rest, turn, rest),
        )
        captures.append(folder / f"{pose}.raw")
        captures[-1].write_bytes(b"".join(data for data, _ in record(scenario, layout)))
    prior = PriorCalibration(NOMINAL.without_size_effect(), "unit.yaml", "0f" * 32)
    return identify(captures, site=SITE, calibration=prior, profile="imu50-rs422")


@pytest.fixture(scope="module")
def made(identification: IdentificationResult) -> tuple[Particulars, Document]:
    particulars = Particulars(
        number="50-0017-20261126-0123abcd",
        bench=BENCH,
        operator="Wang Li",
        procedure="three-rotations, SHA-256 0123",
        measured="2026-11-26",
        attempts=(
            ("rejected: x-up, attempt 1", "turned 150.0 deg, want 180 +- 5"),
            ("skipped: y-up", "by the operator"),
        ),
        verified=message("residual_velocity", without_mm_s=90.0, compensated_mm_s=1.0),
        is_simulated=False,
    )
    arms = identification.arms
    return particulars, document(identification, (arms, convert(arms, "x")), particulars)


def test_it_has_every_item_and_names_what_is_blank(made: tuple[Particulars, Document]) -> None:
    particulars, certificate = made
    page = as_html(certificate, number=particulars.number)
    text = re.sub(r"<[^>]+>", " ", page)
    for words in (
        "Calibration certificate 50-0017-20261126-0123abcd",
        "Laboratory &lt;1&gt;",
        "Wang Li",
        "three-rotations, SHA-256 0123",
        "gravity survey",
        "coverage probability of about 95 %",
        "Angle: half turns, closed by the direction of gravity and the rotation of the Earth.",
        "Acceleration: local gravity",
        "Time: the unit's clock".replace("'", "&#x27;"),
        "no lever arms: the size effect was not compensated",
        "90.0 mm/s without size-effect compensation, 1.0 mm/s with it",
        "Decision rule",
        "rejected: x-up, attempt 1",
        "skipped: y-up",
        "relate only to this item",
        "signature",
        "Left blank, as not stated: address, bench, authorised by, received.",
    ):
        assert words in text, words
    assert certificate.sections[-1].title == "End of the certificate"
    assert 'content: "50-0017-20261126-0123abcd"' in page
    assert "counter(page)" in page
    assert 'class="watermark"' not in page
    assert '<div class="watermark">SIMULATED</div>' in as_html(certificate, watermark="SIMULATED")


def test_the_sources_add_up_to_the_uncertainty(
    made: tuple[Particulars, Document], identification: IdentificationResult
) -> None:
    (section,) = [s for s in made[1].sections if s.title == "Uncertainty budget"]
    (budget,) = [block for block in section.blocks if isinstance(block, Table)]
    rows = {row[0]: np.array(row[1:], float) for row in budget.rows}
    combined, expanded = rows.pop("combined, u"), rows.pop("U, k = 2")

    # of numbers rounded to 0.1 um
    assert np.sqrt(sum(part**2 for part in rows.values())) == pytest.approx(combined, abs=3e-4)
    assert combined == pytest.approx(identification.result.differences_sigma.ravel() / MM, abs=6e-5)
    assert expanded == pytest.approx(2.0 * combined, abs=2e-4)
    # what the sum over a half turn cancels, or leaves: skew beside noise is the largest
    assert rows["gyro-accelerometer skew"].max() > rows["accelerometer scale factor"].max()
    assert all(part.min() >= 0.0 for part in rows.values())


def test_a_browser_prints_it_with_pages(made: tuple[Particulars, Document], tmp_path: Path) -> None:
    if not any(map(shutil.which, BROWSERS)):
        pytest.skip("there is no browser on this system")
    page = tmp_path / "page.html"
    page.write_text(as_html(made[1], number="n", watermark="SIMULATED"))
    write_pdf(page, tmp_path / "page.pdf")
    assert (tmp_path / "page.pdf").read_bytes().startswith(b"%PDF-")


def test_without_a_program_for_pdf_the_session_does_not_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputError, match="--pdf: expected one of chromium"):
        run(RunOptions(tmp_path / "s", rehearse=True, pdf=True), console())
    assert not (tmp_path / "s").exists()


def test_another_unit_than_that_of_the_certificate_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected unit 'rehearsal' of the certificate, got '50-0018'"):
        run(RunOptions(tmp_path / "s", rehearse=True, unit="50-0018"), console())


def test_a_bench_file_is_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bench.yaml"
    path.write_text("{format: imu50-bench, version: 1, instruments: [{name: a, valid_until: 2027-01-31}]}")
    assert imudrv(["check", str(path)]) == 0
    path.write_text("{format: imu50-bench, version: 1, bench: 3b, instruments: [{valid_until: soon}]}")
    assert imudrv(["check", str(path)]) == 2
    shown = capsys.readouterr().err
    assert "instruments" in shown
    assert "valid_until" in shown


def test_a_plan_of_an_older_version_has_no_bench_and_no_operator() -> None:
    file = EmbeddedFile.of("a", b"text")
    before = CertificateFile(Path("/c"), "0" * 64)
    plan = Plan("imu50-session", 1, "imu50 0.1", "50", "p", before, file, file, file, file, "Wang")
    line = to_json(plan)
    assert from_json(line) == plan
    del line["bench"], line["operator"]
    older = from_json(line)
    assert isinstance(older, Plan)
    assert (older.bench, older.operator) == (None, "")
