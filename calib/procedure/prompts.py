"""Prompts of the bench procedure: what to do now, which way, what is expected, from what the sensors show."""

from dataclasses import dataclass
from math import pi
from typing import Final, NamedTuple

from calib.axes import axis_name, opposite, side, vector
from calib.detection.tracking import AttitudeTracker, RotationTracker, StillnessDetector
from calib.messages import Message, message
from calib.procedure.events import Accepted, RestAccepted
from calib.procedure.schema import PlannedTurn, Procedure, ProcedureLimits, Run, Step
from imudrv.records import Flag
from imudrv.units import DEG

READY_S: Final = 1.0
"""Rest after which the unit counts as set down, s."""


MIN_ROTATION_RAD: Final = 10.0 * DEG
"""Smallest rotation of which direction and axis are judged."""


_REACTION_S: Final = 0.3  # from the word to the end of the motion


_LONG_S: Final = 5.0  # a wrong pose for this long is no passing moment


_COMPASS: Final = (
    message("north"),
    message("north_east"),
    message("east"),
    message("south_east"),
    message("south"),
    message("south_west"),
    message("west"),
    message("north_west"),
)


class Prompt(NamedTuple):
    """Headline of at most 38 characters, and hints."""

    headline: Message
    hints: tuple[Message, ...] = ()


@dataclass(frozen=True)
class StepObservation:
    """Sensors against what the step requires.

    Attributes
    ----------
    step : Step
        The current one.
    limits : ProcedureLimits
        Of the procedure.
    attitude : AttitudeTracker
        Attitude of the unit.
    stillness : StillnessDetector
        Whether it is at rest.
    flags : int
        `Flag` bits of the newest block.
    faults : tuple of str
        Names of the faults that the unit reports.
    """

    step: Step
    limits: ProcedureLimits
    attitude: AttitudeTracker
    stillness: StillnessDetector
    flags: int
    faults: tuple[str, ...]

    @property
    def upright(self) -> bool:
        """Whether the right side is up."""
        return self.attitude.lean(vector(self.step.up)) <= self.limits.tilt_deg * DEG

    @property
    def clockwise(self) -> float | None:
        """Clockwise deviation from the heading of the pose, rad, -pi to pi; None: not known."""
        azimuth = self.attitude.azimuth(vector(self.step.east))
        return None if azimuth is None else (azimuth + 0.5 * pi) % (2.0 * pi) - pi

    @property
    def placed(self) -> bool:
        """Whether the unit is in the pose of the step, as far as known."""
        return self.upright and abs(self.clockwise or 0.0) <= self.limits.heading_deg * DEG

    @property
    def unfit(self) -> Message | None:
        """Reason why the unit cannot measure."""
        if self.flags & Flag.FAULT:
            return fault_message(self.faults)
        return message("unit_warming_up") if self.flags & Flag.WARM_UP else None

    @property
    def ready(self) -> bool:
        """Whether the unit is at rest in the pose of the step, and can measure."""
        return self.placed and self.stillness.quiet_s >= READY_S and not self.unfit


def fault_message(faults: tuple[str, ...]) -> Message:
    """Return the message of the faults that the unit reports."""
    return message("fault", faults=faults) if faults else message("unnamed_fault")


def turn_message(clockwise_rad: float) -> Message:
    """Return the turn that undoes a clockwise one: ``90 deg counter-clockwise, seen from above``."""
    angle_deg = abs(clockwise_rad) / DEG
    if clockwise_rad > 0.0:
        return message("counter_clockwise", angle_deg=angle_deg)
    return message("clockwise", angle_deg=angle_deg)


def pose_message(step: Step) -> Message:
    """Return the message of a pose."""
    north = axis_name(step.C_bn[:, 1])
    return message("pose", up=side(step.up), east=side(step.east), north=side(north))


def title(step: Step, number: int, steps: int, turn: int) -> Message:
    """Return the title of step `number` of `steps`, at one of its turns."""
    up = side(step.up)
    if not isinstance(step, Run):
        return message("title_rest", step=number, steps=steps, id=step.id, side=up)
    if step.turns > 1:
        return message("title_turns", step=number, steps=steps, side=up, turn=turn, turns=step.turns)
    return message("title", step=number, steps=steps, side=up, turn_deg=step.turn_deg)


def wrong_direction(angle_deg: float, expected_deg: int) -> Message:
    """Return the message of a rotation with the wrong sign."""
    return message("wrong_direction", angle_deg=angle_deg, expected_deg=expected_deg)


def lean_message(lean_rad: float, step: Step, limits: ProcedureLimits) -> Message:
    """Return the message of an upper axis that is not vertical."""
    return message("leans", side=side(step.up), lean_deg=lean_rad / DEG, limit_deg=limits.tilt_deg)


