"""The engine on ideal samples with white noise; alignments of 30 s: nothing here depends on their length."""

from collections.abc import Callable
from dataclasses import asdict
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from calib.detection.acceptance import rejection_reasons
from calib.detection.segments import find_segments
from calib.messages import english, message, verbatim
from calib.procedure.engine import Engine
from calib.procedure.events import (
    Abort,
    Aborted,
    Accepted,
    Checked,
    Conditions,
    Confirm,
    Entered,
    Event,
    Finished,
    Phase,
    Redo,
    Redone,
    Rejected,
    Restarted,
    Skip,
    Skipped,
    Turned,
    View,
)
from calib.procedure.schema import Procedure
from imudrv.files.settings_file import parse
from imudrv.nav.earth import EARTH_RATE
from imudrv.records import Flag, Records
from imudrv.sim.scenario import NOMINAL
from imudrv.site import Site
from imudrv.units import ARCSEC, DEG

INTERVAL_NS = 2_000_000
CHECK_S = 31.0  # the preflight and a little more
ALIGN_S = 33.0  # placed, settled, aligned, and a little more
Z = {"id": "z", "up": "+Z", "east": "+X", "turn_deg": 180}
Z_BACK = {"id": "z-back", "up": "+Z", "east": "-X", "turn_deg": -180}
X = {"id": "x", "up": "+X", "east": "+Y", "turn_deg": 180}

Z_TURNS = {**Z, "turns": 3}

Bench = Callable[..., Records]


def plan(*poses: dict[str, Any], **limits: float) -> Procedure:
    document = {
        "format": "imu50-procedure",
        "version": 2,
        "name": "test",
        "align_s": 30,
        "rest_s": 3,
        "limits": {"still_s": 1.0, **limits},
        "poses": list(poses) or [Z],
    }
    return parse(document, Procedure, "test")


def reasons(of: Any) -> list[str]:
    """English reasons of a view or an event."""
    return [english(reason) for reason in of.reasons]


class Driver:
    """Feeds an engine, and keeps what it says."""

    def __init__(self, site: Site, procedure: Procedure, **options: Any) -> None:
        options = {"hands_free": True, **options}
        calibration = options.pop("calibration", NOMINAL)
        self.engine = Engine(procedure, site, calibration, interval_ns=INTERVAL_NS, **options)
        self.events: list[Event] = []
        self.views: list[View] = []

    def feed(self, samples: Records, piece: int = 97) -> "Driver":
        for at in range(0, len(samples), piece):
            self.events += self.engine.feed(samples[at : at + piece])
            self.views.append(self.engine.view)
        return self

    def act(self, action: Any) -> tuple[Event, ...]:
        events = self.engine.handle(action)
        self.events += events
        return events

    def of(self, kind: type[Event]) -> list[Any]:
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def phases(self) -> list[str]:
        return [str(event.phase) for event in self.of(Entered)]

    @property
    def headlines(self) -> list[str]:
        said = [english(view.headline) for view in self.views]
        return [b for a, b in pairwise(["", *said]) if a != b]

    @property
    def hints(self) -> set[str]:
        return {english(hint) for view in self.views for hint in view.hints}


@pytest.fixture
def drive(site: Site) -> Callable[..., Driver]:
    return lambda *poses, limits=None, **options: Driver(site, plan(*poses, **(limits or {})), **options)


Drive = Callable[..., Driver]


@pytest.fixture
def turned(bench: Bench, step: Any) -> Records:
    """Preflight, alignment, a turn by 180 deg, a rest, and then some."""
    return bench(step(CHECK_S + ALIGN_S), step(2.5, 180.0), step(12.0))


def part(samples: Records, begin_s: float, stop_s: float) -> Records:
    return samples[round(begin_s / 2e-3) : round(stop_s / 2e-3)].copy()


# The way through


def test_a_step_goes_through_its_phases_by_the_sensors_alone(drive: Drive, turned: Records) -> None:
    driver = drive().feed(turned)

    assert driver.phases == ["preflight", "place", "settle", "align", "rotate", "rest", "verdict", "done"]
    assert driver.headlines == [
        "HANDS OFF",
        "ROTATE NOW +180",
        "ROTATE +180",
        "STOP",
        "HANDS OFF",
        "GOOD: STEP 1 OF 1 DONE",
        "ALL STEPS DONE",
    ]
    (accepted,) = driver.of(Accepted)
    assert accepted.angle_deg == pytest.approx(180.0, abs=0.05)
    assert accepted.peak_deg_per_s == pytest.approx(180.0 * 1.875 / 2.5, rel=0.01)
    assert accepted.rest_before_s >= 30.0
    assert accepted.rest_after_s >= 3.0
    assert abs(accepted.heading_deg) < 2.0  # 2 mrad of tilt, and a heading from 30 s
    (checked,) = driver.of(Checked)
    assert checked.earth_rate_deg_per_h == pytest.approx(EARTH_RATE / DEG * 3600.0, abs=0.1)
    assert driver.of(Finished)[0].accepted == ("z",)


def test_any_cut_gives_the_same_events_and_the_same_view_at_the_same_sample(
    drive: Drive, bench: Bench, step: Any
) -> None:
    samples = bench(
        step(CHECK_S + 20.0),
        step(0.5, 1.0),  # touched while it is aligned
        step(ALIGN_S),
        step(2.5, 180.0),
        step(11.0),
    )
    lost = np.ones(len(samples), np.bool_)
    lost[[40, 41, 9_000]] = False
    samples = samples[lost]
    rng = np.random.default_rng(3)
    marks = np.unique([0, *rng.integers(0, len(samples), 400).tolist(), len(samples)]).tolist()

    def views(piece: int | None) -> tuple[list[Event], list[View]]:
        driver, seen = drive(), []
        for begin, stop in pairwise(marks):
            driver.feed(samples[begin:stop], piece or stop - begin)
            seen.append(driver.engine.view)
        return driver.events, seen

    events, seen = views(None)

    assert views(1) == (events, seen)
    assert drive().feed(samples, len(samples)).events == events
    assert [type(e) for e in events if not isinstance(e, Entered)] == [Checked, Restarted, Accepted, Finished]


