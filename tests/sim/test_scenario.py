from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from imudrv import profiles
from imudrv.calibration import Calibration
from imudrv.errors import FaultyFileError, InputError
from imudrv.files.settings_file import write
from imudrv.sim.scenario import NOMINAL, Scenario, load, shipped
from imudrv.sim.unit import draw_true_unit, simulate

Make = Callable[..., Scenario]
TEXT = """\
format: imu50-scenario
version: 1
site: {latitude_deg: 28.2, longitude_deg: 113.0, height_m: 60.0}
motion:
  - rest: {duration_s: 1}
"""
HALF_TURN = {"angle_deg": 180.0, "duration_s": 2.0}


@pytest.mark.parametrize("name", shipped())
def test_a_shipped_scenario_loads_and_runs(name: str) -> None:
    scenario = load(name)
    chunk = next(simulate(scenario, profiles.load("imu50-rs422").layout(), 10))
    assert chunk.pulses.size == 10
    up = "xyz".index(scenario.start.pose[0])
    # g for 10 ms at 2000 pulses per m/s; noise and the dither of the arm are a pulse or two
    assert chunk.pulses["accelerometer"].sum(axis=0)[up] == pytest.approx(196, abs=4)


def test_the_three_poses_of_the_bench_procedure_are_shipped() -> None:
    assert {"z-up", "x-up", "y-up", "rocking", "vibration", "static"} <= set(shipped())
    assert [load(name).start.pose for name in ("x-up", "y-up", "z-up")] == ["x_up", "y_up", "z_up"]


def test_an_unknown_name_is_reported_with_the_known_ones() -> None:
    with pytest.raises(
        InputError, match=r"scenario 'w-up': expected one of long-rest, .*there is no such file"
    ):
        load("w-up")


def test_the_calibration_file_is_found_beside_the_scenario(tmp_path: Path) -> None:
    write(tmp_path / "mine.yaml", NOMINAL.model_copy(update={"serial_number": "50-0042"}))
    path = tmp_path / "run.yaml"
    path.write_text(TEXT + "unit: {calibration_file: mine.yaml}\n")
    calibration = load(str(path)).unit.calibration
    assert isinstance(calibration, Calibration)
    assert calibration.serial_number == "50-0042"


def test_a_missing_calibration_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text(TEXT + "unit: {calibration_file: mine.yaml}\n")
    with pytest.raises(InputError, match=r"mine\.yaml"):
        load(str(path))


@pytest.mark.parametrize(
    ("motion", "sections", "message"),
    [
        ({}, {}, "expected one of rest, rotate, carry, turns, rock, vibrate, got none"),
        (
            {"rest": {"duration_s": 1.0}, "rotate": {"angle_deg": 1.0, "duration_s": 1.0}},
            {},
            "got rest and rotate",
        ),
        ({"rest": {"duration_s": 0.0}}, {}, "duration_s"),
        (
            {"rotate": {"angle_deg": 1.0, "duration_s": 1.0, "axis_tilt_mrad": [0, 0], "axis_n": [0, 0, 1]}},
            {},
            "got both",
        ),
        ({"rotate": {"angle_deg": 1.0, "duration_s": 1.0, "axis_n": [0, 0, 0]}}, {}, "expected a direction"),
        (
            {"rock": {"duration_s": 9.0, "band_hz": [3, 1], "rate_rms_deg_per_s": [1, 1, 1]}},
            {},
            "expected the lower frequency first",
        ),
        (
            {"vibrate": {"duration_s": 1.0, "band_hz": [20, 30], "g_rms": [1, 1, 1]}},
            {},
            "expected half of duration_s at most",
        ),
        (
            {"rest": {"duration_s": 1.0}},
            {"faults": {"stream": {"bit_flips": 0.6, "bytes_lost": 0.6}}},
            "at most 1, got 1.2",
        ),
        (
            {"rest": {"duration_s": 1.0}},
            {"faults": {"can": {"lost": 0.9, "swapped": 0.6}}},
            "at most 1, got 1.5",
        ),
        (
            {"rest": {"duration_s": 1.0}},
            {"faults": {"unplugs": [{"at_s": 1.0, "duration_s": 2.0}, {"at_s": 2.5, "duration_s": 1.0}]}},
            "one after the other, got one at 2.5 s before the end of that at 1 s",
        ),
        (
            {"rest": {"duration_s": 1.0}},
            {"unit": {"temperature": {"settles_at_degc": 9.0}}},
            "together, got one of them",
        ),
        (
            {"rest": {"duration_s": 1.0}},
            {"faults": {"restarts": [{"at_s": 1.0, "duration_s": 2.0}, {"at_s": 2.5, "duration_s": 1.0}]}},
            "restarts: expected one after the other",
        ),
        (
            {"rotate": {"angle_deg": 180.0, "duration_s": 2.0, "wobble_deg": 21.0}},
            {},
            "wobble_deg",
        ),
        ({"turns": {"count": 101, "arrest_s": 4.0, "rotate": HALF_TURN}}, {}, "count"),
        ({"rest": {"duration_s": 1.0}}, {"motor": {"frequency_hz": 2001.0, "mg": [1, 1, 1]}}, "frequency_hz"),
        ({"rest": {"duration_s": 1.0}}, {"unit": {"noize": {}}}, "noize"),
        ({"rest": {"duration_s": 1.0}}, {"start": {"pose": "upside_down"}}, "pose"),
    ],
)
def test_nonsense_is_refused_with_its_place(
    scenario: Make, motion: dict[str, Any], sections: dict[str, Any], message: str
) -> None:
    with pytest.raises(FaultyFileError, match=message):
        scenario(motion, **sections)


def test_two_calibrations_are_one_too_many(scenario: Make) -> None:
    inline = NOMINAL.model_dump(mode="json", exclude_none=True)
    with pytest.raises(FaultyFileError, match="expected calibration_file or calibration, got both"):
        scenario({"rest": {"duration_s": 1.0}}, unit={"calibration": inline, "calibration_file": "a.yaml"})


def test_many_turns_are_rotations_to_and_fro_with_a_rest_after_each(scenario: Make) -> None:
    turns = scenario({"turns": {"count": 3, "arrest_s": 4.0, "rotate": HALF_TURN}}).motions
    assert [type(motion).__name__ for motion in turns] == ["Rotate", "Rest"] * 3
    assert [motion.angle_deg for motion in turns[::2]] == [180.0, -180.0, 180.0]
    assert {motion.duration_s for motion in turns[1::2]} == {4.0}
    same_way = scenario({"turns": {"count": 2, "arrest_s": 4.0, "rotate": HALF_TURN, "alternate": False}})
    assert [motion.angle_deg for motion in same_way.motions[::2]] == [180.0, 180.0]


def test_more_motions_than_a_scenario_may_have_are_refused(scenario: Make) -> None:
    turns = {"turns": {"count": 100, "arrest_s": 4.0, "rotate": HALF_TURN}}
    with pytest.raises(FaultyFileError, match="expected at most 1000 rotations and rests, got 1200"):
        scenario(*[turns] * 6)


def test_the_three_poses_of_the_bench_procedure_are_of_one_unit() -> None:
    layout = profiles.load("imu50-rs422").layout()
    units = [draw_true_unit(load(name), layout) for name in ("z-up", "x-up", "y-up")]
    assert len({unit.C_ba.tobytes() for unit in units}) == 1
    assert len({load(name).seed for name in ("z-up", "x-up", "y-up")}) == 3  # noise of their own
