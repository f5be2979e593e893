"""The bench procedure's engine: samples and keys in, prompts and verdicts out; no screen, no I/O, no clock.

    PREFLIGHT -> PLACE -> SETTLE -> ALIGN -> ROTATE -> REST -> VERDICT -> PLACE (next, or again) ... DONE

Time is that of the samples' counter: nothing runs while no samples come, and nothing times out while a person
carries the unit. Any cut of the samples into pieces gives the same events and, at the same sample, the same
view.

The sensors decide. A key only agrees: `Confirm` bears the id of the step that it confirms, and counts only
while the unit stands still in that step's pose. What counts as motion follows from the noise that the
preflight found, by the rule of `calib.detection.segments`; the verdict on a rotation is that of
`calib.detection.acceptance` on the samples from `Accepted.first_counter` to `last_counter`, so that whoever
cuts these from a recording finds the same.

Velocity and H of every sample from the end of an alignment to the end of the rest after the turn are in the
`NavigationLog` of the run. Where the turn is waited for, the log begins anew each minute.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from calib.detection.acceptance import rejection_reasons
from calib.detection.blocks import BLOCK_NS, Block, BlockSplitter
from calib.detection.segments import LEAST_FORCE, QUIET_S, SIGMAS, Rotation
from calib.detection.tracking import MG, AttitudeTracker, RestAverages, StillnessDetector
from calib.estimation.linear_system import GAIN_WINDOW_S
from calib.estimation.runs import GUARD_S, Priors
from calib.procedure import prompts
from calib.procedure.attempt import Attempt
from calib.procedure.events import (
    PREFLIGHT,
    Abort,
    Aborted,
    Accepted,
    Action,
    Checked,
    Conditions,
    Confirm,
    Entered,
    Event,
    Finished,
    NavigationLog,
    Phase,
    Redo,
    Redone,
    Rejected,
    Restarted,
    Skip,
    Skipped,
    View,
)
from calib.procedure.plan import predicted
from calib.procedure.preflight import axis_faults
from calib.procedure.prompts import NAMED_RAD, READY_S, Says, StepObservation, pose_text, wrong_direction_text
from calib.procedure.schema import Procedure, Step
from imudrv.calibration import Calibration
from imudrv.errors import InputError
from imudrv.nav.alignment import Alignment
from imudrv.nav.attitude import Quaternion, conjugate, turn
from imudrv.nav.earth import EARTH_RATE, normal_gravity
from imudrv.nav.mechanisation import Navigator
from imudrv.records import Flag, Records
from imudrv.site import Site
from imudrv.units import DEG, DEG_PER_H, NS

__all__ = [
    "PREFLIGHT",
    "Abort",
    "Aborted",
    "Accepted",
    "Action",
    "Checked",
    "Conditions",
    "Confirm",
    "Engine",
    "Entered",
    "Event",
    "Finished",
    "NavigationLog",
    "Phase",
    "Redo",
    "Redone",
    "Rejected",
    "Restarted",
    "Skip",
    "Skipped",
    "View",
]


PREFLIGHT_S: Final = 30.0
"""Rest that the preflight looks at, s."""


VERDICT_S: Final = 5.0
"""A verdict is shown so long, or until the unit moves, s."""


WAIT_S: Final = 60.0
"""The log begins anew when the turn has not come after so long, s."""


_MARGIN_S: Final = 0.1  # segments make motions some blocks wider than they are


class Engine:
    """Leads through a procedure.

    Parameters
    ----------
    procedure : Procedure
        What is to be done.
    site : Site
        Where the unit stands.
    calibration : Calibration
        That made the increments; its size effect is not used.
    interval_ns : int
        Sample interval.
    hands_free : bool
        Go on by the sensors alone, without `Confirm`.
    accepted : mapping of str to Accepted
        Steps that an earlier session has done, by id.
    attempts : mapping of str to int
        Number of the last attempt of each step in an earlier session; the next one is one more.
    """

    def __init__(
        self,
        procedure: Procedure,
        site: Site,
        calibration: Calibration,
        *,
        interval_ns: int,
        hands_free: bool = False,
        accepted: Mapping[str, Accepted] | None = None,
        attempts: Mapping[str, int] | None = None,
    ) -> None:
        self._procedure, self._site, self._calibration = procedure, site, calibration
        self._steps = procedure.steps
        self._interval_s = interval_ns * NS
        self._hands_free = hands_free
        self._cutter = BlockSplitter(interval_ns)
        self._posture = AttitudeTracker(site.latitude_rad)
        limits = procedure.limits
        # wide, so that a unit that is too noisy is seen to rest, and its noise is then named
        self._still = StillnessDetector(
            *_motion_limits(3.0 * limits.noise_deg_per_s * DEG, 3.0 * limits.noise_mg * MG)
        )
        self._conditions = Conditions()
        self._flags = 0
        self._counter = -1
        self._events: list[Event] = []
        self._bells = 0
        self._reasons: tuple[str, ...] = ()
        self._accepted = dict(accepted or {})
        self._skipped: set[str] = set()
        self._attempts = dict(attempts or {})
        self._logs: list[NavigationLog] = []
        self._attempt = Attempt()
        self._preflight = RestAverages()
        self._checks = 1
        self._check_failed = False
        self._elapsed_s = 0.0  # of the phase
        at = self._next()
        self._at = len(self._steps) - 1 if at is None else at
        self._phase = Phase.PREFLIGHT
        if at is None:
            self._finish()
        else:
            self._enter(Phase.PREFLIGHT)

    def feed(self, increments: Records) -> tuple[Event, ...]:
        """Take samples.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order, compensated without size effect; any pieces give the same events.

        Returns
        -------
        tuple of Event
            What has happened, in order.
        """
        for block in self._cutter.feed(increments):
            self._take(block)
        return self._told()

    def conditions(self, conditions: Conditions) -> tuple[Event, ...]:
        """Take what the unit tells beside its samples."""
        self._conditions = conditions
        return self._told()

    def act(self, action: Action) -> tuple[Event, ...]:
        """Take a key. One that names another step, or that the sensors do not agree with, does nothing."""
        if isinstance(action, Abort):
            self._abort()
        elif isinstance(action, Confirm):
            if action.step_id == self._step.id and self._phase is Phase.PLACE and self._seen.ready:
                self._settle()
        elif isinstance(action, Redo):
            self._redo(action.step_id)
        elif action.step_id == self._step.id and self._phase in _IN_A_STEP:
            self._skip()
        return self._told()

    def reject(self, step_id: str, reason: str) -> tuple[Event, ...]:
        """Take an accepted step back because its evidence could not be kept; it is asked again.

        Parameters
        ----------
        step_id : str
            An accepted step.
        reason : str
            For the operator.

        Returns
        -------
        tuple of Event
            Empty after an abort.
        """
        if self._phase is not Phase.ABORTED:
            del self._accepted[step_id]
            self._at = next(k for k, step in enumerate(self._steps) if step.id == step_id)
            self._reject((reason,))
        return self._told()

    @property
    def view(self) -> View:
        """All that a screen shows now."""
        step, turn_now = self._step, self._attempt.turn
        turning = self._phase in (Phase.ROTATE, Phase.REST)
        headline, hints = self._says()
        duration_s = self._duration_s()
        progress = None if duration_s is None else min(1.0, self._elapsed_s / duration_s)
        aligned = self._attempt.aligned
        return View(
            phase=self._phase,
            step=self._at + 1,
            steps=len(self._steps),
            step_id=step.id,
            title=f"step {self._at + 1} of {len(self._steps)}: {step.title}",
            headline=headline,
            hints=hints,
            reasons=self._reasons,
            angle_deg=turn_now.angle / DEG if turning else None,
            want_deg=float(step.turn_deg) if turning else None,
            rate_deg_per_s=(turn_now.rate if turning else self._still.rate) / DEG,
            stillness=self._still.stillness,
            progress=progress,
            remaining_s=None if duration_s is None else max(0.0, duration_s - self._elapsed_s),
            level_sigma_deg=aligned.level_sigma_rad / DEG if aligned else None,
            heading_sigma_deg=aligned.heading_sigma_rad / DEG if aligned else None,
            actions=self._actions(),
            bells=self._bells,
        )

    @property
    def accepted(self) -> Mapping[str, Accepted]:
        """The run that serves for each step, by id, in the order of the steps."""
        return {s.id: self._accepted[s.id] for s in self._steps if s.id in self._accepted}

    @property
    def runs(self) -> tuple[NavigationLog, ...]:
        """Logs of all runs that were accepted here, in time, also of those that were done again."""
        return tuple(self._logs)

    # Steps and phases

    @property
    def _step(self) -> Step:
        return self._steps[self._at]

    @property
    def _number(self) -> int:
        """Of the attempt."""
        return self._checks if self._phase is Phase.PREFLIGHT else self._attempts.get(self._step.id, 0)

    @property
    def _event_id(self) -> str:
        return PREFLIGHT if self._phase is Phase.PREFLIGHT else self._step.id

    def _next(self) -> int | None:
        """First step that is neither accepted nor skipped."""
        done = self._accepted.keys() | self._skipped
        return next((k for k, step in enumerate(self._steps) if step.id not in done), None)

    def _told(self) -> tuple[Event, ...]:
        told, self._events = tuple(self._events), []
        return told

    def _enter(self, phase: Phase) -> None:
        self._phase, self._elapsed_s = phase, 0.0
        self._events.append(Entered(phase, self._event_id, self._number, self._counter))

    def _begin(self) -> None:
        """Place the unit for a new attempt of the current step."""
        step_id = self._step.id
        self._attempts[step_id] = self._attempts.get(step_id, 0) + 1
        self._attempt = Attempt()
        self._enter(Phase.PLACE)

    def _go_on(self) -> None:
        """On to the next step, or to the end."""
        at = self._next()
        if at is None:
            self._finish()
            return
        self._at = at
        self._begin()

    def _finish(self) -> None:
        accepted = tuple(self.accepted)
        skipped = tuple(step.id for step in self._steps if step.id not in self._accepted)
        self._reasons = ()
        if skipped:
            try:
                predicted(self._procedure, self._site, skipped=skipped)
            except InputError as error:
                self._reasons = (str(error),)
        self._attempt = Attempt()
        self._enter(Phase.DONE)
        self._bells += 1
        self._events.append(Finished(accepted, skipped, self._reasons, self._counter))

    def _abort(self) -> None:
        if self._phase in (Phase.DONE, Phase.ABORTED):
            return
        event = Aborted(self._event_id, self._number, self._counter)
        self._enter(Phase.ABORTED)
        self._events.append(event)

    def _redo(self, step_id: str) -> None:
        at = next((k for k, step in enumerate(self._steps) if step.id == step_id), None)
        if at is None or self._phase in (Phase.PREFLIGHT, Phase.ABORTED):
            return
        current = at == self._at and self._phase is not Phase.DONE
        if step_id not in self._accepted and step_id not in self._skipped and not current:
            return
        if current and self._phase is Phase.PLACE:
            return  # it has just begun
        self._accepted.pop(step_id, None)
        self._skipped.discard(step_id)
        self._at, self._reasons = at, ()
        self._events.append(Redone(step_id, self._attempts.get(step_id, 0) + 1, self._counter))
        self._begin()

    def _skip(self) -> None:
        if self._step.id in self._accepted:
            return
        self._skipped.add(self._step.id)
        self._reasons = ()
        self._events.append(Skipped(self._step.id, self._number, self._counter))
        self._go_on()

    def _settle(self) -> None:
        self._attempt = Attempt()
        self._enter(Phase.SETTLE)

    # Samples

    @property
    def _seen(self) -> StepObservation:
        return StepObservation(
            self._step,
            self._procedure.limits,
            self._posture,
            self._still,
            self._flags,
            tuple(self._conditions.faults),
        )

    def _take(self, block: Block) -> None:
        """Look at 20 ms."""
        self._counter, self._flags = block.last, block.flags
        self._elapsed_s += block.seconds
        self._still.feed(block)
        self._posture.feed(block)
        if self._phase is Phase.PREFLIGHT:
            self._check(block)
        elif self._phase is Phase.PLACE:
            if self._hands_free and self._seen.ready and self._elapsed_s >= READY_S:
                self._settle()
        elif self._phase is Phase.SETTLE:
            self._stand(block)
        elif self._phase is Phase.ALIGN:
            self._align(block)
        elif self._phase is Phase.ROTATE:
            self._rotate(block)
        elif self._phase is Phase.REST:
            self._rest(block)
        elif self._phase is Phase.VERDICT and (self._elapsed_s >= VERDICT_S or self._still.moving):
            if self._step.id in self._accepted:
                self._go_on()
            else:
                self._begin()

    def _trouble(self, block: Block) -> str:
        """What makes the samples useless, if anything."""
        if block.restarted:
            return "the unit restarted"
        return f"{block.missing} samples missing" if block.hole else self._seen.unfit

    def _moved(self) -> str:
        return f"it moved ({self._still.why})" if self._still.moving else ""

    def _check(self, block: Block) -> None:
        """PREFLIGHT: half a minute at rest tells whether the unit is sound."""
        if self._still.moving or block.flags & Flag.WARM_UP:
            self._preflight, self._elapsed_s = RestAverages(), 0.0
            self._check_failed = self._check_failed and not self._still.moving
            return
        self._preflight.feed(block)
        if self._elapsed_s < PREFLIGHT_S - 0.5 * BLOCK_NS * NS:
            return
        found = self._preflight
        rate_noise, force_noise = found.noise()
        limits = _motion_limits(rate_noise, force_noise)
        # what was too little to be seen as motion before the noise was known
        self._elapsed_s = found.forget(*limits) * BLOCK_NS * NS
        if self._elapsed_s < PREFLIGHT_S - 0.5 * BLOCK_NS * NS:
            self._reasons = (
                f"it did not stand still, limits {limits[0] / DEG:.2f} deg/s and {limits[1] / MG:.1f} mg: "
                "looked at again",
            )
            return
        self._preflight, self._elapsed_s = RestAverages(), 0.0
        self._reasons = self._unsound(found)
        if self._reasons:
            if not self._check_failed:
                self._bells += 1
                self._events.append(Rejected(PREFLIGHT, self._checks, self._reasons, self._counter))
                self._checks += 1
            self._check_failed = True
            return
        self._still.limit(*limits)
        self._events.append(
            Checked(
                self._counter,
                float(np.linalg.norm(found.force)),
                float(np.linalg.norm(found.rate)) / DEG_PER_H,
                rate_noise / DEG,
                force_noise / MG,
                tuple(self._conditions.temperature_degc.items()),
            )
        )
        self._begin()

    def _unsound(self, found: RestAverages) -> tuple[str, ...]:
        """What the preflight has against the unit."""
        limits, reasons = self._procedure.limits, []
        if found.flags & Flag.FAULT or self._conditions.faults:
            reasons.append(
                f"the unit tells a fault: {', '.join(self._conditions.faults) or 'which, is not known'}"
            )
        reasons += self._out_of_range(found.flags)
        rate_noise, force_noise = found.noise()
        for what, noise, most, name in (
            ("gyro", rate_noise / DEG, limits.noise_deg_per_s, "deg/s"),
            ("accelerometer", force_noise / MG, limits.noise_mg, "mg"),
        ):
            if noise > most:
                reasons.append(
                    f"{what} noise {noise:.3g} {name} rms at rest, want {most:g} at most: look for what "
                    "shakes the bench"
                )
        return (*reasons, *self._axis_faults(found))

    def _out_of_range(self, flags: int) -> list[str]:
        """Temperatures for which the certificate does not hold."""
        terms = self._calibration.temperature
        if terms is None:
            return []
        low, high = terms.range_degc
        holds = f"the certificate holds from {low:g} to {high:g}: wait until it is there"
        outside = [
            f"{name} at {t:.1f} degC, {holds}"
            for name, t in self._conditions.temperature_degc.items()
            if t is not None and not low <= t <= high
        ]
        return outside or ([f"a temperature is off, {holds}"] if flags & Flag.TEMPERATURE_RANGE else [])

    def _axis_faults(self, found: RestAverages) -> tuple[str, ...]:
        site = self._site
        gravity = site.gravity_m_s2 or normal_gravity(site.latitude_rad, site.height_m)
        return axis_faults(
            found.force, found.rate, self._step, self._procedure.limits, gravity, site.latitude_rad
        )

    def _stand(self, block: Block) -> None:
        """SETTLE: the unit has to stand still for a while before the alignment begins."""
        if not self._seen.placed:
            self._enter(Phase.PLACE)
        elif self._still.moving or self._trouble(block):
            self._elapsed_s, self._attempt = 0.0, Attempt()
        else:
            self._attempt.hold(block)
            if self._elapsed_s >= self._procedure.limits.still_s:
                self._attempt.flush()
                self._attempt.alignment = Alignment(
                    self._site.latitude_rad,
                    _PRIORS.gyro_bias,
                    _PRIORS.accelerometer_bias,
                    self._step.align_s,
                )
                self._enter(Phase.ALIGN)

    def _align(self, block: Block) -> None:
        """ALIGN: looked at now and then; motion and trouble begin it again."""
        why = self._trouble(block) or self._moved()
        if why:
            self._restart(f"{why} {self._elapsed_s:.0f} s into the alignment")
            return
        attempt = self._attempt
        attempt.hold(block)
        attempt.means.feed(block)
        if self._elapsed_s < min(attempt.look_s, self._step.align_s - 0.5 * self._interval_s):
            return
        attempt.flush()
        assert attempt.alignment is not None
        done, first = attempt.alignment.done, attempt.aligned is None
        attempt.look_s = max(self._elapsed_s + 10.0, 1.2 * self._elapsed_s)
        faults = self._axis_faults(attempt.means) if first else ()
        try:
            aligned = attempt.alignment.result()
        except InputError as error:
            self._restart("; ".join((*faults, str(error))))
            return
        if done and aligned.motion:
            faults = (*faults, aligned.motion)
        attempt.aligned = aligned
        w, x, y, z = aligned.q_nb.tolist()
        self._posture.q_nb = w, x, y, z
        if faults:
            self._restart("; ".join(faults))
        elif done:
            attempt.heading = self._seen.clockwise or 0.0
            self._navigate((w, x, y, z))
            self._bells += 1
            self._reasons = ()
            self._enter(Phase.ROTATE)

    def _navigate(self, q_nb: Quaternion) -> None:
        """Begin the log: from rest, with this attitude."""
        site = self._site
        navigator = Navigator(
            site.latitude_rad,
            site.longitude_rad,
            site.height_m,
            site.gravity_m_s2,
            q_nb,
            C_ba=self._calibration.accelerometer.C_ba_array,
        )
        self._attempt.navigate(navigator, turn(conjugate(q_nb), (0.0, 0.0, 1.0)))

    def _rotate(self, block: Block) -> None:
        """ROTATE: wait for the turn, however long it takes; then wait for its end."""
        attempt, turning = self._attempt, self._attempt.turn
        attempt.hold(block)
        trouble = self._trouble(block)
        if turning.begun is None:
            if trouble:
                self._restart(f"{trouble} before the turn")
                return
            if not self._still.moving:
                if self._elapsed_s >= WAIT_S:
                    attempt.flush()
                    assert self._posture.q_nb is not None
                    self._navigate(self._posture.q_nb)
                    self._elapsed_s = 0.0
                return
        elif trouble:
            self._reject((f"{trouble} during the turn",))
            return
        turning.feed(block)
        if self._still.quiet_s < QUIET_S + _MARGIN_S:
            return
        if turning.size < NAMED_RAD:
            self._restart(f"moved {turning.size / DEG:.1f} deg before the turn: the rest is disturbed")
            return
        attempt.flush()
        reasons = self._against(attempt.rotation(), rest_after_s=0.0)
        if reasons:
            self._reject(reasons)
        else:
            self._enter(Phase.REST)
            self._elapsed_s = self._still.quiet_s

    def _rest(self, block: Block) -> None:
        """REST: after the turn."""
        attempt = self._attempt
        attempt.hold(block)
        why = self._trouble(block) or self._moved()
        if why:
            self._reject((f"{why} {self._elapsed_s:.1f} s into the rest, want {self._step.rest_s:g}",))
            return
        if self._still.quiet_s < self._step.rest_s + _MARGIN_S:
            return
        attempt.flush()
        rotation = attempt.rotation()
        reasons = self._against(rotation, self._step.rest_s)
        if reasons or rotation is None:
            self._reject(reasons)
        else:
            self._accept(rotation)

    def _against(self, rotation: Rotation | None, rest_after_s: float) -> tuple[str, ...]:
        """Why a rotation cannot serve."""
        step = self._step
        if rotation is None:
            return ("the turn is not to be told from the rest",)
        limits = replace(self._procedure.rotation_limits(step), rest_after_s=rest_after_s)
        reasons = rejection_reasons(rotation, limits, step.up[1])
        if rotation.angle_deg * np.sign(step.turn_deg) < -NAMED_RAD / DEG:
            return (wrong_direction_text(rotation.angle_deg * DEG, step), *reasons)
        return reasons

    def _accept(self, rotation: Rotation) -> None:
        attempt, step_id = self._attempt, self._step.id
        assert rotation.before is not None
        assert rotation.after is not None
        assert attempt.aligned is not None
        log = attempt.log(step_id, self._number, self._interval_s)
        guard, told = (round(s / self._interval_s) for s in (GUARD_S, GAIN_WINDOW_S))
        begin = rotation.stop + guard
        after = (log.counter >= begin) & (log.counter < begin + told)
        east, north, up = log.v_n[after].mean(axis=0).tolist()
        self._accepted[step_id] = Accepted(
            step_id,
            self._number,
            log.first_counter,
            log.last_counter,
            rotation.angle_deg,
            rotation.duration_s,
            rotation.peak_deg_per_s,
            rotation.axis_tilt_deg,
            rotation.before.duration_s,
            rotation.after.duration_s,
            attempt.aligned.level_sigma_rad / DEG,
            attempt.aligned.heading_sigma_rad / DEG,
            attempt.heading / DEG,
            (east, north, up),
            attempt.samples,
        )
        self._logs.append(log)
        self._events.append(self._accepted[step_id])
        self._bells += 1
        self._enter(Phase.VERDICT)

    def _reject(self, reasons: tuple[str, ...]) -> None:
        self._events.append(Rejected(self._step.id, self._number, reasons, self._counter))
        self._bells += 1
        self._reasons = reasons
        self._attempt = Attempt()
        self._enter(Phase.VERDICT)

    def _restart(self, reason: str) -> None:
        self._events.append(Restarted(self._step.id, self._number, reason, self._counter))
        self._bells += 1
        self._reasons = (reason,)
        self._settle()

    # What is shown

    def _duration_s(self) -> float | None:
        """Length of the phase, where it has one."""
        return {
            Phase.PREFLIGHT: PREFLIGHT_S,
            Phase.SETTLE: self._procedure.limits.still_s,
            Phase.ALIGN: self._step.align_s,
            Phase.REST: self._step.rest_s,
        }.get(self._phase)

    def _actions(self) -> tuple[str, ...]:
        if self._phase is Phase.ABORTED:
            return ()
        if self._phase is Phase.DONE:
            return ("redo",)
        if self._phase is Phase.PREFLIGHT:
            return ("abort",)
        confirm = ("confirm",) if self._phase is Phase.PLACE and self._seen.ready else ()
        redo = () if self._phase is Phase.PLACE else ("redo",)
        skip = () if self._step.id in self._accepted else ("skip",)
        return (*confirm, *redo, *skip, "abort")

    def _says(self) -> Says:
        """Headline and hints."""
        seen, number, steps = self._seen, self._at + 1, len(self._steps)
        match self._phase:
            case Phase.PREFLIGHT:
                return prompts.preflight(seen, self._check_failed)
            case Phase.PLACE:
                return prompts.place(seen, self._hands_free)
            case Phase.SETTLE:
                return prompts.settle(seen)
            case Phase.ALIGN:
                return "HANDS OFF, ALIGNING", ("do not touch the unit or the bench",)
            case Phase.ROTATE:
                return prompts.rotate(seen, self._attempt.turn)
            case Phase.REST:
                return "HANDS OFF, RESTING", ("do not touch the unit or the bench",)
            case Phase.VERDICT if good := self._accepted.get(self._step.id):
                return f"GOOD: STEP {number} OF {steps} DONE", (
                    f"turned {good.angle_deg:+.1f} deg in {good.duration_s:.1f} s, "
                    f"peak {good.peak_deg_per_s:.0f} deg/s",
                )
            case Phase.VERDICT:
                return "REJECTED: DO IT AGAIN", (pose_text(seen.step),)
            case Phase.DONE:
                done = len(self._accepted)
                return "ALL STEPS DONE", (f"{done} accepted, {steps - done} skipped",)
        return "ABORTED", ()


_IN_A_STEP: Final = (Phase.PLACE, Phase.SETTLE, Phase.ALIGN, Phase.ROTATE, Phase.REST, Phase.VERDICT)


_PRIORS: Final = Priors()


def _motion_limits(rate_noise: float, force_noise: float) -> tuple[float, float]:
    """Rate, rad/s, and change of specific force, m/s^2, that are motion for sensors of this noise."""
    return 2.0 * EARTH_RATE + SIGMAS * rate_noise, LEAST_FORCE + SIGMAS * force_noise
