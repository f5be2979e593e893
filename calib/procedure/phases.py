"""Phases that procedures of all kinds have: blocks of 20 ms in, outcome and prompt out."""

from abc import ABC, abstractmethod
from typing import Final

import numpy as np

from calib.detection.blocks import BLOCK_NS, Block
from calib.detection.segments import LEAST_FORCE, SIGMAS
from calib.detection.tracking import MG, RestAverages
from calib.messages import Message, message
from calib.procedure import prompts
from calib.procedure.attempt import Attempt
from calib.procedure.events import PREFLIGHT, Checked, Phase, Rejected
from calib.procedure.preflight import PREFLIGHT_S, dither_faults, sensor_faults
from calib.procedure.progress import Progress
from calib.procedure.prompts import READY_S, Prompt
from calib.procedure.transitions import Outcome
from imudrv.arrays import Array
from imudrv.nav.earth import EARTH_RATE
from imudrv.records import Flag
from imudrv.units import DEG, DEG_PER_H, NS

VERDICT_S: Final = 5.0
"""Longest time for which a verdict is shown, s; it ends earlier when the unit moves."""


_HALF_BLOCK_S: Final = 0.5 * BLOCK_NS * NS


class PhaseState(ABC):
    """A phase while it lasts; made when the phase begins.

    Attributes
    ----------
    progress : Progress
        The shared state.
    step_id, number
        Step id and attempt number of the events of this phase.
    duration_s : float or None
        Length of the phase, where it is fixed.
    turning : bool
        The angle about the vertical is shown.
    """

    turning = False

    def __init__(self, progress: Progress, duration_s: float | None = None) -> None:
        self.progress, self.duration_s = progress, duration_s
        self.step_id, self.number = progress.step.id, progress.number

    def feed(self, block: Block) -> Outcome | None:
        """Take a block; None: the phase continues."""
        return None

    @abstractmethod
    def prompt(self) -> Prompt:
        """Return what the operator has to do."""


