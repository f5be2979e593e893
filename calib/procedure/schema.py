"""Schema of a procedure file: poses, rotations, rests and limits.

A file lists poses; `Procedure.steps` are what is done in them: runs, each with one alignment. A pose with
`repeats` gives several; one with `turns` gives one run of several rotations with a rest, the *arrest*, after
each. The id of a step never changes, so that a journal, a key and a recording can name it.

`calib.procedure.plan.predicted` gives the accuracy of a plan in advance, and refuses one from which the six
differences are not observable.

A procedure of the sensors, or of the noise, has rests instead of runs: one in each pose and, with `turn_deg`,
another one after a turn in place.
"""

from collections import Counter
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal, Self, TypeAlias

import numpy as np
from pydantic import Field as Key
from pydantic import model_validator

from calib.axes import Side, opposite, vector
from calib.detection import acceptance
from imudrv.arrays import Array
from imudrv.files.model import Model
from imudrv.nav.alignment import MAX_ALIGNMENT_S, MIN_ALIGNMENT_S

LEAST_ARREST_S: Final = 1.0
"""Shortest rest that counts as one between two turns, s."""


Kind: TypeAlias = Literal["arms", "sensors", "noise"]
"""What a procedure determines."""


_OF_ARMS: Final = frozenset({"align_s", "repeats", "turns", "alternate"})
"""Keys of a pose of the kind arms only."""


VERIFICATION: Final = "verification"
"""Step id of the rotation that verifies the result."""


class ProcedureLimits(Model):
    """Limits of poses, rests and rotations.

    `tilt_deg`: largest angle between the upper axis and the vertical. `heading_deg`: largest deviation of the
    pose about the vertical; 180: any heading. `still_s`: rest before the alignment. `noise_deg_per_s` and
    `noise_mg`: largest noise of the sensors at rest, rms over 20 ms; the limits of motion follow from the
    measured noise. The others are those of `calib.detection.acceptance.RotationLimits`.
    """

    tilt_deg: Annotated[float, Key(gt=0, le=20)] = 5.0
    heading_deg: Annotated[float, Key(gt=0, le=180)] = 45.0
    still_s: Annotated[float, Key(ge=1, le=600)] = 5.0
    noise_deg_per_s: Annotated[float, Key(gt=0, le=1)] = 0.1
    noise_mg: Annotated[float, Key(gt=0, le=50)] = 5.0
    angle_tolerance_deg: Annotated[float, Key(gt=0, le=20)] = 5.0
    least_peak_deg_per_s: Annotated[float, Key(gt=0, le=1000)] = 60.0
    axis_tilt_deg: Annotated[float, Key(gt=0, le=20)] = 10.0


RestTime = Annotated[float, Key(ge=2, le=100_000)]
REST_S: Final = {"arms": (2.0, 600.0), "sensors": (20.0, 3600.0), "noise": (20.0, 100_000.0)}
"""Shortest and longest rest of each kind of procedure, s."""
TurnTime = Annotated[float, Key(ge=0.5, le=60)]


def _given(settings: Model) -> set[str]:
    """Return the keys that are not at their defaults, which a file written from a model has too."""
    fields = type(settings).model_fields
    return {name for name, field in fields.items() if getattr(settings, name) != field.default}


class PlannedTurn(Model):
    """Motion of a turntable into a pose, right-handed about a body axis: never a measurement."""

    about: Side
    deg: Annotated[float, Key(ge=-720, le=720)]
    seconds: Annotated[float, Key(ge=0.5, le=300)]


