"""First look at a capture: every sample is in the envelope, and the page loads nothing."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from imudrv import Capture
from imudrv.cli import main
from imudrv.plot import MOST, Envelope, Overview
from imudrv.profiles import load
from imudrv.sim.capture import record
from imudrv.sim.scenario import NOMINAL, Faults, Rest, Scenario, Segment, Silence
from imudrv.site import Site

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds at rest, ten samples of which are lost on the wire."""
    path = tmp_path_factory.mktemp("plot") / "rest.raw"
    scenario = Scenario(
        format="imu50-scenario",
        version=1,
        seed=1,
        site=Site(latitude_deg=28.0, longitude_deg=113.0, height_m=60.0),
        motion=(Segment(rest=Rest(duration_s=3.0)),),
        faults=Faults(silences=(Silence(at_s=1.0, duration_s=0.01),)),
    )
    path.write_bytes(b"".join(data for data, _ in record(scenario, load("imu50-rs422").layout())))
    return path


@given(pieces=st.lists(st.integers(0, 6000), max_size=8), seed=st.integers(0, 100))
def test_an_envelope_has_every_spike_whatever_the_pieces(pieces: list[int], seed: int) -> None:
    values = np.random.default_rng(seed).standard_normal((sum(pieces), 2))
    envelope, at = Envelope(2), 0
    for n in pieces:
        envelope.feed(values[at : at + n])
        at += n
    low, high = envelope.bounds

    assert len(low) <= 2 * MOST + 1
    if len(values):
        assert np.array_equal(low.min(axis=0), values.min(axis=0))
        assert np.array_equal(high.max(axis=0), values.max(axis=0))


@pytest.mark.parametrize("name", ["out.png", "out.html"])
def test_a_capture_is_drawn_without_knowing_its_profile(name: str, capture: Path, tmp_path: Path) -> None:
    assert main(["plot", str(capture), "-o", str(tmp_path / name)]) == 0
    drawn = (tmp_path / name).read_bytes()
    if name.endswith("png"):
        assert drawn.startswith(PNG)
    else:
        assert b"data:image/png;base64," in drawn
        assert b"http" not in drawn.replace(b"http-equiv", b"")


def test_rates_need_a_calibration_and_losses_are_counted(capture: Path) -> None:
    bare = Overview(Capture(capture, "imu50-rs422"), None, lambda _: None)
    whole = Overview(Capture(capture, "imu50-rs422"), NOMINAL, lambda _: None)
    titles = [[panel.title.split(",")[0] for panel in shown.panels] for shown in (bare, whole)]

    assert titles[0] == ["gyro", "accelerometer", "samples", "temperature"]
    assert titles[1] == ["gyro", "accelerometer", "rate", "specific force", "samples", "temperature"]
    _, losses = whole.panels[-2].envelope.bounds
    assert losses[-1].tolist() == [10.0, 0.0]
    _, force = whole.panels[3].envelope.bounds
    low, _ = whole.panels[3].envelope.bounds
    assert low[:, 2].min() < 9.79 < force[:, 2].max()  # gravity is in the band of the pulse noise


def test_only_a_png_or_a_page_is_made(capture: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["plot", str(capture), "-o", "out.gif"]) == 2
    assert "expected a name ending in .png or .html" in capsys.readouterr().err
