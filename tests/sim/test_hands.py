"""Motions of a person's hands, a plate that sinks, and biases that wander."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.files.settings_file import parse
from imudrv.records import Records
from imudrv.sim.scenario import Scenario
from imudrv.sim.unit import simulate
from imudrv.units import ARCSEC, DEG_PER_H, UG

LAYOUT = profiles.load("imu50-rs422").layout()


def run(motion: list[dict[str, Any]], unit: dict[str, Any] | None = None) -> tuple[Records, Records]:
    """Pulses and truth of a scenario."""
    document = {
        "format": "imu50-scenario",
        "version": 1,
        "seed": 3,
        "site": {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0},
        "motion": motion,
        "unit": unit or {},
    }
    chunks = list(simulate(parse(document, Scenario, "scenario"), LAYOUT))
    return np.concatenate([c.pulses for c in chunks]), np.concatenate([c.truth for c in chunks])


def angle(C: NDArray[np.float64]) -> float:
    return float(np.arccos(np.clip(0.5 * (np.trace(C) - 1.0), -1.0, 1.0)))


POSE = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])  # X up, -Y east


def test_a_carry_ends_in_its_pose_but_for_the_error_of_the_hand() -> None:
    carry = {"up": "+X", "east": "-Y", "duration_s": 3.0}
    _, exact = run([{"carry": {**carry, "lean_mrad": 0, "heading_deg": 0}}, {"rest": {"duration_s": 0.1}}])
    np.testing.assert_allclose(exact["C_nb"][-1], POSE, atol=1e-12)
    _, by_hand = run([{"carry": carry}, {"rest": {"duration_s": 0.1}}])
    off = angle(by_hand["C_nb"][-1] @ POSE.T)
    assert 1e-4 < off < 4.0 * np.hypot(4e-3, np.radians(3.0))


def test_a_carry_begins_and_ends_at_rest_however_high_it_lifts() -> None:
    carry = {"up": "+Z", "east": "+X", "duration_s": 4.0, "lean_mrad": 0, "heading_deg": 0, "wobble_deg": 0}
    for lift_mm in (0.0, 300.0):
        _, truth = run([{"carry": {**carry, "lift_mm": lift_mm}}])
        gained = truth["dv_b"][:, 2] - truth["dv_b"][:, 2].mean()
        # the attitude stays: what differs from gravity adds up to the velocity, and that to the height
        velocity = np.cumsum(gained)
        assert abs(velocity[-1]) < 1e-9
        height_m = np.cumsum(velocity).max() * 1e-3
        assert height_m == pytest.approx(1e-3 * lift_mm, abs=2e-4)


def test_the_plate_sinks_by_so_much_during_the_rest() -> None:
    _, truth = run([{"rest": {"duration_s": 2.0, "sinks_arcsec": [30, -40]}}])
    turned = truth["C_nb"][-1] @ truth["C_nb"][0].T
    assert angle(turned) == pytest.approx(50.0 * ARCSEC, rel=1e-3)  # the first sample ends a thousandth later
    east, north, _ = turned[:, 2] / ARCSEC
    assert (east, north) == (pytest.approx(30.0, rel=1e-3), pytest.approx(-40.0, rel=1e-3))


def test_biases_wander_with_their_sigma_and_time_constant() -> None:
    wander = {"time_constant_s": 2.0, "gyro_deg_per_h": 3600.0, "accelerometer_ug": 50_000.0}
    still, _ = run([{"rest": {"duration_s": 120.0}}])
    pulses, _ = run([{"rest": {"duration_s": 120.0}}], {"bias_wander": wander})
    for sensor, count, sigma in (
        ("gyro", 0.5 * ARCSEC, 3600.0 * DEG_PER_H),
        ("accelerometer", 1.0 / 2000.0, 50_000.0 * UG),
    ):
        bias = (pulses[sensor] - still[sensor]).reshape(-1, 100, 3).sum(axis=1) * count / 0.1
        # 120 s are some 60 time constants: sigma is known to 1 / sqrt(60) = 13 % on each axis; three sigma
        assert bias.std(axis=0) == pytest.approx(np.full(3, sigma), rel=0.4)
        x = bias - bias.mean(axis=0)
        after = (x[:-20] * x[20:]).mean(axis=0) / (x * x).mean(axis=0)  # 2 s later
        assert after.mean() == pytest.approx(np.exp(-1.0), abs=0.25)


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        ({"carry": {"up": "+X", "east": "-X"}}, "expected two different axes up and east"),
        ({"carry": {"up": "+X"}}, "east"),
        ({"carry": {"up": "+X", "east": "+Y"}, "rest": {"duration_s": 1}}, "got rest and carry"),
    ],
)
def test_an_impossible_carry_is_refused(motion: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        run([motion])