def test_the_verdict_is_that_of_the_segments_of_the_samples_that_it_names(
    drive: Drive, turned: Records
) -> None:
    driver = drive().feed(turned)
    (accepted,) = driver.of(Accepted)
    counter = turned["counter"]

    attempt = turned[(counter >= accepted.first_counter) & (counter <= accepted.last_counter)]
    (rotation,) = find_segments([attempt]).rotations

    assert rotation.angle_deg == pytest.approx(accepted.angle_deg, abs=1e-9)  # rounding of sums in pieces
    assert rotation.peak_deg_per_s == pytest.approx(accepted.peak_deg_per_s, abs=1e-9)
    procedure = plan()
    assert rejection_reasons(rotation, procedure.rotation_limits(procedure.steps[0]), "Z") == ()


def test_the_log_is_of_every_sample_from_the_end_of_the_alignment(drive: Drive, turned: Records) -> None:
    driver = drive().feed(turned)
    (log,), (accepted,) = driver.engine.runs, driver.of(Accepted)
    rotate = next(e for e in driver.of(Entered) if e.phase is Phase.ROTATE)

    assert log.counter[0] == rotate.counter + 1
    assert log.counter[-1] == accepted.last_counter
    np.testing.assert_array_equal(np.diff(log.counter), 1)
    np.testing.assert_allclose(log.t_s, 2e-3 * (1 + np.arange(len(log.counter))))
    # no arms and no errors: what 30 s of alignment leave in level and heading, under 0.1 mrad g
    assert np.abs(log.v_n[:, :2]).max() < 1e-3 * log.t_s[-1]
    # half a turn in 2.5 s makes 8.8 / 2.5 m/s a metre (mathematics, section 3), the way to it 0 at rest
    assert np.linalg.norm(log.H[-1, :2]) > 3.5
    assert np.linalg.norm(log.H[100]) < 0.01


def test_progress_and_sigmas_of_the_alignment_are_shown(drive: Drive, bench: Bench, step: Any) -> None:
    procedure = {**Z, "align_s": 100}
    driver = drive(procedure).feed(bench(step(CHECK_S + 110.0)))
    views = [view for view in driver.views if view.phase is Phase.ALIGN]

    progress = [view.progress for view in views]
    assert progress == sorted(progress)
    assert views[-1].progress == pytest.approx(1.0, abs=0.01)
    assert views[0].remaining_s == pytest.approx(100.0, abs=0.3)
    assert views[0].heading_sigma_deg is None
    sigmas = [view.heading_sigma_deg for view in views if view.heading_sigma_deg is not None]
    assert len(set(sigmas)) >= 4
    assert sigmas[-1] < sigmas[0]


# Keys


def test_without_a_confirmation_it_waits_for_ever(drive: Drive, bench: Bench, step: Any) -> None:
    driver = drive(hands_free=False).feed(bench(step(CHECK_S + 600.0)))

    assert driver.phases == ["preflight", "place"]
    assert english(driver.engine.view.headline) == "PRESS ENTER"
    assert "confirm" in driver.engine.view.actions


def test_a_confirmation_counts_for_its_step_only_and_only_while_the_sensors_agree(
    drive: Drive, bench: Bench, step: Any
) -> None:
    samples = bench(
        step(CHECK_S + 2.0), step(4.0, 20.0), step(5.0), step(4.0, 90.0, (1.0, 0.0, 0.0)), step(5.0)
    )
    driver = drive(Z, X, hands_free=False)
    driver.feed(part(samples, 0.0, 20.0))
    assert not driver.act(Confirm("z"))  # in the preflight
    driver.feed(part(samples, 20.0, CHECK_S + 4.0))

    assert driver.engine.view.phase is Phase.PLACE
    assert not driver.act(Confirm("z"))  # while it moves
    driver.feed(part(samples, CHECK_S + 4.0, CHECK_S + 10.0))
    assert not driver.act(Confirm("x"))  # of a later step
    driver.feed(part(samples, CHECK_S + 10.0, CHECK_S + 20.0))
    assert english(driver.engine.view.headline) == "TURN IT: Z UP"
    assert not driver.act(Confirm("z"))  # in the wrong pose
    assert "confirm" not in driver.engine.view.actions


def test_a_repeated_confirmation_starts_no_later_step(drive: Drive, bench: Bench, step: Any) -> None:
    samples = bench(step(CHECK_S + ALIGN_S), step(2.5, 180.0), step(12.0), step(40.0))
    driver = drive(Z, Z_BACK, hands_free=False)
    driver.feed(part(samples, 0.0, CHECK_S))

    (entered,) = driver.act(Confirm("z"))

    assert entered.phase is Phase.SETTLE
    for at in np.arange(CHECK_S, CHECK_S + 80.0, 0.5):
        driver.feed(part(samples, at, at + 0.5))
        assert not driver.act(Confirm("z"))
    assert driver.phases == ["preflight", "place", "settle", "align", "rotate", "rest", "verdict", "place"]
    assert driver.engine.view.step_id == "z-back"
    (entered,) = driver.act(Confirm("z-back"))
    assert entered.phase is Phase.SETTLE


