"""Phases of a procedure of the arms: alignment, rotations, the rests between them, and their verdict."""

from dataclasses import replace
from typing import Final

import numpy as np

from calib.axes import side
from calib.detection.acceptance import rejection_reasons
from calib.detection.blocks import Block
from calib.detection.segments import QUIET_S, Rotation
from calib.detection.tracking import RestAverages
from calib.estimation.gains import GAIN_WINDOW_S
from calib.estimation.priors import Priors
from calib.estimation.runs import GUARD_S
from calib.messages import Message, message
from calib.procedure import prompts
from calib.procedure.attempt import Attempt
from calib.procedure.events import Accepted, Phase, Turned
from calib.procedure.phases import COMMON_STATES, PhaseState, Preflight, Verdict
from calib.procedure.preflight import axis_faults
from calib.procedure.progress import Progress
from calib.procedure.prompts import MIN_ROTATION_RAD, Prompt
from calib.procedure.transitions import Outcome
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.nav.alignment import MIN_ALIGNMENT_S, Alignment
from imudrv.records import Flag
from imudrv.units import DEG

WAIT_S: Final = 60.0
"""The navigation log starts anew when the rotation has not come after this time, s."""


_MARGIN_S: Final = 0.1  # the segmentation widens motions by some blocks


_PRIORS: Final = Priors()


class CheckingAxes(Preflight):
    """The preflight of a calibrated unit: gravity and the Earth's rotation have to be there, too."""

    def faults(self, averages: RestAverages, dtheta_b: Array) -> tuple[Message, ...]:
        """Return what is wrong with the sensors; `dtheta_b`: the angle increments of the rest, (n, 3)."""
        p = self.progress
        return super().faults(averages, dtheta_b) + axis_faults(averages, p.step, p.procedure.limits, p.site)


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
        super().__init__(progress, progress.run.align_s)
        self._alignment = Alignment(
            progress.site.latitude_rad,
            _PRIORS.gyro_bias,
            _PRIORS.accelerometer_bias,
            progress.run.align_s,
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
        if p.elapsed_s < min(self._next_s, p.run.align_s - 0.5 * p.interval_s):
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
        if p.run.turns > 1:
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
            if p.stillness.quiet_s < min(WAIT_S, 0.9 * p.run.align_s):
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
        limits = replace(p.procedure.rotation_limits(p.run), rest_before_s=0.0, rest_after_s=0.0)
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
            if p.run.turns == 1 or p.trouble(block):
                return p.reject(interrupted)
            p.tell(interrupted)
            attempt.next_turn(p.run.turns)
            attempt.turn.feed(block)
            return Outcome.NEXT_TURN
        if p.stillness.quiet_s < p.step.rest_s + _MARGIN_S:
            return None
        if len(attempt.turns) < p.run.turns:
            attempt.next_turn(p.run.turns)
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
        if p.run.turns == 1:
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


class RunVerdict(Verdict):
    """The verdict on a run."""

    def rejection(self) -> Prompt:
        """Return what to do after a rejection."""
        p = self.progress
        return prompts.rejection(p.run, p.procedure, p.reasons)


STATES: Final[dict[Phase, type[PhaseState]]] = {
    **COMMON_STATES,
    Phase.PREFLIGHT: CheckingAxes,
    Phase.SETTLE: Settling,
    Phase.ALIGN: Aligning,
    Phase.ROTATE: Rotating,
    Phase.REST: Resting,
    Phase.VERDICT: RunVerdict,
}
"""Class of each phase."""


def _rejections(progress: Progress, rotation: Rotation | None, rest_after_s: float) -> tuple[Message, ...]:
    """Return why a rotation cannot be used."""
    run = progress.run
    if rotation is None:
        return (message("no_rotation"),)
    limits = replace(progress.procedure.rotation_limits(run), rest_after_s=rest_after_s)
    reasons = rejection_reasons(rotation, limits, run.up[1])
    if _is_wrong_way(rotation, run.turn_deg):
        return (prompts.wrong_direction(rotation.angle_deg, run.turn_deg), *reasons)
    return reasons


def _is_wrong_way(rotation: Rotation, turn_deg: int) -> bool:
    return bool(rotation.angle_deg * np.sign(turn_deg) < -MIN_ROTATION_RAD / DEG)
