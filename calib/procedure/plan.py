"""Plan of a procedure: the shipped ones, predicted accuracy, remaining steps."""

from collections.abc import Collection, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Final

from calib.axes import Side, opposite, side
from calib.estimation.noise import SensorNoise
from calib.estimation.predict import PlannedRotation, Prediction, predict
from calib.procedure.preflight import PREFLIGHT_S
from calib.procedure.schema import VERIFICATION, Pose, Procedure, Step
from imudrv.errors import InputError
from imudrv.files import shipped as shipped_files
from imudrv.files.settings_file import SettingsFile, read_file
from imudrv.site import Site
from imudrv.units import DEG_PER_SQRT_H, MM
from imudrv.wording import counted

_FOLDER: Final = Path(__file__).parents[1] / "procedures"

TYPICAL_NOISE: Final = SensorNoise(0.002 * DEG_PER_SQRT_H, velocity_walk=5e-5, degrees_of_freedom=0)
"""Noise of a unit that was not measured yet."""


HANDLING_S: Final = 15.0
"""Time to carry the unit into a pose, for the duration of a procedure, s."""


REACTION_S: Final = 1.0
"""Time until a rotation begins that is due, for the duration of a procedure, s."""


def predicted(procedure: Procedure, site: Site, skipped: Collection[str] = ()) -> Prediction:
    """Predict the accuracy of a procedure with a unit of `TYPICAL_NOISE`.

    Parameters
    ----------
    procedure : Procedure
        The plan.
    site : Site
        Location of the unit.
    skipped : collection of str
        Ids of skipped steps.

    Returns
    -------
    Prediction
        `differences_sigma` are the 1-sigma of the six differences, m.

    Raises
    ------
    InputError
        The six differences are not observable from these rotations; names the directions.
    """
    try:
        return predict(_rotations(procedure, skipped), site.latitude_rad, TYPICAL_NOISE)
    except InputError as error:
        raise InputError(f"procedure {procedure.name}: {error}") from error


def _rotations(procedure: Procedure, skipped: Collection[str] = ()) -> list[PlannedRotation]:
    return [
        PlannedRotation(
            step.up,
            step.turn_deg,
            turn_s(procedure),
            step.rest_s,
            turns=step.turns,
            alternate=step.alternate,
        )
        for step in procedure.runs
        if step.id not in skipped
    ]


def _to_add(procedure: Procedure, site: Site) -> tuple[Side, ...]:
    """Return the sides that have to be up in further rotations, the fewest that determine the arms."""
    plan = _rotations(procedure)
    sides: tuple[Side, ...] = ("+X", "+Y", "+Z")
    for n in range(1, 4):
        for ups in combinations(sides, n):
            more = [replace(plan[-1], up=up) for up in ups]
            try:
                predict([*plan, *more], site.latitude_rad, TYPICAL_NOISE)
            except InputError:
                continue
            return ups
    return ()


def turn_s(procedure: Procedure) -> float:
    """Return the duration of a rotation by hand from rest to rest, s."""
    shortest, longest = procedure.turn_s
    return 0.5 * (shortest + longest)


def duration_s(procedure: Procedure) -> float:
    """Return how long a procedure takes in practised hands, s."""
    if not procedure.runs:
        return PREFLIGHT_S + sum(HANDLING_S + step.rest_s for step in procedure.steps)
    return PREFLIGHT_S + sum(
        HANDLING_S
        + procedure.limits.still_s
        + step.align_s
        + step.turns * (REACTION_S + turn_s(procedure) + step.rest_s)
        for step in procedure.runs
    )


def text(procedure: Procedure, site: Site) -> str:
    """Return a plan as text: its steps, how long it takes, and its predicted accuracy, or what to add."""
    shortest, longest = procedure.turn_s
    rotations = sum(step.turns for step in procedure.runs)
    minutes = duration_s(procedure) / 60.0
    lines = [f"{procedure.name}: {counted(rotations, 'rotation')}, about {minutes:.0f} min"]
    lines += [
        f"  {step.id}: {side(step.up)} up, {side(step.east)} east; alignment of {step.align_s:g} s, then "
        f"{step.turns} x 180 deg in {shortest:g} to {longest:g} s with a rest of {step.rest_s:g} s"
        for step in procedure.runs
    ]
    try:
        prediction = predicted(procedure, site)
    except InputError:
        ups = " and ".join(f"{side(up)} up" for up in _to_add(procedure, site))
        if not ups:
            raise
        return "\n".join(
            [*lines, f"does not determine the six differences of the sensing points; add: {ups}"]
        )
    lines.append("expected accuracy (1 sigma), mm       X       Y       Z")
    for name, sigma in zip(("r_x - r_y", "r_x - r_z"), prediction.differences_sigma / MM, strict=True):
        lines.append(f"  {name:30}" + "".join(f"{value:8.4f}" for value in sigma))
    return "\n".join(lines)


def steps_left(procedure: Procedure, done: Collection[str]) -> Procedure:
    """Return a procedure of the steps that are not done.

    Parameters
    ----------
    procedure : Procedure
        The complete one.
    done : collection of str
        Ids of steps; not all of them.

    Returns
    -------
    Procedure
    """
    return _with_steps(procedure, [step for step in procedure.steps if step.id not in done])


def verification(procedure: Procedure) -> Procedure:
    """Return a procedure of one more rotation, `VERIFICATION`, from the pose in which the last one ended."""
    last = procedure.runs[-1]
    east = opposite(last.east) if last.turns % 2 else last.east
    return _with_steps(procedure, [replace(last, id=VERIFICATION, east=east, turns=1)])


def all_steps(procedure: Procedure) -> tuple[Step, ...]:
    """Return the steps of a procedure, and for the arms that of its `verification`."""
    return (*procedure.steps, *(verification(procedure).steps if procedure.runs else ()))


def _with_steps(procedure: Procedure, steps: Sequence[Step]) -> Procedure:
    poses = tuple(Pose.model_validate(vars(step)) for step in steps)
    return procedure.model_copy(update={"poses": poses})


def shipped() -> list[str]:
    """Return the names of the procedures that come with the package."""
    return shipped_files.names(_FOLDER)


def load(name_or_path: str) -> Procedure:
    """Load a procedure, by the name of a shipped one or by the path of a file.

    Parameters
    ----------
    name_or_path : str
        ``three-rotations``, or ``my/bench.yaml``.

    Returns
    -------
    Procedure
        The checked procedure.

    Raises
    ------
    InputError
        No such procedure, or one with faults; all faults at once.
    """
    return load_file(name_or_path).model


def load_file(name_or_path: str) -> SettingsFile[Procedure]:
    """Load a procedure with the content of its file; see `load`."""
    return read_file(shipped_files.find("procedure", name_or_path, _FOLDER), Procedure)
