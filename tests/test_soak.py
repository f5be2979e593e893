"""The tests of `tools.soak` in small: counts and contents, not what depends on the speed of the machine."""

import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

from tools.soak import __main__ as soak
from tools.soak import virtual_hours
from tools.soak.checks import Check, StepError, measured

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs ptys, /proc and UDP multicast")


def failed(checks: Sequence[Check]) -> list[str]:
    """Failed checks of counts and contents."""
    counted = [check for check in checks if not check.on_machine]
    assert counted
    return [str(check) for check in counted if not check.passed]


@pytest.mark.parametrize("profile", ["imu50-rs422", "imu50-canfd"])
def test_every_sample_passes_three_processes_with_the_bits_of_the_offline_command(
    tmp_path: Path, profile: str
) -> None:
    assert failed(soak.loopback(tmp_path, 1.0, profile)) == []


def test_every_sample_passes_at_20_kHz(tmp_path: Path) -> None:
    assert failed(soak.loopback(tmp_path, 1.0, rate_hz=20_000)) == []


def test_a_scenario_with_faults_has_the_same_counts_offline_live_and_recorded(tmp_path: Path) -> None:
    checks = soak.line_faults(tmp_path, 1.0, ("imu50-rs422", "imu50-can"))
    assert failed(checks) == []
    kinds = " ".join(check.found for check in checks)
    for word in ("damaged", "torn", "missing", "duplicate", "restarts", "no_sync", "check_failed", "stale"):
        assert word in kinds


def test_a_recording_after_kill_9_opens_exports_and_replays_to_the_same_increments(tmp_path: Path) -> None:
    assert failed(soak.kill(tmp_path, 2, longest_s=0.6)) == []


def test_the_service_survives_an_unplug_a_full_disk_and_stuck_or_absent_receivers(tmp_path: Path) -> None:
    assert failed(soak.disruption(tmp_path, 10.0)) == []


def test_all_samples_of_minutes_in_virtual_time_are_counted(tmp_path: Path) -> None:
    assert failed(soak.virtual_hours(tmp_path, 0.05)) == []


def test_a_lost_sample_fails_the_check_of_the_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = virtual_hours.encoded_frames
    monkeypatch.setattr(virtual_hours, "encoded_frames", lambda first, count: frames(first, count)[1:])
    (check,) = failed(soak.virtual_hours(tmp_path, 0.03))
    assert "107998 good + 1 missing" in check


def test_a_failed_check_or_step_is_printed_and_sets_the_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(folder: Path, size: float) -> list[Check]:
        raise StepError("no reply within 60 s")

    checks = [Check("two and two", "4", True), measured("fast", "slow", False)]
    monkeypatch.setitem(soak.TESTS, "fast", soak.SoakTest(lambda folder, size: checks, "--seconds", 1, ""))
    monkeypatch.setitem(soak.TESTS, "kill", soak.SoakTest(fails, "--times", 1, ""))
    assert soak.main(["fast"]) == soak.main(["kill"]) == 1
    printed = capsys.readouterr().out
    assert "ok     two and two: 4\n  FAILED fast: slow" in printed
    assert "no reply within 60 s" in printed
    checks.pop()
    assert soak.main(["fast", "--seconds", "2"]) == 0
