"""Simulated technician: turns a procedure, with optional mistakes, into a motion scenario.

The technician sets the unit down in the first pose and waits for the preflight. For each step the unit is
carried into its pose, rests, is rotated, and rests again; hands tremble while they carry. After a mistake the
technician follows the engine's instructions and repeats the step. Times are those of the engine with
`hands_free`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import radians
from typing import Final, Literal

import numpy as np
from scipy.spatial.transform import Rotation as Attitude

from calib.axes import side
from calib.certificate import sensing_points
from calib.procedure.plan import turn_s
from calib.procedure.preflight import PREFLIGHT_S
from calib.procedure.prompts import READY_S
from calib.procedure.schema import Procedure, Step
from imudrv.arrays import Array
from imudrv.calibration import Calibration, SizeEffect
from imudrv.errors import InputError
from imudrv.nav.attitude import rotation
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


REACTION_S: Final = 4.0
"""Time from the engine's instruction to the action, s."""


TURN_REACTION_S: Final = 1.0
"""The same before the second and later turns of a run, s."""


CARRY_DEG_PER_S: Final = 45.0
"""Mean rate while the unit is carried into another pose."""


ARM_MM: Final = 18.0
"""Distance of the random sensing points from their centroid along each axis, 1 sigma."""


@dataclass(frozen=True)
class Mistake:
    """A mistake in a step.

    Attributes
    ----------
    step_id : str
        The step.
    kind : str
        'moves': touches the unit during the alignment. 'wrong way': rotates in the wrong direction first.
        'short': rotates by 150 deg only. 'slow': takes 8 s. 'wrong pose': puts another side up first. 'bump':
        bumps the bench during the rest after the rotation. 'unplug': unplugs the cable for 3 s during the
        alignment. 'short rest': rotates again too early; in a step of several turns.
    turn : int
        Number of the turn, in a step of several.
    """

    step_id: str
    kind: Kind
    turn: int = 1


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
    truth = _draw_lever_arms(rng, unit) if calibration is None else calibration
    hands = _MotionScript(procedure, rng)
    for step in procedure.steps:
        hands.do(step, by_step.get(step.id))
    hands.rest(REACTION_S)
    return Scenario(
        format="imu50-scenario",
        version=1,
        seed=seed,
        site=BENCH,
        start=hands.start,
        motion=tuple(hands.motion),
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
        faults=Faults(unplugs=tuple(hands.unplugs)),
    )


def true_calibration(seed: int, unit: Calibration = NOMINAL) -> Calibration:
    """Return a unit with random lever arms, as `technician_scenario` simulates it."""
    return _draw_lever_arms(np.random.default_rng(seed), unit)


def _draw_lever_arms(rng: np.random.Generator, unit: Calibration) -> Calibration:
    """Draw the lever arms of a unit, in gauge centroid."""
    r_mm = np.round(rng.normal(0.0, ARM_MM, (3, 3)), 3)
    r_mm[2] = -r_mm[0] - r_mm[1]
    size_effect = SizeEffect(r_mm=sensing_points(np.round(r_mm, 3)), gauge="centroid")
    return unit.model_copy(update={"serial_number": "rehearsal", "size_effect": size_effect})


