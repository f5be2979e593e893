"""Engine of the bench procedure: samples and keys in, prompts and verdicts out; no screen, files or clock.

The phases and their order are in `calib.procedure.transitions`. Time is that of the samples' counter: nothing
runs while no samples come, and nothing times out while a person carries the unit. Any cut of the samples into
pieces gives the same events and, at the same sample, the same view.

The sensors decide. A key only agrees: `Confirm` carries the id of the step that it confirms, and counts only
while the unit rests in that step's pose. What counts as motion follows from the noise that the preflight
found, by the rule of `calib.detection.segments`; the verdict on a rotation is that of
`calib.detection.acceptance` on the samples from `Accepted.first_counter` to `last_counter`, so that anyone
who cuts these from a recording gets the same.

Velocity and H of every sample from the end of an alignment to the end of the rest after the rotation are in
the `NavigationLog` of the run.

A step with several turns is one run: after each turn and its rest the next one is due, without a new
alignment. A turn outside its limits and a rest cut short are reported, and the run continues. Lost, saturated
or faulted samples end it, and so does a unit that leaves its pose. At least half of the turns have to be
within their limits.
"""

from collections.abc import Mapping
from math import hypot

from calib.axes import vector
from calib.detection.blocks import Block, BlockSplitter
from calib.detection.tracking import MG, AttitudeTracker, StillnessDetector
from calib.messages import Message
from calib.procedure.events import (
    Abort,
    Aborted,
    Accepted,
    Action,
    Conditions,
    Confirm,
    Entered,
    Event,
    Finished,
    NavigationLog,
    Phase,
    Redo,
    Redone,
    RestAccepted,
    Skipped,
    View,
)
from calib.procedure.kinds import KINDS
from calib.procedure.phases import Placing, motion_limits
from calib.procedure.progress import Progress
from calib.procedure.prompts import title
from calib.procedure.schema import Procedure
from calib.procedure.transitions import NEW_ATTEMPT, Outcome
from imudrv.calibration import Calibration
from imudrv.records import Records
from imudrv.site import Site
from imudrv.units import DEG, NS


