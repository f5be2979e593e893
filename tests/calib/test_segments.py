from collections.abc import Callable
from dataclasses import is_dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from calib.detection import acceptance, blocks
from calib.detection import segments as segments_module
from calib.detection.acceptance import RotationLimits, expected_error_mm
from calib.detection.segments import Rotation, Segments, find_segments
from calib.messages import english
from imudrv.errors import InputError
from imudrv.records import Flag, Records
from imudrv.units import ARCSEC

Bench = Callable[..., Records]
Step = Callable[..., Any]
LIMITS = RotationLimits()


def rejection_reasons(rotation: Rotation, limits: RotationLimits, **more: Any) -> tuple[str, ...]:
    """English reasons."""
    return tuple(map(english, acceptance.rejection_reasons(rotation, limits, **more)))


def only(segments: Segments) -> Rotation:
    (rotation,) = segments.rotations
    return rotation


@pytest.mark.parametrize("up", ["+Z", "+X", "+Y", "-Z"])
@pytest.mark.parametrize("angle", [180.0, -180.0])
def test_a_half_turn_is_found_with_its_angle_sign_and_axis(
    bench: Bench, step: Step, up: str, angle: float
) -> None:
    found = find_segments([bench(step(40.0), step(2.5, angle), step(8.0), up=up)])
    rotation = only(found)
    assert rejection_reasons(rotation, LIMITS) == ()
    # blocks of 20 ms; the quintic's very ends are slower than the noise
    assert rotation.start_s == pytest.approx(40.0, abs=0.06)
    assert rotation.stop_s == pytest.approx(42.5, abs=0.06)
    # the 2 mrad that the body leans change nothing; the slow ends hide thousandths of a degree
    assert rotation.angle_deg == pytest.approx(angle, abs=0.01)
    assert (rotation.axis, rotation.about) == (up, up[1])
    assert rotation.axis_tilt_deg < 0.2  # of 2.2 mrad
    assert rotation.peak_deg_per_s == pytest.approx(180.0 * 1.875 / 2.5, rel=0.01)
    assert [rest.up for rest in found.rests] == [up, up]
    assert rotation.before is found.rests[0]
    assert rotation.after is found.rests[1]


