"""Captures whose good frames do not continue the counter that the profile describes."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from imudrv import Capture
from imudrv.cli import main
from imudrv.profiles import load
from imudrv.records import PULSES
from imudrv.wire.encode import StreamEncoder

COUNT = 400
RANDOM = np.random.default_rng(1).integers(0, 2**31, COUNT)
FOUND = "most of the 400 good frames do not continue the counter: "


def written(path: Path, counters: NDArray[np.int64]) -> Path:
    """A capture with these counters."""
    samples = np.zeros(len(counters), PULSES)
    samples["counter"] = counters
    path.write_bytes(StreamEncoder(load("imu50-rs422").layout()).encode(samples).tobytes())
    return path


@pytest.mark.parametrize(
    ("counters", "advice"),
    [
        (
            np.arange(COUNT) * 10,
            "it advances by 10 from frame to frame: if that is one sample, set `step: 10`",
        ),
        (np.arange(COUNT) * 5000, "set `step: 5000` of the counter in the profile"),
        (1000 - np.arange(COUNT), "it advances by -1 from frame to frame"),
        (np.full(COUNT, 7), "it does not change: check its offset in the profile"),
        (RANDOM, "check offset, type and byte order of the counter in the profile"),
    ],
    ids=["ten", "microseconds", "backward", "still", "random"],
)
def test_a_capture_whose_frames_do_not_continue_the_counter_is_a_failure_that_says_what_to_set(
    counters: NDArray[np.int64], advice: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = written(tmp_path / "unit.raw", counters)
    assert main(["decode", str(capture), "--profile", "imu50-rs422", "-o", str(tmp_path / "out.npz")]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"error: {capture}: {FOUND}")
    assert advice in message


@pytest.mark.parametrize(
    "counters",
    [
        np.arange(COUNT),
        np.delete(np.arange(2 * COUNT), np.s_[200 : COUNT + 200]),  # one gap, as long as all the rest
        np.repeat(np.arange(COUNT // 2), 2),  # each frame sent twice, by two lines
        np.arange(COUNT) % 100,  # three restarts
        np.array([0, 3, 9]),  # too few to say anything
    ],
    ids=["whole", "gap", "twice", "restarts", "few"],
)
def test_losses_duplicates_and_restarts_are_no_fault_of_the_profile(
    counters: NDArray[np.int64], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = written(tmp_path / "unit.raw", counters)
    assert main(["decode", str(capture), "--profile", "imu50-rs422", "-o", str(tmp_path / "out.npz")]) == 0
    assert capsys.readouterr().err == ""


def test_a_notebook_finds_the_fault_in_the_capture(tmp_path: Path) -> None:
    capture = Capture(written(tmp_path / "unit.raw", np.arange(COUNT) * 10), "imu50-rs422")
    for _ in range(2):  # each reading begins anew
        assert sum(map(len, capture.pulses())) == COUNT
        assert FOUND in capture.sequence_fault


def test_a_capture_without_frames_says_what_was_seen_and_which_profile_fits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = written(tmp_path / "unit.raw", np.arange(COUNT))
    out = str(tmp_path / "out.csv")
    assert main(["decode", str(capture), "--profile", "imu50-rs422-acc", "-o", out]) == 2
    assert capsys.readouterr().err == (
        f"error: {capture}: expected frames of imu50-rs422-acc, got none in {COUNT * 44} bytes of binary data: "
        f"sync EB 90 seen {COUNT} times, check never right; "
        "its beginning has frames of imu50-rs422: try --profile imu50-rs422\n"
    )
    assert main(["decode", str(capture), "--profile", "imu50-can", "-o", out]) == 2
    assert "its beginning has frames of imu50-rs422: try --profile imu50-rs422" in capsys.readouterr().err
