"""The four simulated trials: a unit with errors, its arms from our procedure, what it is then put through.

A trial draws the real unit from its scenario: the calibration that all know, the errors that nobody knows,
and where the accelerometers sense. With that same unit the procedure is run in simulation, three half turns,
each a run with noise of its own; segments, alignment, navigation and estimate are those of `calib identify`.
What it finds becomes the calibration of the trial. The truth never gets there.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from calib.certificate import PROVENANCE_IDENTIFIED, with_lever_arms
from calib.detection.acceptance import RotationLimits
from calib.estimation.joint import estimate_joint
from calib.estimation.result import LeverArmEstimate
from calib.estimation.runs import NavigationOptions, Run, navigate_rotations
from calib.lever_arms.gauge import LeverArms
from calib.validation.navigate import navigate
from calib.validation.trial import RATE_FILTER, Trial, TrialSettings
from imudrv import profiles
from imudrv.arrays import Array
from imudrv.calibration import Accelerometer, Calibration, Gyro, SensingPoints, SizeEffect, coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import RateFilterName, rate_filter
from imudrv.nav.alignment import ALIGNMENT_S
from imudrv.records import Flag, Records
from imudrv.sim import scenario as scenarios
from imudrv.sim.scenario import NOMINAL, Residuals, Rest, Scenario, Segment, Unit
from imudrv.sim.unit import draw_true_unit, simulate
from imudrv.units import ARCSEC, DEG_PER_H, UG

PROFILE: Final = "imu50-rs422"


PROCEDURE: Final = ("z-up", "x-up", "y-up")


TRIALS: Final = {"rotation": "z-up", "rocking": "rocking", "vibration": "vibration", "static": "static"}
"""Trials, and the shipped scenario of each."""


SKEW_S: Final = 1e-3
"""By how much the accelerometers' sample ends too late where that is looked at, s."""


BEFORE_S: Final = 10.0
"""Rest between alignment and motion, s."""


@dataclass(frozen=True)
class SimulatedUnit:
    """A unit, and what the procedure found of it.

    Attributes
    ----------
    real : Calibration
        As it really is; for the simulator alone.
    found : Calibration
        What is known of it: the calibration it came with, and the arms identified.
    result : Identification
        The estimate.
    skew_s : float
        Of the accelerometers' samples, as estimated.
    """

    real: Calibration
    found: Calibration
    result: LeverArmEstimate
    skew_s: float


def subject(unit: Unit, seed: int, *, procedure: Sequence[str] = PROCEDURE) -> SimulatedUnit:
    """Draw a unit and run the procedure with it.

    Parameters
    ----------
    unit : Unit
        Calibration, and errors that it is drawn from.
    seed : int
        Decides the unit, and the noise of every run.
    procedure : sequence of str
        Scenarios, the shipped ones' names; each motion in them serves.

    Returns
    -------
    Subject
    """
    came_with = (unit.calibration or NOMINAL).model_copy(update={"size_effect": None})
    real = true_calibration(unit, seed)
    built = unit.model_copy(update={"calibration": real, "residuals": Residuals()})
    runs = [run for k, name in enumerate(procedure) for run in _evidence(name, built, [seed, k], came_with)]
    result = estimate_joint(runs)
    skew_s = next(n.value for n in result.parameters if n.name == "skew_s")
    arms = LeverArms(result.R_b, result.covariance, result.gauge)
    return SimulatedUnit(
        real,
        with_lever_arms(came_with, arms, PROVENANCE_IDENTIFIED, {"method": result.method}),
        result,
        skew_s,
    )


def true_calibration(unit: Unit, seed: int) -> Calibration:
    """The unit that a seed draws, as a calibration that would leave no error."""
    nominal = unit.calibration or NOMINAL
    drawn = draw_true_unit(scenarios.load(PROCEDURE[0]).model_copy(update={"unit": unit, "seed": seed}))
    return nominal.model_copy(
        update={
            "gyro": Gyro(
                scale_arcsec_per_pulse=tuple((drawn.gyro_scale / ARCSEC).tolist()),
                bias_deg_per_h=tuple((drawn.gyro_bias / DEG_PER_H).tolist()),
                C_bg=_rows(drawn.C_bg),
            ),
            "accelerometer": Accelerometer(
                scale_pulse_per_m_s=tuple(drawn.accelerometer_scale.tolist()),
                bias_ug=tuple((drawn.accelerometer_bias / UG).tolist()),
                C_ba=_rows(drawn.C_ba),
            ),
        }
    )


def scenario(name: str, align_s: float = ALIGNMENT_S) -> Scenario:
    """The scenario of a trial: a shipped one, its first rest long enough.

    Parameters
    ----------
    name : {'rotation', 'rocking', 'vibration', 'static'}
        Which.
    align_s : float
        Length of the alignment.

    Returns
    -------
    Scenario
    """
    shipped = scenarios.load(TRIALS[name])
    first, *motion = shipped.motion
    rest_s = BEFORE_S if motion else first.motion.duration_s
    return shipped.model_copy(
        update={"motion": (Segment(rest=Rest(duration_s=align_s + rest_s)), *motion)},
    )


