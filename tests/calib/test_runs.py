from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from calib.estimation.runs import AFTER_S, BEFORE_S, CaptureRuns, NavigationOptions, navigate_rotations
from imudrv.errors import InputError
from imudrv.records import Records
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
    assert [round(run.rotation.angle_deg) for run in found.runs] == [180, -180]
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
    assert first.t_s[first.after][-1] == pytest.approx(BEFORE_S + 2.5 + AFTER_S, abs=0.1)
    assert second.t_s[second.after][-1] < BEFORE_S + 2.5 + 12.0  # the placing ends it


def test_a_rest_that_is_long_is_aligned_on_for_370_s(bench: Bench, step: Step, site: Site) -> None:
    data = bench(step(400.0), step(2.5, 180.0), step(8.0), interval_ns=10_000_000)
    (run,) = navigated(data, site).runs
    assert run.aligned.duration_s == pytest.approx(370.0, abs=0.01)


def test_a_short_rest_is_aligned_on_for_30_s_at_least(bench: Bench, step: Step, site: Site) -> None:
    (run,) = navigated(bench(step(33.0), step(2.5, 180.0), step(8.0)), site).runs
    assert run.aligned.duration_s == pytest.approx(30.0, abs=0.01)
    assert run.t_s[run.before][-1] == pytest.approx(3.0, abs=0.2)


def test_velocity_at_rest_is_what_errors_make_and_H_only_what_the_turn_makes(
    session: Records, site: Site
) -> None:
    for run in navigated(session, site).runs:
        # noise alone: a random walk of 5e-5 m/s/sqrt(s), and tilts that the alignment leaves, some 5 urad
        assert np.abs(run.v_n[run.before, :2]).max() < 2e-3
        assert np.abs(run.v_n[run.after, :2]).max() < 6e-3
        H = run.rows["H"].reshape(-1, 3, 3, 3)
        assert np.abs(run.rows["H"][run.before]).max() < 0.02  # of the rate at a row's end
        assert np.abs(H[run.after][:, :2]).max() > 3.0  # 8.8 / 2.5 m/s a metre
        # a common shift leaves nothing at rest, but for that same noise
        assert np.abs(H[run.after].sum(axis=2).mean(axis=0)).max() < 1e-3
        assert not (run.before & run.after).any()


@pytest.mark.parametrize("pieces", [1, 3, 97])
def test_any_cut_into_pieces_gives_the_same_bits(session: Records, site: Site, pieces: int) -> None:
    for a, b in zip(navigated(session, site).runs, navigated(session, site, pieces).runs, strict=True):
        assert a.rows.tobytes() == b.rows.tobytes()
        assert a.v_n.tobytes() == b.v_n.tobytes()
        assert (a.before.tolist(), a.after.tolist()) == (b.before.tolist(), b.after.tolist())


def test_means_are_those_of_all_samples(bench: Bench, step: Step, site: Site) -> None:
    (run,) = navigated(bench(step(40.0), step(2.5, 180.0), step(8.0)), site).runs
    # ten samples a row: the mean of the last lies half a row before its end
    ends = run.rows["v_n"]
    smooth = 0.5 * (ends[1:] + ends[:-1])
    # samples of white noise 5e-5 * sqrt(0.002) each: sums of five
    np.testing.assert_allclose(run.v_n[1:][run.before[1:]], smooth[run.before[1:]], atol=3e-5)


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
