"""Phases of the procedure: blocks of 20 ms in, outcome and prompt out."""

from abc import ABC, abstractmethod
from dataclasses import replace
from typing import Final

import numpy as np

from calib.axes import side
from calib.detection.acceptance import rejection_reasons
from calib.detection.blocks import BLOCK_NS, Block
from calib.detection.segments import LEAST_FORCE, QUIET_S, SIGMAS, Rotation
from calib.detection.tracking import MG, RestAverages
from calib.estimation.gains import GAIN_WINDOW_S
from calib.estimation.priors import Priors
from calib.estimation.runs import GUARD_S
from calib.messages import Message, message
from calib.procedure import prompts
from calib.procedure.attempt import Attempt
from calib.procedure.events import PREFLIGHT, Accepted, Checked, Phase, Rejected, Turned
from calib.procedure.preflight import PREFLIGHT_S, axis_faults, dither_faults, sensor_faults
from calib.procedure.progress import Progress
from calib.procedure.prompts import MIN_ROTATION_RAD, READY_S, Prompt
from calib.procedure.transitions import Outcome
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.nav.alignment import MIN_ALIGNMENT_S, Alignment
from imudrv.nav.earth import EARTH_RATE
from imudrv.records import Flag
from imudrv.units import DEG, DEG_PER_H, NS

VERDICT_S: Final = 5.0
"""Longest time for which a verdict is shown, s; it ends earlier when the unit moves."""


WAIT_S: Final = 60.0
"""The navigation log starts anew when the rotation has not come after this time, s."""


_MARGIN_S: Final = 0.1  # the segmentation widens motions by some blocks


_HALF_BLOCK_S: Final = 0.5 * BLOCK_NS * NS


_PRIORS: Final = Priors()


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
        p.reasons = sensor_faults(averages, p.status, p.procedure.limits, p.calibration)
        p.reasons += dither_faults(np.concatenate(kept), round(p.interval_s / NS))
        p.reasons += axis_faults(averages, p.step, p.procedure.limits, p.site)
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
    """The unit is brought into the pose of the step; takes as long as it takes."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(progress)
        progress.attempt = Attempt()
        self._was_moved = False

    def feed(self, block: Block) -> Outcome | None:
        """Go on without a confirmation, where nobody is asked for one."""
        p = self.progress
        self._was_moved = self._was_moved or p.stillness.moving
        ready = p.hands_free and p.observation.ready and p.elapsed_s >= READY_S
        return Outcome.PLACED if ready else None

    def prompt(self) -> Prompt:
        """Return what the operator has to do."""
        return prompts.place(self.progress.observation, self.progress.hands_free, self._was_moved)


class Settling(PhaseState):
    """The unit has to rest for a while before the alignment begins."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(progress, progress.procedure.limits.still_s)
        progress.attempt = Attempt()

    def feed(self, block: Block) -> Outcome | None:
        """Start again after motion."""
        p = self.progress
        if not p.observation.placed:
            return Outcome.DISPLACED
        if p.disturbance(block):
            p.elapsed_s, p.attempt = 0.0, Attempt()
            return None
        p.attempt.append(block)
        return Outcome.SETTLED if p.elapsed_s >= p.procedure.limits.still_s else None

    def prompt(self) -> Prompt:
        """Return what the operator has to do."""
        return prompts.settle(self.progress.observation)


