"""The four simulated trials: a unit with errors, its lever arms from the procedure, then the motion.

A trial draws the true unit from its scenario: the calibration that is known, errors that are not known, and
the sensing points. The procedure is simulated with that same unit: three rotations by 180 deg, each a run
with its own noise; detection, alignment, navigation and estimate are those of `calib identify`. The result
becomes the calibration of the trial. The truth is never used there.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.certificate import PROVENANCE_IDENTIFIED, with_lever_arms
from calib.detection.acceptance import RotationLimits
from calib.estimation.joint import estimate_joint
from calib.estimation.result import LeverArmEstimate
from calib.estimation.runs import NavigationOptions, Run, navigate_capture
from calib.validation.navigate import navigate
from calib.validation.trial import RATE_FILTER, Trial, TrialSettings
from imudrv import profiles
from imudrv.calibration import Calibration
from imudrv.imu.rate_filter import RateFilterName
from imudrv.nav.alignment import ALIGNMENT_S
from imudrv.records import Flag, Records
from imudrv.sim import scenario as scenarios
from imudrv.sim import truth
from imudrv.sim.scenario import NOMINAL, Residuals, Rest, Scenario, Segment, Unit
from imudrv.sim.unit import simulate
from imudrv.wire.layout import Layout

LAYOUT: Final = profiles.load("imu50-rs422").layout()
"""Layout of the simulated units."""


PROCEDURE: Final = ("z-up", "x-up", "y-up")


TRIALS: Final = {"rotation": "z-up", "rocking": "rocking", "vibration": "vibration", "static": "static"}
"""Shipped scenario of each trial."""


SKEW_S: Final = 1e-3
"""Time by which accelerometer samples end too late in the skew trials, s."""


BEFORE_S: Final = 10.0
"""Rest between alignment and motion, s."""


@dataclass(frozen=True)
class SimulatedUnit:
    """A simulated unit and the result of the procedure.

    Attributes
    ----------
    real : Calibration
        True calibration; for the simulator only.
    found : Calibration
        Known calibration: the nominal one with the identified lever arms.
    result : LeverArmEstimate
        The estimate.
    """

    real: Calibration
    found: Calibration
    result: LeverArmEstimate

    @property
    def skew_s(self) -> float:
        """Estimated skew of the accelerometer samples, s."""
        return next(n.value for n in self.result.parameters if n.name == "skew_s")


def subject(unit: Unit, seed: int, *, procedure: Sequence[str] = PROCEDURE) -> SimulatedUnit:
    """Draw a unit and run the procedure with it.

    Parameters
    ----------
    unit : Unit
        Nominal calibration and distribution of its errors.
    seed : int
        Seed of the unit and of the noise of every run.
    procedure : sequence of str
        Names of shipped scenarios; every motion in them is used.

    Returns
    -------
    SimulatedUnit
    """
    nominal = (unit.calibration or NOMINAL).without_size_effect()
    real = true_calibration(unit, seed)
    built = unit.model_copy(update={"calibration": real, "residuals": Residuals()})
    runs = [
        run for k, name in enumerate(procedure) for run in _simulated_runs(name, built, [seed, k], nominal)
    ]
    result = estimate_joint(runs)
    found = with_lever_arms(nominal, result.arms, PROVENANCE_IDENTIFIED, {"method": result.method})
    return SimulatedUnit(real, found, result)


def true_calibration(unit: Unit, seed: int) -> Calibration:
    """Return the calibration of the unit that a seed draws, which would leave no error."""
    seeded = unit.model_copy(update={"seed": seed})
    return truth.true_calibration(scenarios.load(PROCEDURE[0]).model_copy(update={"unit": seeded}), LAYOUT)


def scenario(name: str, align_s: float = ALIGNMENT_S) -> Scenario:
    """Return the scenario of a trial: a shipped one with a first rest that is long enough.

    Parameters
    ----------
    name : {'rotation', 'rocking', 'vibration', 'static'}
        Name of the trial.
    align_s : float
        Length of the alignment, s.

    Returns
    -------
    Scenario
    """
    shipped = scenarios.load(TRIALS[name])
    first, *motion = shipped.motion
    rest_s = BEFORE_S if motion else first.motions[0].duration_s
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
    """Simulate a trial with a unit.

    Parameters
    ----------
    label : str
        Name in reports.
    of : Scenario
        Motion; noise, dither and skew of the unit.
    who : SimulatedUnit
        The unit.
    seed : int
        Seed of noise and motion.
    align_s : float
        Length of the alignment, s.
    filter_name : str
        Rate filter for the size effect.
    skew_s : float
        Skew to be corrected, s.

    Returns
    -------
    Trial
        With the velocity of the twin without lever arms.
    """
    unit = of.unit.model_copy(update={"calibration": who.real, "residuals": Residuals()})
    run = of.model_copy(update={"seed": _seed([seed, len(PROCEDURE)]), "unit": unit})
    settings = TrialSettings(LAYOUT, who.found, run.site, align_s, filter_name, skew_s)
    return navigate(label, simulated_pulses(run), settings, simulated_pulses(_twin(run)))


def campaign(names: Sequence[str], seeds: Sequence[int], filter_name: RateFilterName) -> Iterator[Trial]:
    """Simulate trials with several units.

    Parameters
    ----------
    names : sequence of str
        Names of trials, see `TRIALS`.
    seeds : sequence of int
        Seed of each unit.
    filter_name : str
        Rate filter for the size effect.

    Yields
    ------
    Trial
        All of the first unit, all of the second, ...
    """
    for seed in seeds:
        who = subject(scenario(names[0]).unit, seed)
        for name in names:
            yield trial(f"{name}, unit {seed}", scenario(name), who, seed, filter_name=filter_name)


def skew_trials(seed: int) -> Iterator[Trial]:
    """Yield rocking with accelerometer samples that end `SKEW_S` too late: ignored, then corrected.

    Rotations about the vertical do not determine a skew, because gravity keeps its direction; so the estimate
    uses the procedure and another rocking.

    Parameters
    ----------
    seed : int
        Seed of the unit.

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
    """Yield the rotation with the gyro dither in the increments, with two rate filters.

    The lever arms are those identified with the dither removed by the unit.

    Parameters
    ----------
    seed : int
        Seed of the unit.

    Yields
    ------
    Trial
    """
    turn = scenario("rotation")
    who = subject(turn.unit, seed)
    turn = turn.model_copy(update={"unit": _with_dither(turn.unit, 1.0)})
    filters: tuple[RateFilterName, ...] = ("causal", "dither")
    for name in filters:
        yield trial(f"rotation, raw dither, filter {name}", turn, who, seed, filter_name=name)


