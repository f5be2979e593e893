"""Alignment of a rest in a capture, and what it says about the site."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import calib
from calib.alignment import RestAlignment
from calib.cli import main
from imudrv import profiles
from imudrv.calibration import write_calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.nav.earth import earth_rate_n
from imudrv.sim.capture import record
from imudrv.sim.scenario import NOMINAL, Scenario
from imudrv.site import Site
from imudrv.units import DEG, DEG_PER_H

PROFILE = "imu50-rs422"
SITE = {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0, "gravity_m_s2": 9.7917}
HEADING_DEG = 12.0  # clockwise, seen from above: X, which is east, turns to the south
TILT_MRAD = (3.0, -2.0)  # of the upper axis, to the east and to the north


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute of rest, a turn, and two minutes of rest; with the unit's certificate and site."""
    folder = tmp_path_factory.mktemp("align")
    document = {
        "format": "imu50-scenario",
        "version": 1,
        "seed": 4,
        "site": SITE,
        "start": {"pose": "z_up", "heading_deg": HEADING_DEG, "tilt_mrad": TILT_MRAD},
        "motion": [
            {"rest": {"duration_s": 60}},
            {"rotate": {"angle_deg": 90, "duration_s": 3}},
            {"rest": {"duration_s": 120}},
        ],
        "unit": {"noise": {"arw_deg_per_sqrt_h": 0.002, "vrw_m_s_per_sqrt_h": 0.003}},
    }
    scenario = settings_file.parse(document, Scenario, "rests")
    layout = profiles.load(PROFILE).layout()
    (folder / "rests.raw").write_bytes(b"".join(data for data, _ in record(scenario, layout)))
    write_calibration(folder / "unit.yaml", NOMINAL.without_size_effect())
    settings_file.write(folder / "site.yaml", settings_file.parse(SITE, Site, "site"))
    return folder


Align = Callable[..., RestAlignment]


@pytest.fixture
def align(here: Path) -> Align:
    def aligned(window_s: tuple[float, float] | None = None, **site: float) -> RestAlignment:
        where = settings_file.parse({**SITE, **site}, Site, "site")
        return calib.align(
            here / "rests.raw",
            site=where,
            calibration=here / "unit.yaml",
            profile=PROFILE,
            window_s=window_s,
        )

    return aligned


def test_level_and_heading_are_the_true_ones_within_three_sigma(align: Align) -> None:
    result = align((1.0, 59.0))

    heading_sigma_deg = result.aligned.heading_sigma_rad / DEG
    level_sigma_deg = result.aligned.level_sigma_rad / DEG
    assert result.up == "+Z"
    # X pointed east before the heading was turned clockwise
    assert result.azimuth_deg[0] == pytest.approx(90.0 + HEADING_DEG, abs=3.0 * heading_sigma_deg)
    # Z leans by (3, -2) mrad: what points there points down
    C, S = np.cos(HEADING_DEG * DEG), np.sin(HEADING_DEG * DEG)
    x_n, y_n = np.array([C, -S]), np.array([S, C])
    expected_deg = -1e-3 / DEG * np.array([x_n @ TILT_MRAD, y_n @ TILT_MRAD])
    np.testing.assert_allclose(result.elevation_deg[:2], expected_deg, atol=3.0 * level_sigma_deg)
    assert heading_sigma_deg < 0.5
    assert level_sigma_deg < 0.01
    assert result.verdicts[0][0] == "good"


def test_the_longest_rest_is_used_without_a_window(align: Align) -> None:
    result = align()

    assert result.begin_s == pytest.approx(64.0, abs=0.5)  # a second of margin
    assert result.end_s == pytest.approx(182.0, abs=0.5)
    assert result.azimuth_deg[0] == pytest.approx(
        HEADING_DEG, abs=3.0 * result.aligned.heading_sigma_rad / DEG
    )


def test_the_readings_of_the_right_site_agree(align: Align) -> None:
    up, level, force = align().comparisons

    _, north, vertical = earth_rate_n(28.2 * DEG)
    assert (up.of_site, level.of_site, force.of_site) == (vertical, north, 9.7917)
    for compared in (up, level, force):
        assert compared.agrees
    # 0.01 deg/h of the prior, and half a pulse of 0.5 arcsec over two minutes
    assert up.sigma < 0.02 * DEG_PER_H


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"latitude_deg": 29.2}, "the vertical part of the Earth's rotation is"),
        ({"gravity_m_s2": 9.7967}, "the specific force is"),  # 500 mGal
    ],
)
def test_a_degree_of_latitude_and_500_mgal_are_cautions(
    align: Align, wrong: dict[str, float], words: str
) -> None:
    verdicts = align(**wrong).verdicts

    assert any(mark == "caution" and text.startswith(words) for mark, text in verdicts), verdicts


def test_the_wrong_hemisphere_is_refused(align: Align) -> None:
    with pytest.raises(InputError, match=r"rests\.raw: .*vertical part .*-7\.11 deg/h .*got \+7\.1.*sign of"):
        align(latitude_deg=-28.2)


def test_a_window_with_a_turn_in_it_is_bad(align: Align) -> None:
    # 0.055 deg of a turn that begins at 60 s: the mean rate is 3 deg/h more
    mark, text = align((0.12, 60.12)).verdicts[0]

    assert mark == "bad"
    assert "the unit moved" in text


@pytest.mark.parametrize(
    ("window_s", "words"),
    [
        ((0.0, 20.0), "expected a length of 30 to 7200 s"),
        ((100.0, 300.0), "expected samples from 100 to 300 s, got 83.0 s of them"),
        ((50.0, 40.0), "expected a rest that begins before it ends"),
    ],
)
def test_a_window_that_is_not_in_the_capture_is_refused(
    align: Align, window_s: tuple[float, float], words: str
) -> None:
    with pytest.raises(InputError, match=words):
        align(window_s)


def test_the_command_prints_attitude_and_comparison(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = ["--calibration", str(here / "unit.yaml"), "--site", str(here / "site.yaml")]
    window = ["--from", "1", "--to", "59"]

    assert main(["align", str(here / "rests.raw"), "--profile", PROFILE, *files, *window]) == 0

    shown = capsys.readouterr().out
    assert "rests.raw, 1.0 to 59.0 s, +Z up" in shown
    assert "good  at rest, and the readings are those of the site" in shown
    for words in ("from north to east", "above horizon", "sigma", "specific force, m/s^2"):
        assert words in shown
    assert main(["align", str(here / "rests.raw"), "--profile", PROFILE, *files, "--from", "1"]) == 2