def test_an_accepted_step_can_be_repeated_and_the_old_recording_is_kept(
    drive: Drive, bench: Bench, step: Any
) -> None:
    samples = bench(
        step(CHECK_S + ALIGN_S),
        step(2.5, 180.0),
        step(10.0),
        step(4.0, -180.0),
        step(ALIGN_S),
        step(2.5, 180.0),
        step(12),
    )
    again = CHECK_S + ALIGN_S + 11.0
    driver = drive().feed(part(samples, 0.0, again))
    assert driver.engine.view.phase is Phase.DONE

    redone, entered = driver.act(Redo("z"))

    assert redone == Redone("z", 2, entered.counter)
    assert (entered.phase, entered.attempt) == (Phase.PLACE, 2)
    assert driver.act(Redo("z")) == ()  # it has only just begun
    driver.feed(part(samples, again, 200.0))
    assert [(a.step_id, a.attempt) for a in driver.of(Accepted)] == [("z", 1), ("z", 2)]
    assert [(log.step_id, log.attempt) for log in driver.engine.runs] == [("z", 1), ("z", 2)]
    assert driver.engine.accepted["z"].attempt == 2
    assert len(driver.of(Finished)) == 2
    # after the first turn the pose was the other way round, and said so
    assert (
        "X points 180 deg off east, expected at most 45: turn it 180 deg clockwise, seen from above"
        in driver.hints
    )


def test_redo_in_the_middle_begins_the_step_anew(drive: Drive, turned: Records) -> None:
    driver = drive().feed(part(turned, 0.0, CHECK_S + 20.0))

    redone, entered = driver.act(Redo("z"))

    assert isinstance(redone, Redone)
    assert (entered.phase, entered.attempt) == (Phase.PLACE, 2)
    assert driver.act(Redo("x")) == ()
    assert driver.engine.view.actions == ("confirm", "skip", "abort")


def test_with_too_few_accepted_steps_the_skipped_ones_are_named(drive: Drive, turned: Records) -> None:
    driver = drive(X, Z, hands_free=False)
    driver.feed(turned[:500])
    assert driver.act(Skip("x")) == ()  # the preflight comes first
    driver = drive(Z, X).feed(part(turned, 0.0, CHECK_S + ALIGN_S + 9.0))
    assert driver.engine.view.step_id == "z"
    assert driver.act(Skip("z")) == ()  # it was accepted
    driver.feed(part(turned, CHECK_S + ALIGN_S + 9.0, 100.0))
    assert driver.engine.view.step_id == "x"

    skipped, entered, finished = driver.act(Skip("x"))

    assert isinstance(skipped, Skipped)
    assert entered.phase is Phase.DONE
    assert (finished.accepted, finished.skipped) == (("z",), ("x",))
    assert finished.reasons == (message("too_few_steps", steps=("x",)),)
    assert driver.engine.view.reasons == finished.reasons
    assert driver.act(Skip("x")) == ()
    assert [type(e) for e in driver.act(Redo("x"))] == [Redone, Entered]


@pytest.mark.parametrize("ends", ["key", "motion"])
def test_a_rejection_stays_for_a_person_until_a_key_or_the_next_motion(
    ends: str, drive: Drive, bench: Bench, step: Any
) -> None:
    wrong = bench(step(CHECK_S + ALIGN_S), step(2.5, -180.0), step(60.0), step(4.0, 180.0), step(2.0))
    driver = drive(hands_free=False).feed(part(wrong, 0.0, CHECK_S))
    driver.act(Confirm("z"))
    driver.feed(part(wrong, CHECK_S, CHECK_S + ALIGN_S + 60.0))
    rejected = driver.engine.view

    assert rejected.phase is Phase.VERDICT
    assert reasons(rejected)[0].startswith("wrong direction: -180 deg")
    assert [english(hint) for hint in rejected.hints] == [
        "turn it 180 deg counter-clockwise, seen from above"
    ]
    if ends == "key":
        driver.act(Confirm("z"))
    else:
        driver.feed(part(wrong, CHECK_S + ALIGN_S + 60.0, 200.0))
    again = driver.engine.view
    assert again.phase is Phase.PLACE
    assert again.reasons == ()
    assert again.last_try == rejected.reasons


def test_a_skip_can_be_taken_back(drive: Drive, turned: Records) -> None:
    driver = drive(Z, X, Z_BACK, hands_free=False).feed(part(turned, 0.0, CHECK_S))
    assert "back" not in driver.engine.view.actions
    driver.act(Skip("z"))
    driver.act(Skip("x"))
    assert driver.engine.view.skipped == ("z", "x")
    assert "back" in driver.engine.view.actions
    driver.act(Redo("x"))
    assert (driver.engine.view.step_id, driver.engine.view.skipped) == ("x", ("z",))


def test_exchanged_accelerometers_are_suspected_only_after_the_unit_was_lifted(
    drive: Drive, bench: Bench, step: Any
) -> None:
    samples = bench(step(CHECK_S + 60.0), step(4.0, 5.0, (1.0, 0.0, 0.0)), step(20.0))
    driver = drive(Z, X, hands_free=False).feed(part(samples, 0.0, CHECK_S))
    driver.act(Skip("z"))

    driver.feed(part(samples, CHECK_S, CHECK_S + 60.0))
    assert not any("exchanged" in hint for hint in driver.hints)

    driver.feed(part(samples, CHECK_S + 60.0, 200.0))
    assert any("accelerometers Z and X are exchanged" in hint for hint in driver.hints)