def preflight(observed: StepObservation, failed: bool) -> Prompt:
    """Prompt for the preflight; `failed`: the latest check has found something."""
    pose = pose_message(observed.step)
    if observed.flags & Flag.WARM_UP:
        return Prompt(message("warming_up"), (message("unit_warming_up"),))
    if observed.stillness.moving or not (observed.upright or failed):
        return Prompt(message("set_down_side", side=side(observed.step.up)), (pose, *_motion(observed)))
    if failed:
        return Prompt(message("check_failed"), (pose, message("check_repeats")))
    return Prompt(message("hands_off"), (pose,))


def place(observed: StepObservation, hands_free: bool, was_moved: bool) -> Prompt:
    """Prompt for placing the unit.

    Parameters
    ----------
    observed : StepObservation
        Sensors against what the step requires.
    hands_free : bool
        Nobody is asked to confirm.
    was_moved : bool
        Whether the unit was moved since it is to be placed.
    """
    step, pose = observed.step, pose_message(observed.step)
    if not observed.upright:
        return Prompt(message("side_up", side=side(step.up)), (*_tip(observed, was_moved), pose))
    if not observed.placed:
        return _turn_to_heading(observed, observed.clockwise or 0.0)
    if observed.unfit:
        return Prompt(message("wait_for_unit"), (observed.unfit,))
    if observed.stillness.quiet_s < READY_S:
        return Prompt(message("set_down"), (pose, *_motion(observed)))
    return Prompt(message("hands_off") if hands_free else message("confirm"), (pose,))


def settle(observed: StepObservation) -> Prompt:
    """Prompt for the rest before the alignment."""
    if observed.unfit:
        return Prompt(message("wait_for_unit"), (observed.unfit,))
    return Prompt(message("hands_off"), _motion(observed))


def rotate(
    observed: StepObservation, rotation: RotationTracker, turn_deg: int, turn_s: tuple[float, float]
) -> Prompt:
    """Prompt for a rotation by `turn_deg`, in `turn_s` from the shortest to the longest time."""
    limits = observed.limits
    whole, angle_deg = abs(turn_deg) * DEG, rotation.angle / DEG
    shortest_s, longest_s = turn_s
    instruction = message(
        "rotation", turn=turn_message(turn_deg * DEG), shortest_s=shortest_s, longest_s=longest_s
    )
    if rotation.begun is None:
        return Prompt(message("rotate_now", turn_deg=turn_deg), (instruction,))
    if rotation.size > MIN_ROTATION_RAD:
        if rotation.axis_tilt > limits.axis_tilt_deg * DEG:
            return Prompt(message("wrong_axis"), (_off_axis(observed, rotation),))
        if rotation.angle * turn_deg < 0.0:
            return Prompt(message("wrong_way"), (wrong_direction(angle_deg, turn_deg),))
    done = abs(rotation.angle)
    if done + abs(rotation.rate) * _REACTION_S >= whole:
        return Prompt(message("stop"), (message("stop_at", angle_deg=abs(turn_deg)),))
    if done >= whole - limits.angle_tolerance_deg * DEG:
        return Prompt(message("hold_still"), (message("turned", angle_deg=angle_deg),))
    # a smooth rotation is nearly at its fastest from a quarter of the way on
    peak, least = rotation.peak / DEG, limits.least_peak_deg_per_s
    if 0.25 < done / whole < 0.7 and peak < 0.9 * least:
        return Prompt(message("faster"), (message("slow", peak_deg_per_s=peak, limit_deg_per_s=least),))
    return Prompt(message("rotate", turn_deg=turn_deg), (instruction,))


def rejection(run: Run, procedure: Procedure, reasons: tuple[Message, ...]) -> Prompt:
    """Prompt after a rejection: the remedy for the first reason."""
    shortest_s, longest_s = procedure.turn_s
    angle_deg = abs(run.turn_deg)
    remedies = {
        "wrong_direction": message("remedy_direction", turn=turn_message(run.turn_deg * DEG)),
        "wrong_angle": message("remedy_angle", angle_deg=angle_deg),
        "too_slow": message("remedy_time", shortest_s=shortest_s, longest_s=longest_s),
        "too_slow_with_error": message("remedy_time", shortest_s=shortest_s, longest_s=longest_s),
        "saturated": message("remedy_time", shortest_s=shortest_s, longest_s=longest_s),
        "axis_tilted": message("remedy_axis", side=side(run.up)),
        "wrong_vertical": message("remedy_axis", side=side(run.up)),
        "left_pose": message("remedy_axis", side=side(run.up)),
        "rest_interrupted": message("remedy_rest"),
        "no_rest_before": message("remedy_rest"),
        "no_rest_after": message("remedy_rest"),
        "short_rest_before": message("remedy_rest"),
        "short_rest_after": message("remedy_rest"),
        "no_rotation": message("remedy_rest"),
        "samples_lost": message("remedy_cable"),
        "during_rotation": message("remedy_cable"),
        "recording_lacks": message("remedy_computer"),
    }
    first = reasons[0].key if reasons else ""
    return Prompt(message("rejected"), (remedies.get(first, message("remedy_again")),))


