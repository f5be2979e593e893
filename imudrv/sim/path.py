"""Path of the body in one segment of motion, and the nodes to integrate over it.

A path has six coordinates: three elementary angles about axes fixed to the body, and the displacement of the
pivot in n. A rotation follows the quintic from rest to rest; its wobble, rock and vibration are sums of
sinusoids, faded in and out by the same quintic.

**Integrals** are Gauss-Legendre over panels of at most 1 ms, of the order that the highest frequency needs.
"""

from math import ceil, cos, exp, floor, hypot, lgamma, log, pi, radians, sin
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from imudrv.arrays import Array
from imudrv.kernels import kernel
from imudrv.nav.attitude import rotation
from imudrv.sim.scenario import Carry, OneMotion, Rest, Rock, Rotate, Side, Start, Vibrate, intervals
from imudrv.units import ARCSEC, DEG, MM, STANDARD_GRAVITY
from imudrv.vectors import Vector

SINUSOIDS: Final = 32
"""Sinusoids in a random motion."""
PANEL_S: Final = 1e-3
"""Longest panel of the Gauss-Legendre rule, s."""
ACCURACY: Final = 1e-15
"""Largest error of the rule, relative to the amplitude of the highest frequency."""

_POSES: Final = {
    "z_up": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "x_up": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    "y_up": ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
}


class Nodes(NamedTuple):
    """Nodes of the quadrature over one sample interval."""

    offset_s: Array  # (j,), from the start of the interval; the last is its end, with weight 0
    weight_s: Array  # (j,)
    early: int  # number of nodes before the split


class PathSegment(NamedTuple):
    """One segment of motion, as the kernels take it."""

    intervals: int
    C_nb: Array  # (3, 3), at the start
    axes_b: Array  # (3, 3), row r the axis of elementary rotation r
    angle_rad: float  # of the rotation from rest to rest, about the first axis
    ramp: int  # intervals in which the sinusoids are faded in, and out; not the rotation
    rate: Array  # (m,), of the sinusoids, rad/s
    cycles: Array  # (m, 2), per sample interval, see `split_cycles`
    cosine: Array  # (6, m), amplitudes, rad or m
    sine: Array  # (6, m)
    nodes: Nodes
    offset_cosine: Array  # (m, j), of rate * offset
    offset_sine: Array  # (m, j)

    @property
    def is_still(self) -> bool:
        """Whether the body rests."""
        return self.angle_rad == 0.0 and self.rate.size == 0


class Path(NamedTuple):
    """Path at the nodes of one interval, with its derivatives."""

    x: Array  # (6, j), rad and m
    v: Array  # (6, j)
    a: Array  # (6, j)
    cosine: Array  # (j,), one sinusoid at the nodes
    sine: Array  # (j,)


