"""Transition tables of the procedures.

    arms            PREFLIGHT -> PLACE -> SETTLE -> ALIGN -> ROTATE -> REST -> VERDICT -> PLACE ... DONE
                                                             ROTATE <- REST  (next turn)
    sensors, noise  PREFLIGHT -> PLACE -> REST -> VERDICT -> PLACE (next step, or again) ... DONE

Every change of phase is a row of the table of the kind. An outcome without a row is ignored in that phase.
The first phase is PREFLIGHT, or DONE where an earlier session has accepted every step.
"""

from enum import Enum, auto
from typing import Final

from calib.procedure.events import Phase


class Outcome(Enum):
    """Result of a phase, or request of the operator."""

    CHECKED = auto()  # the sensors are sound
    PLACED = auto()  # the unit is at rest in the pose of the step, and confirmed
    DISPLACED = auto()  # the unit has left the pose
    SETTLED = auto()  # at rest for long enough
    DISTURBED = auto()  # the alignment has to start again
    ALIGNED = auto()
    TURNED = auto()  # the rotation has ended; the only one of a step within its limits
    NEXT_TURN = auto()  # another rotation is due, or has begun early
    ACCEPTED = auto()
    REJECTED = auto()  # by its limits, or because its recording is not complete
    AGAIN = auto()  # another attempt, after a rejection or on request
    NEXT_STEP = auto()  # the step is accepted or skipped
    COMPLETED = auto()  # the same, and it was the last one
    ABORTED = auto()


IN_A_STEP: Final = (Phase.PLACE, Phase.SETTLE, Phase.ALIGN, Phase.ROTATE, Phase.REST, Phase.VERDICT)
"""Phases of a step."""


_COMMON: Final[dict[tuple[Phase, Outcome], Phase]] = {
    (Phase.PREFLIGHT, Outcome.CHECKED): Phase.PLACE,
    (Phase.PREFLIGHT, Outcome.ABORTED): Phase.ABORTED,
    **{(phase, Outcome.REJECTED): Phase.VERDICT for phase in IN_A_STEP},
    **{(phase, Outcome.AGAIN): Phase.PLACE for phase in IN_A_STEP},
    **{(phase, Outcome.NEXT_STEP): Phase.PLACE for phase in IN_A_STEP},
    **{(phase, Outcome.COMPLETED): Phase.DONE for phase in IN_A_STEP},
    **{(phase, Outcome.ABORTED): Phase.ABORTED for phase in IN_A_STEP},
    (Phase.REST, Outcome.ACCEPTED): Phase.VERDICT,
    (Phase.DONE, Outcome.REJECTED): Phase.VERDICT,
    (Phase.DONE, Outcome.AGAIN): Phase.PLACE,
}


TRANSITIONS: Final[dict[tuple[Phase, Outcome], Phase]] = {
    **_COMMON,
    (Phase.PLACE, Outcome.PLACED): Phase.SETTLE,
    (Phase.SETTLE, Outcome.DISPLACED): Phase.PLACE,
    (Phase.SETTLE, Outcome.SETTLED): Phase.ALIGN,
    (Phase.ALIGN, Outcome.DISTURBED): Phase.SETTLE,
    (Phase.ALIGN, Outcome.ALIGNED): Phase.ROTATE,
    (Phase.ROTATE, Outcome.DISTURBED): Phase.SETTLE,
    (Phase.ROTATE, Outcome.TURNED): Phase.REST,
    (Phase.REST, Outcome.NEXT_TURN): Phase.ROTATE,
}
"""Next phase by phase and outcome, for the arms."""


OF_RESTS: Final[dict[tuple[Phase, Outcome], Phase]] = {
    **_COMMON,
    (Phase.PLACE, Outcome.PLACED): Phase.REST,
}
"""The same for the sensors and the noise."""


NEW_ATTEMPT: Final = (Outcome.CHECKED, Outcome.AGAIN, Outcome.NEXT_STEP)
"""Outcomes after which a new attempt begins."""
