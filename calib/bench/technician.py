"""Simulated technician: turns a procedure, with optional mistakes, into a motion scenario.

The technician sets the unit down in the first pose and waits for the preflight. For each step the unit is
carried into its pose, rests, is rotated, and rests again; hands tremble while they carry. After a mistake the
technician follows the engine's instructions and repeats the step. Times are those of the engine with
`hands_free`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import radians
from typing import Final, Literal

import numpy as np
from scipy.spatial.transform import Rotation as Attitude

from calib.axes import side
from calib.certificate import sensing_points
from calib.procedure.events import Phase, View
from calib.procedure.phases import VERDICT_S
from calib.procedure.plan import turn_s
from calib.procedure.preflight import PREFLIGHT_S
from calib.procedure.prompts import READY_S
from calib.procedure.schema import Procedure, Run, Step
from imudrv.arrays import Array
from imudrv.calibration import Calibration, SizeEffect, coefficients
from imudrv.errors import InputError
from imudrv.nav.attitude import rotation
from imudrv.sim import scenario as scenarios
from imudrv.sim.path import start_attitude
from imudrv.sim.scenario import (
    NOMINAL,
    Faults,
    Noise,
    Residuals,
    Rest,
    Rock,
    Rotate,
    Scenario,
    Segment,
    Start,
    Unit,
    Unplug,
)
from imudrv.site import Site

Kind = Literal["moves", "wrong way", "short", "slow", "wrong pose", "bump", "unplug", "short rest"]


BENCH: Final = Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0)
"""Site of the rehearsal."""


NEW_UNIT: Final = "six-faces-turned"
"""Shipped scenario with the unit of a rehearsal of the sensors and the noise, and its site."""


REHEARSED_UNIT: Final = "rehearsal"
"""Serial number of the unit of a rehearsal."""


REACTION_S: Final = 4.0
"""Time from the engine's instruction to the action, s."""


TURN_REACTION_S: Final = 1.0
"""The same before the second and later turns of a run, s."""


CARRY_DEG_PER_S: Final = 45.0
"""Mean rate while the unit is carried into another pose."""


_MOVING: Final = 0.5  # stillness of a unit that moves


_REACTION_VIEWS: Final = 8  # views at rest before the technician acts


_MISSED_VIEWS: Final = 25  # views after which a motion that was not noticed is over


ARM_MM: Final = 18.0
"""Distance of the random sensing points from their centroid along each axis, 1 sigma."""


MISTAKES: Final[tuple[Kind, ...]] = ("moves", "wrong way", "short", "slow", "wrong pose", "bump")
"""Mistakes to practise with, whoever makes them."""
MISTAKES_AT_REST: Final[tuple[Kind, ...]] = ("moves", "wrong pose", "bump", "unplug")
"""The same where the steps are rests."""


@dataclass(frozen=True)
class Mistake:
    """A mistake in a step.

    Attributes
    ----------
    step_id : str
        The step.
    kind : str
        'moves': touches the unit during the alignment, or during a rest of the sensors. 'wrong way': rotates
        in the wrong direction first.
        'short': rotates by 150 deg only. 'slow': takes 8 s. 'wrong pose': puts another side up first. 'bump':
        bumps the bench during the rest after the rotation. 'unplug': unplugs the cable for 3 s during the
        alignment. 'short rest': rotates again too early; in a step of several turns.
    turn : int
        Number of the turn, in a step of several.
    """

    step_id: str
    kind: Kind
    turn: int = 1


def mistakes_of(text: str, procedure: Procedure, rng: np.random.Generator) -> tuple[Mistake, ...]:
    """Return the mistakes that a user names, in the first steps of a procedure.

    Parameters
    ----------
    text : str
        Such as ``wrong-way,slow``; or ``random``, for a random one in most steps.
    procedure : Procedure
        The procedure.
    rng : Generator
        For ``random``.

    Returns
    -------
    tuple of Mistake

    Raises
    ------
    InputError
        A mistake is unknown, or there are more than steps.
    """
    steps = [step.id for step in procedure.steps]
    possible = MISTAKES if procedure.runs else MISTAKES_AT_REST
    if text == "random":
        kinds = [possible[k] for k in rng.integers(len(possible), size=len(steps))]
        return tuple(Mistake(s, kind) for s, kind in zip(steps, kinds, strict=True) if rng.random() < 0.75)
    names = text.split(",")
    known = {kind.replace(" ", "-"): kind for kind in possible}
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"--mistakes: expected random, or some of {', '.join(known)}, got {unknown[0]!r}")
    if len(names) > len(steps):
        raise InputError(f"--mistakes: expected one a step, {len(steps)} at most, got {len(names)}")
    return tuple(Mistake(step_id, known[name]) for step_id, name in zip(steps, names, strict=False))


