"""The engine with rests: the sensors and the noise, on ideal samples with white noise."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from calib.messages import english
from calib.procedure.engine import Engine
from calib.procedure.events import (
    Conditions,
    Confirm,
    Entered,
    Event,
    Finished,
    Phase,
    Rejected,
    RestAccepted,
    Rested,
    Skip,
    View,
)
from calib.procedure.planned_turn import turn_fault
from calib.procedure.schema import PlannedTurn, Procedure
from imudrv.files.settings_file import parse
from imudrv.records import Records
from imudrv.sim.scenario import NOMINAL
from imudrv.site import Site
from imudrv.units import DEG, UG

INTERVAL_NS = 2_000_000
CHECK_S = 31.0  # the preflight and a little more
REST_S = 22.0  # set down, a rest of 20 s, and a little more
Z = {"id": "z", "up": "+Z", "east": "+X", "turn_deg": 180}
X = {"id": "x", "up": "+X", "east": "+Y"}

Bench = Callable[..., Records]


def plan(*poses: dict[str, Any], kind: str = "sensors", rest_s: float = 20.0) -> Procedure:
    document = {
        "format": "imu50-procedure",
        "version": 2,
        "name": "test",
        "kind": kind,
        "rest_s": rest_s,
        "limits": {"tilt_deg": 10},
        "poses": list(poses),
    }
    return parse(document, Procedure, "test")


class Driver:
    """Feeds an engine, and keeps what it says."""

    def __init__(self, site: Site, procedure: Procedure, **options: Any) -> None:
        self.engine = Engine(
            procedure, site, NOMINAL, interval_ns=INTERVAL_NS, **{"hands_free": True, **options}
        )
        self.events: list[Event] = []
        self.views: list[View] = []

    def feed(self, samples: Records, piece: int = 97) -> "Driver":
        for at in range(0, len(samples), piece):
            self.events += self.engine.feed(samples[at : at + piece])
            self.views.append(self.engine.view)
        return self

    def of(self, kind: type[Event]) -> list[Any]:
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def accepted(self) -> list[str]:
        return [event.step_id for event in self.of(RestAccepted)]

    @property
    def why(self) -> list[str]:
        return [english(reason) for event in self.of(Rejected) for reason in event.reasons]


@pytest.fixture
def turned(bench: Bench, step: Any) -> Records:
    """A rest with Z up, half a turn, a rest, and a quarter turn about the axis that points west: X up."""
    return bench(
        step(CHECK_S + REST_S), step(3.0, 180.0), step(REST_S + 6.0), step(3.0, 90.0, (0.0, 1.0, 0.0))
    )


def test_each_rest_is_led_to_and_accepted_and_the_next_pose_is_named(site: Site, turned: Records) -> None:
    drive = Driver(site, plan(Z)).feed(turned)

    assert drive.accepted == ["z", "z-turned"]
    assert drive.engine.view.phase is Phase.DONE
    phases = [event.phase for event in drive.of(Entered)]
    assert phases == ["preflight", *(["place", "rest", "verdict"] * 2), "done"]
    first = drive.of(RestAccepted)[0]
    assert first.last_counter - first.first_counter + 1 == first.samples == round(20.0 / (INTERVAL_NS * 1e-9))
    assert abs(first.heading_deg) < 1.0  # by the Earth's rotation, the noise of 20 s
    hints = {english(hint) for view in drive.views for hint in view.hints}
    assert "then z-turned: Z up, -X roughly east, -Y roughly north" in hints
    assert any(view.remaining_s is not None and 9.0 < view.remaining_s < 11.0 for view in drive.views)


def test_any_cut_of_the_samples_gives_the_same_events(site: Site, turned: Records) -> None:
    assert Driver(site, plan(Z)).feed(turned).events == Driver(site, plan(Z)).feed(turned, 1013).events


def test_the_unit_has_to_be_turned_before_the_second_rest(site: Site, bench: Bench, step: Any) -> None:
    drive = Driver(site, plan(Z)).feed(bench(step(CHECK_S + 4.0 * REST_S)))

    assert drive.accepted == ["z"]
    assert english(drive.engine.view.headline).startswith("TURN IT 180 DEG")


@pytest.mark.parametrize("lost", [False, True])
def test_a_disturbed_rest_is_asked_for_again(site: Site, bench: Bench, step: Any, lost: bool) -> None:
    if lost:
        samples = bench(step(CHECK_S + 3.0 * REST_S))
        at = round((CHECK_S + 0.5 * REST_S) / (INTERVAL_NS * 1e-9))
        samples = np.delete(samples, slice(at, at + 3))  # less than half a block
    else:
        samples = bench(step(CHECK_S + 0.5 * REST_S), step(0.5, 1.0), step(2.0 * REST_S))
    drive = Driver(site, plan(Z)).feed(samples)

    assert len(drive.why) == 1
    assert drive.why[0].startswith("rest interrupted after ")
    assert ("3 samples missing" in drive.why[0]) is lost
    assert drive.accepted == ["z"]
    assert drive.of(RestAccepted)[0].attempt == 2


def test_a_rest_on_a_plate_that_sinks_is_asked_for_again(site: Site, bench: Bench, step: Any) -> None:
    samples = bench(step(CHECK_S + REST_S))
    at_s = np.arange(len(samples)) * INTERVAL_NS * 1e-9
    tilt_ug = np.clip((at_s - CHECK_S) / REST_S, 0.0, 1.0) * 200.0  # 40 arcsec, 0.4 sigma of a block
    samples["dv_b"][:, 0] += tilt_ug * UG * INTERVAL_NS * 1e-9
    drive = Driver(site, plan(Z)).feed(samples)

    assert drive.accepted == []
    assert drive.why[0].startswith("the specific force changed by 1")
    assert "arcsec" in drive.why[0]


@pytest.mark.parametrize(("axis", "kelvin", "accepted"), [(2, 0.5, True), (2, 0.0, False), (0, 0.5, False)])
def test_a_force_along_gravity_that_changes_with_the_temperature_is_no_tilt(
    site: Site, bench: Bench, step: Any, axis: int, kelvin: float, accepted: bool
) -> None:
    samples = bench(step(CHECK_S + REST_S))
    warm = np.clip((np.arange(len(samples)) * INTERVAL_NS * 1e-9 - CHECK_S) / REST_S, 0.0, 1.0)
    samples["dv_b"][:, axis] += warm * 90.0 * UG * INTERVAL_NS * 1e-9
    drive = Driver(site, plan(Z))
    for at in range(0, len(samples), 500):  # once a second
        drive.engine.update_status(Conditions((), {"gyro": 30.0 + kelvin * float(warm[at])}))
        drive.feed(samples[at : at + 500])

    assert drive.accepted == (["z"] if accepted else [])


def test_a_wrong_side_is_named_and_another_pose_of_the_plan_counts(
    site: Site, bench: Bench, step: Any
) -> None:
    y = {"id": "y", "up": "+Y", "east": "+Z"}
    samples = bench(step(CHECK_S + REST_S), step(3.0, -90.0, (0.0, 1.0, 0.0)), step(REST_S + 8.0))
    pose = {"id": "z", "up": "+Z", "east": "+X"}
    drive = Driver(site, plan(pose, y, X)).feed(samples)

    assert drive.accepted == ["z"]
    assert english(drive.engine.view.headline) == "TURN IT: Y UP"

    other = {"id": "x", "up": "+X", "east": "-Z"}  # so it stands after the turn
    drive = Driver(site, plan(pose, y, other)).feed(samples)

    assert drive.accepted == ["z", "x"]
    assert english(drive.engine.view.title).startswith("step 2 of 3: y")


def test_samples_lost_on_the_way_are_named_and_the_rest_is_accepted(site: Site, turned: Records) -> None:
    at = round((CHECK_S + REST_S + 1.5) / (INTERVAL_NS * 1e-9))
    drive = Driver(site, plan(Z)).feed(np.delete(turned, slice(at, at + 100)))

    assert drive.accepted == ["z", "z-turned"]
    assert [event.missing for event in drive.of(RestAccepted)] == [0, 100]
    assert "100 samples lost on the way here" in " ".join(told(drive))


def restarted(samples: Records, at_s: float) -> Records:
    """Samples of a unit that was switched off for a tenth of a second and numbers them from 0 again."""
    at = round(at_s / (INTERVAL_NS * 1e-9))
    after = samples[at + 50 :].copy()
    after["counter"] -= after["counter"][0]
    return np.concatenate([samples[:at], after])


def told(drive: Driver) -> set[str]:
    return {english(reason) for view in drive.views for reason in view.reasons}


def test_a_restart_on_the_way_is_told_at_once_and_the_rests_remain(site: Site, turned: Records) -> None:
    at_s = CHECK_S + REST_S + 1.5
    samples = restarted(turned, at_s)
    drive = Driver(site, plan(Z))
    drive.feed(samples[: round((at_s + 0.2) / (INTERVAL_NS * 1e-9))])

    assert drive.accepted == ["z"]
    assert [english(reason) for reason in drive.engine.view.reasons] == [
        "the unit restarted: the motion since the last rest is not used, the accepted rests are; "
        "keep the unit powered"
    ]
    assert Driver(site, plan(Z)).feed(samples).accepted == ["z", "z-turned"]


def test_a_restart_in_a_rest_is_the_end_of_it_and_it_is_asked_for_again(
    site: Site, bench: Bench, step: Any
) -> None:
    samples = restarted(bench(step(CHECK_S + 3.0 * REST_S)), CHECK_S + 0.5 * REST_S)
    drive = Driver(site, plan(Z)).feed(samples)

    assert len(drive.why) == 1
    assert drive.why[0].endswith(": the unit restarted")
    assert drive.accepted == ["z"]


def test_with_keys_each_rest_is_confirmed(site: Site, turned: Records) -> None:
    drive = Driver(site, plan(Z), hands_free=False).feed(turned[: round(40.0 / (INTERVAL_NS * 1e-9))])

    assert drive.engine.view.phase is Phase.PLACE
    assert drive.engine.view.actions == ("confirm", "skip", "abort")
    drive.events += drive.engine.handle(Confirm("z"))
    assert drive.engine.view.phase is Phase.REST


def test_without_three_rests_there_is_no_result(site: Site, turned: Records) -> None:
    drive = Driver(site, plan(Z, X)).feed(turned[:100])
    drive.events += drive.engine.handle(Skip("z"))
    drive.feed(turned[100 : round(CHECK_S / (INTERVAL_NS * 1e-9))])
    for name in ("z", "z-turned", "x"):
        drive.events += drive.engine.handle(Skip(name))

    (finished,) = drive.of(Finished)
    assert [english(reason) for reason in finished.reasons] == [
        "the accepted rests are too few: do more of the skipped steps: z, z-turned, x"
    ]


# The turn of a table


TABLE = {"id": "a", "up": "+Z", "east": "+X"}


@pytest.mark.parametrize(
    ("about", "deg", "words"),
    [
        ("+Z", 90.0, None),
        ("-Z", -90.0, None),
        ("+Z", -90.0, "turned +90.0 deg about Z, the procedure says -90 +- 10: the sign is wrong"),
        ("+Z", 9.0, "the procedure says +9 +- 5: ten times too much or too little"),
        (
            "+X",
            90.0,
            "deg about X, the procedure says +90 +- 10: turned +90.0 deg about Z instead",
        ),
        ("+Z", 60.0, "the procedure says +60 +- 8: check the table, the file and the profile"),
    ],
)
def test_the_turn_of_a_table_is_checked_against_the_gyros(
    site: Site, bench: Bench, step: Any, about: str, deg: float, words: str | None
) -> None:
    turn = {"about": about, "deg": deg, "seconds": 3}
    b = {"id": "b", "up": "+Z", "east": "-Y", "turn": turn}  # 90 deg counter-clockwise of a
    samples = bench(step(CHECK_S + REST_S), step(3.0, 90.0), step(REST_S + 3.0))
    drive = Driver(site, plan(TABLE, b)).feed(samples)

    assert drive.accepted == (["a", "b"] if words is None else ["a"])
    assert len(drive.why) == (words is not None)  # once, until the table is turned again
    assert words is None or words in drive.why[0]
    hints = {english(hint) for view in drive.views for hint in view.hints}
    assert f"turn the table by {deg:+g} deg about {about.removeprefix('+')}, in 3 s" in hints


def test_a_gyro_scale_of_five_percent_is_no_wrong_turn() -> None:
    turn = PlannedTurn(about="+X", deg=360.0, seconds=10.0)
    assert turn_fault(turn, (378.0 * DEG, 0.0, 0.0)) is None
    assert turn_fault(turn, (390.0 * DEG, 0.0, 0.0)) is not None


# The noise


def test_a_long_rest_goes_on_after_a_disturbance_and_after_a_kill(
    site: Site, bench: Bench, step: Any
) -> None:
    samples = bench(step(CHECK_S + 72.0), step(0.5, 1.0), step(62.0))
    one = {"id": "z", "up": "+Z", "east": "+X"}
    drive = Driver(site, plan(one, kind="noise", rest_s=130.0)).feed(samples)

    assert drive.accepted == ["z"]
    assert drive.why == []
    assert [round(event.rest_s) for event in drive.of(Rested)] == [60, 120]
    assert any(reason.startswith("disturbed after 7") for reason in told(drive))

    again = Driver(site, plan(one, kind="noise", rest_s=130.0), rested_s={"z": 120.0})
    again.feed(samples[: round((CHECK_S + 14.0) / (INTERVAL_NS * 1e-9))])
    assert again.accepted == ["z"]


def test_a_long_rest_over_a_restart_is_that_of_the_samples_numbered_since(
    site: Site, bench: Bench, step: Any
) -> None:
    one = {"id": "z", "up": "+Z", "east": "+X"}
    samples = restarted(bench(step(CHECK_S + 82.0)), CHECK_S + 40.0)
    drive = Driver(site, plan(one, kind="noise", rest_s=70.0)).feed(samples)

    (accepted,) = drive.of(RestAccepted)
    assert any(
        reason.endswith(
            "the unit restarted; the time at rest still counts, but one longer stretch shows more"
        )
        for reason in told(drive)
    )
    assert accepted.last_counter - accepted.first_counter + 1 == accepted.samples
    assert 25.0 < accepted.samples * INTERVAL_NS * 1e-9 < 35.0
