"""The report: whole, self-contained, safe, and the same as text."""

import re
from base64 import b64decode
from dataclasses import replace
from functools import partial
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from rich.cells import cell_len

from calib.estimation.dither_line import DitherLine
from calib.estimation.result import ChiSquare, LeaveOneOut
from calib.identification import IdentificationResult, PriorCalibration, identify
from calib.lever_arms.gauge import LeverArms, convert
from calib.messages import english
from calib.messages import text as translated
from calib.reports.identification import arms_text, document, report_html, terminal_document
from calib.reports.text import as_text
from calib.reports.verdict import verdict
from imudrv.cli import main as imudrv
from imudrv.sim.scenario import NOMINAL
from imudrv.site import Site
from imudrv.units import ARCSEC, MM

HOSTILE = "<img src=x onerror=alert(1)>&\x1b[31m$\\frac{长名字}$" + 60 * "z"
SCENARIO = """
format: imu50-scenario
version: 1
seed: 11
site: {{latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}}
start: {{pose: {pose}, tilt_mrad: [2, -1]}}
motion:
  - rest: {{duration_s: 40}}
  - rotate: {{angle_deg: 180, duration_s: 2.5}}
  - rest: {{duration_s: 6}}
  - rotate: {{angle_deg: 30, duration_s: 2.0}}
  - rest: {{duration_s: 2}}
unit:
  noise: {{arw_deg_per_sqrt_h: 0.002, vrw_m_s_per_sqrt_h: 0.003}}
"""


def verdict_texts(identification: IdentificationResult) -> list[tuple[str, str]]:
    return [(mark, english(text)) for mark, text in verdict(identification)]


@pytest.fixture(scope="module")
def identification(tmp_path_factory: pytest.TempPathFactory) -> IdentificationResult:
    """Three poses, a hostile file name, a unit whose number is markup; a second, small turn in each."""
    folder = tmp_path_factory.mktemp("report")
    captures = []
    for name, pose in ((HOSTILE, "z_up"), ("x", "x_up"), ("y", "y_up")):
        (folder / "run.yaml").write_text(SCENARIO.format(pose=pose))
        captures.append(folder / f"{name}.raw")
        out = ["-o", str(captures[-1])]
        assert imudrv(["sim", str(folder / "run.yaml"), "--profile", "imu50-rs422", *out]) == 0
    unit = NOMINAL.model_copy(update={"serial_number": "50<b>&17"})
    site = Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0)
    prior = PriorCalibration(unit, "<u>.yaml", "0f" * 32)
    return identify(captures, site=site, calibration=prior, profile="imu50-rs422")


@pytest.fixture(scope="module")
def arms(identification: IdentificationResult) -> tuple[LeverArms, LeverArms]:
    return identification.arms, convert(identification.arms, "x")


@pytest.fixture(scope="module")
def page(identification: IdentificationResult, arms: tuple[LeverArms, LeverArms]) -> str:
    return report_html(identification, arms)