def technician_scenario(
    procedure: Procedure,
    mistakes: Sequence[Mistake] = (),
    *,
    seed: int = 1,
    calibration: Calibration | None = None,
    unit: Calibration = NOMINAL,
) -> Scenario:
    """Return the scenario of a procedure carried out by hand.

    Parameters
    ----------
    procedure : Procedure
        The procedure.
    mistakes : sequence of Mistake
        At most one per step. The step is repeated after it; one of several turns is not.
    seed : int
        Random seed of the unit's errors, its lever arms, and the technician's hands.
    calibration : Calibration, optional
        Certificate of the unit; its `size_effect` is the truth. Default: `true_calibration` of the seed.
    unit : Calibration
        The unit whose lever arms are drawn by default.

    Returns
    -------
    Scenario
        `unit.calibration` is the certificate with the true lever arms; the engine must get it without them.

    Raises
    ------
    InputError
        A mistake in a step that does not exist, or two in one step.
    """
    by_step = {mistake.step_id: mistake for mistake in mistakes}
    known = [step.id for step in procedure.steps]
    if len(by_step) != len(mistakes) or not by_step.keys() <= set(known):
        raise InputError(
            f"rehearsal: expected mistakes in different steps of {', '.join(known)}, "
            f"got {', '.join(m.step_id for m in mistakes)}"
        )
    rng = np.random.default_rng(seed)
    if procedure.runs:
        truth = _draw_lever_arms(rng, unit) if calibration is None else calibration
    hands = _MotionScript(procedure, rng)
    for step in procedure.steps:
        hands.do(step, by_step.get(step.id))
    hands.rest(REACTION_S)
    if not procedure.runs:
        return new_unit_scenario(hands.start, hands.motion, unit, seed, hands.unplugs)
    return unit_scenario(hands.start, hands.motion, truth, seed, hands.unplugs)


def unit_scenario(
    start: Start, motion: Sequence[Segment], truth: Calibration, seed: int, unplugs: Sequence[Unplug] = ()
) -> Scenario:
    """Return the scenario of a unit of typical errors with some motion."""
    return Scenario(
        format="imu50-scenario",
        version=1,
        seed=seed,
        site=BENCH,
        start=start,
        motion=tuple(motion),
        unit=Unit(
            calibration=truth,
            residuals=Residuals(
                gyro_bias_deg_per_h=0.01,
                gyro_scale_ppm=5.0,
                gyro_misalignment_urad=30.0,
                accelerometer_bias_ug=50.0,
                accelerometer_scale_ppm=20.0,
                accelerometer_misalignment_urad=30.0,
            ),
            noise=Noise(arw_deg_per_sqrt_h=0.002, vrw_m_s_per_sqrt_h=0.003),
        ),
        faults=Faults(unplugs=tuple(unplugs)),
    )


def new_unit_scenario(
    start: Start, motion: Sequence[Segment], nominal: Calibration, seed: int, unplugs: Sequence[Unplug] = ()
) -> Scenario:
    """Return the scenario of a unit that was never calibrated, `true_new_unit`, with some motion."""
    shipped = scenarios.load(NEW_UNIT)
    unit = shipped.unit.model_copy(update={"calibration": true_new_unit(nominal)})
    return shipped.model_copy(
        update={
            "seed": seed,
            "start": start,
            "motion": tuple(motion),
            "unit": unit,
            "faults": Faults(unplugs=tuple(unplugs)),
        }
    )