def rest(step: Step, following: Step | None) -> Prompt:
    """Prompt for a rest, and for the pose after it."""
    hints = [message("do_not_touch")]
    if following is not None:
        hints.append(message("next_pose", id=following.id, pose=pose_message(following)))
    return Prompt(message("hands_off"), tuple(hints))


def turn_of_table(turn: PlannedTurn) -> Message:
    """Return how a turntable comes to a pose."""
    return message("turn_table", turn_deg=turn.deg, about=side(turn.about), seconds=turn.seconds)


def heading_message(observed: StepObservation) -> Message:
    """Return how far the heading is off, and the turn that corrects it."""
    clockwise = observed.clockwise or 0.0
    return message(
        "heading_off",
        side=side(observed.step.east),
        angle_deg=abs(clockwise) / DEG,
        limit_deg=observed.limits.heading_deg,
        turn=turn_message(clockwise),
    )


def rest_rejection(step: Step, reasons: tuple[Message, ...]) -> Prompt:
    """Prompt after the rejection of a rest: the remedy for the first reason."""
    remedies = {
        "rest_interrupted": message("remedy_leave_alone"),
        "rest_drifts": message("remedy_firm"),
        "heading_off": message("remedy_pose", pose=pose_message(step)),
        "turn_differs": message("remedy_table"),
        "recording_lacks": message("remedy_computer"),
    }
    first = reasons[0].key if reasons else ""
    return Prompt(message("rejected"), (remedies.get(first, message("remedy_again")),))


def verdict(number: int, steps: int, accepted: Accepted | RestAccepted) -> Prompt:
    """Verdict on an accepted attempt."""
    if isinstance(accepted, RestAccepted):
        hint = message("accepted_rest", rest_s=accepted.rest_s, lean_deg=accepted.lean_deg)
    elif accepted.turns > 1:
        hint = message("accepted_turns", turns=accepted.turns, within=accepted.turns_within_limits)
    else:
        hint = message(
            "accepted",
            angle_deg=accepted.angle_deg,
            duration_s=accepted.duration_s,
            peak_deg_per_s=accepted.peak_deg_per_s,
        )
    return Prompt(message("step_done", step=number, steps=steps), (hint,))


def _turn_to_heading(observed: StepObservation, clockwise: float) -> Prompt:
    angle_deg = abs(clockwise) / DEG
    if clockwise > 0.0:
        headline = message("turn_counter_clockwise", angle_deg=angle_deg)
    else:
        headline = message("turn_clockwise", angle_deg=angle_deg)
    return Prompt(headline, (heading_message(observed), pose_message(observed.step)))


def _off_axis(observed: StepObservation, rotation: RotationTracker) -> Message:
    return message(
        "off_axis",
        axis=rotation.about,
        tilt_deg=rotation.axis_tilt / DEG,
        limit_deg=observed.limits.axis_tilt_deg,
        side=side(observed.step.up),
    )


def _tip(observed: StepObservation, was_moved: bool) -> tuple[Message, ...]:
    """Return how to tip the unit so that the right side comes up; reversed axes are suspected after that."""
    wanted, now, attitude = observed.step.up, observed.attitude.up, observed.attitude
    if now == wanted:
        return (lean_message(attitude.lean(vector(wanted)), observed.step, observed.limits),)
    if now[1] == wanted[1]:
        hint = message("turn_over", now=side(now), wanted=side(wanted))
        cause = message("accelerometer_reversed", axis=wanted[1])
    else:
        # the upper side tips toward the side opposite to the wanted one
        down = opposite(wanted)
        azimuth = attitude.azimuth(vector(down))
        if azimuth is None:
            hint = message("roll", now=side(now), wanted=side(wanted), down=side(down))
        else:
            compass = _COMPASS[round(azimuth / (pi / 4.0)) % 8]
            hint = message(
                "roll_toward", now=side(now), wanted=side(wanted), down=side(down), compass=compass
            )
        cause = message("accelerometers_exchanged", first=now[1], second=wanted[1])
    if not was_moved or observed.stillness.quiet_s < _LONG_S:
        return (hint,)
    return hint, message("suspect", side=side(wanted), cause=cause)


def _motion(observed: StepObservation) -> tuple[Message, ...]:
    return (message("moving", motion=observed.stillness.why),) if observed.stillness.moving else ()
