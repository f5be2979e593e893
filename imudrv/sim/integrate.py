"""Motion of the body: exact rates and specific force, integrated over every sample interval.

Frames: n is local level (east, north, up), fixed to the bench, its origin where the pivot rests; b is
the body.

**Rates.** The attitude of a segment is `C_nb = C_nb0 R1 R2 R3`, elementary rotations about fixed axes. For
`C = C1 R` with `R` about the fixed axis u by the angle x(t), from the derivative of a product:

    omega = R^T omega1 + u x'        omega' = R^T omega1' + u x'' - u x' x (R^T omega1)

**Specific force.** The sensing point i is at `p_n + C_nb (s + r_i)` from the origin of n, with `p` the
displacement of the pivot and `s` the vector from the pivot to the origin of b. In the rotating n the pivot
has the acceleration `p''` and Coriolis'; the arm is rigid, its inertial acceleration is `Omega (s + r_i)`,
`Omega = [omega' x] + [omega x]^2`, with omega relative to inertial space:

    f_i = a_i . ( C_bn (p_n'' + 2 omega_ie_n x p_n' - g_n) + Omega (s + r_i) )

Neglected: the change of gravity along the arm and the displacement, 3.1e-6 / s^2 (0.03 ug over 0.1 m).

A motor adds its acceleration at the pivot; neglected is Coriolis' of its velocity, 1e-7 of the amplitude.

**Dither** rotates the case by `d(t)`, small: `R = I + [d x]`. Neglected: d^2/2, 3e-11 for 1.5 arcsec.
"""

from bisect import bisect_right
from math import cos, pi, sin
from typing import Final, NamedTuple

import numpy as np

from imudrv.arrays import Array
from imudrv.kernels import kernel
from imudrv.nav.attitude import rotate_about, rotation
from imudrv.sim.path import (
    Path,
    PathSegment,
    Quadrature,
    cycles_at,
    evaluate,
    new_path,
    path_segment,
    start_attitude,
    still,
)
from imudrv.sim.scenario import OneMotion, Scenario
from imudrv.vectors import Vector, add, cross, dot, row, scale

_NO_END: Final = 2**62
_AXES_N: Final = np.eye(3)


class Dithering(NamedTuple):
    """Sinusoidal angles about three axes, during the whole run."""

    axes_b: Array  # (3, 3), one axis per row
    amplitude_rad: Array  # (3,)
    rate: Array  # (3,), rad/s
    cycles: Array  # (3, 2), per sample interval, see `imudrv.sim.path.split_cycles`
    phase: Array  # (3,), cycles, at the start of the run


class Shaking(NamedTuple):
    """Sinusoidal acceleration of the pivot, during the whole run."""

    amplitude_n: Vector  # m/s^2
    rate: float  # rad/s
    cycles: Array  # (2,), per sample interval, see `imudrv.sim.path.split_cycles`


class Body(NamedTuple):
    """Constants of a run: the site and its motor, the geometry of the unit, the dither of its case."""

    interval_s: float
    gravity: float  # m/s^2
    omega_ie_n: Vector  # rad/s
    motor: Shaking
    pivot_to_origin_b: Vector  # m
    A: Array  # (3, 3), row i the sensing direction of accelerometer i in b
    r_b: Array  # (3, 3), row i the sensing point of accelerometer i from the origin of b, m
    case: Dithering


class Integrals(NamedTuple):
    """Integrals over sample intervals, one per row."""

    dtheta_b: Array  # (n, 3), integral of omega_ib_b, rad
    dv_b: Array  # (n, 3), integral of the specific force at the origin of b, m/s
    early: Array  # (n, 3), integral of f_i from the start of the interval to the split, m/s
    late: Array  # (n, 3), from the split to the end of the interval, m/s
    omega_ib_b: Array  # (n, 3), at the end of the interval, rad/s
    C_nb: Array  # (n, 3, 3), at the end of the interval


