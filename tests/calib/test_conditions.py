"""Lever arms under conditions that are not ideal: each was refused, or wrong, at first."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from calib.estimation.channel import channel
from calib.estimation.joint import estimate_joint
from calib.estimation.priors import Priors, certified_priors
from calib.estimation.pulses import without_quantisation
from calib.estimation.readings import RestSamples, read_rests
from calib.estimation.result import LeverArmEstimate
from calib.estimation.rigid_motion import rigid_motion
from calib.estimation.runs import navigate_rotations
from calib.estimation.walk import random_walk
from calib.validation.montecarlo import PRIORS, Budget, case, drawn, worst_sigma
from imudrv.arrays import Array
from imudrv.files.settings_file import parse
from imudrv.records import Records
from imudrv.sim.scenario import NOMINAL
from imudrv.site import Site
from imudrv.units import MM, PPM, UG, URAD

Bench = Callable[..., Records]

BOTH = (1, -1)
UNCERTAIN = replace(PRIORS, accelerometer_misalignment=1e-3, gyro_misalignment=1e-3)


def rms_mm(found: LeverArmEstimate, truth: Array) -> float:
    return float(np.sqrt(((found.R_b - truth) ** 2).mean())) / MM


@pytest.mark.parametrize(
    ("budget", "limit_mm"),
    [
        pytest.param(Budget(signs=BOTH, pose_bias_ug=20.0), 0.03, id="bias of each pose"),
        pytest.param(Budget(signs=BOTH, warming_k_per_min=0.12), 0.03, id="warming"),
        pytest.param(Budget(signs=BOTH, pulse_factor=10.0), 0.03, id="coarse pulses"),
        pytest.param(Budget(signs=BOTH, one_file=True), 0.03, id="restarts in one file"),
        pytest.param(
            Budget(signs=BOTH, dither_arcsec=150.0, dither_share=0.0, case_reaction=0.01),
            0.03,
            id="dither shakes the case",
        ),
        pytest.param(  # 6 sigma with misalignments to first order only; 1 mrad of 150 mm is 0.15 mm
            Budget(signs=BOTH, misalignment_urad=1e3, arms_mm=150.0, priors=UNCERTAIN), 0.15, id="1 mrad"
        ),
    ],
)
def test_the_error_is_within_its_uncertainty(budget: Budget, limit_mm: float) -> None:
    runs, truth = case(9, budget)
    found = estimate_joint(runs, budget.priors)
    assert len(runs) == 6
    assert found.refusals == ()
    assert worst_sigma(found, truth) < 3.5  # six numbers: once in 400
    assert rms_mm(found, truth) < limit_mm
    assert found.scatter is not None
    # 500 degrees of freedom, and noise known to 5 %: three times 12 %
    assert found.scatter.value / found.scatter.degrees_of_freedom == pytest.approx(1.0, abs=0.4)


@pytest.mark.parametrize("seed", [4, 21])
def test_conditions_drawn_at_random_give_no_certificate_beyond_four_sigma(seed: int) -> None:
    """A sample of `tools/montecarlo.py --search`."""
    budget = drawn(seed)
    runs, truth = case(seed, budget)
    found = estimate_joint(runs, budget.priors)
    assert found.refusals or worst_sigma(found, truth) < 4.0


def test_a_case_that_shakes_neither_determines_the_skew_nor_is_read_once_next_to_a_turn() -> None:
    # 5.5 sigma, and the skew to 0.24 ms, when single velocities and accelerations contained the shaking
    budget = Budget(dither_arcsec=150.0, dither_share=0.0, case_reaction=0.01)
    runs, truth = case(13, budget)
    found = estimate_joint(runs, budget.priors)
    (skew,) = (n for n in found.parameters if n.name == "skew_s")
    assert skew.sigma > 0.95 * skew.prior  # three rotations do not determine it
    assert worst_sigma(found, truth) < 3.5  # six numbers: once in 400


def test_bias_from_run_to_run_contradicts_an_estimate_that_does_not_allow_for_it() -> None:
    runs, _ = case(9, Budget(signs=BOTH, pose_bias_ug=20.0))
    constant = estimate_joint(runs, replace(PRIORS, accelerometer_bias_of_run=0.01 * UG))
    assert constant.redundancy.p_value < 1e-3 or constant.refusals


# --- a restart of the unit inside a file ---


def test_a_restart_ends_a_rest_and_no_run_spans_it(bench: Bench, step: Any, site: Site) -> None:
    one = bench(step(50.0), step(2.5, 180.0), step(12.0))
    other = bench(step(50.0), step(2.5, -180.0), step(12.0), seed=2)
    found = navigate_rotations(lambda: [one, other], np.eye(3), site, "both")
    assert [round(run.turns[0].angle_deg) for run in found.runs] == [180, -180]
    assert found.rejected == ()
    assert found.restarts_s == (pytest.approx(64.5),)
    # aligned on its own rest only: 50 s less the ten that are navigated, and the settling
    assert found.runs[1].aligned.duration_s == pytest.approx(40.0, abs=0.2)


# --- priors of the certificate ---


def test_the_covariance_of_the_certificate_replaces_the_priors_of_its_numbers() -> None:
    names = ["accelerometer.bias_ug[0]", "gyro.C_bg[1][0]", "skew_ms"]
    sensors = {"covariance": {"names": names, "lower_triangle": [[4.0], [0.0, 1e-10], [0.0, 0.0, 0.0025]]}}
    calibration = NOMINAL.model_copy(update={"skew_ms": 0.2})
    document = {**calibration.model_dump(mode="json", exclude_none=True), "skew_ms": 0.2}
    document["provenance"] = {**document.get("provenance", {}), "sensors": sensors}
    priors = certified_priors(parse(document, type(NOMINAL), "certificate"))
    sigma = np.sqrt(np.diag(priors.shared_covariance))
    ageing = 3.0  # ug and urad
    assert sigma[0] == pytest.approx(np.hypot(2.0, ageing) * UG)
    assert sigma[15 + 3] == pytest.approx(np.hypot(10.0, ageing) * URAD)
    assert sigma[3] == pytest.approx(np.hypot(Priors().accelerometer_scale / PPM, 2.0) * PPM)  # not named
    assert priors.skew == pytest.approx(0.05e-3)
    assert priors.expected_skew == pytest.approx(0.2e-3)


# --- readings at pulses ---


def counted(v: Array, pulse: float) -> Array:
    """Increments of the whole pulses of a velocity."""
    return np.asarray(np.diff(np.floor(v / pulse + 0.37) * pulse, prepend=0.0), np.float64)


@pytest.mark.parametrize("swing", [0.0, 0.3, 1.1, 3.0])
@pytest.mark.parametrize("slope", [-0.02, 0.004])
def test_a_channel_is_read_to_a_small_part_of_a_pulse_whatever_it_vibrates(
    swing: float, slope: float
) -> None:
    pulse, t = 5e-4, np.arange(1, 10001) * 1e-3
    steady = slope * t + np.cumsum(5e-5 * 1e-3**0.5 * np.random.default_rng(3).standard_normal(len(t)))
    increments = counted(steady + swing * pulse * np.sin(2.0 * np.pi * 391.3 * t), pulse)
    read = channel(t, np.cumsum(increments), increments, pulse, 5e-5)
    error = read.v - np.interp(read.t_s, t, steady)
    assert len(read.t_s) >= 60  # pulses in ten seconds
    # a count is off by 0.29 of a pulse; what vibrates is sampled, and beats with the pulses
    assert error.std() < (0.1 if swing else 0.03) * pulse
    assert error.std() < 3.0 * np.sqrt(read.variance.mean() + 2e-6**2) + 1e-6


def test_the_random_walk_of_a_level_channel_is_not_that_of_one_edge() -> None:
    """A level accelerometer comes back to the edge of one pulse again and again."""
    t = np.arange(1, 40001) * 1e-3
    v = np.cumsum(5e-5 * 1e-3**0.5 * np.random.default_rng(5).standard_normal((3, len(t))), axis=1).T
    increments = np.stack([counted(v[:, 0], 5e-4), counted(v[:, 1] + 0.02 * t, 5e-4)], axis=1)
    assert random_walk(t, increments, np.full(2, 5e-4), [0]).degrees_of_freedom < 5
    moving = random_walk(t, increments, np.full(2, 5e-4), [1])
    assert moving.root == pytest.approx(5e-5, rel=0.3)  # 38 degrees of freedom: 11 %


def test_the_motion_between_two_pulses_is_that_of_a_rigid_body() -> None:
    pulse, gravity, rho = 5e-3, 9.79, np.array([0.06, -0.03, 0.02])
    t = np.arange(1, 14001) * 1e-3
    u = np.clip((t - 6.0) / 2.5, 0.0, 1.0)
    angle = np.pi * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    omega = np.stack([0.0 * t, 0.0 * t, np.gradient(angle, t)], axis=1)
    cos, sin, zero, one = np.cos(angle), np.sin(angle), 0.0 * t, np.ones(len(t))
    C_nb = np.moveaxis(np.array([[cos, -sin, zero], [sin, cos, zero], [zero, zero, one]]), 2, 0)
    lean = np.array([1.0, 2e-4, -3e-4])[[1, 2, 0]]  # of the bench: gravity along east and north
    a = np.array([1.0, 0.0, 0.0])
    force = gravity * (C_nb.transpose(0, 2, 1) @ lean)[:, 0] + 2e-4
    tangential = np.cross(omega, rho)[:, 0]
    centripetal = np.cross(omega, np.cross(omega, rho))[:, 0]
    v = np.cumsum(1e-3 * (force + centripetal)) + tangential
    increments = counted(v, pulse)
    motion = rigid_motion(t, C_nb, omega * 1e-3, a, gravity)
    smooth = np.cumsum(without_quantisation(t, increments, pulse, motion))
    turning = (t > 6.1) & (t < 8.4)
    error = (smooth - v)[turning]
    assert error.std() < 0.02 * pulse
    assert (np.cumsum(increments) - v)[turning].std() > 0.2 * pulse


@pytest.mark.parametrize(("turn_s", "tau"), [(2.5, 1e-3), (1.0, 1e-3), (2.5, 5e-3)])
def test_what_a_shaken_accelerometer_leaves_in_a_turn_is_as_derived(turn_s: float, tau: float) -> None:
    pulse, t = 5e-4, tau * np.arange(1, round((4.0 + turn_s) / tau) + 1)
    u = np.clip((t - 2.0) / turn_s, 0.0, 1.0)
    angle = np.pi * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    turning, before, after = (u > 0.0) & (u < 1.0), t < 2.0, t > 2.0 + turn_s
    left = []
    for seed in range(1000, 1040):
        rng = np.random.default_rng(seed)
        v = 0.1 * rng.standard_normal() * np.sin(angle) + rng.uniform(-0.05, 0.05) * t  # arms, and a lean
        v += 5e-5 * tau**0.5 * np.cumsum(rng.standard_normal(len(t)))
        lines = [np.sin(2.0 * np.pi * (f * t + rng.random())) for f in (400.0, 392.0, 412.0)]
        v += pulse * np.sum(lines, axis=0)
        increments = counted(v, pulse)
        error = np.cumsum(increments) - v
        error -= error[~turning].mean()
        left.append([error @ np.gradient(x) for x in (np.sin(angle), np.cos(angle))])
    dv_a = np.tile(increments[:, None], 3)
    rests = [RestSamples(t[at], np.zeros((at.sum(), 3)), dv_a[at], np.eye(3)) for at in (before, after)]
    stated = read_rests(rests, np.eye(3), np.full(3, pulse), 5e-5).turn[0, 0]
    # 40 draws of two: 11 %, and sampled lines are not quite independent from sample to sample
    assert np.sqrt(np.square(left).sum(axis=1).mean() / stated) == pytest.approx(1.0, abs=0.35)