def test_an_abort_ends_it(drive: Drive, turned: Records) -> None:
    driver = drive().feed(part(turned, 0.0, CHECK_S + 10.0))

    entered, aborted = driver.act(Abort())

    assert entered.phase is Phase.ABORTED
    assert isinstance(aborted, Aborted)
    driver.feed(part(turned, CHECK_S + 10.0, 100.0))
    assert driver.events[-1] is aborted
    assert driver.act(Abort()) == ()
    assert driver.act(Redo("z")) == ()
    assert driver.engine.view.actions == ()


def test_a_session_that_is_resumed_asks_no_accepted_step_again_and_counts_attempts_on(
    drive: Drive, turned: Records
) -> None:
    (accepted,) = drive().feed(turned).of(Accepted)
    back = turned.copy()
    back["dtheta_b"][:, :2] *= -1.0  # turned by 180 deg, X west
    back["dv_b"][:, :2] *= -1.0

    driver = drive(Z, Z_BACK, accepted={"z": Accepted(**asdict(accepted))}, attempts={"z": 1, "z-back": 3})
    driver.feed(part(back, 0.0, CHECK_S))

    (placed,) = (e for e in driver.of(Entered) if e.phase is Phase.PLACE)
    assert (placed.step_id, placed.attempt) == ("z-back", 4)
    done = drive(Z, accepted={"z": accepted}).feed(turned[:100])
    assert [type(e) for e in done.events] == [Entered, Finished]


@pytest.mark.parametrize("poses", [(Z,), (Z, X)], ids=["all is done", "in the next step"])
def test_an_accepted_step_without_a_complete_recording_is_repeated(
    drive: Drive, turned: Records, poses: tuple[dict[str, Any], ...]
) -> None:
    driver = drive(*poses).feed(turned)
    newest = int(turned["counter"][-1])

    rejected, entered = driver.engine.reject("z", verbatim("the disk is full"))

    assert isinstance(rejected, Rejected)
    assert (rejected.step_id, rejected.attempt) == ("z", 1)
    assert entered.phase is Phase.VERDICT
    assert driver.engine.accepted == {}
    assert english(driver.engine.view.headline) == "REJECTED: DO IT AGAIN"
    assert reasons(driver.engine.view) == ["the disk is full"]
    rest = np.tile(turned[-1000:], 3)  # 6 s: the verdict has been shown
    rest["counter"] = newest + 1 + np.arange(len(rest))
    driver.feed(rest)
    placed = [(e.step_id, e.attempt) for e in driver.of(Entered) if e.phase is Phase.PLACE]
    assert placed == [("z", 1), *[("x", 1) for _ in poses[1:]], ("z", 2)]
    assert reasons(driver.engine.view) == []
    assert [english(reason) for reason in driver.engine.view.last_try] == ["the disk is full"]


def test_after_an_abort_no_step_is_repeated(drive: Drive, turned: Records) -> None:
    driver = drive(Z, X).feed(turned)
    driver.act(Abort())
    assert driver.engine.reject("z", verbatim("the disk is full")) == ()


def test_an_accepted_step_has_its_number_of_samples_without_lost_ones(drive: Drive, turned: Records) -> None:
    (whole,) = drive().feed(turned).of(Accepted)
    lost = np.arange(19_000, 31_000, 500)
    (holed,) = drive().feed(np.delete(turned, lost)).of(Accepted)
    counter = np.delete(turned["counter"], lost)
    assert whole.samples == whole.last_counter - whole.first_counter + 1
    assert holed.samples == ((counter >= holed.first_counter) & (counter <= holed.last_counter)).sum()
    assert holed.samples < whole.samples


# Nothing runs out


def test_the_engine_waits_any_time_for_the_rotation_and_the_log_stays_short(
    drive: Drive, bench: Bench, step: Any
) -> None:
    driver = drive().feed(bench(step(CHECK_S + ALIGN_S + 500.0), step(2.5, 180.0), step(6.0)))

    (accepted,), (log,) = driver.of(Accepted), driver.engine.runs
    assert accepted.rest_before_s > 500.0
    assert log.t_s[-1] < 60.0 + 7.0
    assert driver.phases.count("rotate") == 1


def test_nothing_runs_out_while_the_unit_is_carried_or_no_samples_come(
    drive: Drive, bench: Bench, step: Any
) -> None:
    samples = bench(step(CHECK_S + 1.0), *[step(50.0, 80.0), step(50.0, -80.0)] * 3, step(ALIGN_S))
    away = (samples["counter"] > 60_000) & (samples["counter"] < 100_000)

    driver = drive().feed(samples[~away])

    assert driver.phases[-1] == "rotate"
    assert not driver.of(Rejected)


# What goes wrong


def test_samples_that_are_missing_begin_the_alignment_again_with_their_number(
    drive: Drive, turned: Records
) -> None:
    # 6 of the 10 samples of a block are enough to hide a push
    for missing in (6, 700):
        driver = drive().feed(np.delete(turned, slice(20_002, 20_002 + missing)))

        restarted = driver.of(Restarted)[0]
        assert reasons(restarted) == [f"alignment interrupted after 8 s: {missing} samples missing"]
        assert driver.phases[3:6] == ["align", "settle", "align"]


def test_single_samples_that_are_missing_do_not_disturb_a_rest(drive: Drive, turned: Records) -> None:
    driver = drive().feed(np.delete(turned, np.arange(19_000, 31_000, 500)))

    assert not driver.of(Restarted)
    assert driver.of(Accepted)


def test_a_sample_that_is_missing_in_the_turn_rejects_it(drive: Drive, turned: Records) -> None:
    during = round((CHECK_S + ALIGN_S + 1.2) / 2e-3)

    driver = drive().feed(np.delete(turned, [during]))

    (rejected,) = driver.of(Rejected)
    assert reasons(rejected) == ["1 sample missing during the rotation, expected at most 0"]
    assert driver.phases[-2:] == ["verdict", "place"]