class Aligning(PhaseState):
    """The alignment is evaluated at growing intervals; motion and faults start it again."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(progress, progress.step.align_s)
        self._alignment = Alignment(
            progress.site.latitude_rad,
            _PRIORS.gyro_bias,
            _PRIORS.accelerometer_bias,
            progress.step.align_s,
        )
        self._averages = RestAverages()
        self._next_s = MIN_ALIGNMENT_S
        progress.attempt.align(self._alignment)

    def prompt(self) -> Prompt:
        """Return what the operator has to do."""
        return Prompt(message("hands_off"), (message("do_not_touch"),))

    def feed(self, block: Block) -> Outcome | None:
        """Align."""
        p, attempt = self.progress, self.progress.attempt
        if cause := p.disturbance(block):
            return p.restart(message("alignment_interrupted", elapsed_s=p.elapsed_s, cause=cause))
        attempt.append(block)
        self._averages.feed(block)
        if p.elapsed_s < min(self._next_s, p.step.align_s - 0.5 * p.interval_s):
            return None
        self._next_s = max(p.elapsed_s + 10.0, 1.2 * p.elapsed_s)
        attempt.process()
        faults: tuple[Message, ...] = ()
        if attempt.aligned is None:
            faults = axis_faults(self._averages, p.step, p.procedure.limits, p.site)
        try:
            aligned = self._alignment.result()
        except InputError as error:
            return p.restart(*faults, message("alignment_failed", why=str(error)))
        if self._alignment.done and aligned.motion:
            moved = aligned.motion
            faults = (*faults, message("moved_at_rest", begin_s=moved.begin_s, end_s=moved.end_s))
        attempt.aligned = aligned
        w, x, y, z = aligned.q_nb.tolist()
        p.attitude.q_nb = w, x, y, z
        if faults:
            return p.restart(*faults)
        if not self._alignment.done:
            return None
        attempt.heading_rad = p.observation.clockwise or 0.0
        p.navigate((w, x, y, z))
        p.bells += 1
        p.reasons = p.last_try = ()
        return Outcome.ALIGNED


class Rotating(PhaseState):
    """A rotation: waits for it, then for its end; however long the first one of a step takes."""

    turning = True

    def prompt(self) -> Prompt:
        """Return what the operator has to do."""
        p = self.progress
        return prompts.rotate(p.observation, p.attempt.turn, p.turn_deg, p.procedure.turn_s)

    def feed(self, block: Block) -> Outcome | None:
        """Follow the rotation."""
        p, attempt = self.progress, self.progress.attempt
        rotation = attempt.turn
        attempt.append(block)
        trouble = p.trouble(block)
        if rotation.begun is None:
            if trouble:
                return p.restart(message("before_rotation", cause=trouble))
            if not p.stillness.moving:
                return self._wait()
        elif trouble:
            return p.reject(message("during_rotation", cause=trouble))
        rotation.feed(block)
        if p.stillness.quiet_s < QUIET_S + _MARGIN_S:
            return None
        if rotation.size < MIN_ROTATION_RAD:
            disturbed = message("rest_disturbed", angle_deg=rotation.size / DEG)
            if not attempt.turns:
                return p.restart(disturbed)
            p.tell(disturbed)
            return Outcome.TURNED  # the rest has to be repeated
        attempt.process()
        if p.step.turns > 1:
            return self._judge(attempt.rotation(rotation.begun))
        if reasons := _rejections(p, attempt.rotation(rotation.begun), rest_after_s=0.0):
            return p.reject(*reasons)
        attempt.judge(True)
        return Outcome.TURNED

    def _wait(self) -> Outcome | None:
        """Keep the log short."""
        p = self.progress
        if p.attempt.turns:
            # a rest as long as an alignment would begin another run in the recording
            if p.stillness.quiet_s < min(WAIT_S, 0.9 * p.step.align_s):
                return None
            return p.restart(message("paused", elapsed_s=p.stillness.quiet_s))
        if p.elapsed_s >= WAIT_S and p.attitude.q_nb is not None:
            p.attempt.process()
            p.navigate(p.attitude.q_nb)
            p.elapsed_s = 0.0
        return None

    def _judge(self, rotation: Rotation | None) -> Outcome:
        """Judge one of several turns: the run continues if it can be navigated through."""
        p, attempt = self.progress, self.progress.attempt
        if rotation is None:
            return p.reject(message("no_rotation"))
        limits = replace(p.procedure.rotation_limits(p.step), rest_before_s=0.0, rest_after_s=0.0)
        reasons = rejection_reasons(rotation, limits, p.step.up[1])
        if rotation.missing > limits.missing or rotation.flags & (Flag.SATURATED | Flag.FAULT):
            return p.reject(*reasons)
        if not p.observation.upright:
            return p.reject(message("left_pose", side=side(p.step.up)), *reasons)
        attempt.judge(not reasons)
        if _is_wrong_way(rotation, p.turn_deg):
            reasons = (prompts.wrong_direction(rotation.angle_deg, p.turn_deg), *reasons)
        p.tell(*reasons)
        p.events.append(
            Turned(
                step_id=p.step.id,
                attempt=p.number,
                turn=len(attempt.turns),
                angle_deg=rotation.angle_deg,
                duration_s=rotation.duration_s,
                peak_deg_per_s=rotation.peak_deg_per_s,
                axis_tilt_deg=rotation.axis_tilt_deg,
                reasons=reasons,
                counter=p.counter,
            )
        )
        return Outcome.TURNED


class Resting(PhaseState):
    """The rest after a rotation."""

    turning = True

    def __init__(self, progress: Progress) -> None:
        super().__init__(progress, progress.step.rest_s)
        progress.elapsed_s = progress.stillness.quiet_s

    def prompt(self) -> Prompt:
        """Return what the operator has to do."""
        return Prompt(message("hands_off"), (message("do_not_touch"),))

    def feed(self, block: Block) -> Outcome | None:
        """Judge the rotation after the rest, or ask for the next one."""
        p, attempt = self.progress, self.progress.attempt
        attempt.append(block)
        if cause := p.disturbance(block):
            rest_s = p.step.rest_s
            interrupted = message("rest_interrupted", elapsed_s=p.elapsed_s, rest_s=rest_s, cause=cause)
            if p.step.turns == 1 or p.trouble(block):
                return p.reject(interrupted)
            p.tell(interrupted)
            attempt.next_turn(p.step.turns)
            attempt.turn.feed(block)
            return Outcome.NEXT_TURN
        if p.stillness.quiet_s < p.step.rest_s + _MARGIN_S:
            return None
        if len(attempt.turns) < p.step.turns:
            attempt.next_turn(p.step.turns)
            p.bells += 1
            return Outcome.NEXT_TURN
        attempt.process()
        return self._judge()

    def _judge(self) -> Outcome:
        """Accept or reject the attempt."""
        p, attempt = self.progress, self.progress.attempt
        rotation = attempt.rotation(attempt.turns[-1].begun)
        reasons = self._reasons(rotation)
        accepted = None if reasons or rotation is None else self._accepted(rotation)
        if accepted is None:
            return p.reject(*reasons)
        p.accepted[p.step.id] = accepted
        p.events.append(accepted)
        p.bells += 1
        return Outcome.ACCEPTED

    def _reasons(self, rotation: Rotation | None) -> tuple[Message, ...]:
        """Return why the run cannot be used; `rotation` is the last one."""
        p, turns = self.progress, self.progress.attempt.turns
        if p.step.turns == 1:
            return _rejections(p, rotation, p.step.rest_s)
        if rotation is None:
            return (message("no_rotation"),)
        within = sum(turn.is_within_limits for turn in turns)
        if 2 * within >= len(turns):
            return ()
        return (message("too_few_turns", within=within, turns=len(turns)),)

    def _accepted(self, rotation: Rotation) -> Accepted | None:
        """Summarise an accepted rotation and keep its log; None: it lacks a rest or an alignment."""
        p, attempt = self.progress, self.progress.attempt
        if rotation.before is None or rotation.after is None or attempt.aligned is None:
            return None
        log = attempt.log(p.step.id, p.number, p.interval_s)
        p.logs.append(log)
        begin = rotation.stop + round(GUARD_S / p.interval_s)
        stop = begin + round(GAIN_WINDOW_S / p.interval_s)
        east, north, up = log.v_n[(log.counter >= begin) & (log.counter < stop)].mean(axis=0).tolist()
        return Accepted(
            step_id=p.step.id,
            attempt=p.number,
            first_counter=log.first_counter,
            last_counter=log.last_counter,
            angle_deg=rotation.angle_deg,
            duration_s=rotation.duration_s,
            peak_deg_per_s=rotation.peak_deg_per_s,
            axis_tilt_deg=rotation.axis_tilt_deg,
            rest_before_s=rotation.before.duration_s,
            rest_after_s=rotation.after.duration_s,
            level_sigma_deg=attempt.aligned.level_sigma_rad / DEG,
            heading_sigma_deg=attempt.aligned.heading_sigma_rad / DEG,
            heading_deg=attempt.heading_rad / DEG,
            v_n=(east, north, up),
            samples=attempt.samples,
            turns=len(attempt.turns),
            turns_within_limits=sum(turn.is_within_limits for turn in attempt.turns),
        )


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
            return prompts.rejection(p.step, p.procedure, p.reasons)
        return prompts.verdict(p.index + 1, len(p.procedure.steps), accepted)


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


STATES: Final[dict[Phase, type[PhaseState]]] = {
    Phase.PREFLIGHT: Preflight,
    Phase.PLACE: Placing,
    Phase.SETTLE: Settling,
    Phase.ALIGN: Aligning,
    Phase.ROTATE: Rotating,
    Phase.REST: Resting,
    Phase.VERDICT: Verdict,
    Phase.DONE: Done,
    Phase.ABORTED: Stopped,
}
"""Class of each phase."""


def motion_limits(rate_noise: float, force_noise: float) -> tuple[float, float]:
    """Return the rate, rad/s, and the change of specific force, m/s^2, that are motion at this noise."""
    return 2.0 * EARTH_RATE + SIGMAS * rate_noise, LEAST_FORCE + SIGMAS * force_noise


def _rejections(progress: Progress, rotation: Rotation | None, rest_after_s: float) -> tuple[Message, ...]:
    """Return why a rotation cannot be used."""
    step = progress.step
    if rotation is None:
        return (message("no_rotation"),)
    limits = replace(progress.procedure.rotation_limits(step), rest_after_s=rest_after_s)
    reasons = rejection_reasons(rotation, limits, step.up[1])
    if _is_wrong_way(rotation, step.turn_deg):
        return (prompts.wrong_direction(rotation.angle_deg, step.turn_deg), *reasons)
    return reasons


def _is_wrong_way(rotation: Rotation, turn_deg: int) -> bool:
    return bool(rotation.angle_deg * np.sign(turn_deg) < -MIN_ROTATION_RAD / DEG)
