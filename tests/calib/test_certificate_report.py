"""The report of a session is a calibration certificate: who, what, where, how uncertain."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest

from calib.bench.entries import CertificateFile, EmbeddedFile, Plan, from_json, to_json
from calib.bench.run import RunOptions, run
from calib.estimation.budget import uncertainty_by_source
from calib.estimation.joint import estimate_joint
from calib.estimation.result import TO_DIFFERENCES, LeverArmEstimate
from calib.identification import IdentificationResult, PriorCalibration, identify
from calib.lever_arms.gauge import convert
from calib.messages import LANGUAGES, message
from calib.reports.certificate import Particulars, documents
from calib.reports.document import MARKS, Document, KeyValues, Paragraph, Table
from calib.reports.html import as_html
from calib.reports.pdf import BROWSERS, write_pdf
from imudrv.arrays import Array
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
Made: TypeAlias = tuple[Particulars, dict[str, Document]]
WRONG = {"angle_deg": 150.0, "expected_deg": 180.0, "tolerance_deg": 5.0}


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A half turn in each of three poses, of the simulated unit."""
    folder, made = tmp_path_factory.mktemp("certificate"), []
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
        made.append(folder / f"{pose}.raw")
        made[-1].write_bytes(b"".join(data for data, _ in record(scenario, layout)))
    return made


@pytest.fixture(scope="module")
def identification(captures: list[Path]) -> IdentificationResult:
    prior = PriorCalibration(NOMINAL.without_size_effect(), "unit.yaml", "0f" * 32)
    return identify(captures, site=SITE, calibration=prior, profile="imu50-rs422")


@pytest.fixture(scope="module")
def made(identification: IdentificationResult) -> Made:
    particulars = Particulars(
        number="50-0017-20261126-0123abcd",
        bench=BENCH,
        operator="Wang Li",
        received="2026-11-20",
        procedure=message("procedure_edition", name="three-rotations", edition="0123", software="imu50 0.1"),
        measured=("2026-11-25", "2026-11-26"),
        attempts=(
            (message("attempt_rejected", step="x-up", attempt=1), message("wrong_angle", **WRONG)),
            (message("step_skipped", step="y-up"), message("by_the_operator")),
        ),
        verified=message("residual_velocity", without_mm_s=90.0, compensated_mm_s=1.0),
    )
    arms = identification.arms
    return particulars, documents(identification, (arms, convert(arms, "x")), particulars)


def test_it_has_every_item_and_names_what_is_blank(made: Made) -> None:
    particulars, certificate = made[0], made[1]["en"]
    page = as_html(certificate, number=particulars.number, watermark="SIMULATED")
    text = re.sub(r"<[^>]+>", " ", page)
    for words in (
        "Calibration certificate 50-0017-20261126-0123abcd",
        "Laboratory &lt;1&gt;",
        "Wang Li",
        "three-rotations, edition by SHA-256 0123, imu50 0.1",
        "2026-11-20",
        "2026-11-25 to 2026-11-26",
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
        "Left blank, as not stated: address, bench, authorised by.",
    ):
        assert words in text, words
    assert certificate.sections[-1].blocks[-1] == Paragraph("End of the certificate.")
    assert 'content: "50-0017-20261126-0123abcd"' in page
    assert "counter(page)" in page
    assert '<div class="watermark">SIMULATED</div>' in page
    assert 'class="watermark"' not in as_html(Document("", "", ()))


def test_the_lines_of_the_budget_add_up_to_the_stated_uncertainty(
    made: Made, identification: IdentificationResult
) -> None:
    (section,) = [s for s in made[1]["en"].sections if s.title == "Uncertainty budget"]
    inputs, *tables = [block for block in section.blocks if isinstance(block, Table)]
    result = identification.result
    for table, covariance in zip(
        tables, (result.differences_covariance, identification.arms.covariance), strict=True
    ):
        rows = {row[0]: np.array(row[1:], float) for row in table.rows}
        combined, expanded = rows.pop("combined, u"), rows.pop("U, k = 2")
        assert [row[0] for row in inputs.rows] == list(rows)
        # of numbers rounded to 0.1 um
        assert np.sqrt(sum(part**2 for part in rows.values())) == pytest.approx(combined, abs=3e-4)
        assert combined == pytest.approx(np.sqrt(np.diag(covariance)) / MM, abs=6e-5)
        assert expanded == pytest.approx(2.0 * combined, abs=2e-4)
        assert all(part.min() >= 0.0 for part in rows.values())
    # what the sum over a half turn cancels, or leaves
    assert rows["accelerometer misalignment"].max() > rows["accelerometer scale factor"].max()