def test_the_cable_out_during_the_turn_or_the_rest_after_rejects_it(drive: Drive, turned: Records) -> None:
    turn_s = CHECK_S + ALIGN_S
    for begin_s, reason in (
        (turn_s + 1.0, "during the rotation: 250 samples missing"),
        (turn_s + 4.0, "rest interrupted after 1.5 s of 3: 250 samples missing"),
    ):
        at = round(begin_s / 2e-3)
        driver = drive().feed(np.delete(turned, slice(at, at + 250)))

        assert reasons(driver.of(Rejected)[0]) == [reason]


def test_a_unit_that_restarts_begins_the_alignment_again(drive: Drive, turned: Records) -> None:
    turned["counter"][20_000:] -= turned["counter"][20_000] - 1

    driver = drive().feed(turned)

    restarted = driver.of(Restarted)[0]
    assert reasons(restarted) == ["alignment interrupted after 8 s: the unit restarted"]
    assert restarted.counter < 100


def test_a_fault_of_the_unit_is_named_and_the_engine_waits_for_its_end(drive: Drive, turned: Records) -> None:
    turned["flags"][20_000:22_000] |= np.uint32(Flag.FAULT)
    driver = drive()
    driver.feed(turned[:19_000])
    driver.engine.update_status(Conditions(("dither fault",), {}))
    driver.feed(turned[19_000:])

    restarted = driver.of(Restarted)[0]
    assert reasons(restarted) == ["alignment interrupted after 8 s: the unit reports a fault: dither fault"]
    assert "WAIT FOR THE UNIT" in driver.headlines
    assert [e.counter for e in driver.of(Entered) if e.phase is Phase.ALIGN][1] > 1000 + 22_000


def test_a_push_before_the_turn_disturbs_the_rest_and_aligns_again(
    drive: Drive, bench: Bench, step: Any
) -> None:
    driver = drive().feed(
        bench(step(CHECK_S + ALIGN_S), step(0.4, 2.0), step(ALIGN_S), step(2.5, 180.0), step(6.0))
    )

    (restarted,) = driver.of(Restarted)
    assert reasons(restarted) == ["moved 2.0 deg before the rotation: the rest is disturbed"]
    assert len(driver.of(Accepted)) == 1


def test_a_turn_about_another_axis_is_named(drive: Drive, bench: Bench, step: Any) -> None:
    driver = drive().feed(bench(step(CHECK_S + ALIGN_S), step(2.5, 180.0, (1.0, 0.0, 0.0)), step(9.0)))

    assert "WRONG AXIS" in driver.headlines
    assert "rotates about X, 90 deg off the vertical, expected at most 10: keep Z up" in driver.hints
    (rejected,) = driver.of(Rejected)
    assert reasons(rejected)[0] == "turned about X, expected about Z"
    assert english(driver.engine.view.headline) == "TURN IT: Z UP"
    assert "the -Z side is up, turn the Z side up: turn it over, 180 deg" in driver.hints


def test_a_turn_back_and_forth_that_ends_at_180_is_good(drive: Drive, bench: Bench, step: Any) -> None:
    driver = drive().feed(bench(step(CHECK_S + ALIGN_S), step(0.7, -30.0), step(2.5, 210.0), step(6.0)))

    assert "WRONG WAY" in driver.headlines
    (accepted,) = driver.of(Accepted)
    assert accepted.angle_deg == pytest.approx(180.0, abs=0.1)


# Preflight


def test_the_unit_warms_up_before_it_is_checked(drive: Drive, turned: Records) -> None:
    turned["flags"][:5_000] |= np.uint32(Flag.WARM_UP)

    driver = drive().feed(part(turned, 0.0, 45.0))

    assert driver.headlines[0] == "WARMING UP, WAIT"
    assert driver.of(Checked)[0].counter >= 1000 + 5_000 + 15_000 - 10


READINGS = {
    "upside down": (
        np.diag([1, -1, -1]),
        np.diag([1, -1, -1]),
        ["accelerometer Z reads -9.79 m/s^2, expected +9.79: the unit has its -Z side up"],
    ),
    "accelerometer reversed": (
        np.diag([1, 1, -1]),
        np.eye(3),
        ["accelerometer Z reads -9.79 m/s^2, expected +9.79: accelerometer Z is reversed"],
    ),
    "gyro reversed": (
        np.eye(3),
        np.diag([1, 1, -1]),
        ["gyro Z reads -7.1 deg/h, expected +7.1: gyro Z is reversed"],
    ),
    "accelerometers exchanged": (
        np.eye(3)[[0, 2, 1]],
        np.eye(3),
        [
            "accelerometer Y reads +9.79 m/s^2, expected +0.00; "
            "accelerometer Z reads -0.00 m/s^2, expected +9.79: "
            "accelerometers Y and Z are exchanged"
        ],
    ),
    "gyros exchanged": (
        np.eye(3),
        np.eye(3)[[0, 2, 1]],
        ["gyro Z reads +13.2 deg/h, expected +7.1: gyros Y and Z are exchanged"],
    ),
    "the other way round": (
        np.diag([-1, -1, 1]),
        np.diag([-1, -1, 1]),
        [
            "gyro Y reads -13.2 deg/h, expected +13.3: possible causes in this pose: "
            "the unit has to be turned 180 deg clockwise, seen from above; gyro Y is reversed"
        ],
    ),
    "two things at once": (
        np.diag([1, 1, -1]),
        np.eye(3)[[2, 0, 1]],
        [
            "accelerometer Z reads -9.79 m/s^2, expected +9.79: not explained by another pose, one "
            "reversed axis or two exchanged axes: check C_ba and C_bg"
        ],
    ),
    "accelerometer scale": (
        1.01 * np.eye(3),
        np.eye(3),
        [
            "gravity reads 9.890 m/s^2, expected 9.792 +- 0.02: check the accelerometers' scale "
            "factors and biases, and the site"
        ],
    ),
    "gyro scale": (
        np.eye(3),
        0.9 * np.eye(3),
        [
            "the Earth's rotation reads 13.5 deg/h, expected 15.0 +- 1: check the gyros' scale "
            "factors and biases"
        ],
    ),
}


