"""Phases of a procedure of the sensors or of the noise: rests, and the motions between them.

Nothing is aligned: the unit was never calibrated. The side that is up is that of the raw accelerometers. The
heading is that of the Earth's rotation during a rest, carried to the next one by the raw gyros: good enough
for a pose that may be off by 45 deg. The motions are evidence, so that everything is recorded from the first
rest to the last, also what is rejected here; `calib.sensors` and `calib.noise` find the rests again.
"""

from typing import Final

import numpy as np

from calib.axes import vector
from calib.detection.blocks import BLOCK_NS, Block
from calib.detection.rest_bins import BIN_S, RestBins, binned, rest_noise
from calib.detection.tracking import RestAverages
from calib.messages import Message, message
from calib.procedure import prompts
from calib.procedure.events import Phase, RestAccepted, Rested
from calib.procedure.phases import COMMON_STATES, PhaseState, Placing, Preflight, Verdict
from calib.procedure.planned_turn import turn_fault
from calib.procedure.progress import Carried, Progress
from calib.procedure.prompts import READY_S, Prompt
from calib.procedure.schema import PlannedRest
from calib.procedure.transitions import Outcome
from imudrv.arrays import Array
from imudrv.calibration import coefficients
from imudrv.units import DEG, NS

NEW_ATTITUDE: Final = 30.0 * DEG
"""A unit that was turned by less since the last rest is not in another pose, rad."""
_HALF_BLOCK_S: Final = 0.5 * BLOCK_NS * NS
JOURNAL_S: Final = 60.0
"""Interval at which the time of a long rest is reported, s."""


class CheckingNoise(Preflight):
    """The preflight of a unit that was never calibrated: its noise, its faults, and how it stands."""

    def faults(self, averages: RestAverages, dtheta_b: Array) -> tuple[Message, ...]:
        """Return what is wrong with the sensors."""
        faults = super().faults(averages, dtheta_b)
        if not faults and self.progress.procedure.kind == "sensors":
            self.progress.attitude.align(averages.rate, averages.force)
        return faults


class PlacingForRest(Placing):
    """The unit is brought into a pose; that of another step that is not done counts as well."""

    def feed(self, block: Block) -> Outcome | None:
        """Go to the step whose pose the unit is in."""
        p = self.progress
        tell_restart(p, block)
        if not p.observation.placed and p.stillness.quiet_s >= READY_S and self._is_elsewhere():
            return Outcome.NEXT_STEP
        if not self.was_moved and any(reason.key == "turn_differs" for reason in p.last_try):
            self.was_moved = p.stillness.moving
            return None  # the turn has to be made again
        return super().feed(block)

    def _is_elsewhere(self) -> bool:
        """Choose the first step not done in whose pose the unit is; return whether there is one."""
        p = self.progress
        turned = p.attitude.turned_from(p.carried.since)
        if turned is not None and turned < NEW_ATTITUDE:
            return False
        for index, step in enumerate(p.procedure.steps):
            if step.id not in p.accepted and step.id not in p.skipped and p.observe(step).placed:
                p.index = index
                return True
        return False

    def placed(self) -> Outcome:
        """Check how a turntable came here."""
        p = self.progress
        planned = p.step.turn if isinstance(p.step, PlannedRest) else None
        if planned is not None and p.carried.is_whole and (fault := turn_fault(planned, p.carried.turned)):
            return p.reject(fault)
        if p.carried.missing:
            p.tell(message("link_lost", missing=p.carried.missing))
        return super().placed()

    def prompt(self) -> Prompt:
        """Return what the operator has to do."""
        p, prompt = self.progress, super().prompt()
        planned = p.step.turn if isinstance(p.step, PlannedRest) else None
        if planned is None:
            return prompt
        return Prompt(prompt.headline, (prompts.turn_of_table(planned), *prompt.hints))