def _twin(run: Scenario) -> Scenario:
    """Return the same run with accelerometers at the origin and in time, increments without dither."""
    calibration = (run.unit.calibration or NOMINAL).without_size_effect()
    changes = {"calibration": calibration, "accelerometer_skew_s": 0.0}
    return run.model_copy(update={"unit": _with_dither(run.unit, 0.0).model_copy(update=changes)})


def _with_dither(unit: Unit, share: float) -> Unit:
    """Return the unit with a share of its gyro dither, if it has any, in the increments."""
    dither = unit.dither and unit.dither.model_copy(update={"in_increments": share})
    return unit.model_copy(update={"dither": dither})


ANY_MOTION: Final = RotationLimits(
    angle_deg=0.0, angle_tolerance_deg=1e9, least_peak_deg_per_s=0.0, axis_tilt_deg=90.0
)
"""Limits of motions that are no rotation by 180 deg, such as rocking."""


def _simulated_runs(name: str, unit: Unit, seed: list[int], known: Calibration) -> tuple[Run, ...]:
    """Return the runs of one simulated capture of the procedure."""
    run = scenarios.load(name).model_copy(update={"unit": unit, "seed": _seed(seed)})
    options = NavigationOptions(RotationLimits() if name in PROCEDURE else ANY_MOTION)
    pulses = list(simulated_pulses(run))
    return navigate_capture(lambda: pulses, LAYOUT, known, run.site, name, options).runs


def simulated_pulses(run: Scenario, layout: Layout = LAYOUT) -> Iterator[Records]:
    """Yield the pulses of a scenario, piece by piece."""
    for chunk in simulate(run, layout):
        chunk.pulses["flags"] = Flag.VALID
        yield chunk.pulses


def _seed(parts: list[int]) -> int:
    """Return a different seed for each run."""
    return int(np.random.default_rng(parts).integers(2**63))