def true_new_unit(nominal: Calibration) -> Calibration:
    """Return the unit of the shipped scenario `NEW_UNIT`, its scales as far off the nominal ones as there."""
    shipped = scenarios.load(NEW_UNIT).unit.calibration
    if shipped is None:
        raise RuntimeError(f"{NEW_UNIT}: a unit without a calibration")
    truth, at_nominal = coefficients(shipped), coefficients(NOMINAL)
    gyro = truth.gyro_scale / at_nominal.gyro_scale
    accelerometer = truth.accelerometer_scale / at_nominal.accelerometer_scale
    scales = nominal.gyro.scale_arcsec_per_pulse, nominal.accelerometer.scale_pulse_per_m_s
    names = "scale_arcsec_per_pulse", "scale_pulse_per_m_s"
    parts = []
    for own, ratio, scale, name in zip(
        (shipped.gyro, shipped.accelerometer), (gyro, accelerometer), scales, names, strict=True
    ):
        values = tuple((ratio * np.array(scale or (1.0, 1.0, 1.0))).tolist())
        given = {name: values, "scale": None} if scale else {name: None, "scale": values}
        parts.append(own.model_copy(update=given))
    return shipped.model_copy(
        update={"gyro": parts[0], "accelerometer": parts[1], "serial_number": REHEARSED_UNIT}
    )


def true_calibration(seed: int, unit: Calibration = NOMINAL) -> Calibration:
    """Return a unit with random lever arms, as `technician_scenario` simulates it."""
    return _draw_lever_arms(np.random.default_rng(seed), unit)


def _draw_lever_arms(rng: np.random.Generator, unit: Calibration) -> Calibration:
    """Draw the lever arms of a unit, in gauge centroid."""
    r_mm = np.round(rng.normal(0.0, ARM_MM, (3, 3)), 3)
    r_mm[2] = -r_mm[0] - r_mm[1]
    size_effect = SizeEffect(r_mm=sensing_points(np.round(r_mm, 3)), gauge="centroid")
    return unit.model_copy(update={"serial_number": REHEARSED_UNIT, "size_effect": size_effect})


