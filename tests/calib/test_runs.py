from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from calib.estimation.runs import AFTER_S, BEFORE_S, CaptureRuns, NavigationOptions, navigate_rotations
from imudrv.errors import InputError
from imudrv.records import Flag, Records
from imudrv.site import Site

Bench = Callable[..., Records]
Step = Callable[..., Any]


def navigated(data: Records, site: Site, pieces: int = 5, **options: Any) -> CaptureRuns:
    return navigate_rotations(
        lambda: np.array_split(data, pieces), np.eye(3), site, "capture", NavigationOptions(**options)
    )


@pytest.fixture(scope="module")
def session(bench: Bench, step: Step) -> Records:
    """Two half turns to and fro, and a placing that follows."""
    data: Records = bench(
        step(50.0),
        step(2.5, 180.0),
        step(40.0),
        step(2.5, -180.0),
        step(12.0),
        step(6.0, 90.0, (0, 1, 0)),
        step(5.0),
    )
    return data


def test_every_rotation_is_a_run_of_its_own(session: Records, site: Site) -> None:
    found = navigated(session, site)
    first, second = found.runs
    assert [run.label for run in found.runs] == ["capture#1", "capture#2"]
    assert [round(run.turns[0].angle_deg) for run in found.runs] == [180, -180]
    ((placing, reasons),) = found.rejected
    assert placing.about == "Y"
    assert reasons
    # 50 s: the last ten are navigated; 40 s less the two rests' ends of 0.06 s each
    assert first.aligned.duration_s == pytest.approx(40.0, abs=0.1)
    assert second.aligned.duration_s == pytest.approx(30.0, abs=0.1)
    for run in found.runs:
        assert run.aligned.motion is None
        assert run.t_s[0] == pytest.approx(0.02)
        np.testing.assert_allclose(np.diff(run.t_s), 0.02, atol=1e-9)
    assert first.t_s[first.arrests[1]][-1] == pytest.approx(BEFORE_S + 2.5 + AFTER_S, abs=0.1)
    assert second.t_s[second.arrests[1]][-1] < BEFORE_S + 2.5 + 12.0  # the placing ends it


def turns_of(step: Step, count: int, **odd: Any) -> list[Any]:
    """An alignment, then turns to and fro with arrests of 4 s."""
    steps = [step(42.0)]
    for k in range(count):
        steps += [odd.get(f"turn_{k + 1}", step(1.5, -180.0 if k % 2 else 180.0)), step(4.0)]
    return steps


def test_turns_with_short_arrests_are_one_run(bench: Bench, step: Step, site: Site) -> None:
    found = navigated(bench(*turns_of(step, 4)), site)
    (run,) = found.runs
    assert found.rejected == ()
    assert run.label == "capture"
    assert run.turn_labels == ("capture/1", "capture/2", "capture/3", "capture/4")
    assert [round(turn.angle_deg) for turn in run.turns] == [180, -180, 180, -180]
    assert run.arrests.shape == (5, len(run.rows))
    # 4 s less a guard of 0.1 s and up to two blocks at each end; no turn follows the last
    assert [run.t_s[at].size * 0.02 for at in run.arrests[1:]] == pytest.approx([3.75] * 4, abs=0.15)
    assert (np.diff([run.t_s[at][0] for at in run.arrests]) > 5.0).all()


def test_a_turn_outside_its_limits_stays_in_the_run_and_is_reported(
    bench: Bench, step: Step, site: Site
) -> None:
    found = navigated(bench(*turns_of(step, 4, turn_2=step(1.5, -160.0))), site)
    (run,) = found.runs
    assert [turn.accepted for turn in run.turns] == [True, False, True, True]
    ((rotation, reasons),) = found.rejected
    assert reasons[0].key == "wrong_angle"
    assert rotation.start == run.turns[1].start


@pytest.mark.parametrize("spoil", ["lost", "saturated"])
def test_lost_or_saturated_samples_end_the_run(bench: Bench, step: Step, site: Site, spoil: str) -> None:
    data = bench(*turns_of(step, 4))
    at = round((42.0 + 2 * 5.5 + 0.7) / 0.002)  # within the third turn
    if spoil == "lost":
        data = np.delete(data, at)
    else:
        data["flags"][at] |= Flag.SATURATED
    found = navigated(data, site)
    (run,) = found.runs
    assert len(run.turns) == 2
    assert len(found.rejected) == 2  # the third, and the fourth for want of an alignment