def test_the_sources_add_up_to_the_covariance_also_where_the_errors_are_correlated(
    identification: IdentificationResult,
) -> None:
    runs, priors = identification.runs, identification.priors
    sigma = np.sqrt(np.diag(priors.shared_covariance))
    share = np.random.default_rng(7).normal(size=(len(sigma), 3))
    correlated = replace(
        priors, covariance=np.diag(sigma**2) + 0.3 * np.outer(sigma, sigma) * (share @ share.T)
    )
    for one in (priors, correlated):
        sources = uncertainty_by_source(runs, one)
        site, covariance = sources.pop("site"), estimate_joint(runs, one).covariance
        assert np.trace(site) < 1e-6 * np.trace(covariance)
        total = sum(sources.values())
        assert total == pytest.approx(covariance, abs=1e-9 * np.abs(covariance).max())  # of inverse matrices
        assert ("correlation" in sources) == (one is correlated)


def test_a_line_is_the_shift_that_the_error_of_its_source_makes(
    identification: IdentificationResult, captures: list[Path]
) -> None:
    runs, priors = identification.runs, identification.priors
    sources = uncertainty_by_source(runs, priors)

    def stated_mm(source: str) -> Array:
        return np.sqrt(np.diag(TO_DIFFERENCES @ sources[source] @ TO_DIFFERENCES.T)) / MM

    def shift_mm(other: LeverArmEstimate) -> Array:
        return np.abs(other.differences - identification.result.differences).ravel() / MM

    skewed = estimate_joint(runs, replace(priors, expected_skew=priors.skew))
    assert shift_mm(skewed) == pytest.approx(stated_mm("skew"), rel=1e-2)  # what is of second order
    # the site as if it were known that wrongly: latitude and gravity one after the other
    moved = []
    for change in ({"latitude_deg": SITE.latitude_deg + 0.01}, {"gravity_m_s2": SITE.gravity + 50e-5}):
        site = SITE.model_copy(update=change)
        prior = identification.prior_calibration
        moved.append(shift_mm(identify(captures, site=site, calibration=prior, profile="imu50-rs422").result))
    assert np.hypot(*moved) == pytest.approx(stated_mm("site"), abs=2e-5)  # a tenth of it


@pytest.mark.parametrize("language", LANGUAGES)
def test_the_certificate_is_in_each_language(language: str, made: Made) -> None:
    certificate, english = made[1][language], made[1]["en"]
    text = "".join(map(str, certificate.sections))
    words = {
        "en": ("combined, u", "rejected: x-up, attempt 1", "turned 150.0 deg"),
        "zh_CN": ("合成，u", "不合格：x-up，第1次", "转了150.0度"),
    }
    for word in words[language]:
        assert word in text
    fixed = r"[+-]?\d+\.\d{4}"  # the numbers of results and budget
    assert re.findall(fixed, str(certificate.sections[2:4])) == re.findall(fixed, str(english.sections[2:4]))
    if language != "en":
        for ours in certificate.sections[:8]:
            paragraphs = [block.text for block in ours.blocks if isinstance(block, Paragraph)]
            assert not [text for text in paragraphs if re.search("[a-z]{3} [a-z]{2}", text)]


def test_a_browser_prints_it_with_pages(made: Made, tmp_path: Path) -> None:
    if not any(map(shutil.which, BROWSERS)):
        pytest.skip("there is no browser on this system")
    page = tmp_path / "page.html"
    page.write_text(as_html(made[1]["zh_CN"], number="n", watermark="SIMULATED", language="zh_CN"))
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


def test_everything_on_a_chinese_certificate_but_names_is_chinese(made: Made) -> None:
    certificate, words = made[1]["zh_CN"], []
    for section in certificate.sections:
        words.append(section.title)
        for block in section.blocks:
            if isinstance(block, KeyValues):
                words += [name for name, _ in block.rows if name not in MARKS]
            else:
                words.append(block.text if isinstance(block, Paragraph) else block.title)
    assert [one for one in words if not re.search("[一-鿿]", one)] == 4 * [
        "SHA-256"
    ]  # of the calibration and three captures
    assert len(words) > 80
