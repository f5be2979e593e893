"""The bench procedure as data: which side up, which way round, how long, and what has to be kept.

A file lists poses; `Procedure.steps` are its rotations in order, a pose with `repeats` gives several. The id
of a step never changes, so that a journal, a key and a recording can name it. `predicted` tells what the plan
will give before anyone lifts anything, and refuses one that does not see the six differences.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Annotated, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field as Key
from pydantic import model_validator

from calib import segments
from calib.identify import Planned, Prediction, predict
from calib.runs import Priors
from calib.segments import Noise
from imudrv.config import Model, SettingsFile, read_file
from imudrv.errors import InputError
from imudrv.nav.alignment import MAX_ALIGNMENT_S, MIN_ALIGNMENT_S
from imudrv.site import Site
from imudrv.units import DEG_PER_SQRT_H

Array = NDArray[np.float64]
Side = Literal["+X", "-X", "+Y", "-Y", "+Z", "-Z"]
"""A body axis with its sign: the side of the unit that it points out of."""

VERIFICATION: Final = "verification"
"""Step id of the rotation after the result."""
TURN_S: Final = 2.5
"""A rotation by hand from rest to rest, as predictions take it, s."""
TYPICAL_NOISE: Final = Noise(
    angle_walk=0.002 * DEG_PER_SQRT_H, velocity_walk=8e-5, velocity_white=6e-5, velocity_pulse=1.2e-4
)
"""Of a unit of the kind that was not measured yet; how its pulses beat makes it quieter in some poses."""


class Limits(Model):
    """What poses, rests and rotations have to keep.

    `tilt_deg`: how far the upper axis may lean. `heading_deg`: how far the pose may be turned about the
    vertical; 180: any way round. `still_s`: so long it stands still before the alignment. `noise_deg_per_s`
    and `noise_mg`: largest noise of the sensors at rest, rms over 20 ms; what counts as motion follows from
    the noise that was found. The others are those of `calib.segments.Limits`.
    """

    tilt_deg: Annotated[float, Key(gt=0, le=20)] = 5.0
    heading_deg: Annotated[float, Key(gt=0, le=180)] = 45.0
    still_s: Annotated[float, Key(ge=1, le=600)] = 5.0
    noise_deg_per_s: Annotated[float, Key(gt=0, le=1)] = 0.1
    noise_mg: Annotated[float, Key(gt=0, le=50)] = 5.0
    angle_tolerance_deg: Annotated[float, Key(gt=0, le=20)] = 5.0
    least_peak_deg_per_s: Annotated[float, Key(gt=0, le=1000)] = 70.0
    axis_tilt_deg: Annotated[float, Key(gt=0, le=20)] = 10.0


class Pose(Model):
    """A pose and the rotation in it: `up` points up and `east` about east, before the turn.

    `turn_deg` is right-handed about the vertical: +180 is counter-clockwise, seen from above. After a turn
    the pose is the other way round, so that a repeat begins where the turn before it ended. `align_s` and
    `rest_s` are those of the procedure where they are absent.
    """

    id: Annotated[str, Key(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$", max_length=40)]
    up: Side
    east: Side
    turn_deg: Literal[180, -180]
    align_s: Annotated[float, Key(ge=MIN_ALIGNMENT_S, le=MAX_ALIGNMENT_S)] | None = None
    rest_s: Annotated[float, Key(ge=2, le=600)] | None = None
    repeats: Annotated[int, Key(ge=1, le=20)] = 1

    @model_validator(mode="after")
    def _two_axes(self) -> Self:
        if self.up[1] == self.east[1]:
            raise ValueError(
                f"expected two different axes up and east, got {self.up} and {self.east}; change one"
            )
        return self


@dataclass(frozen=True)
class Step:
    """One rotation of the procedure.

    Attributes
    ----------
    id : str
        Of the pose; with repeats ``ID-1``, ``ID-2``, ...
    up, east : str
        Body axes that point up and about east before the turn.
    turn_deg : int
        +180 or -180, right-handed about up.
    align_s, rest_s : float
        Rest that is aligned on, and rest after the turn.
    """

    id: str
    up: Side
    east: Side
    turn_deg: int
    align_s: float
    rest_s: float

    @property
    def title(self) -> str:
        """Such as ``X up, +180 deg``."""
        return f"{side(self.up)} up, {self.turn_deg:+d} deg"

    @property
    def C_bn(self) -> Array:
        """East, north and up of the pose as columns, body axes, shape (3, 3)."""
        up, east = vector(self.up), vector(self.east)
        return np.stack([east, np.cross(up, east), up], axis=1)


class Procedure(Model):
    """A procedure file."""

    format: Literal["imu50-procedure"]
    version: Literal[1]
    name: Annotated[str, Key(min_length=1, max_length=80)]
    align_s: Annotated[float, Key(ge=MIN_ALIGNMENT_S, le=MAX_ALIGNMENT_S)] = 370.0
    rest_s: Annotated[float, Key(ge=2, le=600)] = 15.0
    limits: Limits = Limits()
    poses: Annotated[tuple[Pose, ...], Key(min_length=1, max_length=100)]

    @model_validator(mode="after")
    def _each_id_once(self) -> Self:
        counts = Counter(step.id for step in self.steps)
        if twice := [name for name, count in counts.items() if count > 1]:
            raise ValueError(f"poses: expected each id once, got {', '.join(twice)} again; rename them")
        return self

    @property
    def steps(self) -> tuple[Step, ...]:
        """The rotations in order."""
        return tuple(
            Step(
                pose.id if pose.repeats == 1 else f"{pose.id}-{k + 1}",
                pose.up,
                opposite(pose.east) if k % 2 else pose.east,
                pose.turn_deg,
                pose.align_s or self.align_s,
                pose.rest_s or self.rest_s,
            )
            for pose in self.poses
            for k in range(pose.repeats)
        )

    def rotation_limits(self, step: Step) -> segments.Limits:
        """What the rotation of a step has to keep, as `segments.judge` and `runs.collect` take it.

        Parameters
        ----------
        step : Step
            One of `steps`.

        Returns
        -------
        calib.segments.Limits
        """
        limits = self.limits
        return segments.Limits(
            angle_deg=abs(step.turn_deg),
            angle_tolerance_deg=limits.angle_tolerance_deg,
            least_peak_deg_per_s=limits.least_peak_deg_per_s,
            axis_tilt_deg=limits.axis_tilt_deg,
            rest_before_s=step.align_s,
            rest_after_s=step.rest_s,
        )


def predicted(
    procedure: Procedure,
    site: Site,
    noise: Noise | None = None,
    priors: Priors | None = None,
    skipped: Collection[str] = (),
) -> Prediction:
    """Tell what a procedure will give.

    Parameters
    ----------
    procedure : Procedure
        The plan.
    site : Site
        Where the unit stands.
    noise : Noise, optional
        Of the unit's sensors; `TYPICAL_NOISE` where it was not measured yet.
    priors : Priors, optional
        What the static calibration leaves.
    skipped : collection of str
        Ids of steps that are left out.

    Returns
    -------
    Prediction
        `differences_sigma` are the 1-sigma of the six differences, m.

    Raises
    ------
    InputError
        The rotations do not see the six differences; names the directions.
    """
    plan = [
        Planned(step.up, step.turn_deg, TURN_S, step.rest_s)
        for step in procedure.steps
        if step.id not in skipped
    ]
    try:
        return predict(plan, site.latitude_rad, noise or TYPICAL_NOISE, priors)
    except InputError as error:
        raise InputError(f"procedure {procedure.name}: {error}") from error


def steps_left(procedure: Procedure, done: Collection[str]) -> Procedure:
    """The procedure of the steps that are not done.

    Parameters
    ----------
    procedure : Procedure
        The whole one.
    done : collection of str
        Ids of steps; not all of them.

    Returns
    -------
    Procedure
    """
    return _with_steps(procedure, [step for step in procedure.steps if step.id not in done])


def verification(procedure: Procedure) -> Procedure:
    """One more rotation, `VERIFICATION`, from where the last one ended."""
    last = procedure.steps[-1]
    return _with_steps(procedure, [replace(last, id=VERIFICATION, east=opposite(last.east))])


def _with_steps(procedure: Procedure, steps: Sequence[Step]) -> Procedure:
    poses = tuple(Pose.model_validate(vars(step)) for step in steps)
    return procedure.model_copy(update={"poses": poses})


def shipped() -> list[str]:
    """Names of the procedures that come with the package."""
    return sorted(p.name.removesuffix(".yaml") for p in (resources.files("calib") / "procedures").iterdir())


def load(name_or_path: str) -> Procedure:
    """Load a procedure, by the name of a shipped one or by the path of a file.

    Parameters
    ----------
    name_or_path : str
        ``three-rotations``, or ``my/bench.yaml``.

    Returns
    -------
    Procedure
        Checked.

    Raises
    ------
    InputError
        No such procedure, or one with faults; all faults at once.
    """
    return load_file(name_or_path).model


def load_file(name_or_path: str) -> SettingsFile[Procedure]:
    """Load a procedure with the content of its file; see `load`."""
    if name_or_path in shipped():
        with resources.as_file(resources.files("calib") / "procedures" / f"{name_or_path}.yaml") as path:
            return read_file(path, Procedure)
    if not Path(name_or_path).exists():
        raise InputError(
            f"procedure {name_or_path!r}: expected one of {', '.join(shipped())}, "
            "or the path of a procedure file; there is no such file"
        )
    return read_file(name_or_path, Procedure)


def vector(axis: Side) -> Array:
    """Unit vector of a body axis, '+X' to '-Z', body axes."""
    v = np.zeros(3)
    v["XYZ".index(axis[1])] = -1.0 if axis[0] == "-" else 1.0
    return v


def opposite(axis: Side) -> Side:
    """Turn the sign of a body axis round."""
    other: dict[Side, Side] = {"+X": "-X", "-X": "+X", "+Y": "-Y", "-Y": "+Y", "+Z": "-Z", "-Z": "+Z"}
    return other[axis]


def side(axis: str) -> str:
    """Name of a body axis in a sentence: ``X`` for '+X', ``-X`` for '-X'."""
    return axis.removeprefix("+")
