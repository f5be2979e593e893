"""Runs of a capture: turns in one pose, with short rests between them, after one alignment.

A run begins with a rest that is long enough for the alignment. Each motion after it is a turn of the run, if
the unit keeps its pose and the rest after it, the *arrest*, is long enough for a velocity. The run ends
before a motion in which samples were lost or are invalid, or after which the unit is in another pose, and at
a rest that is long enough for an alignment of its own.

A turn outside the other limits stays in the run, so that later arrests still count; it has the reasons.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from calib.detection.acceptance import RotationLimits, rejection_reasons
from calib.detection.segments import Rest, Rotation
from calib.messages import Message
from imudrv.records import Flag


@dataclass(frozen=True)
class Turn(Rotation):
    """A turn of a run; it has a rest before and after it.

    Attributes
    ----------
    before, after : Rest
    reasons : tuple of Message
        Why it is outside the limits; empty: it is accepted.
    """

    before: Rest
    after: Rest
    reasons: tuple[Message, ...]

    @property
    def accepted(self) -> bool:
        """Whether the turn is within the limits."""
        return not self.reasons


class RejectedRotation(NamedTuple):
    """A motion that is outside the limits, and the reasons."""

    rotation: Rotation
    reasons: tuple[Message, ...]


class DetectedRuns(NamedTuple):
    """Runs of a capture, the last turn of each accepted, and all rejected motions."""

    runs: tuple[tuple[Turn, ...], ...]
    rejected: tuple[RejectedRotation, ...]


def find_runs(
    rotations: Sequence[Rotation], limits: RotationLimits, expected: str | None = None
) -> DetectedRuns:
    """Group the motions of a capture into runs.

    Parameters
    ----------
    rotations : sequence of Rotation
        All motions of the capture, in order.
    limits : RotationLimits
        Limits of a turn, and of the rests before the first turn and after each.
    expected : {'X', 'Y', 'Z'}, optional
        Body axis that has to be vertical.

    Returns
    -------
    DetectedRuns
    """
    between = replace(limits, rest_before_s=limits.rest_after_s)
    runs: list[list[Turn]] = []
    rejected: list[RejectedRotation] = []
    previous: Turn | None = None
    for rotation in rotations:
        continues = previous is not None and _continues(previous, rotation, limits)
        used = between if continues else limits
        reasons = rejection_reasons(rotation, used, expected)
        if reasons:
            rejected.append(RejectedRotation(rotation, reasons))
        previous = _turn(rotation, used, reasons)
        if previous is None:
            continue
        if not continues:
            runs.append([])
        runs[-1].append(previous)
    return DetectedRuns(tuple(filter(None, map(_up_to_last_accepted, runs))), tuple(rejected))


def _continues(previous: Turn, rotation: Rotation, limits: RotationLimits) -> bool:
    """Whether the motion follows a turn after a rest too short for an alignment."""
    before = rotation.before
    return before is previous.after and before.duration_s < limits.rest_before_s


def _turn(rotation: Rotation, limits: RotationLimits, reasons: tuple[Message, ...]) -> Turn | None:
    """Return the motion as a turn; None where a run cannot be navigated through it."""
    before, after = rotation.before, rotation.after
    if before is None or after is None:
        return None
    is_invalid = rotation.missing > limits.missing or rotation.flags & (Flag.SATURATED | Flag.FAULT)
    is_short = before.duration_s < limits.rest_before_s or after.duration_s < limits.rest_after_s
    is_moved = bool(reasons) and after.up != before.up
    if is_invalid or is_short or is_moved:
        return None
    return Turn(**{**vars(rotation), "reasons": reasons})


def _up_to_last_accepted(turns: Sequence[Turn]) -> tuple[Turn, ...]:
    accepted = [k for k, turn in enumerate(turns) if turn.accepted]
    return tuple(turns[: accepted[-1] + 1]) if accepted else ()
