"""Motion of the body: exact rates and specific force, integrated over every sample interval.

Frames: n is local level (east, north, up), fixed to the bench, its origin at the pivot's place of rest; b is
the body.

**Rates.** The attitude of a segment is `C_nb = C_nb0 R1 R2 R3`, elementary rotations about fixed axes. For
`C = C1 R` with `R` about the fixed axis u by the angle x(t), from the derivative of a product:

    omega = R^T omega1 + u x'        omega' = R^T omega1' + u x'' - u x' x (R^T omega1)

**Specific force.** The sensing point i lies at `p_n + C_nb (s + r_i)` from the origin of n, `p` the pivot's
way, `s` from the pivot to the origin of b. The rotating n sees the acceleration `p''` and Coriolis'; the arm
is rigid, its inertial acceleration is `Omega (s + r_i)`, `Omega = [omega' x] + [omega x]^2`, omega being that
relative to inertial space:

    f_i = a_i . ( C_bn (p_n'' + 2 omega_ie_n x p_n' - g_n) + Omega (s + r_i) )

Left out: the change of gravity over the arm and the way, 3.1e-6 / s^2 (0.03 ug over 0.1 m).

**Dither** turns the case by `d(t)`, small: `R = I + [d x]`. Left out: d^2/2, 3e-11 for 1.5 arcsec.

**Integrals** are Gauss-Legendre over panels of 1 ms at the most, of the order that the fastest content needs.
"""

from math import ceil, cos, exp, floor, lgamma, log, pi, radians, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from imudrv.arrays import Array
from imudrv.kernels import kernel
from imudrv.nav.attitude import rotate_about, rotation
from imudrv.sim.scenario import Rest, Rock, Rotate, Scenario, Start, Vibrate, intervals
from imudrv.units import DEG, MM, NS, STANDARD_GRAVITY
from imudrv.vectors import Vector, add, cross, dot, row, scale

SINUSOIDS = 32
"""Sinusoids in a random motion."""
PANEL_S = 1e-3
"""Longest stretch that one Gauss-Legendre rule covers, s."""
ACCURACY = 1e-15
"""Largest error of the rule, relative to the amplitude of the fastest content."""

_POSES = {
    "z_up": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "x_up": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    "y_up": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
}
_NO_END = 2**62
_AXES_N = np.eye(3)


class Dithering(NamedTuple):
    """Sinusoidal angles about three axes, over the whole run."""

    axes_b: Array  # (3, 3), a row an axis
    amplitude_rad: Array  # (3,)
    rate: Array  # (3,), rad/s
    cycles: Array  # (3, 2), a sample interval's, see `split_cycles`
    phase: Array  # (3,), cycles, at the beginning of the run


class Body(NamedTuple):
    """What stays the same over the run: the place, the geometry of the unit, the dither of its case."""

    interval_s: float
    gravity: float  # m/s^2
    omega_ie_n: Vector  # rad/s
    pivot_to_origin_b: Vector  # m
    A: Array  # (3, 3), row i the sensing direction of accelerometer i in b
    r_b: Array  # (3, 3), row i the sensing point of accelerometer i from the origin of b, m
    case: Dithering


class Integrals(NamedTuple):
    """One row a sample interval."""

    dtheta_b: Array  # (n, 3), integral of omega_ib_b, rad
    dv_b: Array  # (n, 3), integral of the specific force at the origin of b, m/s
    early: Array  # (n, 3), integral of f_i from the interval's beginning to the split, m/s
    late: Array  # (n, 3), and from the split to the interval's end
    omega_ib_b: Array  # (n, 3), at the interval's end, rad/s
    C_nb: Array  # (n, 3, 3), at the interval's end


class _Segment(NamedTuple):
    """A stretch of motion as the kernels take it; a path's rows are three angles and the pivot's way in n."""

    intervals: int
    C_nb: Array  # (3, 3), at the beginning
    axes_b: Array  # (3, 3), a row an elementary rotation's axis
    turn_rad: float  # of the rotation from rest to rest, about the first axis
    ramp: int  # intervals in which the sinusoids are faded in, and out
    rate: Array  # (m,), of the sinusoids, rad/s
    cycles: Array  # (m, 2), a sample interval's
    cosine: Array  # (6, m), amplitudes, rad or m
    sine: Array  # (6, m)
    offset_s: Array  # (j,), nodes from the interval's beginning; the last is its end, without weight
    weight_s: Array  # (j,)
    early: int  # nodes before the split
    offset_cosine: Array  # (m, j), of rate * offset
    offset_sine: Array  # (m, j)