class Motion:
    """Motion of a scenario, in sample intervals; before and after it the body rests.

    Parameters
    ----------
    scenario : Scenario
        Start, motion and seed are used.
    body : Body
        The unit and the place; its `interval_s` is the sample interval.
    split_s : float
        Time from the start of an interval at which `Integrals.early` ends and `late` starts.

    Attributes
    ----------
    samples : int
        Number of sample intervals.
    """

    def __init__(self, scenario: Scenario, body: Body, split_s: float = 0.0) -> None:
        self._body = body
        bandwidth_hz = _case_bandwidth(body.case) + body.motor.rate / (2.0 * pi)
        quadrature = Quadrature(body.interval_s, split_s, bandwidth_hz)
        self._is_shaken = bandwidth_hz > 0.0
        self._quadrature, self._seed = quadrature, scenario.seed
        self._C_nb = start_attitude(scenario.start)
        self._before = self._after = still(_NO_END, self._C_nb, quadrature)
        self._segments: list[PathSegment] = []
        self._ends: list[int] = []
        self.samples = 0
        for motion in scenario.motions:
            self.append(motion)

    def append(self, motion: OneMotion) -> None:
        """Append a motion, before any of its intervals were asked for."""
        rng = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(1, len(self._segments))))
        part = path_segment(motion, self._C_nb, self._quadrature, rng)
        self._C_nb = self._C_nb @ rotation(part.axes_b[0], part.angle_rad)
        self._after = still(_NO_END, self._C_nb, self._quadrature)
        self._segments.append(part)
        self.samples += part.intervals
        self._ends.append(self.samples)

    def integrals(self, first: int, stop: int) -> Integrals:
        """Return the integrals over the sample intervals `first` to `stop - 1`.

        Parameters
        ----------
        first, stop : int
            Interval numbers from the start of the motion; before 0 and from `samples` on the body rests.

        Returns
        -------
        Integrals
            They depend on the interval alone: any ranges give the same bits.
        """
        n = stop - first
        dtheta_b, dv_b, early, late, omega_ib_b = np.empty((5, n, 3))
        out = Integrals(dtheta_b, dv_b, early, late, omega_ib_b, np.empty((n, 3, 3)))
        at = first
        while at < stop:
            now, begin, end = self._segment_at(at)
            upto = min(end, stop)
            part = Integrals(*(a[at - first : upto - first] for a in out))
            if now.is_still and not self._is_shaken:
                _integrate(now, self._body, 0, 0, Integrals(*(a[:1] for a in part)))
                for a in part:
                    a[1:] = a[:1]
            else:
                _integrate(now, self._body, at - begin, at, part)
            at = upto
        return out

    def _segment_at(self, interval: int) -> tuple[PathSegment, int, int]:
        """Return the segment of an interval, with its first interval and the one after its last."""
        if interval < 0:
            return self._before, -_NO_END, 0
        if interval >= self.samples:
            return self._after, self.samples, _NO_END
        number = bisect_right(self._ends, interval)
        found, end = self._segments[number], self._ends[number]
        return found, end - found.intervals, end


def _case_bandwidth(case: Dithering) -> float:
    shaking = case.amplitude_rad > 0.0
    # the square of omega doubles the frequency
    return float(2.0 * np.max(case.rate[shaking]) / (2.0 * pi)) if shaking.any() else 0.0


@kernel
def _integrate(segment: PathSegment, body: Body, first: int, run: int, out: Integrals) -> None:
    """Fill `out` from interval `first` of the segment, which is interval `run` of the run."""
    path = new_path(segment)
    for i in range(out.dtheta_b.shape[0]):
        evaluate(segment, body.interval_s, first + i, path)
        dtheta, dv = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        early, late = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for j in range(segment.nodes.offset_s.size):
            turn = _turn(segment, body, run + i, path, j)
            omega, omega_dot = _rates(segment, body, turn, path, j)
            f = _into_b(_force_n(segment, body, run + i, path, j), segment, turn)
            weight = segment.nodes.weight_s[j]
            dtheta = add(dtheta, scale(weight, omega))
            f_o = add(f, _omega_times(omega, omega_dot, body.pivot_to_origin_b))
            dv = add(dv, scale(weight, f_o))
            f_x = dot(row(body.A, 0), add(f_o, _omega_times(omega, omega_dot, row(body.r_b, 0))))
            f_y = dot(row(body.A, 1), add(f_o, _omega_times(omega, omega_dot, row(body.r_b, 1))))
            f_z = dot(row(body.A, 2), add(f_o, _omega_times(omega, omega_dot, row(body.r_b, 2))))
            if j < segment.nodes.early:
                early = add(early, scale(weight, (f_x, f_y, f_z)))
            else:
                late = add(late, scale(weight, (f_x, f_y, f_z)))
        for m in range(3):  # the last node is the end of the interval
            out.dtheta_b[i, m] = dtheta[m]
            out.dv_b[i, m] = dv[m]
            out.early[i, m] = early[m]
            out.late[i, m] = late[m]
            out.omega_ib_b[i, m] = omega[m]
            # a row of C_nb is an axis of n in b
            axis_b = _into_b(row(_AXES_N, m), segment, turn)
            out.C_nb[i, m, 0], out.C_nb[i, m, 1], out.C_nb[i, m, 2] = axis_b