def same(one: object, other: object) -> bool:
    """Whether two results have the same bits."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return one.tobytes() == other.tobytes()
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if is_dataclass(one) and is_dataclass(other):
        return same(tuple(vars(one).values()), tuple(vars(other).values()))
    return one == other


@pytest.mark.parametrize("pieces", [2, 7, 1000, 8000])
def test_any_cut_into_pieces_gives_the_same_bits(bench: Bench, step: Step, pieces: int) -> None:
    data = bench(step(20.0), step(2.5, 180.0), step(12.0))
    data = np.delete(data, [5, 10, 11, 700, *range(3000, 3030)])
    data["interval_ns"][5] *= 2
    segments = find_segments([data])
    assert same(segments, find_segments(np.array_split(data, pieces)))
    rng = np.random.default_rng(pieces)
    assert same(segments, find_segments(np.split(data, np.sort(rng.integers(0, len(data), pieces)))))


def test_a_first_interval_that_bridges_a_gap_is_not_taken_for_that_of_the_unit(
    bench: Bench, step: Step
) -> None:
    data = bench(step(20.0))
    data["interval_ns"][0] *= 2
    assert find_segments([data[:1], data[1:]]).interval_s == pytest.approx(0.002)


def test_a_capture_of_which_not_all_is_in_memory_gives_the_same_bits(
    bench: Bench, step: Step, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = np.array_split(bench(step(20.0), step(2.5, 180.0), step(12.0)), 10)
    segments = find_segments(data)
    monkeypatch.setattr(blocks, "_IN_MEMORY_BYTES", 10_000)
    assert same(segments, find_segments(data))


def test_a_full_disk_is_reported_with_what_to_do(
    bench: Bench, step: Step, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blocks, "SpooledTemporaryFile", lambda size: open("/dev/full", "r+b", 0))  # noqa: SIM115
    with pytest.raises(InputError, match=r"expected room for 0 MB .* No space left on device; set TMPDIR"):
        find_segments([bench(step(20.0))])


def test_a_long_rest_counts_as_several_and_a_long_motion_as_one(
    bench: Bench, step: Step, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = bench(step(80.0), step(20.0, 180.0), step(10.0))
    whole = find_segments([data])
    monkeypatch.setattr(segments_module, "BLOCKS_AT_ONCE", 600)  # 12 s
    parts = find_segments([data])
    assert len(parts.rests) == 8
    assert all(one.stop == other.start for one, other in pairwise(parts.rests[:7]))
    assert (parts.rests[0].start, parts.rests[6].stop) == (whole.rests[0].start, whole.rests[0].stop)
    assert min(rest.duration_s for rest in parts.rests[:7]) > 11.0  # equal: no short one next to the rotation
    one, other = only(whole), only(parts)
    assert (one.start, one.stop, one.missing, one.flags) == (other.start, other.stop, 0, other.flags)
    assert other.before is parts.rests[6]
    # The vertical is the mean of less of the rest, and sums are rounded.
    assert other.angle_deg == pytest.approx(one.angle_deg, abs=1e-4)
    assert other.peak_deg_per_s == pytest.approx(one.peak_deg_per_s, rel=1e-12)


@pytest.mark.parametrize(
    ("steps", "reason"),
    [
        ([(40.0,), (2.5, 171.2), (8.0,)], "turned 171.2 deg, expected 180 +- 5"),
        ([(40.0,), (7.0, 180.0), (8.0,)], "peak 48 deg/s: slower than 60, an error of about 3.2 mm"),
        (
            [(40.0,), (2.5, 180.0, (0.3, 0.0, 1.0)), (8.0,)],
            "axis 16.7 deg off the vertical, expected at most 10",
        ),
        ([(20.0,), (2.5, 180.0), (8.0,)], "rest before 20.0 s, expected 32"),
        ([(40.0,), (2.5, 180.0), (2.5,)], "rest after 2.5 s, expected 2.8"),
        ([(2.5, 180.0), (8.0,)], "no rest before it, expected 32 s"),
        ([(40.0,), (2.5, 180.0)], "no rest after it, expected 2.8 s"),
    ],
)
def test_each_rejection_has_its_number_and_its_limit(
    bench: Bench, step: Step, steps: list[tuple[Any, ...]], reason: str
) -> None:
    rotation = only(find_segments([bench(*(step(*s) for s in steps))]))
    assert reason in rejection_reasons(rotation, LIMITS)


def test_another_axis_than_that_of_the_procedure_is_reported(bench: Bench, step: Step) -> None:
    rotation = only(find_segments([bench(step(40.0), step(2.5, 180.0), step(8.0), up="+Y")]))
    assert rejection_reasons(rotation, LIMITS, expected="Y") == ()
    assert rejection_reasons(rotation, LIMITS, expected="Z") == ("turned about Y, expected about Z",)


def test_missing_samples_and_flags_in_the_rotation_are_reported(bench: Bench, step: Step) -> None:
    data = bench(step(40.0), step(2.5, 180.0), step(8.0))
    turning = 41 * 500
    kept = np.delete(data, [turning, turning + 40, turning + 41])
    kept["flags"][turning + 5] |= Flag.SATURATED
    kept["flags"][turning + 6] |= Flag.FAULT
    assert rejection_reasons(only(find_segments([kept])), LIMITS) == (
        "3 samples missing during the rotation, expected at most 0",
        "an axis saturated during the rotation",
        "the unit reported a fault during the rotation",
    )


def test_a_sample_that_bridges_a_gap_leaves_nothing_missing(bench: Bench, step: Step) -> None:
    data = bench(step(40.0), step(2.5, 180.0), step(8.0))
    at = 41 * 500
    for name in ("interval_ns", "dtheta_b", "dv_b"):
        data[name][at + 1] += data[name][at]
    assert rejection_reasons(only(find_segments([np.delete(data, at)])), LIMITS) == ()


def test_a_bump_ends_a_rest_and_is_no_rotation(bench: Bench, step: Step) -> None:
    bumped = bench(
        step(20.0),
        step(0.1, 0.2, (1, 0, 0)),
        step(0.1, -0.2, (1, 0, 0)),
        step(25.0),
        step(2.5, 180.0),
        step(8.0),
    )
    bump, rotation = find_segments([bumped]).rotations
    assert "turned 0.0 deg, expected 180 +- 5" in rejection_reasons(bump, LIMITS)
    assert rejection_reasons(rotation, LIMITS) == ("rest before 25.0 s, expected 32",)


def test_a_shift_that_gyros_do_not_feel_ends_a_rest_too(bench: Bench, step: Step) -> None:
    data = bench(step(40.0))
    data["dv_b"][20 * 500 : 20 * 500 + 50, 0] += 0.1 * 0.002  # 10 mg sideways for 0.1 s
    found = find_segments([data])
    assert len(found.rests) == 2
    assert only(found).start_s == pytest.approx(20.0, abs=0.05)


def test_two_pushes_with_a_short_pause_are_one_rotation(bench: Bench, step: Step) -> None:
    data = bench(step(40.0), step(1.3, 90.0), step(0.5), step(1.3, 90.0), step(8.0))
    assert rejection_reasons(only(find_segments([data])), LIMITS) == ()


def test_two_pushes_with_a_rest_between_are_both_rejected(bench: Bench, step: Step) -> None:
    data = bench(step(40.0), step(1.3, 90.0), step(2.0), step(1.3, 90.0), step(8.0))
    first, second = (rejection_reasons(r, LIMITS) for r in find_segments([data]).rotations)
    assert first == ("turned 90.0 deg, expected 180 +- 5", "rest after 2.0 s, expected 2.8")
    assert second == ("turned 90.0 deg, expected 180 +- 5", "rest before 2.0 s, expected 32")


def test_placing_the_unit_between_rotations_is_no_rotation(bench: Bench, step: Step) -> None:
    # Z up, then slowly about north to have X up, with a wobble, then the next half turn
    data = bench(
        step(40.0),
        step(2.5, 180.0),
        step(8.0),
        step(6.0, 90.0, (0, 1, 0)),
        step(2.0, 15.0, (0, 0, 1)),
        step(40.0),
        step(2.5, 180.0),
        step(8.0),
    )
    found = find_segments([data])
    first, placing, second = found.rotations
    assert rejection_reasons(first, LIMITS) == ()
    assert rejection_reasons(second, LIMITS) == ()
    reasons = rejection_reasons(placing, LIMITS)
    assert any("off the vertical" in reason for reason in reasons)
    assert placing.about == "Y"
    assert found.rests[1].up == "+Z"
    assert found.rests[2].up in ("+X", "-X")
    assert first.after is found.rests[1]  # the placing ends it


def test_a_capture_that_begins_in_motion_still_gives_its_rotation(bench: Bench, step: Step) -> None:
    data = bench(
        step(3.0, 40.0, (1, 1, 0)), step(3.0, -40.0, (1, 1, 0)), step(40.0), step(2.5, -180.0), step(8.0)
    )
    moving, rotation = find_segments([data]).rotations
    assert moving.before is None
    assert rejection_reasons(rotation, LIMITS) == ()


def test_a_long_gap_is_no_rest(bench: Bench, step: Step) -> None:
    data = bench(step(40.0))
    assert len(find_segments([np.delete(data, slice(10_000, 10_003))]).rests) == 1  # 6 ms
    holed = find_segments([np.delete(data, slice(10_000, 10_500))])
    assert len(holed.rests) == 2
    assert only(holed).missing == 500


def test_a_leap_of_the_counter_costs_no_memory(bench: Bench, step: Step) -> None:
    data = bench(step(20.0))
    data["counter"][5000:] += 2**40
    assert len(find_segments([data]).rests) == 2


@pytest.mark.parametrize("times", [0.0, 1.0, 20.0])
def test_the_noise_floor_is_the_datas_own(bench: Bench, step: Step, times: float) -> None:
    data = bench(step(40.0), step(2.5, 180.0), step(8.0), arw=times * 6e-7, vrw=times * 5e-5)
    assert rejection_reasons(only(find_segments([data])), LIMITS) == ()


@pytest.mark.parametrize("duration_s", [2.5, 5.0])
def test_a_turn_is_found_whole_though_its_slow_ends_sink_in_the_noise(
    bench: Bench, step: Step, duration_s: float
) -> None:
    # dither that the sample rate aliases: the rests had 7 deg/s in them, and arms of 30 mm were off by 5 mm
    data = bench(step(10.0), step(duration_s, 180.0), step(10.0))
    dither = 75.0 * ARCSEC * np.sin(2.0 * np.pi * 8.0 * 2e-3 * np.arange(len(data) + 1))
    data["dtheta_b"] += np.diff(dither)[:, None]
    found = only(find_segments([data]))
    # no rest contains a block of the turn, and what they lose is a small part of theirs
    assert 9.5 < found.start_s < 10.01
    assert 9.99 < found.stop_s - duration_s < 10.5


def test_noise_is_found_in_the_rests(bench: Bench, step: Step) -> None:
    (rest,) = find_segments([bench(step(370.0))]).rests
    assert rest.noise is not None
    # 370 s have some 700 independent differences a lag and axis: 4 % for three axes and several lags
    assert rest.noise.angle_walk == pytest.approx(6e-7, rel=0.12)
    assert rest.noise.velocity_walk == pytest.approx(5e-5, rel=0.12)
    (short,) = find_segments([bench(step(5.0))]).rests
    assert short.noise is None


def test_the_slower_the_rotation_the_larger_the_expected_error() -> None:
    # twice the time halves the velocity a metre and doubles what errors gain
    assert expected_error_mm(35.0) == pytest.approx(4.0 * expected_error_mm(70.0))


def test_too_little_data_are_refused(bench: Bench, step: Step) -> None:
    with pytest.raises(InputError, match=r"expected a capture of at least 2 s, got 1\.0 s"):
        find_segments([bench(step(1.0))])
    with pytest.raises(InputError, match=r"got 0\.0 s"):
        find_segments([])


def test_limits_can_be_others(bench: Bench, step: Step) -> None:
    rotation = only(find_segments([bench(step(20.0), step(1.5, 90.0), step(8.0))]))
    assert rejection_reasons(rotation, replace(LIMITS, angle_deg=90.0, rest_before_s=15.0)) == ()


@pytest.mark.parametrize("samples", [1, 2, 5, 9])
def test_a_short_last_block_is_no_motion(bench: Bench, step: Step, samples: int) -> None:
    rows = bench(step(20.0), step(2.5, 180.0), step(20.0))[: 20_000 + samples]  # blocks of ten samples
    rows["dtheta_b"][-1] += 1e-5  # a pulse of two arcsec alone in a few samples
    found = find_segments([rows])
    assert len(found.rotations) == 1
    assert found.rests[-1].stop - found.rests[0].start == 20_000


def test_a_half_turn_of_five_seconds_is_accepted(bench: Bench, step: Step) -> None:
    found = only(find_segments([bench(step(40.0), step(5.0, 180.0), step(8.0))]))
    assert found.peak_deg_per_s == pytest.approx(180.0 * 1.875 / 5.0, rel=0.01)
    assert rejection_reasons(found, LIMITS) == ()


def test_no_error_is_extrapolated_for_what_is_no_turn(bench: Bench, step: Step) -> None:
    found = only(find_segments([bench(step(20.0), step(2.0, 9.0), step(20.0))]))
    assert found.peak_deg_per_s < 10.0
    assert "peak 8 deg/s: slower than 60" in rejection_reasons(found, LIMITS)