def start_attitude(start: Start) -> Array:
    """Return the attitude before the motion starts.

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
    C_nb: Array = _tilted(start.tilt_mrad) @ heading @ np.array(_POSES[start.pose])
    return C_nb


def split_cycles(frequency_hz: ArrayLike, interval_s: float) -> Array:
    """Return the cycles per sample interval as a sum of two numbers, for `cycles_at`.

    Parameters
    ----------
    frequency_hz : array_like, shape (m,)
        Frequencies.
    interval_s : float
        Sample interval.

    Returns
    -------
    ndarray, shape (m, 2)
        A number with 26 fractional bits, so that its multiples are exact, and the small remainder.
    """
    cycles = np.asarray(frequency_hz, np.float64) * interval_s
    coarse = np.rint(cycles * 2.0**26) / 2.0**26
    return np.stack([coarse, np.asarray(cycles - coarse, np.float64)], axis=-1)


@kernel
def cycles_at(cycles: Array, interval: int) -> float:
    """Return the fractional cycles from the start of the run to that of an interval, exact after hours."""
    coarse = interval * cycles[0]
    fraction: float = coarse - floor(coarse) + interval * cycles[1]
    return fraction


class Quadrature(NamedTuple):
    """How to place the nodes in a sample interval, which is split in two."""

    interval_s: float
    split_s: float
    bandwidth_hz: float  # of what is added to every path: the dither of the case

    def nodes(self, bandwidth_hz: float) -> Nodes:
        """Return the nodes for a path of a given bandwidth."""
        bandwidth_hz += self.bandwidth_hz
        early, early_weights = _panels(0.0, self.split_s, bandwidth_hz)
        late, late_weights = _panels(self.split_s, self.interval_s, bandwidth_hz)
        offsets = np.concatenate([early, late, [self.interval_s]])
        return Nodes(offsets, np.concatenate([early_weights, late_weights, [0.0]]), early.size)


def _panels(begin_s: float, end_s: float, bandwidth_hz: float) -> tuple[Array, Array]:
    panels = ceil((end_s - begin_s) / PANEL_S - 1e-9)
    if panels == 0:
        return np.empty(0), np.empty(0)
    half = 0.5 * (end_s - begin_s) / panels
    x, w = np.polynomial.legendre.leggauss(_order(2.0 * half, bandwidth_hz))
    middles = begin_s + half * (2 * np.arange(panels) + 1)
    return np.ravel(middles[:, None] + half * x), np.tile(half * w, panels)


def _order(length_s: float, bandwidth_hz: float) -> int:
    """Return the number of nodes that integrate `cos(2 pi bandwidth t)` over the length to `ACCURACY`.

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


def still(count: int, C_nb: Array, quadrature: Quadrature) -> PathSegment:
    """Return a segment at rest.

    Parameters
    ----------
    count : int
        Number of sample intervals.
    C_nb : ndarray, shape (3, 3)
        Attitude.
    quadrature : Quadrature
        How to place the nodes.

    Returns
    -------
    PathSegment
    """
    return PathSegment(
        intervals=count,
        C_nb=C_nb,
        axes_b=np.eye(3),
        angle_rad=0.0,
        ramp=0,
        rate=np.empty(0),
        cycles=np.empty((0, 2)),
        cosine=np.empty((6, 0)),
        sine=np.empty((6, 0)),
        nodes=quadrature.nodes(0.0),
        offset_cosine=np.empty((0, 0)),
        offset_sine=np.empty((0, 0)),
    )


def path_segment(
    motion: OneMotion, C_nb: Array, quadrature: Quadrature, rng: np.random.Generator
) -> PathSegment:
    """Return the segment of one motion of a scenario.

    Parameters
    ----------
    motion : Rest or Rotate or Carry or Rock or Vibrate
        The motion.
    C_nb : ndarray, shape (3, 3)
        Attitude at its start.
    quadrature : Quadrature
        How to place the nodes.
    rng : Generator
        Draws frequencies and phases of random motion, and the errors of a hand.

    Returns
    -------
    PathSegment
    """
    at_rest = still(intervals(motion.duration_s, quadrature.interval_s), C_nb, quadrature)
    if isinstance(motion, Rotate):
        return _rotating(motion, at_rest, quadrature)
    if isinstance(motion, Carry):
        return _carried(motion, at_rest, quadrature, rng)
    if isinstance(motion, Rest):
        return _sinking(motion, at_rest, quadrature) if any(motion.sinks_arcsec) else at_rest
    shaken = _shaken(motion, at_rest, quadrature, rng)
    if isinstance(motion, Rock) and motion.rate_peak_deg_per_s is not None:
        return _bounded(shaken, motion.rate_peak_deg_per_s * DEG, quadrature.interval_s)
    return shaken


def _tilted(tilt_mrad: tuple[float, float]) -> Array:
    """Return the rotation that tilts the vertical to the east and to the north."""
    east, north = (1e-3 * t for t in tilt_mrad)
    angle = float(np.hypot(east, north))
    return rotation((-north, east, 0.0), angle) if angle else np.eye(3)


