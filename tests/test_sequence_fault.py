"""Captures whose good frames do not continue the counter that the profile describes."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from imudrv import Capture
from imudrv.cli import main
from imudrv.profiles import load
from imudrv.records import PULSES, samples_type
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
        f"error: {capture}: expected frames of imu50-rs422-acc, "
        f"got none in {COUNT * 44} bytes of binary data: sync EB 90 seen {COUNT} times, check never right; "
        "its beginning has frames of imu50-rs422: try --profile imu50-rs422\n"
    )
    assert main(["decode", str(capture), "--profile", "imu50-can", "-o", out]) == 2
    assert "its beginning has frames of imu50-rs422: try --profile imu50-rs422" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("profile", "holes", "hint"),
    [
        (
            "kvh1775",
            [100],
            "1 gap of unknown length, counted with the smallest: or 128 samples more, any number of times",
        ),
        (
            "kvh1775",
            [100, 300],
            "2 gaps of unknown length, counted with the smallest: or 128 samples more, any number of times",
        ),
        ("hg4930", [100], "1 gap of unknown length: the unit sends no counter"),
        ("kvh1775", [], ""),
        ("imu50-rs422", [100], ""),
    ],
)
def test_the_summary_says_how_much_longer_a_gap_of_unknown_length_may_be(
    profile: str, holes: list[int], hint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layout = load(profile).layout()
    gyro, accelerometer = layout.sensors
    samples = np.zeros(
        COUNT, samples_type(gyro_pulses=gyro.in_pulses, accelerometer_pulses=accelerometer.in_pulses)
    )
    samples["counter"] = np.arange(COUNT)
    samples["interval_ns"] = layout.interval_ns
    data = StreamEncoder(layout).encode(samples)
    length = len(data.tobytes()) // COUNT
    frames = [data.tobytes()[k * length : (k + 1) * length] for k in range(COUNT)]
    for hole in holes:
        frames[hole] = frames[hole][: length // 2]
    capture = tmp_path / "unit.raw"
    capture.write_bytes(b"".join(frames))
    assert main(["decode", str(capture), "--profile", profile, "-o", str(tmp_path / "out.npz")]) == 0
    printed = capsys.readouterr().out
    assert hint in printed if hint else "unknown length" not in printed