class Pose(Model):
    """A pose and the rotations in it: `up` points up and `east` about east, before the first rotation.

    `turn_deg` is right-handed about the vertical: +180 is counter-clockwise, seen from above. Each
    rotation reverses the heading, so that a repeat begins where the rotation before it ended. `turns`: number
    of rotations after one alignment, `alternate`: every second one is back. `align_s` and `rest_s` are those
    of the procedure where they are absent. Only a pose of the kind arms needs a `turn_deg`; in one of the
    kind sensors it is a turn in place, with another rest after it, and `turn` is how a turntable comes there.
    """

    id: Annotated[str, Key(pattern=r"^[a-z0-9]+(-[a-z0-9]+)*$", max_length=40)]
    up: Side
    east: Side
    turn_deg: Literal[180, -180] | None = None
    align_s: Annotated[float, Key(ge=MIN_ALIGNMENT_S, le=MAX_ALIGNMENT_S)] | None = None
    rest_s: RestTime | None = None
    repeats: Annotated[int, Key(ge=1, le=20)] = 1
    turns: Annotated[int, Key(ge=1, le=20)] = 1
    alternate: bool = True
    turn: PlannedTurn | None = None

    @model_validator(mode="after")
    def _turns_or_repeats(self) -> Self:
        if self.turns > 1 and self.repeats > 1:
            raise ValueError(
                f"expected turns or repeats above 1, got turns: {self.turns} and repeats: {self.repeats}; "
                "write several poses"
            )
        return self

    @model_validator(mode="after")
    def _two_axes(self) -> Self:
        if self.up[1] == self.east[1]:
            raise ValueError(
                f"expected two different axes up and east, got {self.up} and {self.east}; change one"
            )
        return self


@dataclass(frozen=True)
class Step:
    """One step of a procedure, of any kind: a pose, and what is done in it.

    Attributes
    ----------
    id : str
        Id of the pose; with repeats ``ID-1``, ``ID-2``, ...; of the rest after a turn in place ``ID-turned``.
    up, east : str
        Body axes that point up and about east at its beginning.
    rest_s : float
        Length of its rest, after each rotation if there are any.
    """

    id: str
    up: Side
    east: Side
    rest_s: float

    @property
    def C_bn(self) -> Array:
        """East, north and up of the pose as columns in body axes, shape (3, 3)."""
        z, x = vector(self.up), vector(self.east)
        return np.stack([x, np.cross(z, x), z], axis=1)


@dataclass(frozen=True)
class Run(Step):
    """One run of a procedure of the arms: an alignment, and one or more rotations.

    Attributes
    ----------
    turn_deg : int
        The first rotation: +180 or -180, right-handed about up.
    align_s : float
        Length of the alignment.
    turns : int
        Number of rotations.
    alternate : bool
        Whether every second rotation is back.
    """

    turn_deg: int
    align_s: float
    turns: int = 1
    alternate: bool = True

    def angle_deg(self, turn: int) -> int:
        """Return the angle of a turn, numbered from 1: +180 or -180, right-handed about up."""
        return -self.turn_deg if self.alternate and turn % 2 == 0 else self.turn_deg


@dataclass(frozen=True)
class PlannedRest(Step):
    """One rest of a procedure of the sensors or of the noise.

    Attributes
    ----------
    turn : PlannedTurn or None
        How a turntable comes there.
    """

    turn: PlannedTurn | None = None


