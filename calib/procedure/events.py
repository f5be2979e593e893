"""What goes into the procedure's engine and what comes out: keys, events, the log of a run, the view.

Fields of keys and events are text, numbers and tuples of them, so that a journal can hold them as JSON.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib.procedure.messages import Message
from imudrv.arrays import Array

PREFLIGHT: Final = "preflight"
"""Step id of the events of the preflight."""


class Phase(StrEnum):
    """Where the procedure is."""

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
    """What the unit tells beside its samples; once a second, or when it changes.

    Parameters
    ----------
    bits : tuple of str
        Names of the status bits that are set.
    faults : tuple of str
        Those that mean a fault.
    temperature_degc : mapping of str to float or None
        By channel; None: not known.
    """

    bits: tuple[str, ...] = ()
    faults: tuple[str, ...] = ()
    temperature_degc: Mapping[str, float | None] = {}


@dataclass(frozen=True)
class Confirm:
    """The unit stands as the step wants it; counts in PLACE of that step, while the sensors agree."""

    step_id: str


@dataclass(frozen=True)
class Redo:
    """Do a step again, the current one from its beginning or one that was accepted; evidence is kept."""

    step_id: str


@dataclass(frozen=True)
class Skip:
    """Leave the current step out; `Redo` comes back to it."""

    step_id: str


@dataclass(frozen=True)
class Abort:
    """End it."""


Action: TypeAlias = Confirm | Redo | Skip | Abort


@dataclass(frozen=True)
class Entered:
    """A phase has begun; `counter` is that of the newest sample looked at, -1 before the first."""

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
        Sizes of the mean readings.
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
    """The alignment of an attempt begins again."""

    step_id: str
    attempt: int
    reasons: tuple[Message, ...]
    counter: int


@dataclass(frozen=True)
class Accepted:
    """A rotation serves.

    Attributes
    ----------
    first_counter, last_counter : int
        Samples of the evidence, both included: rest before, rotation, rest after, and nothing else.
    angle_deg, duration_s, peak_deg_per_s, axis_tilt_deg : float
        The rotation, as found in these samples.
    rest_before_s, rest_after_s : float
        The rests beside it.
    level_sigma_deg, heading_sigma_deg : float
        Predicted for the alignment.
    heading_deg : float
        How far the pose was turned clockwise, -180 to 180.
    v_n : tuple of 3 float
        Mean velocity east, north, up in the half second after the turn, m/s.
    samples : int or None
        Number of samples of the evidence, less than the counters span where the line lost some; None in the
        journal of an older version.
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


@dataclass(frozen=True)
class Rejected:
    """An attempt, or the preflight (`step_id` is `PREFLIGHT`), cannot serve; each reason bears its number.

    It follows `Accepted` of the same attempt where the evidence turned out not to be kept.
    """

    step_id: str
    attempt: int
    reasons: tuple[Message, ...]
    counter: int


@dataclass(frozen=True)
class Skipped:
    """A step is left out."""

    step_id: str
    attempt: int
    counter: int


@dataclass(frozen=True)
class Redone:
    """A step is done again, from `attempt` on."""

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
    reasons : tuple of str
        What the accepted ones do not see, if anything.
    """

    accepted: tuple[str, ...]
    skipped: tuple[str, ...]
    reasons: tuple[Message, ...]
    counter: int


@dataclass(frozen=True)
class Aborted:
    """The operator has ended it."""

    step_id: str
    attempt: int
    counter: int


Event: TypeAlias = Entered | Checked | Restarted | Accepted | Rejected | Skipped | Redone | Finished | Aborted


@dataclass(frozen=True)
class NavigationLog:
    """Velocity and H of every sample of an accepted run, from the end of its alignment on.

    Attributes
    ----------
    step_id, attempt
        Of the run.
    first_counter, last_counter : int
        As in `Accepted`.
    counter : ndarray of int64, shape (n,)
        Of the samples.
    t_s : ndarray, shape (n,)
        Their ends, from the start of navigation, by the counter.
    v_n : ndarray, shape (n, 3)
        Navigated velocity east, north, up, m/s.
    H : ndarray, shape (n, 3, 9)
        Its answer to (r_x, r_y, r_z), m/s a metre.
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
    """All that a screen shows.

    Attributes
    ----------
    phase : Phase
        Where the procedure is.
    step, steps : int
        Number of the step, from 1, and how many there are.
    step_id, title : str
        Of the step: ``x-up``, and ``step 2 of 3: X up, +180 deg``.
    headline : str
        What to do now, at most 38 characters.
    hints : tuple of str
        How, and what is expected.
    reasons : tuple of str
        Why something was rejected or has begun again.
    angle_deg, want_deg : float or None
        Turned about the vertical, and what it shall become, in ROTATE and REST.
    rate_deg_per_s : float
        About the vertical in ROTATE and REST, else the size of the rate.
    stillness : float
        0 moving to 1 still: 1 less a ninth of how many times the limit is passed, over the last half second.
    progress : float or None
        Of the phase, 0 to 1.
    remaining_s : float or None
        Of the phase.
    level_sigma_deg, heading_sigma_deg : float or None
        Of the alignment, once it can tell.
    actions : tuple of str
        What keys do now: 'confirm', 'redo', 'skip', 'abort'.
    bells : int
        Counts up when a turn is due, a step is done or an attempt is rejected.
    """

    phase: Phase
    step: int
    steps: int
    step_id: str
    title: Message
    headline: Message
    hints: tuple[Message, ...]
    reasons: tuple[Message, ...]
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
