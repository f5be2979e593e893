"""What a plan will show: the sigma of each number before anything is measured, and motions that add to it.

The plan is made into an evidence without errors, with turns from pose to pose at minimum jerk, and goes
through the equations of the adjustment.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from calib.axes import Side, opposite, vector
from calib.detection.rest_bins import Noise, RestBins
from calib.sensors.adjustment import MEASURED_GRAVITY, NORMAL_GRAVITY, Free, information, posterior
from calib.sensors.equations import Equations
from calib.sensors.evidence import Evidence, Link
from calib.sensors.motion import SAMPLE
from calib.sensors.observability import RATIO
from calib.sensors.parameters import NominalScales, Number, Parameters, start_parameters
from calib.sensors.rests import GUARD_S
from calib.sensors.result import free_numbers
from imudrv.arrays import Array
from imudrv.nav.earth import earth_rate_n
from imudrv.records import Records
from imudrv.sim.path import minimum_jerk
from imudrv.site import Site
from imudrv.units import ARCSEC, DEG, DEG_PER_SQRT_H, UG

TYPICAL_NOISE: Final = Noise(0.002 * DEG_PER_SQRT_H, 5 * UG)
"""Noise of a unit of the kind."""
TYPICAL_SCALES: Final = NominalScales(0.5 * ARCSEC, 2000.0)
TURN_S: Final = 4.0
"""Length of a turn by hand, s."""
LIFT_S: Final = 1.0
"""Time by which a hand lifts the unit before it turns it, and sets it down after that, s."""
MOTION_S: Final = TURN_S + 2.0 * LIFT_S
"""Length of a motion by hand, without the guards of the rests, s."""
WOBBLE: Final = 1.5 * DEG
_WOBBLE_HZ: Final = 1.3
"""How a hand sways in a motion, about each axis: it shows the sensing points and the skew."""
_SET_DOWN: Final = Rotation.from_rotvec([2e-3, -3e-3, 0.05]).as_matrix()
"""Tilt of the unit in its poses: exactly level, hardly a pulse would come in a second."""
_RATE_HZ: Final = 100.0
_ROOM_DEGC: Final = 25.0


class PlannedPose(NamedTuple):
    """A rest of a plan.

    Attributes
    ----------
    up, east : str
        Body axes that point up and about east, '+X' to '-Z'.
    degc : float
        Temperature of the unit.
    """

    up: Side
    east: Side
    degc: float = _ROOM_DEGC

    @property
    def C_nb(self) -> Array:
        """Attitude, east, north, up."""
        up, east = vector(self.up), vector(self.east)
        return np.stack([east, np.cross(up, east), up])


def turned(pose: PlannedPose) -> PlannedPose:
    """Return a pose turned half a circle about the vertical."""
    return pose._replace(east=opposite(pose.east))


@dataclass(frozen=True)
class SensorsPrediction:
    """What a plan shows.

    Attributes
    ----------
    numbers : tuple of Number
        Numbers of the certificate of a nominal unit.
    sigma : ndarray, shape (n,)
        In the units of the file.
    observable : tuple of bool
    rank : int
        Number of directions of the parameters that are observable.
    unknowns : int
        Number of parameters.
    """

    numbers: tuple[Number, ...]
    sigma: Array
    observable: tuple[bool, ...]
    rank: int
    unknowns: int

    @property
    def not_observable(self) -> tuple[str, ...]:
        """Paths of the numbers that are not observable."""
        return tuple(one.path for one, shown in zip(self.numbers, self.observable, strict=True) if not shown)


def predict_sensors(
    sessions: Sequence[Sequence[PlannedPose]],
    *,
    site: Site,
    rest_s: float = 60.0,
    motion_s: float = MOTION_S,
    wobble: float = WOBBLE,
    free: Free | None = None,
    noise: Noise = TYPICAL_NOISE,
    nominal: NominalScales = TYPICAL_SCALES,
) -> SensorsPrediction:
    """Predict what rests and the motions between them show.

    Parameters
    ----------
    sessions : sequence of sequence of PlannedPose
        Poses in order; motions are recorded within a session only.
    site : Site
        Place of the unit.
    rest_s, motion_s : float
        Length of each rest, and of each motion without the guards of the rests.
    wobble : float
        Amplitude by which the hand sways, rad; 0: a turntable, which lifts nothing.
    free : Free, optional
        Parameters to estimate.
    noise : Noise
        Noise of the unit.
    nominal : NominalScales
        Pulses of the unit.

    Returns
    -------
    SensorsPrediction
    """
    free = free or Free()
    plan = _Plan(site, noise, nominal, rest_s, motion_s, wobble)
    reference = float(np.mean([pose.degc for session in sessions for pose in session]))
    return plan.shown(
        [
            plan.information([one.C_nb for one in session], free, [one.degc for one in session], reference)
            for session in sessions
        ],
        free,
    )


class Addition(NamedTuple):
    """Motions to add to a session, and the numbers that they show."""

    text: str
    paths: tuple[str, ...]


def additions(
    sessions: Sequence[Sequence[Array]],
    lacking: Sequence[str],
    *,
    site: Site,
    rest_s: float,
    free: Free,
    noise: Noise = TYPICAL_NOISE,
    nominal: NominalScales = TYPICAL_SCALES,
    most: int = 3,
) -> Iterator[Addition]:
    """Yield the motions that would show what is not observable, those that show most first.

    Parameters
    ----------
    sessions : sequence of sequence of ndarray, shape (3, 3)
        Attitudes C_nb of the rests, those linked by motions together.
    lacking : sequence of str
        Paths of the numbers that are not observable.
    site, rest_s, free, noise, nominal
        As in `predict_sensors`.
    most : int
        Number of additions.
    """
    plan = _Plan(site, noise, nominal, rest_s, MOTION_S, WOBBLE)

    def of(attitudes: Sequence[Array]) -> Array:
        return plan.information(attitudes, free, [_ROOM_DEGC] * len(attitudes), _ROOM_DEGC)

    known, left = [of(session) for session in sessions], set(lacking)
    candidates = {text: of(attitudes) for text, attitudes in _candidates()}
    for _ in range(most):
        shows = {
            text: left - set(plan.shown([*known, extra], free).not_observable)
            for text, extra in candidates.items()
        }
        best = max(shows, key=lambda text: len(shows[text]))
        if not shows[best]:
            return
        yield Addition(best, tuple(path for path in lacking if path in shows[best]))
        left -= shows[best]
        known.append(candidates.pop(best))


@cache
def _loops() -> tuple[tuple[str, tuple[Array, ...]], ...]:
    loops = []
    sides: tuple[tuple[Side, Side], ...] = (("+Z", "+X"), ("+Z", "+Y"), ("+X", "+Z"))
    for up, east in sides:
        C, quarter = PlannedPose(up, east).C_nb, Rotation.from_rotvec(np.pi / 2 * vector(east)).as_matrix()
        attitudes = [C]
        for _ in range(4):
            attitudes.append(attitudes[-1] @ quarter)
        loops.append((east[1], tuple(attitudes)))
    return tuple(loops)


def _candidates() -> Iterator[tuple[str, list[Array]]]:
    """Yield motions that a person can make, the short ones first."""
    sides: tuple[tuple[Side, Side], ...] = (("+X", "+Y"), ("+Y", "+Z"), ("+Z", "+X"))
    for up, east in sides:
        up_pose = PlannedPose(up, east)
        yield f"{up} up, turned by half a circle in place", [up_pose.C_nb, turned(up_pose).C_nb]
    for axis, loop in _loops():
        yield f"four quarter turns about {axis} while it is level, a rest after each", list(loop)


class _Plan(NamedTuple):
    """What is the same for every plan of a unit."""

    site: Site
    noise: Noise
    nominal: NominalScales
    rest_s: float
    motion_s: float
    wobble: float

    @property
    def start(self) -> Parameters:
        """The nominal unit at the site."""
        earth = np.array(earth_rate_n(self.site.latitude_rad)[1:])
        return start_parameters(self.site.gravity, earth, self.nominal, None, "quadratic")

    def information(
        self, attitudes: Sequence[Array], free: Free, degc: Sequence[float], reference_degc: float
    ) -> Array:
        """Return what the rests and motions of a session say of the parameters."""
        p = self.start
        attitudes = [_SET_DOWN @ C for C in attitudes]
        rests = tuple(
            self._rest(k * (self.rest_s + self.motion_s), C, p, t)
            for k, (C, t) in enumerate(zip(attitudes, degc, strict=True))
        )
        links = tuple(
            Link(k, k + 1, _turn(before, after, p, self.motion_s, self.wobble))
            for k, (before, after) in enumerate(pairwise(attitudes))
        )
        quanta = (
            self.nominal.gyro if self.nominal.gyro_in_pulses else 0.0,
            1.0 / self.nominal.accelerometer if self.nominal.accelerometer_in_pulses else 0.0,
        )
        equations = Equations(
            Evidence(rests, links, (), self.noise, quanta), reference_degc, free.fixed_pivot
        )
        return information(equations.system(p, attitudes), len(rests), free)

    def shown(self, of_sessions: Sequence[Array], free: Free) -> SensorsPrediction:
        """Return what sessions show together, by the information of each."""
        p = self.start
        sigma_g = MEASURED_GRAVITY if self.site.gravity_m_s2 is not None else NORMAL_GRAVITY
        P, prior = posterior(sum(of_sessions, np.zeros(())), p, free, sigma_g)
        chosen, _, sigma, seen = free_numbers(p, p, free.basis @ P @ free.basis.T, self.nominal, free)
        ratios = eigh(P, prior, eigvals_only=True)
        return SensorsPrediction(
            tuple(chosen),
            np.array(sigma),
            tuple(seen),
            int(np.count_nonzero(ratios < RATIO**2)),
            len(P) - 1,  # gravity is no parameter of the unit
        )

    def _rest(self, at_s: float, C: Array, p: Parameters, degc: float) -> RestBins:
        bins = max(4, round(self.rest_s - 2.0 * GUARD_S))
        samples = round(_RATE_HZ)
        step = np.concatenate([C.T @ p.omega_ie_n, C.T @ p.f_n])
        sums = np.tile(step, (bins, 1))
        means = sums * 0.5 * (samples + 1) / samples
        return RestBins(0, 0, bins, at_s, 1.0, samples, sums, means, np.full(4, degc))


def _turn(before: Array, after: Array, p: Parameters, duration_s: float, wobble: float) -> Records:
    """Return the samples of a turn about one axis that sways about all three, without translation."""
    lift_s = LIFT_S if wobble else 0.0
    turning, guard = round((duration_s - 2.0 * lift_s) * _RATE_HZ), round((GUARD_S + lift_s) * _RATE_HZ)
    n, T = turning + 2 * guard, 1.0 / _RATE_HZ
    whole = Rotation.from_matrix(after @ before.T).as_rotvec()
    share = np.clip((np.arange(n + 1) - guard) / turning, 0.0, 1.0)
    part = np.array([minimum_jerk(u)[0] for u in share.tolist()])
    faded = np.sin(np.pi * part)[:, None] ** 2
    phases = 2.0 * np.pi * (_WOBBLE_HZ * T * np.arange(n + 1)[:, None] + np.arange(3) / 3.0)
    swaying = Rotation.from_rotvec(wobble * faded * np.sin(phases)).as_matrix()
    in_n = Rotation.from_rotvec(np.outer(part, whole)).as_matrix() @ before @ swaying
    earth = Rotation.from_rotvec(np.outer(np.arange(n + 1) * T, p.omega_ie_n)).as_matrix()
    inertial = Rotation.from_matrix(earth @ in_n)
    samples = np.zeros(n, SAMPLE)
    samples["T"] = T
    samples["gyro"] = (inertial[:-1].inv() * inertial[1:]).as_rotvec()
    forces = np.einsum("kij,i->kj", in_n, p.f_n)
    samples["accelerometer"] = 0.5 * T * (forces[:-1] + forces[1:])
    return samples
