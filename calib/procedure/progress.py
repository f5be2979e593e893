"""State that the phases of the procedure share."""

from dataclasses import dataclass, field

from calib.detection.blocks import Block
from calib.detection.tracking import AttitudeTracker, StillnessDetector
from calib.messages import Message, message
from calib.procedure.attempt import Attempt
from calib.procedure.events import (
    Accepted,
    Conditions,
    Event,
    NavigationLog,
    Rejected,
    RestAccepted,
    Restarted,
)
from calib.procedure.prompts import StepObservation
from calib.procedure.schema import Procedure, Run, Step
from calib.procedure.transitions import Outcome
from imudrv.calibration import Calibration
from imudrv.nav.attitude import Quaternion, conjugate, turn
from imudrv.nav.mechanisation import Navigator
from imudrv.site import Site
from imudrv.vectors import Vector, add


@dataclass
class Carried:
    """The motion since the last accepted rest, by the gyros as they are.

    Attributes
    ----------
    since : Quaternion or None
        Attitude in that rest; None: not known.
    is_from_rest : bool
        Whether there was one.
    turned : Vector
        Sums of the angle increments, body axes, rad.
    missing : int
        Number of samples lost.
    """

    since: Quaternion | None = None
    is_from_rest: bool = False
    turned: Vector = (0.0, 0.0, 0.0)
    missing: int = 0

    def feed(self, block: Block) -> None:
        """Follow a block."""
        self.turned = add(self.turned, block.dtheta)
        self.missing += block.missing
        if block.restarted:
            self.is_from_rest = False

    @property
    def is_whole(self) -> bool:
        """Whether `turned` is the whole motion from rest to rest."""
        return self.is_from_rest and not self.missing


@dataclass
class Progress:
    """State that the phases of the procedure share.

    Attributes
    ----------
    procedure, site, calibration, interval_s, hands_free
        See `calib.procedure.engine.Engine`.
    attitude, stillness
        Trackers, fed with every block.
    accepted : dict of str to Accepted or RestAccepted
        Accepted steps, by id.
    attempts : dict of str to int
        Number of the latest attempt, by step id.
    index : int
        Of the current step.
    attempt : Attempt
        The current one.
    skipped : list of str
        Ids of skipped steps, in the order of skipping.
    logs : list of NavigationLog
        Logs of the accepted runs.
    events : list of Event
        Events that were not handed out yet.
    reasons : tuple of Message
        Latest reasons of a rejection or a restart.
    last_try : tuple of Message
        Reasons of a rejection after it was read.
    bells : int
        See `View`.
    status : Conditions
        Latest status of the unit.
    flags, counter : int
        Of the newest block.
    elapsed_s : float
        Time in the current phase.
    carried : Carried
        The motion since the last accepted rest.
    rested_s : dict of str to float
        Time at rest of long rests that are not complete, by step id.
    """

    procedure: Procedure
    site: Site
    calibration: Calibration
    interval_s: float
    hands_free: bool
    attitude: AttitudeTracker
    stillness: StillnessDetector
    accepted: dict[str, Accepted | RestAccepted]
    attempts: dict[str, int]
    index: int = 0
    attempt: Attempt = field(default_factory=Attempt)
    skipped: list[str] = field(default_factory=list)
    logs: list[NavigationLog] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    reasons: tuple[Message, ...] = ()
    last_try: tuple[Message, ...] = ()
    bells: int = 0
    status: Conditions = field(default_factory=Conditions)
    flags: int = 0
    counter: int = -1
    elapsed_s: float = 0.0
    carried: Carried = field(default_factory=Carried)
    rested_s: dict[str, float] = field(default_factory=dict)

    @property
    def step(self) -> Step:
        """Current step."""
        return self.procedure.steps[self.index]

    @property
    def run(self) -> Run:
        """Current step of a procedure of the arms."""
        return self.procedure.runs[self.index]

    @property
    def number(self) -> int:
        """Number of the current attempt at the current step."""
        return self.attempts.get(self.step.id, 0)

    @property
    def turn_deg(self) -> int:
        """Required angle of the current rotation."""
        return self.run.angle_deg(self.attempt.number)

    @property
    def observation(self) -> StepObservation:
        """Sensors against the current step."""
        return self.observe(self.step)

    def observe(self, step: Step) -> StepObservation:
        """Return the sensors against a step."""
        return StepObservation(
            step, self.procedure.limits, self.attitude, self.stillness, self.flags, self.status.faults
        )

    @property
    def following(self) -> Step | None:
        """First step after the current one that is neither accepted nor skipped."""
        done = self.accepted.keys() | set(self.skipped) | {self.step.id}
        return next((step for step in self.procedure.steps if step.id not in done), None)

    def remaining(self) -> int | None:
        """Index of the first step that is neither accepted nor skipped."""
        done = self.accepted.keys() | set(self.skipped)
        return next((k for k, step in enumerate(self.procedure.steps) if step.id not in done), None)

    def advance(self) -> Outcome:
        """Go to the next step, if one remains."""
        index = self.remaining()
        if index is None:
            return Outcome.COMPLETED
        self.index = index
        return Outcome.NEXT_STEP

    def move_on(self) -> None:
        """Note that the reasons shown were read; what follows is another attempt."""
        self.reasons, self.last_try = (), self.reasons

    def trouble(self, block: Block) -> Message | None:
        """Return why the samples of a block cannot be used."""
        if block.restarted:
            return message("unit_restarted")
        return message("samples_missing", missing=block.missing) if block.hole else self.observation.unfit

    def disturbance(self, block: Block) -> Message | None:
        """Return why a block is not one of a rest."""
        moved = message("moved", motion=self.stillness.why) if self.stillness.moving else None
        return self.trouble(block) or moved

    def navigate(self, q_nb: Quaternion) -> None:
        """Start the navigation log of the attempt at rest, with this attitude."""
        navigator = Navigator(self.site.place, q_nb, C_ba=self.calibration.accelerometer.C_ba)
        self.attempt.navigate(navigator, turn(conjugate(q_nb), (0.0, 0.0, 1.0)))

    def tell(self, *reasons: Message) -> None:
        """Show the operator what was wrong; the run continues."""
        self.bells += bool(reasons)
        self.reasons, self.last_try = reasons, ()

    def restart(self, *reasons: Message) -> Outcome:
        """Report that the alignment has to start again."""
        self.last_try = ()
        self.events.append(Restarted(self.step.id, self.number, reasons, self.counter))
        self.bells += 1
        self.reasons = reasons
        return Outcome.DISTURBED

    def reject(self, *reasons: Message) -> Outcome:
        """Report that the attempt is rejected, and drop its samples."""
        self.events.append(Rejected(self.step.id, self.number, reasons, self.counter))
        self.bells += 1
        self.reasons = reasons
        self.attempt = Attempt()
        return Outcome.REJECTED