class _MotionScript:
    """Motion segments of the technician's actions."""

    def __init__(self, procedure: Procedure, rng: np.random.Generator) -> None:
        self._procedure, self._rng = procedure, rng
        self.motion: list[Segment] = []
        self.unplugs: list[Unplug] = []
        self._t_s = 0.0
        first = self.pose(procedure.steps[0])
        self.start = _start(procedure.steps[0], first)
        self._C_nb = start_attitude(self.start)
        if procedure.steps[0].up[0] == "-":
            self.carry(first)
        self.rest(PREFLIGHT_S + REACTION_S)

    def do(self, step: Step, made: Mistake | None) -> None:
        """Carry out a step, with a mistake."""
        if not isinstance(step, Run):
            self._rest_in_pose(step, made.kind if made else None)
            return
        turn_deg, turn_s = self.by_hand(step.turn_deg)
        mistake = made.kind if made else None
        if mistake == "wrong pose":
            self.carry(self.wrong_pose(step))
            self.rest(2.0 * REACTION_S)
        if not self.is_in_pose(step):
            self.carry(self.pose(step))
        before_s = READY_S + self._procedure.limits.still_s
        if mistake == "moves":
            self.rest(before_s + 0.6 * step.align_s)
            self.turn(2.0, 1.0)
        elif mistake == "unplug":
            self.rest(before_s + 0.5 * step.align_s)
            self.unplugs.append(Unplug(at_s=self._t_s, duration_s=3.0))
            self.rest(3.0)
        elif mistake is not None and mistake != "wrong pose" and step.turns == 1:
            self._align(step)
            first_deg, first_s = _mistaken(mistake, turn_deg, turn_s)
            self.turn(first_deg, first_s)
            self.rest(REACTION_S)
            if mistake == "bump":
                self.turn(0.5, 0.2)
                self.rest(REACTION_S)
            self.turn(-first_deg, 4.0)
        self._align(step)
        if step.turns > 1:
            self._several_turns(step, made)
            return
        self.turn(turn_deg, turn_s)
        self.rest(step.rest_s + REACTION_S)

    def _rest_in_pose(self, step: Step, mistake: Kind | None) -> None:
        """Set the unit down and leave it alone; after a mistake once more."""
        if mistake == "wrong pose":
            self.carry(self.wrong_pose(step))
            self.rest(2.0 * REACTION_S)
        if not self.is_in_pose(step):
            self.carry(self.pose(step))
        if mistake in ("moves", "bump", "unplug"):
            self.rest(READY_S + 0.5 * step.rest_s)
            if mistake == "unplug":
                self.unplugs.append(Unplug(at_s=self._t_s, duration_s=3.0))
                self.rest(3.0)
            else:
                self.turn(*((2.0, 1.0) if mistake == "moves" else (0.5, 0.2)))
            self.rest(VERDICT_S)
        self.rest(2.0 * READY_S + step.rest_s + REACTION_S)

    def _several_turns(self, step: Run, made: Mistake | None) -> None:
        """Make the turns of a run, without repeating the one with the mistake."""
        for number in range(1, step.turns + 1):
            turn_deg, turn_s = self.by_hand(step.angle_deg(number))
            mistake = made.kind if made and made.turn == number else None
            self.turn(*_mistaken(mistake, turn_deg, turn_s))
            if mistake == "short rest":
                self.rest(0.5 * step.rest_s)
                continue
            if mistake == "bump":
                self.rest(0.5 * step.rest_s)
                self.turn(0.5, 0.2)
            self.rest(step.rest_s + TURN_REACTION_S)
        self.rest(REACTION_S)

    def by_hand(self, turn_deg: float) -> tuple[float, float]:
        """Return angle and duration of a turn as a hand makes it."""
        duration_s = turn_s(self._procedure) * self._rng.uniform(0.9, 1.1)
        return turn_deg + self._rng.uniform(-1.5, 1.5), duration_s

    def take(self) -> tuple[Segment, ...]:
        """Return the motions since the last call."""
        taken, self.motion = tuple(self.motion), []
        return taken

    def rest(self, duration_s: float) -> None:
        """Leave the unit alone."""
        self._add(Segment(rest=Rest(duration_s=duration_s)), duration_s)

    def _align(self, step: Run) -> None:
        limits = self._procedure.limits
        self.rest(READY_S + limits.still_s + step.align_s + REACTION_S)

    def turn(self, angle_deg: float, duration_s: float) -> None:
        """Rotate about the vertical, within a hand's accuracy."""
        lean = self._rng.normal(0.0, 2.0, 2) * 1e-3
        axis = (float(lean[0]), float(lean[1]), 1.0)
        self._about(axis, angle_deg, duration_s)

    def _about(self, axis_n: tuple[float, float, float], angle_deg: float, duration_s: float) -> None:
        rotate = Rotate(angle_deg=angle_deg, duration_s=duration_s, axis_n=axis_n)
        self._add(Segment(rotate=rotate), duration_s)
        self._C_nb = rotation(axis_n, radians(angle_deg)) @ self._C_nb

    def carry(self, C_nb: Array) -> None:
        """Lift the unit, rotate it, and set it down."""
        self._tremble()
        turn = Attitude.from_matrix(C_nb @ self._C_nb.T).as_rotvec()
        angle = float(np.linalg.norm(turn))
        x, y, z = (turn / angle).tolist()
        self._about((x, y, z), float(np.degrees(angle)), 1.0 + float(np.degrees(angle)) / CARRY_DEG_PER_S)
        self._tremble()

    def _tremble(self) -> None:
        rock = Rock(
            duration_s=2.0,
            band_hz=(0.5, 4.0),
            ramp_s=0.5,
            rate_rms_deg_per_s=(3.0, 3.0, 3.0),
            sway_mm=(5.0, 5.0, 5.0),
        )
        self._add(Segment(rock=rock), 2.0)

    def _add(self, segment: Segment, duration_s: float) -> None:
        self.motion.append(segment)
        self._t_s += duration_s

    def pose(self, step: Step) -> Array:
        """Return the attitude in which a person sets the unit down for a step."""
        heading = rotation((0.0, 0.0, 1.0), radians(self._rng.uniform(-8.0, 8.0)))
        lean = Attitude.from_rotvec([*(self._rng.normal(0.0, 1e-3, 2)), 0.0]).as_matrix()
        C_nb: Array = lean @ heading @ step.C_bn.T
        return C_nb

    def wrong_pose(self, step: Step) -> Array:
        """Return a pose with another side up: the one that should face north."""
        C_nb: Array = rotation((1.0, 0.0, 0.0), radians(90.0)) @ self.pose(step)
        return C_nb

    def is_in_pose(self, step: Step) -> bool:
        """Return whether the unit is in the pose of a step."""
        off = Attitude.from_matrix(self._C_nb @ step.C_bn)
        return bool(off.magnitude() < radians(20.0))