def _rotating(motion: Rotate, at_rest: PathSegment, quadrature: Quadrature) -> PathSegment:
    angle = radians(motion.angle_deg)
    axis_n = (
        np.array(motion.axis_n)
        if motion.axis_n is not None
        else _tilted(motion.axis_tilt_mrad or (0.0, 0.0))[:, 2]
    )
    axis_b = at_rest.C_nb.T @ (axis_n / np.linalg.norm(axis_n))
    # The peak rate of the quintic is 15/8 of the mean; four times that for products of cosines of the angle.
    bandwidth_hz = 4.0 * 1.875 * abs(angle) / (at_rest.intervals * quadrature.interval_s) / (2.0 * pi)
    if motion.wobble_deg:
        return _wobbling(motion, axis_b, at_rest._replace(angle_rad=angle), quadrature, bandwidth_hz)
    return at_rest._replace(
        axes_b=np.array([axis_b, axis_b, axis_b]), angle_rad=angle, nodes=quadrature.nodes(bandwidth_hz)
    )


def _sinking(motion: Rest, at_rest: PathSegment, quadrature: Quadrature) -> PathSegment:
    """Turn the plate about a horizontal axis while the body rests on it."""
    east, north = (arcsec * ARCSEC for arcsec in motion.sinks_arcsec)
    turn = Rotate(
        angle_deg=hypot(east, north) / DEG,
        duration_s=motion.duration_s,
        axis_n=(-north / ARCSEC, east / ARCSEC, 0.0),
    )
    return _rotating(turn, at_rest, quadrature)


def _carried(
    motion: Carry, at_rest: PathSegment, quadrature: Quadrature, rng: np.random.Generator
) -> PathSegment:
    """Turn the body into the pose, as well as a hand can, and lift it meanwhile."""
    lean, heading = 1e-3 * motion.lean_mrad, radians(motion.heading_deg)
    error = rng.normal(0.0, [lean, lean, heading])
    target = _small_rotation(error) @ _pose(motion.up, motion.east)
    turn = Rotation.from_matrix(target @ at_rest.C_nb.T).as_rotvec()
    angle = float(np.linalg.norm(turn))
    x, y, z = (turn / angle).tolist() if angle > 0.0 else (0.0, 0.0, 1.0)
    rotate = Rotate(
        angle_deg=angle / DEG,
        duration_s=motion.duration_s,
        axis_n=(x, y, z),
        wobble_deg=motion.wobble_deg,
        wobble_hz=motion.wobble_hz,
    )
    return _lifted(_rotating(rotate, at_rest, quadrature), motion.lift_mm * MM, quadrature)


def _pose(up: Side, east: Side) -> Array:
    """Return the attitude `C_nb` of a pose."""
    z, x = (np.eye(3)["XYZ".index(side[1])] * (-1.0 if side[0] == "-" else 1.0) for side in (up, east))
    return np.stack([x, np.cross(z, x), z])


def _small_rotation(vector: Array) -> Array:
    return np.asarray(Rotation.from_rotvec(vector).as_matrix(), np.float64)


