from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from calib.cli import main
from calib.procedure.plan import duration_s, load, predicted, shipped, text, verification
from calib.procedure.schema import Procedure
from calib.sensors import plan as sensors_plan
from imudrv.errors import FaultyFileError, InputError
from imudrv.files.settings_file import parse, read, write
from imudrv.site import Site
from imudrv.units import MM


def procedure(*poses: dict[str, object], version: int = 1, **others: object) -> Procedure:
    header = {"format": "imu50-procedure", "version": version, "name": "test"}
    document = {**header, "poses": list(poses), **others}
    return parse(document, Procedure, "test")


def test_the_three_rotations_are_those_of_the_literature() -> None:
    steps = load("three-rotations").steps

    assert [(s.id, s.up, s.east, s.turn_deg, s.align_s) for s in steps] == [
        ("z-up", "+Z", "+X", 180, 370.0),
        ("x-up", "+X", "+Y", 180, 370.0),
        ("y-up", "+Y", "+Z", 180, 370.0),
    ]
    # X east, Y north, Z up; Y east, Z north, X up; Z east, X north, Y up
    for step, order in zip(steps, ([0, 1, 2], [1, 2, 0], [2, 0, 1]), strict=True):
        np.testing.assert_array_equal(step.C_bn, np.eye(3)[:, order])


@pytest.mark.parametrize("name", sorted(shipped()))
def test_a_procedure_that_was_written_is_read_again(name: str, tmp_path: Path) -> None:
    found = load(name)
    write(tmp_path / "copy.yaml", found)
    assert read(tmp_path / "copy.yaml", Procedure) == found


def test_six_rotations_turn_each_pose_both_ways_and_lift_the_unit_twice() -> None:
    steps = load("six-rotations").steps

    assert [(s.up, s.turn_deg) for s in steps] == [
        (up, turn) for up in ("+Z", "+X", "+Y") for turn in (180, -180)
    ]
    for there, back in zip(steps[::2], steps[1::2], strict=True):
        assert back.up == there.up
        np.testing.assert_array_equal(back.C_bn[:, :2], -there.C_bn[:, :2])


def test_a_prediction_is_shown_before_anyone_lifts_anything(site: Site) -> None:
    predictions = {name: predicted(load(name), site) for name in shipped() if load(name).kind == "arms"}
    rms = {name: np.sqrt(np.trace(predictions[name].covariance) / 9.0) / MM for name in predictions}

    # mathematics, section 4: 0.045 mm rms at most with three rotations; the bound for the default priors is
    # near 0.03. Twice as many gain a root of 2, and more, as they determine the skew
    assert 0.02 < rms["three-rotations"] < 0.045
    assert rms["six-rotations"] < rms["three-rotations"] / 2**0.5
    assert predictions["six-rotations"].differences_sigma.shape == (2, 3)


def test_a_plan_that_does_not_see_the_six_differences_is_refused_with_the_direction(site: Site) -> None:
    plan = procedure({"id": "z", "up": "+Z", "east": "+X", "turn_deg": 180, "repeats": 4})

    with pytest.raises(
        InputError, match=r"procedure test: .*determine 6 directions .*got 2; unobservable.*x_Z.*axis up"
    ):
        predicted(plan, site)


def test_what_is_skipped_is_not_predicted(site: Site) -> None:
    plan = load("three-rotations")

    with pytest.raises(InputError, match=r"determine 6 directions .*got 4"):
        predicted(plan, site, skipped=["x-up"])


def test_repeats_begin_where_the_turn_before_has_ended() -> None:
    plan = procedure(
        {"id": "x", "up": "+X", "east": "-Z", "turn_deg": -180, "repeats": 3, "align_s": 60, "rest_s": 9}
    )

    assert [(s.id, s.east) for s in plan.steps] == [("x-1", "-Z"), ("x-2", "+Z"), ("x-3", "-Z")]
    assert {(s.align_s, s.rest_s, s.turn_deg) for s in plan.steps} == {(60.0, 9.0, -180)}


def test_all_faults_of_a_file_are_reported_at_once(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        "format: imu50-procedure\nversion: 1\nname: mine\nalign_s: 5\nlimits: {tilt: 3}\nposes:\n"
        "  - {id: Z up, up: +Z, east: +X, turn_deg: 180}\n"
        "  - {id: x, up: +X, east: -X, turn_deg: 180}\n"
        "  - {id: y, up: Y, east: +X, turn_deg: 90}\n"
    )

    with pytest.raises(FaultyFileError) as error:
        load(str(path))

    assert [fault.partition(":")[0] for fault in error.value.faults] == [
        "align_s",
        "limits.tilt",
        "poses[0].id",
        "poses[1]",
        "poses[2].up",
        "poses[2].turn_deg",
    ]
    text = str(error.value)
    assert "did you mean tilt_deg?" in text
    assert "expected two different axes up and east, got +X and -X" in text
    assert "poses[2].turn_deg: expected 180 or -180, got 90" in text