class Motion:
    """The motion of a scenario, in sample intervals; before it and after it the body rests.

    Parameters
    ----------
    scenario : Scenario
        Start, motion and seed are used.
    body : Body
        The unit and the place; its `interval_s` is the sample interval.
    interval_ns : int
        The sample interval.
    split_s : float
        Where `Integrals.early` ends and `late` begins, within the interval.

    Attributes
    ----------
    samples : int
        Sample intervals from beginning to end.
    """

    def __init__(self, scenario: Scenario, body: Body, interval_ns: int, split_s: float = 0.0) -> None:
        self._body = body
        self._split_s = split_s
        self._rule = _Rule(interval_ns * NS, split_s, _case_bandwidth(body.case))
        C_nb = start_attitude(scenario.start)
        self._segments = []
        for number, entry in enumerate(scenario.motion):
            rng = np.random.default_rng(np.random.SeedSequence(scenario.seed, spawn_key=(1, number)))
            segment = _segment(entry.motion, C_nb, self._rule, rng)
            self._segments.append(segment)
            C_nb = C_nb @ rotation(segment.axes_b[0], segment.turn_rad)
        self._ends = np.cumsum([s.intervals for s in self._segments])
        self.samples = int(self._ends[-1])
        self._before = _still(_NO_END, self._segments[0].C_nb, self._rule)
        self._after = _still(_NO_END, C_nb, self._rule)

    def integrals(self, first: int, stop: int) -> Integrals:
        """Integrals over the sample intervals `first` to `stop - 1`.

        Parameters
        ----------
        first, stop : int
            Counted from the beginning of the motion; before 0 and from `samples` on the body rests.

        Returns
        -------
        Integrals
            A function of the interval alone: any ranges give the same bits.
        """
        n = stop - first
        dtheta_b, dv_b, early, late, omega_ib_b = np.empty((5, n, 3))
        out = Integrals(dtheta_b, dv_b, early, late, omega_ib_b, np.empty((n, 3, 3)))
        at = first
        while at < stop:
            segment, begin, end = self._segment_at(at)
            upto = min(end, stop)
            part = Integrals(*(a[at - first : upto - first] for a in out))
            if _is_still(segment) and not self._body.case.amplitude_rad.any():
                _integrate(segment, self._body, 0, 0, Integrals(*(a[:1] for a in part)))
                for a in part:
                    a[1:] = a[:1]
            else:
                _integrate(segment, self._body, at - begin, at, part)
            at = upto
        return out

    def _segment_at(self, interval: int) -> tuple[_Segment, int, int]:
        if interval < 0:
            return self._before, -_NO_END, 0
        if interval >= self.samples:
            return self._after, self.samples, _NO_END
        number = int(np.searchsorted(self._ends, interval, side="right"))
        segment, end = self._segments[number], int(self._ends[number])
        return segment, end - segment.intervals, end


def start_attitude(start: Start) -> Array:
    """Attitude before the motion begins.

    Parameters
    ----------
    start : Start
        Pose, heading, tilt.

    Returns
    -------
    ndarray, shape (3, 3)
        `C_nb`.
    """
    heading = rotation((0.0, 0.0, 1.0), -radians(start.heading_deg))
    C_nb: Array = _leaning(start.tilt_mrad) @ heading @ np.array(_POSES[start.pose])
    return C_nb


def split_cycles(frequency_hz: ArrayLike, interval_s: float) -> Array:
    """Cycles in a sample interval as a sum of two numbers, for `cycles_at`.

    Parameters
    ----------
    frequency_hz : array_like, shape (m,)
    interval_s : float

    Returns
    -------
    ndarray, shape (m, 2)
        A number of 26 bits after the point, so that its multiples are exact, and the small rest.
    """
    cycles = np.asarray(frequency_hz, np.float64) * interval_s
    coarse = np.rint(cycles * 2.0**26) / 2.0**26
    return np.stack([coarse, np.asarray(cycles - coarse, np.float64)], axis=-1)


