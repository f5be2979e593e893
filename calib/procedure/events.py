"""Input and output of the procedure's engine: actions, events, the log of a run, the view.

Fields of actions and events are text, numbers, messages and tuples of them: a journal holds them as JSON.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib.messages import Message
from imudrv.arrays import Array
from imudrv.vectors import Vector

PREFLIGHT: Final = "preflight"
"""Step id of the events of the preflight."""


class Phase(StrEnum):
    """Phase of the procedure; see `calib.procedure.transitions`."""

    PREFLIGHT = "preflight"
    PLACE = "place"
    SETTLE = "settle"
    ALIGN = "align"
    ROTATE = "rotate"
    REST = "rest"
    VERDICT = "verdict"
    DONE = "done"
    ABORTED = "aborted"


class Conditions(NamedTuple):
    """Status of the unit beside its samples; once a second, or when the faults change.

    Parameters
    ----------
    faults : tuple of str
        Names of the status bits that are set and mean a fault.
    temperature_degc : mapping of str to float or None
        By channel; None: unknown.
    """

    faults: tuple[str, ...] = ()
    temperature_degc: Mapping[str, float | None] = {}


@dataclass(frozen=True)
class Confirm:
    """The unit is in the pose of the step; counts in PLACE of that step, while the sensors agree.

    After a rejection, it is read: the step is repeated.
    """

    step_id: str


@dataclass(frozen=True)
class Redo:
    """Repeat a step, the current one or one that was accepted or skipped; all recordings are kept."""

    step_id: str


@dataclass(frozen=True)
class Skip:
    """Omit the current step; `Redo` comes back to it."""

    step_id: str


@dataclass(frozen=True)
class Abort:
    """End the procedure."""


Action: TypeAlias = Confirm | Redo | Skip | Abort


@dataclass(frozen=True)
class Entered:
    """A phase has begun; `counter` is that of the newest sample processed, -1 before the first."""

    phase: Phase
    step_id: str
    attempt: int
    counter: int


@dataclass(frozen=True)
class Checked:
    """The preflight has passed.

    Attributes
    ----------
    gravity_m_s2, earth_rate_deg_per_h : float
        Magnitudes of the mean readings.
    noise_deg_per_s, noise_mg : float
        Rms over 20 ms at rest.
    temperature_degc : tuple of (str, float or None)
        By channel.
    """

    counter: int
    gravity_m_s2: float
    earth_rate_deg_per_h: float
    noise_deg_per_s: float
    noise_mg: float
    temperature_degc: tuple[tuple[str, float | None], ...]


@dataclass(frozen=True)
class Restarted:
    """The alignment of an attempt starts again."""

    step_id: str
    attempt: int
    reasons: tuple[Message, ...]
    counter: int


@dataclass(frozen=True)
class Turned:
    """One of several rotations of a run has ended.

    Attributes
    ----------
    turn : int
        Its number, from 1.
    angle_deg, duration_s, peak_deg_per_s, axis_tilt_deg : float
        The rotation.
    reasons : tuple of Message
        What was wrong with it; the run continues.
    """

    step_id: str
    attempt: int
    turn: int
    angle_deg: float
    duration_s: float
    peak_deg_per_s: float
    axis_tilt_deg: float
    reasons: tuple[Message, ...]
    counter: int


@dataclass(frozen=True)
class Accepted:
    """A run is accepted.

    Attributes
    ----------
    first_counter, last_counter : int
        First and last sample of the attempt: rest before, rotation, rest after, and nothing else.
    angle_deg, duration_s, peak_deg_per_s, axis_tilt_deg : float
        The rotation, as detected in these samples; the last one of several.
    rest_before_s, rest_after_s : float
        Lengths of the rests before and after it.
    level_sigma_deg, heading_sigma_deg : float
        1-sigma predicted for the alignment.
    heading_deg : float
        Clockwise deviation from the heading of the pose, -180 to 180.
    v_n : tuple of 3 float
        Mean velocity east, north, up in the half second after the turn, m/s.
    samples : int or None
        Number of samples of the attempt, fewer than the counters span where some were lost; None in the
        journal of an older version.
    turns, turns_within_limits : int
        Number of rotations of the run, and of those within their limits.
    """

    step_id: str
    attempt: int
    first_counter: int
    last_counter: int
    angle_deg: float
    duration_s: float
    peak_deg_per_s: float
    axis_tilt_deg: float
    rest_before_s: float
    rest_after_s: float
    level_sigma_deg: float
    heading_sigma_deg: float
    heading_deg: float
    v_n: tuple[float, float, float]
    samples: int | None = None
    turns: int = 1
    turns_within_limits: int = 1


@dataclass(frozen=True)
class Rested:
    """A long rest of the noise goes on; it counts in another session, too.

    Attributes
    ----------
    rest_s : float
        Time at rest so far.
    """

    step_id: str
    attempt: int
    rest_s: float
    counter: int


@dataclass(frozen=True)
class RestAccepted:
    """A rest of a procedure of the sensors or the noise is accepted.

    Attributes
    ----------
    first_counter, last_counter : int
        First and last sample of the rest.
    samples : int
        Number of samples between them that arrived.
    rest_s : float
        Time at rest.
    lean_deg : float
        Angle between the axis that is to be up and the vertical.
    heading_deg : float or None
        Clockwise deviation from the heading of the pose, by the Earth's rotation; None: not known.
    missing : int
        Number of samples lost while the unit was carried to this pose.
    """

    step_id: str
    attempt: int
    first_counter: int
    last_counter: int
    samples: int
    rest_s: float
    lean_deg: float
    heading_deg: float | None
    missing: int = 0


@dataclass(frozen=True)
class Rejected:
    """An attempt, or the preflight (`step_id` is `PREFLIGHT`), is rejected.

    It follows `Accepted` of the same attempt where the recording is not complete.
    """

    step_id: str
    attempt: int
    reasons: tuple[Message, ...]
    counter: int


@dataclass(frozen=True)
class Skipped:
    """A step is skipped."""

    step_id: str
    attempt: int
    counter: int


@dataclass(frozen=True)
class Redone:
    """A step is repeated, from `attempt` on."""

    step_id: str
    attempt: int
    counter: int


@dataclass(frozen=True)
class Finished:
    """Every step is accepted or skipped.

    Attributes
    ----------
    accepted, skipped : tuple of str
        Step ids.
    reasons : tuple of Message
        Why the accepted steps are not sufficient, if they are not.
    """

    accepted: tuple[str, ...]
    skipped: tuple[str, ...]
    reasons: tuple[Message, ...]
    counter: int


@dataclass(frozen=True)
class Aborted:
    """The operator has ended the procedure."""

    step_id: str
    attempt: int
    counter: int


Event: TypeAlias = (
    Entered
    | Checked
    | Restarted
    | Turned
    | Rested
    | Accepted
    | RestAccepted
    | Rejected
    | Skipped
    | Redone
    | Finished
    | Aborted
)


@dataclass(frozen=True)
class NavigationLog:
    """Velocity and H of every sample of an accepted run, from the end of its alignment on.

    Attributes
    ----------
    step_id, attempt
        Step and attempt of the run.
    first_counter, last_counter : int
        As in `Accepted`.
    counter : ndarray of int64, shape (n,)
        Sample counter.
    t_s : ndarray, shape (n,)
        End of each sample since the start of navigation, by the counter.
    v_n : ndarray, shape (n, 3)
        Navigated velocity east, north, up, m/s.
    H : ndarray, shape (n, 3, 9)
        Sensitivity of the velocity to (r_x, r_y, r_z), m/s per metre.
    """

    step_id: str
    attempt: int
    first_counter: int
    last_counter: int
    counter: NDArray[np.int64]
    t_s: Array
    v_n: Array
    H: Array


@dataclass(frozen=True)
class View:
    """Content of the operator's screen.

    Attributes
    ----------
    phase : Phase
        Current phase.
    step_id : str
        Id of the step.
    title : Message
        Title of the step: ``step 2 of 3: X up, +180 deg``, or ``step 2 of 3: X up, turn 4 of 10``.
    headline : Message
        What to do now; at most 38 characters in English.
    hints : tuple of Message
        How to do it, and what is expected.
    reasons : tuple of Message
        Why something was rejected or has started again, the first one most important.
    last_try : tuple of Message
        Reasons of an earlier rejection of this step, while it is repeated.
    accepted, skipped : tuple of str
        Ids of the steps that are accepted, and of those that are skipped, in the order of skipping.
    C_nb : tuple of 3 tuples of 3 float, or None
        Attitude, body to east, north, up; before an alignment, with the heading of the pose. None: unknown.
    force_m_s2 : float or None
        Magnitude of the specific force, smoothed.
    angle_deg, want_deg : float or None
        Rotation about the vertical so far, and the required one, in ROTATE and REST.
    rate_deg_per_s : float
        Rate about the vertical in ROTATE and REST, else the magnitude of the rate.
    stillness : float
        From 0, moving, to 1, at rest: 1 less a ninth of the largest excess over the motion limit, in units of
        that limit, in the last half second.
    progress : float or None
        Elapsed part of the phase, 0 to 1.
    remaining_s : float or None
        Remaining time of the phase.
    level_sigma_deg, heading_sigma_deg : float or None
        1-sigma of the alignment, once it is known.
    actions : tuple of str
        Keys that have an effect now: 'confirm', 'redo', 'skip', 'back' to the step skipped last, 'abort'.
    bells : int
        Increases when a rotation is due, a step is done or an attempt is rejected.
    """

    phase: Phase
    step_id: str
    title: Message
    headline: Message
    hints: tuple[Message, ...]
    reasons: tuple[Message, ...]
    last_try: tuple[Message, ...]
    accepted: tuple[str, ...]
    skipped: tuple[str, ...]
    C_nb: tuple[Vector, Vector, Vector] | None
    force_m_s2: float | None
    angle_deg: float | None
    want_deg: float | None
    rate_deg_per_s: float
    stillness: float
    progress: float | None
    remaining_s: float | None
    level_sigma_deg: float | None
    heading_sigma_deg: float | None
    actions: tuple[str, ...]
    bells: int