def test_another_pose_ends_the_run(bench: Bench, step: Step, site: Site) -> None:
    steps = [*turns_of(step, 2), step(4.0, 90.0, (0, 1, 0)), *turns_of(step, 3)]
    first, second = navigated(bench(*steps), site).runs
    assert (first.label, second.label) == ("capture#1", "capture#2")
    assert second.turn_labels == ("capture#2/1", "capture#2/2", "capture#2/3")
    assert {turn.axis for turn in first.turns} == {"+Z"}
    assert {turn.axis for turn in second.turns} == {"+X"} or {turn.axis for turn in second.turns} == {"-X"}


def test_a_rest_that_is_long_is_aligned_on_for_370_s(bench: Bench, step: Step, site: Site) -> None:
    data = bench(step(400.0), step(2.5, 180.0), step(8.0), interval_ns=10_000_000)
    (run,) = navigated(data, site).runs
    assert run.aligned.duration_s == pytest.approx(370.0, abs=0.01)


def test_a_short_rest_is_aligned_on_for_30_s_at_least(bench: Bench, step: Step, site: Site) -> None:
    (run,) = navigated(bench(step(33.0), step(2.5, 180.0), step(8.0)), site).runs
    assert run.aligned.duration_s == pytest.approx(30.0, abs=0.01)
    assert run.t_s[run.arrests[0]][-1] == pytest.approx(3.0, abs=0.2)


def test_velocity_at_rest_is_what_errors_make_and_H_only_what_the_turn_makes(
    session: Records, site: Site
) -> None:
    for run in navigated(session, site).runs:
        # noise alone: a random walk of 5e-5 m/s/sqrt(s), and tilts that the alignment leaves, some 5 urad
        assert np.abs(run.v_n[run.arrests[0], :2]).max() < 2e-3
        assert np.abs(run.v_n[run.arrests[1], :2]).max() < 6e-3
        H = run.rows["H"].reshape(-1, 3, 3, 3)
        assert np.abs(run.rows["H"][run.arrests[0]]).max() < 0.02  # of the rate at a row's end
        assert np.abs(H[run.arrests[1]][:, :2]).max() > 3.0  # 8.8 / 2.5 m/s a metre
        # a common shift leaves nothing at rest, but for that same noise
        assert np.abs(H[run.arrests[1]].sum(axis=2).mean(axis=0)).max() < 1e-3
        assert run.arrests.sum(axis=0).max() == 1


@pytest.mark.parametrize("pieces", [1, 3, 97])
def test_any_cut_into_pieces_gives_the_same_bits(session: Records, site: Site, pieces: int) -> None:
    for a, b in zip(navigated(session, site).runs, navigated(session, site, pieces).runs, strict=True):
        assert a.rows.tobytes() == b.rows.tobytes()
        assert a.v_n.tobytes() == b.v_n.tobytes()
        assert a.arrests.tolist() == b.arrests.tolist()


def test_means_are_those_of_all_samples(bench: Bench, step: Step, site: Site) -> None:
    (run,) = navigated(bench(step(40.0), step(2.5, 180.0), step(8.0)), site).runs
    # ten samples a row: the mean of the last lies half a row before its end
    ends = run.rows["v_n"]
    smooth = 0.5 * (ends[1:] + ends[:-1])
    # samples of white noise 5e-5 * sqrt(0.002) each: sums of five
    np.testing.assert_allclose(run.v_n[1:][run.arrests[0][1:]], smooth[run.arrests[0][1:]], atol=3e-5)


def test_a_rotation_about_another_axis_than_expected_is_rejected(session: Records, site: Site) -> None:
    found = navigated(session, site, expected="X")
    assert found.runs == ()
    assert all(reasons[0].key == "wrong_vertical" for _, reasons in found.rejected)


def test_gravity_is_the_sites_own(bench: Bench, step: Step, site: Site) -> None:
    data = bench(step(40.0), step(2.5, 180.0), step(8.0))
    (run,) = navigated(data, site.model_copy(update={"gravity_m_s2": 9.79})).runs
    assert run.gravity == 9.79


def test_a_capture_too_short_is_refused(bench: Bench, step: Step, site: Site) -> None:
    with pytest.raises(InputError, match="expected a capture of at least 2 s"):
        navigated(bench(step(1.0)), site)