def test_an_id_given_twice_is_refused() -> None:
    pose = {"up": "+X", "east": "+Y", "turn_deg": 180}

    with pytest.raises(FaultyFileError, match=r"expected each id once, got x-1 again"):
        procedure({"id": "x", "repeats": 2, **pose}, {"id": "x-1", **pose})


def test_a_procedure_that_is_not_there_names_the_shipped_ones() -> None:
    with pytest.raises(
        InputError,
        match=r"'four': expected one of long-rest, loops-both, .* or the path",
    ):
        load("four")


def test_limits_reach_the_judge_of_the_rotation() -> None:
    plan = procedure(
        {"id": "x", "up": "+X", "east": "+Y", "turn_deg": -180, "rest_s": 7},
        align_s=60,
        limits={"angle_tolerance_deg": 2, "least_peak_deg_per_s": 90, "axis_tilt_deg": 4},
    )

    limits = plan.rotation_limits(plan.steps[0])

    assert (limits.angle_deg, limits.angle_tolerance_deg, limits.least_peak_deg_per_s) == (180.0, 2.0, 90.0)
    assert (limits.axis_tilt_deg, limits.rest_before_s, limits.rest_after_s) == (4.0, 60.0, 7.0)


# Version 2


TURNS: dict[str, object] = {"id": "z", "up": "+Z", "east": "+X", "turn_deg": 180, "turns": 4}


def test_ten_turns_are_three_runs_of_about_nine_minutes() -> None:
    plan = load("ten-turns")

    assert [(s.id, s.up, s.turns, s.align_s, s.rest_s) for s in plan.steps] == [
        ("z-up", "+Z", 10, 90.0, 4.0),
        ("x-up", "+X", 10, 90.0, 4.0),
        ("y-up", "+Y", 10, 90.0, 4.0),
    ]
    assert plan.turn_s == (1.5, 2.0)
    assert 8.5 < duration_s(plan) / 60.0 < 9.5


def test_every_second_turn_is_back_unless_the_file_says_otherwise() -> None:
    to_and_fro, onwards = procedure(
        TURNS, {**TURNS, "id": "a", "turn_deg": -180, "alternate": False}, version=2
    ).steps

    assert [to_and_fro.angle_deg(turn) for turn in (1, 2, 3, 4)] == [180, -180, 180, -180]
    assert [onwards.angle_deg(turn) for turn in (1, 2, 3)] == [-180, -180, -180]


@pytest.mark.parametrize(("turns", "east"), [(3, "-X"), (4, "+X")])
def test_the_verification_begins_where_the_last_turn_has_ended(turns: int, east: str) -> None:
    (step,) = verification(procedure({**TURNS, "turns": turns}, version=2)).steps

    assert (step.id, step.turns, step.east) == ("verification", 1, east)


@pytest.mark.parametrize(
    ("pose", "others", "words"),
    [
        ({"repeats": 2}, {}, "poses[0]: expected turns or repeats above 1, got turns: 4 and repeats: 2"),
        ({"turns": 21}, {}, "poses[0].turns: expected at most 20, got 21"),
        ({}, {"version": 1}, "expected no turns in version 1, got one; write version: 2"),
        ({"turns": 2}, {"version": 1, "turn_s": [1.5, 2]}, "expected no turn_s, turns in version 1"),
        ({}, {"turn_s": [3, 2]}, "turn_s: expected the shorter duration first, got [3.0, 2.0]"),
    ],
)
def test_nonsense_of_version_2_is_refused(
    pose: dict[str, object], others: dict[str, object], words: str
) -> None:
    with pytest.raises(FaultyFileError) as caught:
        procedure({**TURNS, **pose}, **{"version": 2, **others})  # type: ignore[arg-type]

    (fault,) = caught.value.faults
    assert fault.startswith(words)