def _lifted(segment: PathSegment, height_m: float, quadrature: Quadrature) -> PathSegment:
    """Add a lift to a motion: a sinusoid of frequency 0, faded in and out."""
    nodes, up = segment.nodes, np.zeros((6, 1))
    up[5] = height_m
    return segment._replace(
        ramp=max(1, segment.intervals // 4),
        rate=np.append(segment.rate, 0.0),
        cycles=np.concatenate([segment.cycles, split_cycles([0.0], quadrature.interval_s)]),
        cosine=np.concatenate([segment.cosine, up], axis=1),
        sine=np.concatenate([segment.sine, np.zeros((6, 1))], axis=1),
        offset_cosine=np.concatenate(
            [segment.offset_cosine.reshape(-1, nodes.offset_s.size), np.ones((1, nodes.offset_s.size))]
        ),
        offset_sine=np.concatenate(
            [segment.offset_sine.reshape(-1, nodes.offset_s.size), np.zeros((1, nodes.offset_s.size))]
        ),
    )


def _wobbling(
    motion: Rotate, axis_b: Array, segment: PathSegment, quadrature: Quadrature, bandwidth_hz: float
) -> PathSegment:
    """Add a cone to a rotation: about two axes across its own, a quarter of a cycle apart."""
    across = np.cross(axis_b, np.eye(3)[np.argmin(np.abs(axis_b))])
    across /= np.linalg.norm(across)
    amplitude = radians(motion.wobble_deg)
    cosine, sine = np.zeros((6, 1)), np.zeros((6, 1))
    cosine[1], sine[2] = amplitude, amplitude
    rate = 2.0 * pi * np.array([motion.wobble_hz])
    # Omega doubles the band; the angles modulate the attitude, at worst with the sum of their rates.
    wobbling_hz = 2.0 * motion.wobble_hz + 2.0 * amplitude * motion.wobble_hz
    nodes = quadrature.nodes(bandwidth_hz + wobbling_hz)
    return segment._replace(
        axes_b=np.array([axis_b, across, np.cross(axis_b, across)]),
        ramp=max(1, segment.intervals // 4),
        rate=rate,
        cycles=split_cycles([motion.wobble_hz], quadrature.interval_s),
        cosine=cosine,
        sine=sine,
        nodes=nodes,
        offset_cosine=np.cos(np.outer(rate, nodes.offset_s)),
        offset_sine=np.sin(np.outer(rate, nodes.offset_s)),
    )


def _shaken(
    motion: Rock | Vibrate, at_rest: PathSegment, quadrature: Quadrature, rng: np.random.Generator
) -> PathSegment:
    """Draw sums of sinusoids, each with the same share in the rms."""
    low, high = motion.band_hz
    frequency = low + (high - low) * (np.arange(SINUSOIDS) + rng.random(SINUSOIDS)) / SINUSOIDS
    phase = 2.0 * pi * rng.random((6, SINUSOIDS))
    rate = 2.0 * pi * frequency
    angle_rate_rms = np.array(motion.rate_rms_deg_per_s) * DEG
    share = np.sqrt(2.0 / SINUSOIDS)
    if isinstance(motion, Rock):
        displacement_rms = np.repeat(np.array(motion.sway_mm)[:, None] * MM, SINUSOIDS, axis=1)
    else:
        displacement_rms = np.array(motion.g_rms)[:, None] * STANDARD_GRAVITY / rate**2
    amplitude = share * np.concatenate([angle_rate_rms[:, None] / rate, displacement_rms])
    # Omega doubles the band; the angles modulate the attitude, at worst with the sum of all their rates.
    fastest = float(np.sum(share * angle_rate_rms) * SINUSOIDS)
    nodes = quadrature.nodes(2.0 * high + 2.0 * fastest / (2.0 * pi))
    return at_rest._replace(
        ramp=max(1, min(round(motion.ramp_s / quadrature.interval_s), at_rest.intervals // 2)),
        rate=rate,
        cycles=split_cycles(frequency, quadrature.interval_s),
        cosine=amplitude * np.cos(phase),
        sine=amplitude * np.sin(phase),
        nodes=nodes,
        offset_cosine=np.cos(np.outer(rate, nodes.offset_s)),
        offset_sine=np.sin(np.outer(rate, nodes.offset_s)),
    )


def _bounded(shaken: PathSegment, peak: float, interval_s: float) -> PathSegment:
    """Reduce each rotation whose rate exceeds `peak` at the end of a sample."""
    ends = shaken._replace(
        nodes=Nodes(shaken.nodes.offset_s[-1:], shaken.nodes.weight_s[-1:], 0),
        offset_cosine=shaken.offset_cosine[:, -1:].copy(),
        offset_sine=shaken.offset_sine[:, -1:].copy(),
    )
    peaks = np.zeros(3)
    _find_peaks(ends, interval_s, peaks)
    factor = np.ones((6, 1))
    factor[:3, 0] = np.minimum(1.0, peak / np.maximum(peaks, peak))
    return shaken._replace(cosine=factor * shaken.cosine, sine=factor * shaken.sine)


@kernel
def _find_peaks(segment: PathSegment, interval_s: float, peaks: Array) -> None:
    path = new_path(segment)
    for k in range(segment.intervals):
        evaluate(segment, interval_s, k, path)
        for r in range(3):
            for j in range(path.v.shape[1]):
                peaks[r] = max(peaks[r], abs(path.v[r, j]))


@kernel
def new_path(segment: PathSegment) -> Path:
    """Return room for the path of one interval."""
    j = segment.nodes.offset_s.size
    return Path(np.empty((6, j)), np.empty((6, j)), np.empty((6, j)), np.empty(j), np.empty(j))


@kernel
def evaluate(segment: PathSegment, interval_s: float, k: int, path: Path) -> None:
    """Fill `path` with that of interval k."""
    path.x[:] = 0.0
    path.v[:] = 0.0
    path.a[:] = 0.0
    for m in range(segment.rate.size):
        _add_sinusoid(segment, m, k, path)
    if segment.rate.size > 0:
        _fade(segment, interval_s, k, path)
    if segment.angle_rad != 0.0:
        duration = segment.intervals * interval_s
        for j in range(segment.nodes.offset_s.size):
            e0, e1, e2 = minimum_jerk((k * interval_s + segment.nodes.offset_s[j]) / duration)
            path.x[0, j] += segment.angle_rad * e0
            path.v[0, j] += segment.angle_rad * e1 / duration
            path.a[0, j] += segment.angle_rad * e2 / duration**2


@kernel
def _add_sinusoid(segment: PathSegment, m: int, k: int, path: Path) -> None:
    rate = segment.rate[m]
    angle = 2.0 * pi * cycles_at(segment.cycles[m], k)
    c0, s0 = cos(angle), sin(angle)
    c, s = path.cosine, path.sine
    for j in range(c.size):
        c[j] = c0 * segment.offset_cosine[m, j] - s0 * segment.offset_sine[m, j]
        s[j] = s0 * segment.offset_cosine[m, j] + c0 * segment.offset_sine[m, j]
    for r in range(6):
        p, q = segment.cosine[r, m], segment.sine[r, m]
        for j in range(c.size):
            value = p * c[j] + q * s[j]
            path.x[r, j] += value
            path.v[r, j] += rate * (q * c[j] - p * s[j])
            path.a[r, j] -= rate * rate * value


@kernel
def _fade(segment: PathSegment, interval_s: float, k: int, path: Path) -> None:
    """Multiply the sinusoids by the ramp at the start and at the end of the segment."""
    after = segment.intervals - k
    if k >= segment.ramp and after > segment.ramp:
        return
    x, v, a = path.x, path.v, path.a
    ramp = segment.ramp * interval_s
    for j in range(segment.nodes.offset_s.size):
        if k < segment.ramp:
            e0, e1, e2 = minimum_jerk((k * interval_s + segment.nodes.offset_s[j]) / ramp)
        else:
            e0, e1, e2 = minimum_jerk((after * interval_s - segment.nodes.offset_s[j]) / ramp)
            e1 = -e1
        e1 /= ramp
        e2 /= ramp**2
        for r in range(6):
            a[r, j] = e0 * a[r, j] + 2.0 * e1 * v[r, j] + e2 * x[r, j]
            v[r, j] = e0 * v[r, j] + e1 * x[r, j]
            x[r, j] = e0 * x[r, j]


@kernel
def minimum_jerk(u: float) -> Vector:
    """Return the quintic from 0 to 1 with rate and acceleration zero at both ends, and its derivatives."""
    w = 1.0 - u
    return u * u * u * (10.0 + u * (6.0 * u - 15.0)), 30.0 * u * u * w * w, 60.0 * u * w * (w - u)