def trial(
    label: str,
    of: Scenario,
    who: SimulatedUnit,
    seed: int,
    *,
    align_s: float = ALIGNMENT_S,
    filter_name: RateFilterName = RATE_FILTER,
    skew_s: float = 0.0,
) -> Trial:
    """Put a unit through a trial.

    Parameters
    ----------
    label : str
        How reports call it.
    of : Scenario
        The motion; noise, dither and skew of the unit.
    who : Subject
        The unit.
    seed : int
        Of noise and motion.
    align_s : float
        Length of the alignment.
    filter_name : str
        Rate filter for the size effect.
    skew_s : float
        That is put right.

    Returns
    -------
    Trial
        With the course of the twin that has no lever arms.
    """
    unit = of.unit.model_copy(update={"calibration": who.real, "residuals": Residuals()})
    run = of.model_copy(update={"seed": _seed([seed, len(PROCEDURE)]), "unit": unit})
    layout = profiles.load(PROFILE).layout()
    setting = TrialSettings(layout, who.found, run.site, align_s, filter_name, skew_s)
    return navigate(label, _pulses(run, layout.interval_ns), setting, _pulses(_twin(run), layout.interval_ns))


def campaign(
    names: Sequence[str], seeds: Sequence[int], filter_name: RateFilterName, say: Callable[[str], None]
) -> Iterator[Trial]:
    """Put units through trials.

    Parameters
    ----------
    names : sequence of str
        Of `TRIALS`.
    seeds : sequence of int
        One a unit.
    filter_name : str
        Rate filter for the size effect.
    say : callable
        Told what is going on.

    Yields
    ------
    Trial
        All of the first unit, all of the second, ...
    """
    for seed in seeds:
        say(f"unit {seed}: procedure")
        who = subject(scenario(names[0]).unit, seed)
        for name in names:
            say(f"unit {seed}: {name}")
            yield trial(f"{name}, unit {seed}", scenario(name), who, seed, filter_name=filter_name)


def skew_trials(seed: int) -> Iterator[Trial]:
    """Rocking with accelerometers whose sample ends `SKEW_S` too late: ignored, and estimated and put right.

    Half turns about the vertical do not show a skew, for they leave gravity where it is; the evidence is the
    procedure and another rocking.

    Parameters
    ----------
    seed : int
        Of the unit.

    Yields
    ------
    Trial
    """
    rocking = scenario("rocking")
    unit = rocking.unit.model_copy(update={"accelerometer_skew_s": SKEW_S})
    rocking = rocking.model_copy(update={"unit": unit})
    who = subject(unit, seed, procedure=(*PROCEDURE, TRIALS["rocking"]))
    late = f"{SKEW_S * 1e3:g} ms"
    yield trial(f"rocking, {late} skew ignored", rocking, who, seed)
    label = f"rocking, {late} skew estimated as {who.skew_s * 1e3:.2f} ms"
    yield trial(label, rocking, who, seed, skew_s=who.skew_s)


def dither_trials(seed: int) -> Iterator[Trial]:
    """The rotation with the blocks' dither left in the gyros' increments, with two rate filters.

    The arms are those found while the unit took its dither out.

    Parameters
    ----------
    seed : int
        Of the unit.

    Yields
    ------
    Trial
    """
    turn = scenario("rotation")
    who = subject(turn.unit, seed)
    assert turn.unit.dither is not None
    raw = turn.unit.dither.model_copy(update={"in_increments": 1.0})
    turn = turn.model_copy(update={"unit": turn.unit.model_copy(update={"dither": raw})})
    filters: tuple[RateFilterName, ...] = ("causal", "dither")
    for name in filters:
        yield trial(f"rotation, raw dither, filter {name}", turn, who, seed, filter_name=name)


def _twin(run: Scenario) -> Scenario:
    """The same unit with accelerometers all in the origin of b and in time, and gyros free of dither."""
    calibration = run.unit.calibration
    assert calibration is not None
    assert calibration.size_effect is not None
    none = (0.0, 0.0, 0.0)
    points = SizeEffect(r_mm=SensingPoints(x=none, y=none, z=none), gauge="centroid")
    dither = run.unit.dither
    unit = run.unit.model_copy(
        update={
            "calibration": calibration.model_copy(update={"size_effect": points}),
            "accelerometer_skew_s": 0.0,
            "dither": dither and dither.model_copy(update={"in_increments": 0.0}),
        }
    )
    return run.model_copy(update={"unit": unit})


ANY_MOTION: Final = RotationLimits(
    angle_deg=0.0, angle_tolerance_deg=1e9, least_peak_deg_per_s=0.0, axis_tilt_deg=90.0
)
"""A motion that is evidence without being a half turn, such as rocking, has to keep these."""


def _evidence(name: str, unit: Unit, seed: list[int], known: Calibration) -> tuple[Run, ...]:
    """The runs of one capture of the procedure."""
    layout = profiles.load(PROFILE).layout()
    run = scenarios.load(name).model_copy(update={"unit": unit, "seed": _seed(seed)})
    bare = coefficients(known)
    limits = RotationLimits() if name in PROCEDURE else ANY_MOTION

    def increments() -> Iterator[Records]:
        compensator = Compensator(bare, layout, rate_filter("causal", layout.interval_ns))
        for pulses in captured:
            yield compensator.feed(pulses)

    captured = list(_pulses(run, layout.interval_ns))
    return navigate_rotations(increments, bare.C_ba, run.site, name, NavigationOptions(limits)).runs


def _rows(matrix: Array) -> Any:
    """A matrix as the models of files have it."""
    return tuple(map(tuple, matrix.tolist()))


def _pulses(run: Scenario, interval_ns: int) -> Iterator[Records]:
    for chunk in simulate(run, interval_ns):
        chunk.pulses["flags"] = Flag.VALID
        yield chunk.pulses


def _seed(parts: list[int]) -> int:
    """A seed of its own for each run."""
    return int(np.random.default_rng(parts).integers(2**63))