class Engine:
    """Leads an operator through a procedure.

    Parameters
    ----------
    procedure : Procedure
        The plan.
    site : Site
        Location of the unit.
    calibration : Calibration
        Calibration of the increments; its size effect is not used.
    interval_ns : int
        Sample interval.
    hands_free : bool
        Continue by the sensors alone, without `Confirm`.
    accepted : mapping of str to Accepted
        Steps that an earlier session has accepted, by id.
    attempts : mapping of str to int
        Number of the last attempt of each step in an earlier session; the next one is one more.
    rested_s : mapping of str to float
        Time at rest of long rests that an earlier session has not completed, by id.
    """

    def __init__(
        self,
        procedure: Procedure,
        site: Site,
        calibration: Calibration,
        *,
        interval_ns: int,
        hands_free: bool = False,
        accepted: Mapping[str, Accepted | RestAccepted] | None = None,
        attempts: Mapping[str, int] | None = None,
        rested_s: Mapping[str, float] | None = None,
    ) -> None:
        limits = procedure.limits
        self._kind = KINDS[procedure.kind]
        self._splitter = BlockSplitter(interval_ns)
        self._progress = Progress(
            procedure,
            site,
            calibration,
            interval_ns * NS,
            hands_free,
            AttitudeTracker(site.latitude_rad),
            # wide, so that the preflight sees a unit that is too noisy at rest, and names its noise
            StillnessDetector(*motion_limits(3.0 * limits.noise_deg_per_s * DEG, 3.0 * limits.noise_mg * MG)),
            dict(accepted or {}),
            dict(attempts or {}),
            rested_s=dict(rested_s or {}),
        )
        index = self._progress.remaining()
        self._progress.index = len(procedure.steps) - 1 if index is None else index
        self._enter(Phase.DONE if index is None else Phase.PREFLIGHT)

    def feed(self, increments: Records) -> tuple[Event, ...]:
        """Take samples.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order, compensated without size effect; any pieces give the same events.

        Returns
        -------
        tuple of Event
            In order.
        """
        for block in self._splitter.feed(increments):
            self._on_block(block)
        return self._new_events()

    def update_status(self, conditions: Conditions) -> tuple[Event, ...]:
        """Take the status that the unit reports beside its samples."""
        self._progress.status = conditions
        return self._new_events()

    def handle(self, action: Action) -> tuple[Event, ...]:
        """Take a key; one for another step, or one that the sensors contradict, has no effect."""
        p = self._progress
        if isinstance(action, Abort):
            self._abort()
        elif isinstance(action, Redo):
            self._redo(action.step_id)
        elif action.step_id == p.step.id:
            if not isinstance(action, Confirm):
                self._skip()
            elif self._is_rejected:
                p.move_on()
                self._follow(Outcome.AGAIN)
            elif isinstance(self._state, Placing) and p.observation.ready:
                self._follow(self._state.placed())
        return self._new_events()

    def reject(self, step_id: str, reason: Message) -> tuple[Event, ...]:
        """Withdraw an accepted step, because its recording is not complete; it has to be done again.

        Parameters
        ----------
        step_id : str
            An accepted step.
        reason : Message
            For the operator.

        Returns
        -------
        tuple of Event
            Empty after an abort.
        """
        if self._has(Outcome.REJECTED):
            p = self._progress
            del p.accepted[step_id]
            p.index = self._index(step_id)
            self._follow(p.reject(reason))
        return self._new_events()

    @property
    def view(self) -> View:
        """Content of the operator's screen."""
        p, state = self._progress, self._state
        step, steps, rotation, aligned = p.step, len(p.procedure.steps), p.attempt.turn, p.attempt.aligned
        headline, hints = state.prompt()
        duration_s = state.duration_s
        return View(
            phase=self._phase,
            step_id=step.id,
            title=title(step, p.index + 1, steps, p.attempt.number),
            headline=headline,
            hints=hints,
            reasons=p.reasons,
            last_try=p.last_try,
            accepted=tuple(self.accepted),
            skipped=tuple(p.skipped),
            C_nb=p.attitude.C_nb(vector(step.east)),
            force_m_s2=None if p.attitude.force is None else hypot(*p.attitude.force),
            angle_deg=rotation.angle / DEG if state.turning else None,
            want_deg=float(p.turn_deg) if state.turning else None,
            rate_deg_per_s=(rotation.rate if state.turning else p.stillness.rate) / DEG,
            stillness=p.stillness.stillness,
            progress=None if duration_s is None else min(1.0, p.elapsed_s / duration_s),
            remaining_s=None if duration_s is None else max(0.0, duration_s - p.elapsed_s),
            level_sigma_deg=aligned.level_sigma_rad / DEG if aligned else None,
            heading_sigma_deg=aligned.heading_sigma_rad / DEG if aligned else None,
            actions=self._actions(),
            bells=p.bells,
        )

    @property
    def accepted(self) -> Mapping[str, Accepted | RestAccepted]:
        """Accepted run or rest of each step, by id, in the order of the steps."""
        steps, accepted = self._progress.procedure.steps, self._progress.accepted
        return {s.id: accepted[s.id] for s in steps if s.id in accepted}

    @property
    def runs(self) -> tuple[NavigationLog, ...]:
        """Logs of all runs that were accepted here, in time, including those that were repeated later."""
        return tuple(self._progress.logs)

    # Transitions

    def _has(self, outcome: Outcome) -> bool:
        """Whether an outcome has an effect in the current phase."""
        return (self._phase, outcome) in self._kind.transitions

    def _follow(self, outcome: Outcome) -> None:
        p = self._progress
        if outcome in NEW_ATTEMPT:
            p.attempts[p.step.id] = p.number + 1
        self._enter(self._kind.transitions[self._phase, outcome])

    def _enter(self, phase: Phase) -> None:
        p = self._progress
        p.elapsed_s = 0.0
        self._phase, self._state = phase, self._kind.states[phase](p)
        p.events.append(Entered(phase, self._state.step_id, self._state.number, p.counter))
        if phase is Phase.DONE:
            self._finish()

    def _on_block(self, block: Block) -> None:
        p = self._progress
        p.counter, p.flags = block.last, block.flags
        p.elapsed_s += block.seconds
        p.stillness.feed(block)
        p.attitude.feed(block)
        p.carried.feed(block)
        outcome = self._state.feed(block)
        if outcome is not None:
            self._follow(outcome)

    def _finish(self) -> None:
        p = self._progress
        accepted = tuple(self.accepted)
        skipped = tuple(step.id for step in p.procedure.steps if step.id not in accepted)
        p.reasons = ()
        if skipped and (reason := self._kind.too_few(p.procedure, p.site, skipped)):
            p.reasons = (reason,)
        p.bells += 1
        p.events.append(Finished(accepted, skipped, p.reasons, p.counter))

    def _abort(self) -> None:
        if self._has(Outcome.ABORTED):
            event = Aborted(self._state.step_id, self._state.number, self._progress.counter)
            self._follow(Outcome.ABORTED)
            self._progress.events.append(event)

    def _redo(self, step_id: str) -> None:
        p, index = self._progress, self._index(step_id)
        if index < 0 or not self._has(Outcome.AGAIN):
            return
        if index == p.index and self._phase is Phase.PLACE:
            return  # it has just begun
        current = index == p.index and self._phase is not Phase.DONE
        if not current and step_id not in p.accepted and step_id not in p.skipped:
            return
        p.accepted.pop(step_id, None)
        if step_id in p.skipped:
            p.skipped.remove(step_id)
        p.index, p.reasons, p.last_try = index, (), ()
        p.events.append(Redone(step_id, p.number + 1, p.counter))
        self._follow(Outcome.AGAIN)

    def _skip(self) -> None:
        p = self._progress
        if not self._has(Outcome.NEXT_STEP) or p.step.id in p.accepted:
            return
        p.skipped.append(p.step.id)
        p.reasons = p.last_try = ()
        p.events.append(Skipped(p.step.id, p.number, p.counter))
        self._follow(p.advance())

    @property
    def _is_rejected(self) -> bool:
        """Whether a rejection is shown."""
        return self._phase is Phase.VERDICT and self._progress.step.id not in self._progress.accepted

    def _index(self, step_id: str) -> int:
        """Index of a step, -1 if there is none."""
        return next((k for k, step in enumerate(self._progress.procedure.steps) if step.id == step_id), -1)

    def _new_events(self) -> tuple[Event, ...]:
        events, self._progress.events = tuple(self._progress.events), []
        return events

    def _actions(self) -> tuple[str, ...]:
        """Return the keys that have an effect now."""
        p, placing = self._progress, self._phase is Phase.PLACE
        effective = {
            "confirm": (placing and p.observation.ready) or self._is_rejected,
            "redo": self._has(Outcome.AGAIN) and not placing,
            "skip": self._has(Outcome.NEXT_STEP) and p.step.id not in p.accepted,
            "back": self._has(Outcome.AGAIN) and bool(p.skipped),
            "abort": self._has(Outcome.ABORTED),
        }
        return tuple(name for name, has_effect in effective.items() if has_effect)