class _Turn(NamedTuple):
    """Rotation since the start of the segment, at one node."""

    cosine: Vector  # of the elementary angles
    sine: Vector
    case: Vector  # small angles of the dither of the case, and two derivatives
    case_rate: Vector
    case_acceleration: Vector


@kernel
def _turn(segment: PathSegment, body: Body, interval: int, path: Path, j: int) -> _Turn:
    angle, rate, acceleration = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    case = body.case
    for g in range(3):
        if case.amplitude_rad[g] != 0.0:
            w = case.rate[g]
            phase = (
                2.0 * pi * (cycles_at(case.cycles[g], interval) + case.phase[g])
                + w * segment.nodes.offset_s[j]
            )
            u = scale(case.amplitude_rad[g], row(case.axes_b, g))
            angle = add(angle, scale(sin(phase), u))
            rate = add(rate, scale(w * cos(phase), u))
            acceleration = add(acceleration, scale(-w * w * sin(phase), u))
    x = path.x
    return _Turn(
        (cos(x[0, j]), cos(x[1, j]), cos(x[2, j])),
        (sin(x[0, j]), sin(x[1, j]), sin(x[2, j])),
        angle,
        rate,
        acceleration,
    )


@kernel
def _into_b(v_n: Vector, segment: PathSegment, turn: _Turn) -> Vector:
    """Return `C_bn v_n`."""
    v_b = add(
        add(scale(v_n[0], row(segment.C_nb, 0)), scale(v_n[1], row(segment.C_nb, 1))),
        scale(v_n[2], row(segment.C_nb, 2)),
    )
    for r in range(3):
        v_b = rotate_about(v_b, row(segment.axes_b, r), turn.cosine[r], -turn.sine[r])
    return add(v_b, cross(v_b, turn.case))


@kernel
def _rates(segment: PathSegment, body: Body, turn: _Turn, path: Path, j: int) -> tuple[Vector, Vector]:
    """Return `omega_ib_b` and its derivative."""
    omega, omega_dot = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for r in range(3):
        u = row(segment.axes_b, r)
        before = rotate_about(omega, u, turn.cosine[r], -turn.sine[r])
        omega_dot = rotate_about(omega_dot, u, turn.cosine[r], -turn.sine[r])
        omega_dot = add(omega_dot, add(scale(path.a[r, j], u), scale(path.v[r, j], cross(before, u))))
        omega = add(before, scale(path.v[r, j], u))
    omega_dot = add(omega_dot, add(cross(omega_dot, turn.case), cross(omega, turn.case_rate)))
    omega_dot = add(omega_dot, turn.case_acceleration)
    omega = add(omega, add(cross(omega, turn.case), turn.case_rate))
    # the Earth rate is constant in n; in b it changes with the attitude
    omega_ie_b = _into_b(body.omega_ie_n, segment, turn)
    return add(omega, omega_ie_b), add(omega_dot, cross(omega_ie_b, omega))


@kernel
def _force_n(segment: PathSegment, body: Body, interval: int, path: Path, j: int) -> Vector:
    """Return the specific force at the pivot, in n."""
    v, a, motor = path.v, path.a, body.motor
    coriolis = scale(2.0, cross(body.omega_ie_n, (v[3, j], v[4, j], v[5, j])))
    force = add(add((a[3, j], a[4, j], a[5, j]), coriolis), (0.0, 0.0, body.gravity))
    if motor.rate == 0.0:
        return force
    phase = 2.0 * pi * cycles_at(motor.cycles, interval) + motor.rate * segment.nodes.offset_s[j]
    return add(force, scale(sin(phase), motor.amplitude_n))


@kernel
def _omega_times(omega: Vector, omega_dot: Vector, r: Vector) -> Vector:
    """Return `Omega r`, the acceleration of the point r relative to the origin of b."""
    return add(cross(omega_dot, r), cross(omega, cross(omega, r)))