class Procedure(Model):
    """A procedure file.

    `kind`: what it determines: the lever arms, the sensors or their noise. `turn_s`: shortest and
    longest duration of a rotation from rest to rest, for the operator and for the predicted accuracy.
    """

    format: Literal["imu50-procedure"]
    version: Literal[1, 2]
    name: Annotated[str, Key(min_length=1, max_length=80)]
    kind: Kind = "arms"
    align_s: Annotated[float, Key(ge=MIN_ALIGNMENT_S, le=MAX_ALIGNMENT_S)] = 370.0
    rest_s: RestTime = 15.0
    turn_s: tuple[TurnTime, TurnTime] = (2.0, 3.0)
    limits: ProcedureLimits = ProcedureLimits()
    poses: Annotated[tuple[Pose, ...], Key(min_length=1, max_length=100)]

    @model_validator(mode="after")
    def _keys_of_the_version(self) -> Self:
        given = _given(self).union(*map(_given, self.poses))
        newer = sorted(given & {"kind", "turn_s", "turns", "alternate", "turn"})
        if self.version == 1 and newer:
            raise ValueError(f"expected no {', '.join(newer)} in version 1, got one; write version: 2")
        return self

    @model_validator(mode="after")
    def _shorter_first(self) -> Self:
        if self.turn_s[0] > self.turn_s[1]:
            raise ValueError(f"turn_s: expected the shorter duration first, got {list(self.turn_s)}")
        return self

    @model_validator(mode="after")
    def _poses_of_the_kind(self) -> Self:
        least, most = REST_S[self.kind]
        for pose in self.poses:
            if not least <= (rest_s := pose.rest_s or self.rest_s) <= most:
                raise ValueError(
                    f"rest_s: expected {least:g} to {most:g} s in a procedure of kind {self.kind}, "
                    f"got {rest_s:g}"
                )
            if self.kind == "arms" and pose.turn_deg is None:
                raise ValueError(f"poses: {pose.id}: expected turn_deg, 180 or -180, got none")
            if self.kind == "arms" and pose.turn is not None:
                raise ValueError(f"poses: {pose.id}: expected turn in a procedure of kind sensors only")
            if self.kind != "arms" and (alien := _given(pose) & _OF_ARMS):
                raise ValueError(
                    f"poses: {pose.id}: expected no {', '.join(sorted(alien))} in a procedure of kind "
                    f"{self.kind}"
                )
        if self.kind == "noise" and len(self.rests) > 1:
            raise ValueError(f"poses: expected one rest in a procedure of kind noise, got {len(self.rests)}")
        return self

    @model_validator(mode="after")
    def _each_id_once(self) -> Self:
        counts = Counter(step.id for step in self.steps)
        if twice := [name for name, count in counts.items() if count > 1]:
            raise ValueError(f"poses: expected each id once, got {', '.join(twice)} again; rename them")
        return self

    @property
    def steps(self) -> tuple[Step, ...]:
        """What is done, in order: `runs` or `rests`."""
        return self.runs or self.rests

    @property
    def runs(self) -> tuple[Run, ...]:
        """Runs in order; none where the kind is another one than arms."""
        if self.kind != "arms":
            return ()
        return tuple(
            Run(
                pose.id if pose.repeats == 1 else f"{pose.id}-{k + 1}",
                pose.up,
                opposite(pose.east) if k % 2 else pose.east,
                pose.rest_s or self.rest_s,
                pose.turn_deg or 180,
                pose.align_s or self.align_s,
                pose.turns,
                pose.alternate,
            )
            for pose in self.poses
            for k in range(pose.repeats)
        )

    @property
    def rests(self) -> tuple[PlannedRest, ...]:
        """Rests in order; none where the kind is arms."""
        if self.kind == "arms":
            return ()
        rests = []
        for pose in self.poses:
            first = PlannedRest(pose.id, pose.up, pose.east, pose.rest_s or self.rest_s, pose.turn)
            rests.append(first)
            if pose.turn_deg is not None:
                rests.append(replace(first, id=f"{pose.id}-turned", east=opposite(pose.east), turn=None))
        return tuple(rests)

    def rotation_limits(self, run: Run) -> acceptance.RotationLimits:
        """Return the limits of the rotations of a run, for `rejection_reasons` and `navigate_rotations`.

        An arrest between turns counts even if it was cut short.

        Parameters
        ----------
        run : Run
            One of `runs`.

        Returns
        -------
        calib.detection.acceptance.RotationLimits
        """
        limits = self.limits
        return acceptance.RotationLimits(
            angle_deg=abs(run.turn_deg),
            angle_tolerance_deg=limits.angle_tolerance_deg,
            least_peak_deg_per_s=limits.least_peak_deg_per_s,
            axis_tilt_deg=limits.axis_tilt_deg,
            rest_before_s=run.align_s,
            rest_after_s=run.rest_s if run.turns == 1 else LEAST_ARREST_S,
        )