@pytest.mark.parametrize("name", list(READINGS))
def test_the_preflight_names_what_is_wrong_with_the_axes(
    name: str, drive: Drive, bench: Bench, step: Any
) -> None:
    forces, rates, expected = READINGS[name]
    turned = bench(step(64.0), tilt=(0.0, 0.0, 0.0))
    turned["dv_b"] = turned["dv_b"] @ forces.T
    turned["dtheta_b"] = turned["dtheta_b"] @ rates.T

    driver = drive().feed(turned)

    (rejected,) = driver.of(Rejected)  # once, though it is looked at again
    assert (rejected.step_id, reasons(rejected)) == ("preflight", expected)
    assert driver.engine.view.phase is Phase.PREFLIGHT


def test_near_the_equator_a_reversed_gyro_cannot_be_distinguished_from_a_sound_one(
    bench: Bench, step: Any, site: Site
) -> None:
    there = site.model_copy(update={"latitude_deg": 0.5})
    samples = bench(step(CHECK_S))
    samples["dtheta_b"] = [0.0, EARTH_RATE * 2e-3, 0.0]
    samples["dv_b"] *= 9.7801 / 9.7919

    assert Driver(there, plan()).feed(samples).of(Checked)

    samples["dv_b"][:, 2] *= -1.0
    (rejected,) = Driver(there, plan()).feed(samples).of(Rejected)
    assert reasons(rejected)[0].endswith(
        "possible causes in this pose: the unit has its -Z side up, accelerometer Z is reversed"
    )


def test_an_axis_that_only_another_pose_shows_is_named_there(drive: Drive, bench: Bench, step: Any) -> None:
    samples = bench(step(CHECK_S + 2.0), step(4.0, -120.0, (1.0, 1.0, 1.0)), step(40.0))
    samples["dtheta_b"][:, 0] *= np.where(np.arange(len(samples)) * 2e-3 < CHECK_S + 8.0, 1.0, -1.0)
    driver = drive(Z, X, hands_free=False)
    driver.feed(part(samples, 0.0, CHECK_S + 1.0))
    driver.act(Skip("z"))
    driver.feed(part(samples, CHECK_S + 1.0, CHECK_S + 9.0))
    driver.act(Confirm("x"))
    driver.feed(part(samples, CHECK_S + 9.0, 100.0))

    (restarted,) = driver.of(Restarted)
    assert reasons(restarted)[0].startswith("gyro X reads -7.1 deg/h, expected +7.1: gyro X is reversed")


def test_temperature_noise_and_faults_are_held_against_the_limits(drive: Drive, turned: Records) -> None:
    zero = (0.0, 0.0, 0.0)
    calibration = parse(
        {
            **NOMINAL.model_dump(mode="json", exclude_none=True),
            "temperature": {
                "reference_degc": 25.0,
                "range_degc": [10.0, 40.0],
                "gyro_bias_deg_per_h_per_k": zero,
                "gyro_scale_ppm_per_k": zero,
                "accelerometer_bias_ug_per_k": zero,
                "accelerometer_scale_ppm_per_k": zero,
            },
        },
        type(NOMINAL),
        "test",
    )
    rng = np.random.default_rng(1)
    turned["dv_b"] += 8e-5 * rng.standard_normal(turned["dv_b"].shape)
    driver = drive(calibration=calibration, limits={"noise_mg": 0.5})
    driver.engine.update_status(Conditions(("power",), {"gyro": 48.25, "accelerometer_x": None}))
    driver.feed(part(turned, 0.0, CHECK_S))

    (rejected,) = driver.of(Rejected)
    fault, temperature, noise = reasons(rejected)
    assert fault == "the unit reports a fault: power"
    assert temperature == "gyro at 48.2 degC, certificate valid from 10 to 40: wait"
    assert noise.startswith("accelerometer noise 2.08 ")
    assert noise.endswith("mg rms at rest, expected at most 0.5: check the bench for vibration")


def test_dither_that_the_rate_filter_leaves_is_found_before_the_first_step(
    drive: Drive, turned: Records
) -> None:
    t = np.arange(len(turned)) * 2e-3  # the samples alias 400 Hz to 100 Hz
    for amplitude_arcsec, count in ((2.0, 0), (10.0, 1)):
        dithered = turned.copy()
        dithered["dtheta_b"][:, 1] += np.diff(
            amplitude_arcsec * ARCSEC * np.sin(2.0 * np.pi * 400.0 * t + 0.3), prepend=0.0
        )
        driver = drive().feed(part(dithered, 0.0, CHECK_S))
        found = [text for one in driver.of(Rejected) for text in reasons(one)]
        assert len(found) == count
    assert found[0].startswith("gyro Y carries dither of 10 arcsec at 100 Hz, of which the rate filter ")