class Resting(PhaseState):
    """The unit is left alone until its rest is long enough; a disturbance is the end of it."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(progress, progress.step.rest_s)
        self._samples = round(BIN_S / progress.interval_s)
        self._waiting: list[Array] = []
        self._sums: list[Array] = []
        self._means: list[Array] = []
        self._degc: list[list[float]] = []
        self._first = -1
        self._count = 0

    def prompt(self) -> Prompt:
        """Return what the operator has to do."""
        return prompts.rest(self.progress.step, self.progress.following)

    def feed(self, block: Block) -> Outcome | None:
        """Follow the rest, and judge it at its end."""
        p = self.progress
        lost = message("samples_missing", missing=block.missing) if block.missing else None
        if cause := p.disturbance(block) or lost:
            rest_s = p.step.rest_s
            return p.reject(message("rest_interrupted", elapsed_s=p.elapsed_s, rest_s=rest_s, cause=cause))
        if self._first < 0:
            self._first = int(block.rows["counter"][0])
        self._count += len(block.rows)
        self._waiting.append(np.concatenate([block.rows["dtheta_b"], block.rows["dv_b"]], axis=1))
        if sum(map(len, self._waiting)) >= self._samples:
            self._bin()
        return None if p.elapsed_s < p.step.rest_s - _HALF_BLOCK_S else self._judge()

    def _bin(self) -> None:
        rows = np.concatenate(self._waiting)
        whole = len(rows) // self._samples * self._samples
        self._waiting = [rows[whole:]]
        sums, means = binned(rows[:whole], self._samples)
        self._sums.append(sums)
        self._means.append(means)
        if known := [degc for degc in self.progress.status.temperature_degc.values() if degc is not None]:
            self._degc.append(known)

    def _judge(self) -> Outcome:
        """Accept the rest, or reject it where it was none, or not in its pose."""
        p = self.progress
        bin_s = self._samples * p.interval_s
        sums, means = np.concatenate(self._sums), np.concatenate(self._means)
        degc = np.full(4, np.nan)
        span_k = max((max(of_one) - min(of_one) for of_one in zip(*self._degc, strict=False)), default=0.0)
        rest = RestBins(0, self._first, p.counter + 1, 0.0, bin_s, self._samples, sums, means, degc, span_k)
        known = coefficients(p.calibration)
        pulse = 1.0 / float(known.accelerometer_scale.mean()) if known.accelerometer_in_pulses else 0.0
        if drift := rest.drift(rest_noise([rest.steady]), pulse):
            return p.reject(drift)
        p.attitude.align(rest.rate[:3], rest.rate[3:])
        if not p.observation.placed:
            return p.reject(prompts.heading_message(p.observation))
        accept(p, self._first, self._count, p.elapsed_s)
        return Outcome.ACCEPTED


class LongRest(PhaseState):
    """The long rest of the noise: a disturbance ends a stretch, and the time at rest goes on."""

    def __init__(self, progress: Progress) -> None:
        super().__init__(progress, progress.step.rest_s)
        progress.elapsed_s = progress.rested_s.get(progress.step.id, 0.0)
        self._reported_s = progress.elapsed_s
        self._is_disturbed = False
        self._first = -1
        self._count = 0

    def prompt(self) -> Prompt:
        """Return what the operator has to do."""
        return prompts.rest(self.progress.step, None)

    def feed(self, block: Block) -> Outcome | None:
        """Count the time at rest."""
        p = self.progress
        if self._first < 0:
            self._first = int(block.rows["counter"][0])
        self._count += len(block.rows)
        if block.restarted:  # its numbers begin anew
            self._first, self._count = int(block.rows["counter"][0]), len(block.rows)
        if cause := p.disturbance(block):
            p.elapsed_s -= block.seconds
            if not self._is_disturbed:
                rest_s = p.step.rest_s
                p.tell(message("stretch_ended", elapsed_s=p.elapsed_s, rest_s=rest_s, cause=cause))
            self._is_disturbed = True
            return None
        self._is_disturbed = self._is_disturbed and p.stillness.quiet_s < READY_S
        if p.elapsed_s - self._reported_s >= JOURNAL_S:
            self._reported_s = p.elapsed_s
            p.rested_s[p.step.id] = p.elapsed_s
            p.events.append(Rested(p.step.id, p.number, p.elapsed_s, p.counter))
        if p.elapsed_s < p.step.rest_s - _HALF_BLOCK_S:
            return None
        accept(p, self._first, self._count, p.elapsed_s)
        return Outcome.ACCEPTED


def accept(p: Progress, first: int, samples: int, rest_s: float) -> None:
    """Report that a rest is accepted, and begin to follow the next motion."""
    clockwise = p.observation.clockwise
    accepted = RestAccepted(
        step_id=p.step.id,
        attempt=p.number,
        first_counter=first,
        last_counter=p.counter,
        samples=samples,
        rest_s=rest_s,
        lean_deg=p.attitude.lean(vector(p.step.up)) / DEG,
        heading_deg=None if clockwise is None else clockwise / DEG,
        missing=p.carried.missing,
    )
    p.accepted[p.step.id] = accepted
    p.events.append(accepted)
    p.reasons = p.last_try = ()
    p.carried = Carried(p.attitude.q_nb, is_from_rest=True)
    p.bells += 1


def tell_restart(p: Progress, block: Block) -> None:
    """Tell the operator that the unit restarted between two rests; what is accepted remains."""
    if block.restarted and p.accepted:
        p.tell(message("restarted_on_the_way"))


class RestVerdict(Verdict):
    """The verdict on a rest."""

    def feed(self, block: Block) -> Outcome | None:
        """Wait."""
        outcome = super().feed(block)
        tell_restart(self.progress, block)
        return outcome

    def rejection(self) -> Prompt:
        """Return what to do after a rejection."""
        return prompts.rest_rejection(self.progress.step, self.progress.reasons)


OF_SENSORS: Final[dict[Phase, type[PhaseState]]] = {
    **COMMON_STATES,
    Phase.PREFLIGHT: CheckingNoise,
    Phase.PLACE: PlacingForRest,
    Phase.REST: Resting,
    Phase.VERDICT: RestVerdict,
}
OF_NOISE: Final[dict[Phase, type[PhaseState]]] = {**OF_SENSORS, Phase.REST: LongRest}
"""Class of each phase."""
