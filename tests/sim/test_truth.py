from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np

from imudrv import profiles
from imudrv.calibration import coefficients
from imudrv.sim.scenario import Scenario
from imudrv.sim.truth import true_calibration
from imudrv.sim.unit import draw_true_unit

Make = Callable[..., Scenario]

REST = {"rest": {"duration_s": 1.0}}
RESIDUALS = {
    "gyro_bias_deg_per_h": 0.01,
    "gyro_scale_ppm": 5.0,
    "gyro_misalignment_urad": 30.0,
    "accelerometer_bias_ug": 50.0,
    "accelerometer_scale_ppm": 20.0,
    "accelerometer_misalignment_urad": 30.0,
}
DRIFTING = {**RESIDUALS, "gyro_bias_deg_per_h_per_k": 0.05, "accelerometer_scale_ppm_per_k": 5.0}
POINTS = {"x": [1.0, 2.0, 3.0], "y": [4.0, 5.0, 6.0], "z": [7.0, 8.0, 9.0]}


def same(scenario: Scenario, profile: str) -> None:
    layout = profiles.load(profile).layout()
    true, written = draw_true_unit(scenario, layout), coefficients(true_calibration(scenario, layout))
    for of_unit in fields(true):
        wanted, got = getattr(true, of_unit.name), getattr(written, of_unit.name)
        if of_unit.name == "temperature":
            assert (wanted is None) == (got is None)
            continue
        # a unit of measure there and back is two roundings
        np.testing.assert_allclose(got, wanted, rtol=5e-16)
    if true.temperature and written.temperature:
        np.testing.assert_allclose(written.temperature.gyro_bias, true.temperature.gyro_bias, rtol=5e-16)
        scale = true.temperature.accelerometer_scale
        np.testing.assert_allclose(written.temperature.accelerometer_scale, scale, rtol=5e-16)
        assert written.temperature.reference_degc == true.temperature.reference_degc


def test_the_calibration_of_the_true_unit_has_its_values(scenario: Make) -> None:
    same(scenario(REST, unit={"residuals": RESIDUALS}), "imu50-rs422")
    same(scenario(REST, unit={"residuals": DRIFTING, "r_mm": POINTS}), "imu50-can")


def test_it_has_scales_of_a_unit_that_sends_no_pulses(scenario: Make) -> None:
    same(scenario(REST, unit={"residuals": RESIDUALS}), "kvh1775")


def test_points_of_the_scenario_are_in_the_gauge_given(scenario: Make) -> None:
    unit: dict[str, Any] = {"r_mm": POINTS}
    true = true_calibration(scenario(REST, unit=unit), profiles.load("imu50-rs422").layout())

    assert true.size_effect is not None
    assert true.size_effect.gauge == "given"
    np.testing.assert_allclose(true.size_effect.r_m, np.arange(1, 10).reshape(3, 3) * 1e-3, rtol=1e-15)