def test_a_small_motion_before_the_noise_is_known_is_left_out_of_the_check(
    drive: Drive, bench: Bench, step: Any
) -> None:
    driver = drive().feed(bench(step(10.0), step(4.0, 0.6), step(CHECK_S)))

    (checked,) = driver.of(Checked)
    assert checked.counter >= 1000 + (14.0 + 30.0) / 2e-3 - 200
    assert not driver.of(Rejected)
    assert any("was not at rest" in reason for view in driver.views for reason in reasons(view))


# Where to


def test_the_prompt_for_the_pose_follows_from_gravity_and_heading(
    drive: Drive, bench: Bench, step: Any
) -> None:
    samples = bench(
        step(CHECK_S + ALIGN_S),
        step(2.5, 180.0),
        step(12.0),
        step(4.0, -180.0),
        step(4.0, -120.0, (1.0, 1.0, 1.0)),
        step(8.0),
    )
    driver = drive(Z, X).feed(samples)

    # after the turn X looks west, so the side opposite to it looks east
    assert (
        "the Z side is up, turn the X side up: roll it 90 deg toward its -X side (east)",
        "X up, Y roughly east, Z roughly north",
    ) in {tuple(map(english, view.hints)) for view in driver.views}
    assert driver.engine.view.phase is Phase.ALIGN


def test_headlines_fit_a_screen_that_is_read_from_afar(drive: Drive, turned: Records) -> None:
    driver = drive(Z, X).feed(turned)

    assert max(len(english(view.headline)) for view in driver.views) <= 38
    assert english(driver.views[-1].title) == "step 2 of 2: X up, +180 deg"
    bells = [view.bells for view in driver.views]
    assert bells == sorted(bells)
    assert bells[-1] == 2  # the turn is due, the step is done
    assert driver.views[5].stillness == pytest.approx(1.0)


# Several turns after one alignment


@pytest.fixture
def turns(bench: Bench, step: Any) -> Callable[..., Records]:
    """Preflight and alignment, then these turns and rests, and a rest of 12 s."""
    return lambda *steps: bench(step(CHECK_S + ALIGN_S), *(step(*one) for one in steps), step(12.0))


Turns = Callable[..., Records]
THERE, BACK, ARREST = (2.0, 180.0), (2.0, -180.0), (4.5,)


def titles(driver: Driver) -> list[str]:
    shown = [english(view.title) for view in driver.views]
    return [b for a, b in pairwise(["", *shown]) if a != b]


def test_a_step_of_three_turns_is_one_run(drive: Drive, turns: Turns) -> None:
    driver = drive(Z_TURNS).feed(turns(THERE, ARREST, BACK, ARREST, THERE))

    assert driver.phases == [
        *("preflight", "place", "settle", "align"),
        *("rotate", "rest") * 3,
        *("verdict", "done"),
    ]
    assert [h for h in driver.headlines if h.startswith("ROTATE NOW")] == [
        "ROTATE NOW +180",
        "ROTATE NOW -180",
        "ROTATE NOW +180",
    ]
    assert titles(driver) == [f"step 1 of 1: Z up, turn {turn} of 3" for turn in (1, 2, 3, 1)]
    assert [(e.turn, round(e.angle_deg), e.reasons) for e in driver.of(Turned)] == [
        (1, 180, ()),
        (2, -180, ()),
        (3, 180, ()),
    ]
    (accepted,) = driver.of(Accepted)
    assert (accepted.turns, accepted.turns_within_limits) == (3, 3)
    assert accepted.rest_before_s >= 3.0
    assert accepted.rest_after_s >= 3.0
    (log,) = driver.engine.runs
    np.testing.assert_array_equal(np.diff(log.counter), 1)
    assert log.counter[-1] == accepted.last_counter
    # one alignment: the log begins before the first turn and continues through all
    assert log.counter[0] < driver.of(Turned)[0].counter - 1000
    # the turns back add to what the turns there do to H: three times as much as one
    first = log.H[log.counter == driver.of(Turned)[0].counter][0, :2]
    assert np.linalg.norm(log.H[-1, :2]) == pytest.approx(3.0 * np.linalg.norm(first), rel=0.01)


@pytest.mark.parametrize(
    ("turn", "reasons_told", "within"),
    [
        ((2.0, -150.0), ["turned 150.0 deg, expected 180 +- 5"], 2),
        ((2.0, 180.0), ["wrong direction: +180 deg, expected -180"], 3),
        (
            (1.0, 40.0),
            ["wrong direction: +40 deg, expected -180", "turned 40.0 deg, expected 180 +- 5"],
            2,
        ),
        ((8.0, -180.0), ["peak 42 deg/s: slower than 60, an error of about 4.2 mm"], 2),
        ((2.0, -180.0, (0.1, 0.0, 1.0)), ["axis 5.7 deg off the vertical, expected at most 3"], 2),
    ],
    ids=["short", "wrong way", "a little the wrong way", "slow", "tilted axis"],
)
def test_a_turn_outside_its_limits_is_reported_and_the_run_continues(
    drive: Drive, turns: Turns, turn: Any, reasons_told: list[str], within: int
) -> None:
    driver = drive({**Z_TURNS, "turns": 4}, limits={"tilt_deg": 20.0, "axis_tilt_deg": 3.0})
    driver.feed(turns(THERE, ARREST, turn, ARREST, THERE, ARREST, BACK))

    assert not driver.of(Rejected)
    second = driver.of(Turned)[1]
    assert reasons(second) == reasons_told
    resting = [v for v in driver.views if v.phase is Phase.REST and "turn 2 of 4" in english(v.title)]
    assert all(view.reasons == second.reasons for view in resting)
    assert [e.turn for e in driver.of(Turned)] == [1, 2, 3, 4]
    (accepted,) = driver.of(Accepted)
    assert (accepted.turns, accepted.turns_within_limits) == (4, within + 1)
    assert f"{within + 1} of 4 turns within their limits" in driver.hints


