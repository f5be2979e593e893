"""The words of the bench procedure: what to do now, which way, what is expected, from what sensors show."""

from dataclasses import dataclass
from math import pi
from typing import Final, NamedTuple

from calib.axes import axis_name, opposite, side, vector
from calib.detection.tracking import AttitudeTracker, RotationTracker, StillnessDetector
from calib.procedure.events import Accepted
from calib.procedure.schema import ProcedureLimits, Step
from imudrv.records import Flag
from imudrv.units import DEG


class Prompt(NamedTuple):
    """What the operator has to do: a headline of at most 38 characters, and hints."""

    headline: str
    hints: tuple[str, ...]


READY_S: Final = 1.0
"""The unit has been set down when it stands still for so long, s."""


NAMED_RAD: Final = 10.0 * DEG
"""A turn of less has no way and no axis yet."""


_AHEAD_S: Final = 0.3  # a person stops so long after the word


_LONG_S: Final = 5.0  # so long in the wrong pose is no passing moment


_COMPASS: Final = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")


def turn_instruction(clockwise_rad: float) -> str:
    """Say the turn that takes back one of so much clockwise: ``90 deg clockwise, seen from above``."""
    turn = "counter-clockwise" if clockwise_rad > 0.0 else "clockwise"
    return f"{abs(clockwise_rad) / DEG:.0f} deg {turn}, seen from above"


def pose_text(step: Step) -> str:
    """Say a pose."""
    north = axis_name(step.C_bn[:, 1])
    return f"{side(step.up)} up, {side(step.east)} about east, {side(north)} about north"


def wrong_direction_text(angle_rad: float, step: Step) -> str:
    """Say that a turn has the wrong sign."""
    return f"turns the wrong way: {angle_rad / DEG:+.0f} deg, want {step.turn_deg:+d}"


@dataclass(frozen=True)
class StepObservation:
    """What the sensors show, and what the step wants.

    Attributes
    ----------
    step : Step
        The current one.
    limits : Limits
        Of the procedure.
    posture : Posture
        How the unit lies.
    still : Stillness
        Whether it stands still.
    flags : int
        `Flag` bits of the newest block.
    faults : tuple of str
        Names of the faults that the unit tells.
    """

    step: Step
    limits: ProcedureLimits
    posture: AttitudeTracker
    still: StillnessDetector
    flags: int
    faults: tuple[str, ...]

    @property
    def upright(self) -> bool:
        """Whether the right side is up."""
        return self.posture.lean(vector(self.step.up)) <= self.limits.tilt_deg * DEG

    @property
    def clockwise(self) -> float | None:
        """How far the pose is turned clockwise, rad, -pi to pi; None: not known."""
        azimuth = self.posture.azimuth(vector(self.step.east))
        return None if azimuth is None else (azimuth + 0.5 * pi) % (2.0 * pi) - pi

    @property
    def placed(self) -> bool:
        """Whether the unit lies as the step wants it, as far as it is known."""
        return self.upright and abs(self.clockwise or 0.0) <= self.limits.heading_deg * DEG

    @property
    def unfit(self) -> str:
        """Why the unit cannot measure, if it cannot."""
        if self.flags & Flag.FAULT:
            names = f": {', '.join(self.faults)}" if self.faults else ""
            return f"the unit tells a fault{names}"
        return "the unit is warming up" if self.flags & Flag.WARM_UP else ""

    @property
    def ready(self) -> bool:
        """Whether the sensors agree that the unit stands as the step wants it."""
        return self.placed and self.still.quiet_s >= READY_S and not self.unfit


def preflight(seen: StepObservation, failed: bool) -> Prompt:
    """For the preflight; `failed`: the last check found something."""
    if seen.flags & Flag.WARM_UP:
        return Prompt("WARMING UP, WAIT", ("the unit's warm-up bit is set",))
    if seen.still.moving or not (seen.upright or failed):
        return Prompt(f"SET IT DOWN: {side(seen.step.up)} UP", (pose_text(seen.step), *_motion(seen)))
    if failed:
        hint = "it is checked again and again, and goes on when all is well"
        return Prompt("CHECK FAILED: SEE WHY", (pose_text(seen.step), hint))
    return Prompt("HANDS OFF, CHECKING", (pose_text(seen.step),))


def place(seen: StepObservation, hands_free: bool) -> Prompt:
    """For placing the unit; `hands_free`: nobody is asked to confirm."""
    step = seen.step
    if not seen.upright:
        return Prompt(f"TURN IT: {side(step.up)} UP", (*_tip(seen), pose_text(step)))
    if not seen.placed:
        clockwise = seen.clockwise or 0.0
        word = "COUNTER-CLOCKWISE" if clockwise > 0.0 else "CLOCKWISE"
        hint = (
            f"{side(step.east)} points {abs(clockwise) / DEG:.0f} deg off east, want "
            f"{seen.limits.heading_deg:g} at most: turn it {turn_instruction(clockwise)}"
        )
        return Prompt(f"TURN IT {abs(clockwise) / DEG:.0f} DEG {word}", (hint, pose_text(step)))
    if seen.unfit:
        return Prompt("WAIT FOR THE UNIT", (seen.unfit,))
    if seen.still.quiet_s < READY_S:
        return Prompt("SET IT DOWN, HANDS OFF", (pose_text(step), *_motion(seen)))
    return Prompt("HANDS OFF" if hands_free else "READY: CONFIRM", (pose_text(step),))