def test_the_shipped_procedures_of_the_sensors_have_their_rests() -> None:
    rests = {
        name: load(name).rests for name in ("six-faces-turned", "three-loops", "loops-both", "long-rest")
    }
    assert [len(rests[name]) for name in rests] == [12, 14, 27, 1]
    assert [(r.id, r.up, r.east) for r in rests["six-faces-turned"][:3]] == [
        ("z-up", "+Z", "+X"),
        ("z-up-turned", "+Z", "-X"),
        ("z-down", "-Z", "-X"),
    ]
    for name in ("three-loops", "loops-both"):
        for before, after in pairwise(rests[name]):
            if before.id[0] == after.id[0]:  # a quarter turn about the axis that points east
                turned = after.C_bn @ before.C_bn.T
                assert np.trace(turned) == pytest.approx(1.0)
                np.testing.assert_array_equal(turned @ before.C_bn[:, 0], before.C_bn[:, 0])
    assert all(load(name).runs == () and load(name).steps == rests[name] for name in rests)


@pytest.mark.parametrize(
    ("kind", "pose", "others", "words"),
    [
        ("arms", {}, {}, "poses: z-up: expected turn_deg, 180 or -180, got none"),
        (
            "sensors",
            {"align_s": 100},
            {"rest_s": 60},
            "poses: z-up: expected no align_s in a procedure of kind",
        ),
        (
            "sensors",
            {},
            {"rest_s": 19},
            "rest_s: expected 20 to 3600 s in a procedure of kind sensors, got 19",
        ),
        (
            "sensors",
            {"turn": {"about": "X", "deg": 90, "seconds": 10}},
            {"rest_s": 60},
            "poses[0].turn.about",
        ),
        ("noise", {"turn_deg": 180}, {"rest_s": 60}, "poses: expected one rest in a procedure of kind noise"),
        ("nose", {}, {}, "kind: expected"),
    ],
)
def test_nonsense_of_other_kinds_is_refused(
    kind: str, pose: dict[str, object], others: dict[str, object], words: str
) -> None:
    with pytest.raises(FaultyFileError) as caught:
        procedure({"id": "z-up", "up": "+Z", "east": "+X", **pose}, version=2, kind=kind, **others)

    (fault,) = caught.value.faults
    assert fault.startswith(words)


def test_a_plan_shows_what_is_to_be_done_how_long_it_takes_and_how_accurate_it_is(site: Site) -> None:
    shown = text(load("ten-turns"), site)

    assert shown.startswith("ten-turns: 30 rotations, about 9 min\n")
    assert (
        "  x-up: X up, Y east; alignment of 90 s, then 10 x 180 deg in 1.5 to 2 s with a rest of 4 s" in shown
    )
    worst = predicted(load("ten-turns"), site).differences_sigma.max() / MM
    assert f"{worst:.4f}" in shown


def test_the_plan_of_too_few_rotations_says_what_to_add(site: Site) -> None:
    shown = text(procedure({"id": "z-up", "up": "+Z", "east": "+X", "turn_deg": 180}), site)

    assert shown.startswith("test: 1 rotation, about ")
    assert "  z-up: Z up, X east; " in shown
    assert shown.endswith("does not determine the six differences of the sensing points; add: X up and Y up")


def test_ten_turns_are_three_times_as_accurate_as_three_rotations(site: Site) -> None:
    three, ten = (predicted(load(name), site).differences_sigma for name in ("three-rotations", "ten-turns"))

    assert np.linalg.norm(ten) < np.linalg.norm(three) / 3.0


def test_the_plan_of_the_sensors_shows_what_is_observable(site: Site) -> None:
    shown, measured = (
        sensors_plan.text(load("six-faces-turned"), site.model_copy(update={"gravity_m_s2": gravity}))
        for gravity in (None, 9.7917)
    )

    assert shown.startswith("six-faces-turned: 12 rests, about 13 min\n")
    assert "rank 31 of 31" in shown
    assert "not observable" not in shown
    assert "All three scale factors K are in error by up to 51 ppm" in shown
    assert "Gravity" not in measured


def test_the_plan_of_a_long_rest_has_its_averaging_times(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--plan", "--procedure", "long-rest", "--rehearse"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("long-rest: 1 rest, about 240 min\n")
    assert "averaging times up to 1800 s" in shown


def test_the_plan_of_poor_motions_names_what_they_lack_and_what_would_show_it(site: Site) -> None:
    poses = [{"id": f"z-{k}", "up": "+Z", "east": east} for k, east in enumerate(("+X", "+Y", "-X"))]
    shown = sensors_plan.text(procedure(*poses, version=2, kind="sensors", rest_s=60), site)

    assert "not observable" in shown
    assert "\nadd " in shown