class Preflight(PhaseState):
    """Half a minute at rest shows whether the sensors are sound."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(progress, PREFLIGHT_S)
        self.step_id, self.number = PREFLIGHT, 1
        self._averages = RestAverages()
        self._angles: list[Array] = []
        self._failed = False

    def prompt(self) -> Prompt:
        """Return what the operator has to do."""
        return prompts.preflight(self.progress.observation, self._failed)

    def feed(self, block: Block) -> Outcome | None:
        """Average while at rest, then check."""
        p = self.progress
        if p.stillness.moving or block.flags & Flag.WARM_UP:
            self._begin()
            self._failed = self._failed and not p.stillness.moving
            return None
        self._averages.feed(block)
        self._angles.append(block.rows["dtheta_b"].copy())
        if p.elapsed_s < PREFLIGHT_S - _HALF_BLOCK_S:
            return None
        averages, still = self._averages, self._angles
        rate_noise, force_noise = averages.noise()
        limits = motion_limits(rate_noise, force_noise)
        # motion too small to be detected before the noise was known
        p.elapsed_s = averages.forget(*limits) * BLOCK_NS * NS
        if p.elapsed_s < PREFLIGHT_S - _HALF_BLOCK_S:
            rate, force = limits[0] / DEG, limits[1] / MG
            p.reasons = (message("not_at_rest", rate_deg_per_s=rate, force_mg=force),)
            return None
        kept = still[len(still) - round(p.elapsed_s / (BLOCK_NS * NS)) :]
        self._begin()
        p.reasons = self.faults(averages, np.concatenate(kept))
        if p.reasons:
            self._fail()
            return None
        p.stillness.limit(*limits)
        p.events.append(
            Checked(
                counter=p.counter,
                gravity_m_s2=float(np.linalg.norm(averages.force)),
                earth_rate_deg_per_h=float(np.linalg.norm(averages.rate)) / DEG_PER_H,
                noise_deg_per_s=rate_noise / DEG,
                noise_mg=force_noise / MG,
                temperature_degc=tuple(p.status.temperature_degc.items()),
            )
        )
        return Outcome.CHECKED

    def faults(self, averages: RestAverages, dtheta_b: Array) -> tuple[Message, ...]:
        """Return what is wrong with the sensors; `dtheta_b`: the angle increments of the rest, (n, 3)."""
        p = self.progress
        faults = sensor_faults(averages, p.status, p.procedure.limits, p.calibration)
        return faults + dither_faults(dtheta_b, round(p.interval_s / NS))

    def _begin(self) -> None:
        self._averages, self.progress.elapsed_s = RestAverages(), 0.0
        self._angles = []

    def _fail(self) -> None:
        """Report the faults, once until the unit is moved."""
        p = self.progress
        if not self._failed:
            p.bells += 1
            p.events.append(Rejected(PREFLIGHT, self.number, p.reasons, p.counter))
            self.number += 1
        self._failed = True


class Placing(PhaseState):
    """The unit is brought into the pose of the step; takes as long as it takes.

    Attributes
    ----------
    was_moved : bool
        Whether the unit was moved meanwhile.
    """

    def __init__(self, progress: Progress) -> None:
        super().__init__(progress)
        progress.attempt = Attempt()
        self.was_moved = False

    def feed(self, block: Block) -> Outcome | None:
        """Go on without a confirmation, where nobody is asked for one."""
        p = self.progress
        self.was_moved = self.was_moved or p.stillness.moving
        ready = p.hands_free and p.observation.ready and p.elapsed_s >= READY_S
        return self.placed() if ready else None

    def placed(self) -> Outcome:
        """Return the outcome for a unit that rests in the pose, and is confirmed."""
        return Outcome.PLACED

    def prompt(self) -> Prompt:
        """Return what the operator has to do."""
        return prompts.place(self.progress.observation, self.progress.hands_free, self.was_moved)


class Verdict(PhaseState):
    """The verdict is shown until the unit moves; some seconds at most, except a rejection to a person."""

    def feed(self, block: Block) -> Outcome | None:
        """Wait."""
        p = self.progress
        is_accepted = p.step.id in p.accepted
        is_over = p.elapsed_s >= VERDICT_S and (is_accepted or p.hands_free)
        if not is_over and not p.stillness.moving:
            return None
        if is_accepted:
            return p.advance()
        p.move_on()
        return Outcome.AGAIN

    def prompt(self) -> Prompt:
        """Return the verdict."""
        p = self.progress
        accepted = p.accepted.get(p.step.id)
        if accepted is None:
            return self.rejection()
        return prompts.verdict(p.index + 1, len(p.procedure.steps), accepted)

    @abstractmethod
    def rejection(self) -> Prompt:
        """Return what to do after a rejection."""


class Done(PhaseState):
    """Every step is accepted or skipped."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(progress)
        progress.attempt = Attempt()

    def prompt(self) -> Prompt:
        """Return the number of steps."""
        accepted = len(self.progress.accepted)
        skipped = len(self.progress.procedure.steps) - accepted
        return Prompt(message("all_done"), (message("count", accepted=accepted, skipped=skipped),))


class Stopped(PhaseState):
    """The operator has ended the procedure."""

    def prompt(self) -> Prompt:
        """Return that it has ended."""
        return Prompt(message("aborted"))


COMMON_STATES: Final[dict[Phase, type[PhaseState]]] = {
    Phase.PREFLIGHT: Preflight,
    Phase.PLACE: Placing,
    Phase.DONE: Done,
    Phase.ABORTED: Stopped,
}
"""Classes of the phases that all procedures have; `Verdict` says what to do after a rejection of its kind."""


def motion_limits(rate_noise: float, force_noise: float) -> tuple[float, float]:
    """Return the rate, rad/s, and the change of specific force, m/s^2, that are motion at this noise."""
    return 2.0 * EARTH_RATE + SIGMAS * rate_noise, LEAST_FORCE + SIGMAS * force_noise