def settle(seen: StepObservation) -> Prompt:
    """For standing still before the alignment."""
    if seen.unfit:
        return Prompt("WAIT FOR THE UNIT", (seen.unfit,))
    return Prompt("HANDS OFF, SETTLING", _motion(seen))


def align() -> Prompt:
    """For the alignment."""
    return Prompt("HANDS OFF, ALIGNING", ("do not touch the unit or the bench",))


def rest() -> Prompt:
    """For the rest after the turn."""
    return Prompt("HANDS OFF, RESTING", ("do not touch the unit or the bench",))


def verdict(step: Step, number: int, steps: int, accepted: Accepted | None) -> Prompt:
    """For the verdict on an attempt; None: it was rejected."""
    if accepted is None:
        return Prompt("REJECTED: DO IT AGAIN", (pose_text(step),))
    turned = f"turned {accepted.angle_deg:+.1f} deg in {accepted.duration_s:.1f} s"
    return Prompt(
        f"GOOD: STEP {number} OF {steps} DONE", (f"{turned}, peak {accepted.peak_deg_per_s:.0f} deg/s",)
    )


def done(accepted: int, steps: int) -> Prompt:
    """For the end."""
    return Prompt("ALL STEPS DONE", (f"{accepted} accepted, {steps - accepted} skipped",))


def aborted() -> Prompt:
    """For the end after an abort."""
    return Prompt("ABORTED", ())


def rotate(seen: StepObservation, turn: RotationTracker) -> Prompt:
    """For the turn."""
    step, limits = seen.step, seen.limits
    whole = abs(step.turn_deg) * DEG
    how = "counter-clockwise" if step.turn_deg > 0 else "clockwise"
    plain = (f"{abs(step.turn_deg)} deg {how}, seen from above, in 2 to 3 s; then hands off",)
    if turn.begun is None:
        return Prompt(f"ROTATE NOW {step.turn_deg:+d}", plain)
    if turn.size > NAMED_RAD:
        if turn.axis_tilt > limits.axis_tilt_deg * DEG:
            hint = (
                f"turns about {turn.about}, {turn.axis_tilt / DEG:.0f} deg off the vertical, want "
                f"{limits.axis_tilt_deg:g} at most: keep {side(step.up)} up"
            )
            return Prompt("WRONG AXIS", (hint,))
        if turn.angle * step.turn_deg < 0.0:
            return Prompt("WRONG WAY", (wrong_direction_text(turn.angle, step),))
    done = abs(turn.angle)
    if done + abs(turn.rate) * _AHEAD_S >= whole:
        return Prompt("STOP", (f"stop at {abs(step.turn_deg)} deg, hands off",))
    if done >= whole - limits.angle_tolerance_deg * DEG:
        return Prompt("HOLD STILL", (f"turned {turn.angle / DEG:+.0f} deg",))
    # a smooth turn is nearly at its fastest from a quarter of the way on
    if 0.25 < done / whole < 0.7 and turn.peak < 0.9 * limits.least_peak_deg_per_s * DEG:
        return Prompt(
            "FASTER", (f"peak {turn.peak / DEG:.0f} deg/s, want {limits.least_peak_deg_per_s:g} at least",)
        )
    return Prompt(f"ROTATE {step.turn_deg:+d}", plain)


def _tip(seen: StepObservation) -> tuple[str, ...]:
    """Which way to tip the unit so that the right side comes up."""
    want, now, posture = seen.step.up, seen.posture.up, seen.posture
    if now == want:
        lean = posture.lean(vector(want)) / DEG
        return (f"the {side(now)} side leans {lean:.0f} deg, want {seen.limits.tilt_deg:g} at most",)
    task = f"the {side(now)} side is up, turn the {side(want)} side up"
    if now[1] == want[1]:
        hint, cause = f"{task}: turn it over, 180 deg", f"accelerometer {want[1]} is reversed"
    else:
        # the upper side tips to where the one opposite to the wanted one looks
        down = opposite(want)
        azimuth = posture.azimuth(vector(down))
        compass = "" if azimuth is None else f" ({_COMPASS[round(azimuth / (pi / 4.0)) % 8]})"
        hint = f"{task}: roll it 90 deg toward its {side(down)} side{compass}"
        cause = f"accelerometers {now[1]} and {want[1]} are exchanged"
    if seen.still.quiet_s < _LONG_S:
        return (hint,)
    return hint, f"if its {side(want)} side is up, {cause}: check the certificate"


def _motion(seen: StepObservation) -> tuple[str, ...]:
    return (f"it moves: {seen.still.why}",) if seen.still.moving else ()