@kernel
def cycles_at(cycles: Array, interval: int) -> float:
    """Cycles since the beginning at the beginning of an interval, whole ones dropped: exact after hours."""
    coarse = interval * cycles[0]
    fraction: float = coarse - floor(coarse) + interval * cycles[1]
    return fraction


class _Rule(NamedTuple):
    interval_s: float
    split_s: float
    bandwidth_hz: float  # of what is added to any motion

    def nodes(self, bandwidth_hz: float) -> tuple[Array, Array, int]:
        """Nodes and weights over an interval, and how many nodes lie before the split."""
        bandwidth_hz += self.bandwidth_hz
        early, early_weights = _panels(0.0, self.split_s, bandwidth_hz)
        late, late_weights = _panels(self.split_s, self.interval_s, bandwidth_hz)
        offsets = np.concatenate([early, late, [self.interval_s]])
        return offsets, np.concatenate([early_weights, late_weights, [0.0]]), early.size


def _panels(begin_s: float, end_s: float, bandwidth_hz: float) -> tuple[Array, Array]:
    panels = ceil((end_s - begin_s) / PANEL_S - 1e-9)
    if panels == 0:
        return np.empty(0), np.empty(0)
    half = 0.5 * (end_s - begin_s) / panels
    x, w = np.polynomial.legendre.leggauss(_order(2.0 * half, bandwidth_hz))
    middles = begin_s + half * (2 * np.arange(panels) + 1)
    return np.ravel(middles[:, None] + half * x), np.tile(half * w, panels)


def _order(length_s: float, bandwidth_hz: float) -> int:
    """Nodes that integrate `cos(2 pi bandwidth t)` over the length to `ACCURACY`.

    The remainder of the n-point rule on [-1, 1] is `2^(2n+1) (n!)^4 / ((2n+1) ((2n)!)^3)` times the 2n-th
    derivative (Abramowitz and Stegun, 25.4.30).
    """
    k = pi * bandwidth_hz * length_s
    n = 1
    while k > 0.0:
        constant = (2 * n + 1) * log(2.0) + 4.0 * lgamma(n + 1) - log(2 * n + 1) - 3.0 * lgamma(2 * n + 1)
        if exp(constant + 2 * n * log(k)) < ACCURACY:
            break
        n += 1
    return n


def _case_bandwidth(case: Dithering) -> float:
    shaking = case.amplitude_rad > 0.0
    # omega squared doubles the frequency
    return float(2.0 * np.max(case.rate[shaking]) / (2.0 * pi)) if shaking.any() else 0.0


def _leaning(tilt_mrad: tuple[float, float]) -> Array:
    """Rotation that leans the vertical by so much to the east and to the north."""
    east, north = (1e-3 * t for t in tilt_mrad)
    angle = float(np.hypot(east, north))
    return rotation((-north, east, 0.0), angle) if angle else np.eye(3)


def _segment(
    motion: Rest | Rotate | Rock | Vibrate, C_nb: Array, rule: _Rule, rng: np.random.Generator
) -> _Segment:
    count = intervals(motion.duration_s, rule.interval_s)
    if isinstance(motion, Rotate):
        return _rotate(motion, count, C_nb, rule)
    if isinstance(motion, Rest):
        return _still(count, C_nb, rule)
    rates = np.array(motion.rate_rms_deg_per_s) * DEG
    if isinstance(motion, Rock):
        segment = _shake(motion, count, C_nb, rates, np.array(motion.sway_mm) * MM, 0, rule, rng)
        return (
            segment
            if motion.rate_peak_deg_per_s is None
            else _bounded(segment, motion.rate_peak_deg_per_s * DEG, rule)
        )
    return _shake(motion, count, C_nb, rates, np.array(motion.g_rms) * STANDARD_GRAVITY, 2, rule, rng)


def _still(count: int, C_nb: Array, rule: _Rule) -> _Segment:
    none = np.empty(0)
    offset_s, weight_s, early = rule.nodes(0.0)
    amplitudes, offsets = np.empty((6, 0)), np.empty((0, offset_s.size))
    return _Segment(
        count,
        C_nb,
        np.eye(3),
        0.0,
        0,
        none,
        np.empty((0, 2)),
        amplitudes,
        amplitudes,
        offset_s,
        weight_s,
        early,
        offsets,
        offsets,
    )