class Tags(HTMLParser):
    """Every tag with its attributes; and whether they nest."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_loads_nothing_and_runs_nothing(page: str) -> None:
    tags = Tags(page)
    assert tags.open == []
    assert {tag for tag, _ in tags.found}.isdisjoint(
        {"script", "link", "iframe", "object", "embed", "form", "b", "u"}
    )
    for _, attributes in tags.found:
        assert not [
            name for name in attributes if name.startswith("on") or name in ("href", "srcset", "style")
        ]
        assert attributes.get("src", "data:image/svg+xml;base64,").startswith("data:image/svg+xml;base64,")
    assert not re.search(r"https?://|@import|url\(", page)
    assert len(page) < 1_500_000


def test_its_figures_are_complete_and_load_nothing_from_elsewhere(page: str) -> None:
    images = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', page)
    assert len(images) == 1 + 3 + 1 + 1  # points, a run each, before and after, directions
    for image in images:
        drawing = b64decode(image).decode()
        assert drawing.rstrip().endswith("</svg>")
        assert "<script" not in drawing
        assert not re.search(r'(?:href|src)="(?!#)', drawing)


def test_text_from_files_is_escaped(
    page: str, identification: IdentificationResult, arms: tuple[LeverArms, LeverArms]
) -> None:
    assert "<img src=x" not in page
    assert "&lt;img src=x onerror=alert(1)&gt;&amp;" in page
    assert "50&lt;b&gt;&amp;17" in page
    assert "\x1b" not in page
    assert "\x1b" not in as_text(document(identification, arms))


def test_on_a_terminal_the_verdict_is_last_and_the_rest_only_on_request(
    identification: IdentificationResult, arms: tuple[LeverArms, LeverArms]
) -> None:
    short = as_text(terminal_document(identification, arms))
    last = short.rstrip().splitlines()[-8:]
    assert any(line.strip().startswith("good") for line in last)
    assert len(short.splitlines()) < 45  # a screen, of the 258 lines of the whole
    whole = as_text(terminal_document(identification, arms, verbose=True))
    assert whole.index("THE ESTIMATE") < whole.index("RESULT")
    assert whole.rstrip().splitlines()[-8:] == last


def test_the_text_fits_80_columns_whatever_the_names(
    identification: IdentificationResult, arms: tuple[LeverArms, LeverArms]
) -> None:
    text = as_text(document(identification, arms))
    assert max(map(cell_len, text.splitlines())) <= 80
    assert not re.search(r"[ \t]$", text, re.MULTILINE)
    assert 60 * "z" in re.sub(r"\s", "", text)  # folded, not cut


def test_a_report_is_a_function_of_the_findings(
    page: str, identification: IdentificationResult, arms: tuple[LeverArms, LeverArms]
) -> None:
    assert report_html(identification, arms) == page


def test_text_and_page_show_the_same_numbers(
    page: str, identification: IdentificationResult, arms: tuple[LeverArms, LeverArms]
) -> None:
    numbers = re.compile(r"[+-]\d+\.\d+")
    body = re.sub(r'src="[^"]*"|<style>.*</style>', "", page, flags=re.DOTALL)
    assert set(numbers.findall(as_text(document(identification, arms)))) == set(numbers.findall(body))


def test_lever_arms_are_always_shown_with_their_gauge(
    identification: IdentificationResult, arms: tuple[LeverArms, LeverArms]
) -> None:
    text = as_text(document(identification, arms))
    heads = [line for line in text.splitlines() if line.startswith("  Sensing points in body axes")]
    assert heads == [f"  Sensing points in body axes, mm, gauge {gauge}" for gauge in ("centroid", "x")]
    assert len(re.findall(r"^  r_x  ", text, re.MULTILINE)) == 2
    assert "gauge x" in arms_text(arms[1])
    assert "基准x" in arms_text(arms[1], partial(translated, language="zh_CN"))
    assert "gauge x" in arms_text(LeverArms(arms[1].r_b, None, "x"))


def test_every_rotation_has_a_verdict_or_a_reason_for_rejection(
    identification: IdentificationResult, arms: tuple[LeverArms, LeverArms]
) -> None:
    text = " ".join(as_text(document(identification, arms)).split())
    assert text.count("deg off the vertical; then") == 3
    assert text.count("turned 30.0 deg, expected 180 +- 5") == 3


def marks_of(identification: IdentificationResult, **changes: object) -> list[tuple[str, str]]:
    result = replace(identification.result, **changes)  # type: ignore[arg-type]
    return verdict_texts(replace(identification, result=result))


def test_the_verdict_is_that_of_the_worst_test(identification: IdentificationResult) -> None:
    n, marks = 200, {}
    for ratio in (0.5, 1.0, 1.5, 3.0):
        marks[ratio] = marks_of(identification, scatter=ChiSquare(ratio * n, n), redundancy=ChiSquare(6.0, 6))
    assert [marks[ratio][0][0] for ratio in marks] == ["note", "note", "caution", "bad"]  # skew: a note
    scatter = [next(mark for mark in found if mark[1].startswith("Scatter")) for found in marks.values()]
    assert [mark for mark, _ in scatter] == ["note", "good", "caution", "caution"]
    assert "by a factor of 1.22" in scatter[2][1]
    assert "No certificate is made" in marks[3.0][1][1]


@pytest.mark.parametrize(("value", "level"), [(0.2, "note"), (6.0, "good"), (16.0, "caution"), (40.0, "bad")])
def test_rotations_that_disagree_are_a_caution_or_bad(
    identification: IdentificationResult, value: float, level: str
) -> None:
    marks = marks_of(identification, redundancy=ChiSquare(value, 6))
    (found,) = (mark for mark in marks if mark[1].startswith("Redundancy"))
    assert found[0] == level
    assert f"chi-square {value:.1f} with 6 degrees of freedom, 95 % band 1.2 to 14.4" in found[1]


def test_dither_in_the_increments_is_a_bad_verdict_with_the_remedy(
    identification: IdentificationResult,
) -> None:
    runs = identification.result.runs
    shaken = replace(runs[0], H_rest=0.07, lines=(DitherLine("X", 150.0, 3.0 * ARCSEC),))
    marks = marks_of(identification, runs=(shaken, *runs[1:]), dither_error=8.0)
    bad = [text for mark, text in marks[1:] if mark == "bad"]
    assert len(bad) == 1
    assert bad[0].startswith(
        "No certificate is made: the gyro increments carry dither or vibration (3 arcsec at 150 Hz about X)"
    )
    assert "H is 0.07 m/s per m" in bad[0]
    assert "which costs 8 sigma, expected at most 0.1" in bad[0]
    assert "let the unit remove its dither" in bad[0]


def test_three_rotations_are_noted_as_not_checked(identification: IdentificationResult) -> None:
    marks = verdict_texts(identification)
    assert {mark for mark, _ in marks} <= {"good", "note"}
    overall, text = marks[0]
    assert overall == "note"
    assert "determined by 3 rotations" in text
    assert "Tested: the scatter at rest (" in text
    assert "agreement" not in text
    notes = " ".join(text for mark, text in marks if mark == "note")
    assert "Arms determined, not checked: no redundant rotation" in notes
    assert "include a skew of 0.5 ms" in notes


@pytest.mark.parametrize(("p_shift", "level"), [(2.0, "good"), (20.0, "caution")])
def test_each_rotation_is_judged_against_its_own_sigma(
    identification: IdentificationResult, p_shift: float, level: str
) -> None:
    shift = np.zeros((3, 3))
    shift[1, 2] = -0.02 * MM
    marks = marks_of(
        identification,
        redundancy=ChiSquare(6.0, 6),
        leave_one_out=(
            LeaveOneOut("z", 6, shift, np.full((3, 3), 0.01 * MM), ChiSquare(p_shift, 2)),
            LeaveOneOut("x", 4, None, None, None),
        ),
    )
    (found,) = (mark for mark in marks if mark[1].startswith("Omitting"))
    assert found[0] == level
    assert (
        "z, which fits worst, changes a component by 0.0200 mm, standard uncertainty of that 0.0100 mm"
        in (found[1])
    )


@pytest.mark.parametrize(
    ("site", "text"),
    [
        ({"latitude_deg": 29.2}, "the site's is 29.20 deg"),
        ({"gravity_m_s2": 9.7970}, "gravity at the site 9.79700 m/s^2"),
    ],
)
def test_a_site_that_the_alignment_contradicts_is_a_caution(
    identification: IdentificationResult, site: dict[str, float], text: str
) -> None:
    assert not any("check the site" in sentence for _, sentence in verdict_texts(identification))
    wrong = replace(identification, site=identification.site.model_copy(update=site))
    cautions = [sentence for mark, sentence in verdict_texts(wrong) if mark == "caution"]
    assert sum(text in sentence for sentence in cautions) == 3


def test_digits_follow_the_uncertainty(identification: IdentificationResult) -> None:
    r_b = np.full((3, 3), 1.23456789 * MM)
    coarse = arms_text(LeverArms(r_b, np.diag(np.full(9, (0.25 * MM) ** 2)), "given"))
    fine = arms_text(LeverArms(r_b, np.diag(np.full(9, (0.0123 * MM) ** 2)), "given"))
    assert "+1.23  +1.23  +1.23  0.25" in coarse
    assert "+1.235  +1.235  +1.235  0.012" in fine


def test_the_report_names_files_by_name_only(page: str, tmp_path: Path) -> None:
    assert str(tmp_path.parent) not in page
