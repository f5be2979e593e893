"""Schema of a procedure file: poses, rotations, rests and limits.

A file lists poses; `Procedure.steps` are its rotations in order, a pose with `repeats` gives several. The id
of a step never changes, so that a journal, a key and a recording can name it.
`calib.procedure.plan.predicted` gives the accuracy of a plan in advance, and refuses one from which the six
differences are not observable.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field as Key
from pydantic import model_validator

from calib.axes import Side, opposite, vector
from calib.detection import acceptance
from imudrv.arrays import Array
from imudrv.files.model import Model
from imudrv.nav.alignment import MAX_ALIGNMENT_S, MIN_ALIGNMENT_S

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
    least_peak_deg_per_s: Annotated[float, Key(gt=0, le=1000)] = 70.0
    axis_tilt_deg: Annotated[float, Key(gt=0, le=20)] = 10.0


class Pose(Model):
    """A pose and the rotation in it: `up` points up and `east` about east, before the rotation.

    `turn_deg` is right-handed about the vertical: +180 is counter-clockwise, seen from above. Each
    rotation reverses the heading, so that a repeat begins where the rotation before it ended. `align_s` and
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
        Id of the pose; with repeats ``ID-1``, ``ID-2``, ...
    up, east : str
        Body axes that point up and about east before the rotation.
    turn_deg : int
        +180 or -180, right-handed about up.
    align_s, rest_s : float
        Length of the alignment, and of the rest after the rotation.
    """

    id: str
    up: Side
    east: Side
    turn_deg: int
    align_s: float
    rest_s: float

    @property
    def C_bn(self) -> Array:
        """East, north and up of the pose as columns in body axes, shape (3, 3)."""
        up, east = vector(self.up), vector(self.east)
        return np.stack([east, np.cross(up, east), up], axis=1)


class Procedure(Model):
    """A procedure file."""

    format: Literal["imu50-procedure"]
    version: Literal[1]
    name: Annotated[str, Key(min_length=1, max_length=80)]
    align_s: Annotated[float, Key(ge=MIN_ALIGNMENT_S, le=MAX_ALIGNMENT_S)] = 370.0
    rest_s: Annotated[float, Key(ge=2, le=600)] = 15.0
    limits: ProcedureLimits = ProcedureLimits()
    poses: Annotated[tuple[Pose, ...], Key(min_length=1, max_length=100)]

    @model_validator(mode="after")
    def _each_id_once(self) -> Self:
        counts = Counter(step.id for step in self.steps)
        if twice := [name for name, count in counts.items() if count > 1]:
            raise ValueError(f"poses: expected each id once, got {', '.join(twice)} again; rename them")
        return self

    @property
    def steps(self) -> tuple[Step, ...]:
        """Rotations in order."""
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

    def rotation_limits(self, step: Step) -> acceptance.RotationLimits:
        """Return the limits of the rotation of a step, for `rejection_reasons` and `navigate_rotations`.

        Parameters
        ----------
        step : Step
            One of `steps`.

        Returns
        -------
        calib.detection.acceptance.RotationLimits
        """
        limits = self.limits
        return acceptance.RotationLimits(
            angle_deg=abs(step.turn_deg),
            angle_tolerance_deg=limits.angle_tolerance_deg,
            least_peak_deg_per_s=limits.least_peak_deg_per_s,
            axis_tilt_deg=limits.axis_tilt_deg,
            rest_before_s=step.align_s,
            rest_after_s=step.rest_s,
        )