class _MotionScript:
    """Motion segments of the technician's actions."""

    def __init__(self, procedure: Procedure, rng: np.random.Generator) -> None:
        self._procedure, self._rng = procedure, rng
        self.motion: list[Segment] = []
        self.unplugs: list[Unplug] = []
        self._t_s = 0.0
        first = self._pose(procedure.steps[0])
        self.start = _start(procedure.steps[0], first)
        self._C_nb = start_attitude(self.start)
        if procedure.steps[0].up[0] == "-":
            self._carry(first)
        self.rest(PREFLIGHT_S + REACTION_S)

    def do(self, step: Step, made: Mistake | None) -> None:
        """Carry out a step, with a mistake."""
        turn_deg, turn_s = self._by_hand(step.turn_deg)
        mistake = made.kind if made else None
        if mistake == "wrong pose":
            self._carry(self._wrong_pose(step))
            self.rest(2.0 * REACTION_S)
        if not self._is_in_pose(step):
            self._carry(self._pose(step))
        before_s = READY_S + self._procedure.limits.still_s
        if mistake == "moves":
            self.rest(before_s + 0.6 * step.align_s)
            self._turn(2.0, 1.0)
        elif mistake == "unplug":
            self.rest(before_s + 0.5 * step.align_s)
            self.unplugs.append(Unplug(at_s=self._t_s, duration_s=3.0))
            self.rest(3.0)
        elif mistake is not None and mistake != "wrong pose" and step.turns == 1:
            self._align(step)
            first_deg, first_s = _mistaken(mistake, turn_deg, turn_s)
            self._turn(first_deg, first_s)
            self.rest(REACTION_S)
            if mistake == "bump":
                self._turn(0.5, 0.2)
                self.rest(REACTION_S)
            self._turn(-first_deg, 4.0)
        self._align(step)
        if step.turns > 1:
            self._several_turns(step, made)
            return
        self._turn(turn_deg, turn_s)
        self.rest(step.rest_s + REACTION_S)

    def _several_turns(self, step: Step, made: Mistake | None) -> None:
        """Make the turns of a run, without repeating the one with the mistake."""
        for number in range(1, step.turns + 1):
            turn_deg, turn_s = self._by_hand(step.angle_deg(number))
            mistake = made.kind if made and made.turn == number else None
            self._turn(*_mistaken(mistake, turn_deg, turn_s))
            if mistake == "short rest":
                self.rest(0.5 * step.rest_s)
                continue
            if mistake == "bump":
                self.rest(0.5 * step.rest_s)
                self._turn(0.5, 0.2)
            self.rest(step.rest_s + TURN_REACTION_S)
        self.rest(REACTION_S)

    def _by_hand(self, turn_deg: float) -> tuple[float, float]:
        """Return angle and duration of a turn as a hand makes it."""
        duration_s = turn_s(self._procedure) * self._rng.uniform(0.9, 1.1)
        return turn_deg + self._rng.uniform(-1.5, 1.5), duration_s

    def rest(self, duration_s: float) -> None:
        """Leave the unit alone."""
        self._add(Segment(rest=Rest(duration_s=duration_s)), duration_s)

    def _align(self, step: Step) -> None:
        limits = self._procedure.limits
        self.rest(READY_S + limits.still_s + step.align_s + REACTION_S)

    def _turn(self, angle_deg: float, duration_s: float) -> None:
        """Rotate about the vertical, within a hand's accuracy."""
        lean = self._rng.normal(0.0, 2.0, 2) * 1e-3
        axis = (float(lean[0]), float(lean[1]), 1.0)
        self._about(axis, angle_deg, duration_s)

    def _about(self, axis_n: tuple[float, float, float], angle_deg: float, duration_s: float) -> None:
        rotate = Rotate(angle_deg=angle_deg, duration_s=duration_s, axis_n=axis_n)
        self._add(Segment(rotate=rotate), duration_s)
        self._C_nb = rotation(axis_n, radians(angle_deg)) @ self._C_nb

    def _carry(self, C_nb: Array) -> None:
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

    def _pose(self, step: Step) -> Array:
        """Return the attitude in which a person sets the unit down for a step."""
        heading = rotation((0.0, 0.0, 1.0), radians(self._rng.uniform(-8.0, 8.0)))
        lean = Attitude.from_rotvec([*(self._rng.normal(0.0, 1e-3, 2)), 0.0]).as_matrix()
        C_nb: Array = lean @ heading @ step.C_bn.T
        return C_nb

    def _wrong_pose(self, step: Step) -> Array:
        """Return a pose with another side up: the one that should face north."""
        C_nb: Array = rotation((1.0, 0.0, 0.0), radians(90.0)) @ self._pose(step)
        return C_nb

    def _is_in_pose(self, step: Step) -> bool:
        """Return whether the unit is in the pose of a step."""
        off = Attitude.from_matrix(self._C_nb @ step.C_bn)
        return bool(off.magnitude() < radians(20.0))


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