def test_more_turns_outside_their_limits_than_within_are_no_run(drive: Drive, turns: Turns) -> None:
    driver = drive(Z_TURNS).feed(turns((2.0, 150.0), ARREST, (2.0, -150.0), ARREST, THERE))

    (rejected,) = driver.of(Rejected)
    assert reasons(rejected) == ["1 of 3 turns within their limits, expected at least half"]
    assert driver.phases[-2:] == ["verdict", "place"]


def test_a_bump_in_a_rest_repeats_the_rest_and_counts_as_no_turn(drive: Drive, turns: Turns) -> None:
    driver = drive(Z_TURNS).feed(turns(THERE, (2.0,), (0.3, 1.0), ARREST, BACK, ARREST, THERE))

    assert [round(e.angle_deg) for e in driver.of(Turned)] == [180, -180, 180]
    assert driver.of(Accepted)[0].turns_within_limits == 3
    shown = {reason for view in driver.views for reason in reasons(view)}
    assert any(reason.startswith("rest interrupted after 2.0 s of 3: the unit moved") for reason in shown)
    assert "moved 1.0 deg before the rotation: the rest is disturbed" in shown
    rests = [e.counter for e in driver.of(Entered) if e.phase is Phase.REST]
    # the second rest begins after the bump and lasts whole, before the turn back is asked for
    back = next(e for e in driver.of(Entered) if e.phase is Phase.ROTATE and e.counter > rests[1])
    assert (back.counter - rests[1]) * 2e-3 > 3.0 - 1.2


def test_a_bump_while_the_next_turn_is_due_repeats_the_rest(drive: Drive, turns: Turns) -> None:
    driver = drive(Z_TURNS).feed(turns(THERE, (6.0,), (0.3, 1.0), ARREST, BACK, ARREST, THERE))

    assert [round(e.angle_deg) for e in driver.of(Turned)] == [180, -180, 180]
    assert not driver.of(Restarted)
    assert driver.phases.count("rest") == 4


def test_a_rest_cut_short_by_the_next_turn_is_reported_and_the_run_continues(
    drive: Drive, turns: Turns
) -> None:
    driver = drive(Z_TURNS).feed(turns(THERE, (2.0,), BACK, ARREST, THERE))

    assert [round(e.angle_deg) for e in driver.of(Turned)] == [180, -180, 180]
    (accepted,) = driver.of(Accepted)
    assert (accepted.turns, accepted.turns_within_limits) == (3, 3)
    shown = {reason for view in driver.views for reason in reasons(view)}
    assert any(reason.startswith("rest interrupted after 2.0 s of 3: the unit moved") for reason in shown)


def at(samples: Records, seconds: float) -> int:
    """Sample at a time after the alignment."""
    return round((CHECK_S + ALIGN_S + seconds) / 2e-3)


def test_an_axis_that_saturates_in_a_turn_ends_the_run(drive: Drive, turns: Turns) -> None:
    samples = turns(THERE, ARREST, BACK, ARREST, THERE)
    samples["flags"][at(samples, 7.5)] |= np.uint32(Flag.SATURATED)

    driver = drive(Z_TURNS).feed(samples)

    (rejected,) = driver.of(Rejected)
    assert reasons(rejected) == ["an axis saturated during the rotation"]
    assert [e.turn for e in driver.of(Turned)] == [1]
    assert driver.phases[7:9] == ["verdict", "place"]


@pytest.mark.parametrize(("when_s", "kind"), [(7.5, Rejected), (4.0, Rejected), (6.2, Restarted)])
def test_lost_samples_end_the_run_and_another_alignment_is_asked_for(
    drive: Drive, turns: Turns, when_s: float, kind: type[Event]
) -> None:
    samples = turns(THERE, ARREST, BACK, ARREST, THERE)
    lost = at(samples, when_s)
    samples = np.delete(samples, slice(lost, lost + 100))
    samples["flags"][lost] |= np.uint32(Flag.MISSING_BEFORE)

    driver = drive(Z_TURNS).feed(samples)

    assert "100 samples missing" in reasons(driver.of(kind)[0])[0]
    assert not driver.of(Accepted)
    assert driver.engine.view.phase in (Phase.PLACE, Phase.SETTLE, Phase.ALIGN)


def test_a_unit_that_is_lifted_from_its_pose_ends_the_run(drive: Drive, turns: Turns) -> None:
    driver = drive(Z_TURNS).feed(turns(THERE, ARREST, (4.0, 90.0, (1.0, 0.0, 0.0)), ARREST))

    (rejected,) = driver.of(Rejected)
    assert reasons(rejected)[0] == "the Z side is no longer up: the run is over, align again"


def test_a_pause_as_long_as_an_alignment_asks_for_another_one(drive: Drive, turns: Turns) -> None:
    driver = drive(Z_TURNS).feed(turns(THERE, (50.0,)))

    (restarted,) = driver.of(Restarted)
    assert reasons(restarted) == ["no turn for 27 s: the alignment is too old, align again"]


def test_any_cut_gives_the_same_events_of_several_turns(drive: Drive, turns: Turns) -> None:
    samples = turns(THERE, (2.0,), (0.3, 1.0), ARREST, BACK, (2.0,), (2.0, 150.0))

    whole = drive(Z_TURNS).feed(samples, len(samples)).events

    assert drive(Z_TURNS).feed(samples, 1).events == whole
    assert drive(Z_TURNS).feed(samples, 997).events == whole
    assert len([event for event in whole if isinstance(event, Turned)]) == 3
