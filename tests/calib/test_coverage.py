"""Coverage of the attempts by their recordings."""

from collections.abc import Callable
from pathlib import Path

import pytest

from calib.bench.entries import AcceptedRest
from calib.bench.result import decode_covered, uncovered, uncovered_rests
from calib.bench.state import Attempt
from calib.procedure.schema import Run
from imudrv import profiles
from imudrv.errors import InputError

STEP = Run("z-up", "+Z", "+X", 4.0, 180, 30.0)
FIRST, LAST = 2000, 4999

Recorded = Callable[..., Path]


def attempt(path: Path, samples: int | None = LAST - FIRST + 1) -> Attempt:
    return Attempt(STEP, path, FIRST, LAST, samples)


def without(*lost: range) -> list[int]:
    return [k for k in range(1000, 6000) if not any(k in gap for gap in lost)]


@pytest.mark.parametrize("samples", [LAST - FIRST + 1, None], ids=["counted", "an older session"])
@pytest.mark.parametrize(
    ("lost", "gap"),
    [
        ((), ""),
        ((range(1000, 2000), range(5000, 6000)), ""),
        ((range(1000, 2500),), "2000..2499"),
        ((range(4900, 6000),), "4900..4999"),
        ((range(3000, 3100),), "3000..3099"),
        ((range(2100, 2200), range(3000, 3101)), "3000..3100"),
        ((range(1000, 5500),), "2000..4999"),
    ],
)
def test_what_the_recording_does_not_cover_is_named(
    recorded: Recorded, tmp_path: Path, samples: int | None, lost: tuple[range, ...], gap: str
) -> None:
    path = recorded(tmp_path / "run-z-up-1.mcap", without(*lost))
    words = f"its recording does not cover counters {gap}" if gap else ""
    assert uncovered(attempt(path, samples)) == words
    if not gap:
        decode_covered(attempt(path, samples))
        return
    with pytest.raises(
        InputError, match=rf"step z-up: {words}; .*calib run --session {tmp_path} --redo z-up"
    ):
        decode_covered(attempt(path, samples))


def test_samples_lost_on_the_line_are_not_missing_from_the_recording(
    recorded: Recorded, tmp_path: Path
) -> None:
    lost = range(3000, 3007)
    path = recorded(tmp_path / "lost.mcap", without(lost))
    assert uncovered(attempt(path, LAST - FIRST + 1 - len(lost))) == ""
    assert uncovered(attempt(path)) == "its recording does not cover counters 3000..3006"
    # The engine accepts no longer gap than a block of 20 ms; a shorter one may have been the line's.
    assert uncovered(attempt(path, None)) == ""
    long = recorded(tmp_path / "long.mcap", without(range(3000, 3021)))
    assert uncovered(attempt(long, None)) == "its recording does not cover counters 3000..3020"


@pytest.mark.parametrize("rounds", [0, 3, 70_000])
def test_a_narrow_counter_wraps_before_and_within_the_recording(
    recorded: Recorded, tmp_path: Path, rounds: int
) -> None:
    text = profiles.content("imu50-rs422").decode().replace("counter, type: u32", "counter, type: u16")
    (tmp_path / "narrow.yaml").write_text(text)
    begin = rounds * (1 << 16) + 65_000
    path = recorded(tmp_path / "run.mcap", range(begin, begin + 150_000), str(tmp_path / "narrow.yaml"))
    # The recording continues for more than a counter period after the attempt: nobody was there to end it.
    first, last = begin + 500, begin + 70_000
    assert uncovered(Attempt(STEP, path, first, last, last - first + 1)) == ""
    assert uncovered(Attempt(STEP, path, begin - 50, last)) == (
        f"its recording does not cover counters {begin - 50}..{begin - 1}"
    )


def test_samples_before_a_restart_of_the_unit_are_not_used(recorded: Recorded, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", [*range(1000, 3000), *range(1900, 5500)])
    assert uncovered(attempt(path)) == ""
    late = recorded(tmp_path / "late.mcap", [*range(1000, 5500), *range(2100, 5500)])
    assert uncovered(attempt(late)) == "its recording does not cover counters 2000..2099"


def rest(name: str, first: int, last: int, recording: Path) -> AcceptedRest:
    span = {"first_counter": first, "last_counter": last, "samples": last - first + 1}
    where = {"rest_s": 1.0, "lean_deg": 0.0, "heading_deg": None, "recording": recording.name}
    return AcceptedRest(name, 1, **span, **where)


def test_rests_are_covered_on_both_sides_of_a_restart(recorded: Recorded, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run-1.mcap", [*range(1000, 5500), *range(4000)])
    before, after = rest("z", 2000, 4999, path), rest("x", 100, 3900, path)
    across = rest("y", 500, 4500, path)  # no part between restarts has it whole

    assert list(uncovered_rests(path, [before, across, after])) == ["y"]


def test_a_recording_without_samples_covers_nothing(recorded: Recorded, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", [])
    assert uncovered(attempt(path)) == "its recording does not cover counters 2000..4999"
    assert list(uncovered_rests(path, [rest("z", 2000, 4999, path)])) == ["z"]
    path.write_bytes(b"something else")
    with pytest.raises(InputError, match=r"run.mcap: expected a recording"):
        uncovered(attempt(path))