class LiveTechnician:
    """Technician who does what the screen says while a person presses the keys; each mistake is made once.

    Parameters
    ----------
    procedure : Procedure
        The steps.
    mistakes : sequence of Mistake
        At most one per step.
    seed : int
        Of the hands.
    move : callable
        Receives the motions.
    """

    def __init__(
        self,
        procedure: Procedure,
        mistakes: Sequence[Mistake],
        seed: int,
        move: Callable[[Sequence[Segment]], None],
    ) -> None:
        self._hands = _MotionScript(procedure, np.random.default_rng(seed))
        self.start = self._hands.start
        self.begins_with = self._hands.take()
        self._steps = {step.id: step for step in procedure.steps}
        self._mistakes = {mistake.step_id: mistake.kind for mistake in mistakes}
        self._move = move
        self._is_moving, self._has_moved, self._still_views = False, False, 0

    def watch(self, view: View) -> None:
        """Look at the screen, and act once the unit rests."""
        if view.stillness < _MOVING:
            self._has_moved, self._still_views = True, 0
            return
        self._still_views += 1
        is_done = self._has_moved or self._still_views >= _MISSED_VIEWS
        if self._still_views < _REACTION_VIEWS or (self._is_moving and not is_done):
            return
        self._is_moving = self._has_moved = False
        step = self._steps.get(view.step_id)
        if step is not None:
            self._act(step, view)
        if motions := self._hands.take():
            self._is_moving, self._still_views = True, 0
            self._move(motions)

    def _act(self, step: Step, view: View) -> None:
        hands, mistake = self._hands, self._mistakes.get(step.id)
        resting = Phase.ALIGN if isinstance(step, Run) else Phase.REST
        if view.phase is Phase.PLACE and not hands.is_in_pose(step):
            wrong = mistake == "wrong pose" and self._mistakes.pop(step.id)
            hands.carry(hands.wrong_pose(step) if wrong else hands.pose(step))
        elif view.phase is resting and mistake == "moves" and (view.progress or 0.0) > 0.3:
            del self._mistakes[step.id]
            hands.turn(2.0, 1.0)
        elif view.phase is Phase.ROTATE and view.want_deg is not None:
            turn = hands.by_hand(view.want_deg)
            if mistake in ("wrong way", "short", "slow"):
                turn = _mistaken(self._mistakes.pop(step.id), *turn)
            hands.turn(*turn)
        elif view.phase is Phase.REST and mistake == "bump":
            del self._mistakes[step.id]
            hands.turn(0.5, 0.2)


def _mistaken(mistake: Kind | None, turn_deg: float, turn_s: float) -> tuple[float, float]:
    """Return angle and duration of a turn with a mistake."""
    sign = float(np.sign(turn_deg))
    turns = {"wrong way": (-40.0 * sign, 1.0), "short": (150.0 * sign, turn_s), "slow": (180.0 * sign, 8.0)}
    return turns.get(mistake or "", (turn_deg, turn_s))


def _start(step: Step, C_nb: Array) -> Start:
    """Return the initial pose: that of the step, or Z up if the step has a negative axis up."""
    pose: Literal["x_up", "y_up", "z_up"]
    pose = {"X": "x_up", "Y": "y_up", "Z": "z_up"}[side(step.up)[-1]]  # type: ignore[assignment]
    pivot_offset_mm = (40.0, 30.0, 30.0)
    if step.up[0] == "-":
        return Start(pivot_offset_mm=pivot_offset_mm)
    upright = start_attitude(Start(pose=pose))
    heading = -Attitude.from_matrix(C_nb @ upright.T).as_rotvec()[2]
    return Start(pose=pose, heading_deg=float(np.degrees(heading)), pivot_offset_mm=pivot_offset_mm)