def _is_still(segment: _Segment) -> bool:
    return segment.turn_rad == 0.0 and segment.rate.size == 0


def _rotate(motion: Rotate, count: int, C_nb: Array, rule: _Rule) -> _Segment:
    turn = radians(motion.angle_deg)
    axis_n = (
        np.array(motion.axis_n)
        if motion.axis_n is not None
        else _leaning(motion.axis_tilt_mrad or (0.0, 0.0))[:, 2]
    )
    axis_b = C_nb.T @ (axis_n / np.linalg.norm(axis_n))
    # The quintic's fastest rate is 15/8 of the mean; four times that for products of cosines of the angle.
    bandwidth_hz = 4.0 * 1.875 * abs(turn) / (count * rule.interval_s) / (2.0 * pi)
    offset_s, weight_s, early = rule.nodes(bandwidth_hz)
    return _still(count, C_nb, rule)._replace(
        axes_b=np.array([axis_b, axis_b, axis_b]),
        turn_rad=turn,
        offset_s=offset_s,
        weight_s=weight_s,
        early=early,
        offset_cosine=np.empty((0, offset_s.size)),
        offset_sine=np.empty((0, offset_s.size)),
    )


def _shake(
    motion: Rock | Vibrate,
    count: int,
    C_nb: Array,
    angle_rate_rms: Array,
    way_rms: Array,
    derivative: int,
    rule: _Rule,
    rng: np.random.Generator,
) -> _Segment:
    """Draw sums of sinusoids of equal share in the rms; `way_rms` is that of the way's `derivative`."""
    low, high = motion.band_hz
    frequency = low + (high - low) * (np.arange(SINUSOIDS) + rng.random(SINUSOIDS)) / SINUSOIDS
    phase = 2.0 * pi * rng.random((6, SINUSOIDS))
    rate = 2.0 * pi * frequency
    share = np.sqrt(2.0 / SINUSOIDS)
    amplitude = share * np.concatenate([angle_rate_rms[:, None] / rate, way_rms[:, None] / rate**derivative])
    cosine, sine = amplitude * np.cos(phase), amplitude * np.sin(phase)
    # Omega doubles the band; the attitude is modulated by the angles, whose rates at worst all add up.
    fastest = float(np.sum(share * angle_rate_rms) * SINUSOIDS)
    offset_s, weight_s, early = rule.nodes(2.0 * high + 2.0 * fastest / (2.0 * pi))
    return _Segment(
        intervals=count,
        C_nb=C_nb,
        axes_b=np.eye(3),
        turn_rad=0.0,
        ramp=max(1, min(round(motion.ramp_s / rule.interval_s), count // 2)),
        rate=rate,
        cycles=split_cycles(frequency, rule.interval_s),
        cosine=cosine,
        sine=sine,
        offset_s=offset_s,
        weight_s=weight_s,
        early=early,
        offset_cosine=np.cos(np.outer(rate, offset_s)),
        offset_sine=np.sin(np.outer(rate, offset_s)),
    )


def _bounded(segment: _Segment, peak: float, rule: _Rule) -> _Segment:
    """Make those rotations smaller whose rates beat `peak` at the end of a sample."""
    found = np.zeros(3)
    ends = segment._replace(
        offset_s=segment.offset_s[-1:],
        offset_cosine=segment.offset_cosine[:, -1:].copy(),
        offset_sine=segment.offset_sine[:, -1:].copy(),
    )
    _fastest(ends, rule.interval_s, found)
    smaller = np.ones((6, 1))
    smaller[:3, 0] = np.minimum(1.0, peak / np.maximum(found, peak))
    return segment._replace(cosine=smaller * segment.cosine, sine=smaller * segment.sine)


@kernel
def _fastest(segment: _Segment, interval_s: float, found: Array) -> None:
    nodes = segment.offset_s.size
    x, v, a = np.empty((6, nodes)), np.empty((6, nodes)), np.empty((6, nodes))
    c, s = np.empty(nodes), np.empty(nodes)
    for k in range(segment.intervals):
        _path(segment, interval_s, k, x, v, a, c, s)
        for r in range(3):
            for j in range(nodes):
                found[r] = max(found[r], abs(v[r, j]))


@kernel
def _path(
    segment: _Segment, interval_s: float, k: int, x: Array, v: Array, a: Array, c: Array, s: Array
) -> None:
    """Fill x, v, a (6, nodes) with the path in interval k and its derivatives; c, s are room to work."""
    x[:] = 0.0
    v[:] = 0.0
    a[:] = 0.0
    nodes = segment.offset_s.size
    if segment.turn_rad != 0.0:
        whole = segment.intervals * interval_s
        for j in range(nodes):
            e0, e1, e2 = _smooth((k * interval_s + segment.offset_s[j]) / whole)
            x[0, j] = segment.turn_rad * e0
            v[0, j] = segment.turn_rad * e1 / whole
            a[0, j] = segment.turn_rad * e2 / whole**2
    for m in range(segment.rate.size):
        rate = segment.rate[m]
        angle = 2.0 * pi * cycles_at(segment.cycles[m], k)
        c0, s0 = cos(angle), sin(angle)
        for j in range(nodes):
            c[j] = c0 * segment.offset_cosine[m, j] - s0 * segment.offset_sine[m, j]
            s[j] = s0 * segment.offset_cosine[m, j] + c0 * segment.offset_sine[m, j]
        for r in range(6):
            p, q = segment.cosine[r, m], segment.sine[r, m]
            if p != 0.0 or q != 0.0:
                for j in range(nodes):
                    value = p * c[j] + q * s[j]
                    x[r, j] += value
                    v[r, j] += rate * (q * c[j] - p * s[j])
                    a[r, j] -= rate * rate * value
    after = segment.intervals - k
    if segment.rate.size > 0 and (k < segment.ramp or after <= segment.ramp):
        ramp = segment.ramp * interval_s
        for j in range(nodes):
            if k < segment.ramp:
                e0, e1, e2 = _smooth((k * interval_s + segment.offset_s[j]) / ramp)
            else:
                e0, e1, e2 = _smooth((after * interval_s - segment.offset_s[j]) / ramp)
                e1 = -e1
            e1 /= ramp
            e2 /= ramp**2
            for r in range(6):
                a[r, j] = e0 * a[r, j] + 2.0 * e1 * v[r, j] + e2 * x[r, j]
                v[r, j] = e0 * v[r, j] + e1 * x[r, j]
                x[r, j] = e0 * x[r, j]


@kernel
def _smooth(u: float) -> Vector:
    """Quintic from 0 to 1 with both derivatives zero at both ends, and these derivatives."""
    w = 1.0 - u
    return u * u * u * (10.0 + u * (6.0 * u - 15.0)), 30.0 * u * u * w * w, 60.0 * u * w * (w - u)


@kernel
def _integrate(segment: _Segment, body: Body, first: int, run: int, out: Integrals) -> None:
    """Fill `out` from the segment's interval `first`, which is the run's interval `run`."""
    nodes = segment.offset_s.size
    x, v, a = np.empty((6, nodes)), np.empty((6, nodes)), np.empty((6, nodes))
    c, s = np.empty(nodes), np.empty(nodes)
    for i in range(out.dtheta_b.shape[0]):
        _path(segment, body.interval_s, first + i, x, v, a, c, s)
        dtheta, dv = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        early, late = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        for j in range(nodes):
            turn = _turn(segment, body, run + i, j, x)
            omega, omega_dot = _rates(segment, body, turn, v, a, j)
            f = _into_b(_force_n(body, v, a, j), segment, turn)
            weight = segment.weight_s[j]
            dtheta = add(dtheta, scale(weight, omega))
            f_o = add(f, _omega_times(omega, omega_dot, body.pivot_to_origin_b))
            dv = add(dv, scale(weight, f_o))
            f_x = dot(row(body.A, 0), add(f_o, _omega_times(omega, omega_dot, row(body.r_b, 0))))
            f_y = dot(row(body.A, 1), add(f_o, _omega_times(omega, omega_dot, row(body.r_b, 1))))
            f_z = dot(row(body.A, 2), add(f_o, _omega_times(omega, omega_dot, row(body.r_b, 2))))
            if j < segment.early:
                early = add(early, scale(weight, (f_x, f_y, f_z)))
            else:
                late = add(late, scale(weight, (f_x, f_y, f_z)))
        for m in range(3):  # the last node is the interval's end
            out.dtheta_b[i, m] = dtheta[m]
            out.dv_b[i, m] = dv[m]
            out.early[i, m] = early[m]
            out.late[i, m] = late[m]
            out.omega_ib_b[i, m] = omega[m]
            # a row of C_nb is an axis of n seen from b
            axis_b = _into_b(row(_AXES_N, m), segment, turn)
            out.C_nb[i, m, 0], out.C_nb[i, m, 1], out.C_nb[i, m, 2] = axis_b


class _Turn(NamedTuple):
    """The turn since the segment's beginning, at one node."""

    cosine: Vector  # of the elementary angles
    sine: Vector
    case: Vector  # small angles of the case's dither, with two derivatives
    case_rate: Vector
    case_acceleration: Vector


@kernel
def _turn(segment: _Segment, body: Body, interval: int, j: int, x: Array) -> _Turn:
    angle, rate, acceleration = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    case = body.case
    for g in range(3):
        if case.amplitude_rad[g] != 0.0:
            w = case.rate[g]
            phase = 2.0 * pi * (cycles_at(case.cycles[g], interval) + case.phase[g]) + w * segment.offset_s[j]
            u = scale(case.amplitude_rad[g], row(case.axes_b, g))
            angle = add(angle, scale(sin(phase), u))
            rate = add(rate, scale(w * cos(phase), u))
            acceleration = add(acceleration, scale(-w * w * sin(phase), u))
    return _Turn(
        (cos(x[0, j]), cos(x[1, j]), cos(x[2, j])),
        (sin(x[0, j]), sin(x[1, j]), sin(x[2, j])),
        angle,
        rate,
        acceleration,
    )


@kernel
def _into_b(v_n: Vector, segment: _Segment, turn: _Turn) -> Vector:
    """`C_bn v_n`."""
    v_b = add(
        add(scale(v_n[0], row(segment.C_nb, 0)), scale(v_n[1], row(segment.C_nb, 1))),
        scale(v_n[2], row(segment.C_nb, 2)),
    )
    for r in range(3):
        v_b = rotate_about(v_b, row(segment.axes_b, r), turn.cosine[r], -turn.sine[r])
    return add(v_b, cross(v_b, turn.case))


@kernel
def _rates(segment: _Segment, body: Body, turn: _Turn, v: Array, a: Array, j: int) -> tuple[Vector, Vector]:
    """`omega_ib_b` and its derivative."""
    omega, omega_dot = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    for r in range(3):
        u = row(segment.axes_b, r)
        before = rotate_about(omega, u, turn.cosine[r], -turn.sine[r])
        omega_dot = rotate_about(omega_dot, u, turn.cosine[r], -turn.sine[r])
        omega_dot = add(omega_dot, add(scale(a[r, j], u), scale(v[r, j], cross(before, u))))
        omega = add(before, scale(v[r, j], u))
    omega_dot = add(omega_dot, add(cross(omega_dot, turn.case), cross(omega, turn.case_rate)))
    omega_dot = add(omega_dot, turn.case_acceleration)
    omega = add(omega, add(cross(omega, turn.case), turn.case_rate))
    # the Earth's rate is constant in n, so its derivative in b is that of a vector at rest
    omega_ie_b = _into_b(body.omega_ie_n, segment, turn)
    return add(omega, omega_ie_b), add(omega_dot, cross(omega_ie_b, omega))


@kernel
def _force_n(body: Body, v: Array, a: Array, j: int) -> Vector:
    """Specific force at the pivot."""
    coriolis = scale(2.0, cross(body.omega_ie_n, (v[3, j], v[4, j], v[5, j])))
    return add(add((a[3, j], a[4, j], a[5, j]), coriolis), (0.0, 0.0, body.gravity))


@kernel
def _omega_times(omega: Vector, omega_dot: Vector, r: Vector) -> Vector:
    """`Omega r`: what a point at r feels more than the origin."""
    return add(cross(omega_dot, r), cross(omega, cross(omega, r)))
