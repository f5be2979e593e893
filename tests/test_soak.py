"""The proofs of `tools/soak.py` in small: counts and contents, not what depends on the machine's speed."""

import importlib.util
import sys
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("soak", Path(__file__).parents[1] / "tools" / "soak.py")
assert _spec is not None
assert _spec.loader is not None
soak = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(soak)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs ptys, /proc and UDP multicast")


def broken(checks: list) -> list[str]:
    """Promises of counts and contents that were not kept."""
    counted = [check for check in checks if not check.of_machine]
    assert counted
    return [str(check) for check in counted if not check.kept]


@pytest.mark.parametrize("profile", ["imu50-rs422", "imu50-canfd"])
def test_every_sample_comes_through_three_processes_with_the_bits_of_the_offline_command(
    tmp_path: Path, profile: str
) -> None:
    assert broken(soak.loopback(tmp_path, 1.0, profile)) == []


def test_every_sample_comes_through_at_20_kHz(tmp_path: Path) -> None:
    assert broken(soak.loopback(tmp_path, 1.0, speed=20.0)) == []


def test_one_scenario_of_faults_has_one_account_whichever_way_it_takes(tmp_path: Path) -> None:
    checks = soak.faults(tmp_path, 1.0, ("imu50-rs422", "imu50-can"))
    assert broken(checks) == []
    kinds = " ".join(check.found for check in checks)
    for word in ("damaged", "torn", "missing", "duplicate", "restarts", "no_sync", "check_failed", "stale"):
        assert word in kinds


def test_what_kill_9_leaves_opens_exports_and_replays_to_the_same_increments(tmp_path: Path) -> None:
    assert broken(soak.kill(tmp_path, 2, longest_s=0.6)) == []


def test_the_service_lives_through_unplug_full_disk_and_consumers_that_are_none(tmp_path: Path) -> None:
    assert broken(soak.unplug(tmp_path, 5.0, speed=20.0)) == []


def test_minutes_in_virtual_time_are_accounted_for(tmp_path: Path) -> None:
    assert broken(soak.hours(tmp_path, 0.05)) == []


def test_a_sample_that_is_lost_is_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = soak.turning
    monkeypatch.setattr(soak, "turning", lambda first, count: frames(first, count)[1:])
    (seen,) = broken(soak.hours(tmp_path, 0.03))
    assert "107998 good + 1 missing" in seen


def test_the_exit_code_and_the_words_tell_what_was_not_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def breaks_off(folder: Path, size: float) -> list:
        raise soak.BrokenOffError("waited in vain for Godot")

    checks = [soak.Check("two and two", "4", True), soak.measured("quick", "slow", False)]
    monkeypatch.setitem(soak.PROOFS, "fast", soak.Proof(lambda folder, size: checks, "--seconds", 1, ""))
    monkeypatch.setitem(soak.PROOFS, "kill", soak.Proof(breaks_off, "--times", 1, ""))
    assert soak.main(["fast"]) == soak.main(["kill"]) == 1
    told = capsys.readouterr().out
    assert "kept   two and two: 4\n  BROKEN quick: slow" in told
    assert "waited in vain for Godot" in told
    checks.pop()
    assert soak.main(["fast", "--seconds", "2"]) == 0
