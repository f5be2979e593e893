"""Attitude of a unit that stands still, from gravity and the Earth's rotation.

**Coarse.** Mean specific force points up, mean rate along the Earth's axis: two vectors make an attitude.

**Fine.** The gyros carry a frame i that does not turn (the body's at the start); in it the velocity gained
from the specific force is summed. Seen from n with an attitude in error by phi, `C_nb' = (I - [phi x]) C_nb`,
that velocity less gravity's is what a navigator at rest would show:

    d/dt v_E = -g phi_N        d/dt phi_E = Omega_U phi_N - Omega_N phi_U - d_E
    d/dt v_N =  g phi_E        d/dt phi_N = -Omega_U phi_E - d_N

with the drifts d. Each horizontal axis is a Kalman filter with three states, velocity, tilt and tilt rate,
that measures each second a velocity that ought to be zero. The tilts give the level at the end of the window,
the tilt rate about east the heading, `phi_U = (Omega_U phi_N - rate_E) / Omega_N`; the tilt rate about north
is drift and left free. What is found is taken off, and all repeated, as the equations hold for small angles.

Why so: errors of quantisation or shaking are bounded in velocity, and their weight in a tilt rate falls with
the square of time (0.5 mm/s pulses: 1e-6 rad of heading in 370 s); a body that rocks and comes back costs
nothing, for its true tilt is felt. A mean of the gyros over the window would take every such tilt for the
Earth's rotation.

**Noise** is taken from the data. Third differences of v over a lag L know neither tilt nor tilt rate; white
noise s of velocity and a random walk q of tilt each leave their own law in them:

    variance = 20 s^2 + g^2 q^2 L^3

(the last: two triangles of height L, opposite and L apart, squared and integrated). A random walk of velocity
is put down to the tilt, and heading predicted rather too cautiously: the pulses of a level accelerometer, few
as they are, make noise that looks like one. What is constant cannot be seen: bias b and drift d enter by the
given priors, b / g in level and `hypot(d / Omega_N, tan(latitude) b / g)` in heading (Groves, Principles of
GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., section 5.6).
"""

from dataclasses import dataclass
from math import atan2, hypot, sqrt, tan
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from imudrv.errors import InputError
from imudrv.kernels import kernel
from imudrv.nav.attitude import (
    product,
    quaternion_of_matrix,
    quaternion_of_vector,
    rotation,
    rows_of,
    turn,
    unit,
)
from imudrv.nav.earth import EARTH_RATE, earth_rate_n
from imudrv.nav.mechanisation import body_step
from imudrv.records import Records
from imudrv.units import DEG, NS, NS_PER_S
from imudrv.vectors import add, put, vector_at

Array = NDArray[np.float64]

DURATION_S: Final = 370.0
"""Usual length of an alignment, s."""
SHORTEST_S: Final = 30.0
"""Below this there is no result, s."""
LONGEST_S: Final = 7200.0
"""So much is remembered at the most, s."""
MAX_LATITUDE: Final = 85.0 * DEG
"""Nearer to a pole the Earth's rotation shows no north."""

BLOCK_NS: Final = 100_000_000
"""Samples are summed over so long, ns."""
_BLOCKS_A_SECOND: Final = NS_PER_S // BLOCK_NS
_ROUNDS: Final = 5

WINDOW_BLOCKS: Final = 50
"""Stretches that are compared for motion, blocks."""
MOTION_RATIO: Final = 8.0
"""A stretch this much more restless than the quietest fifth is motion."""
LEAST_RATE: Final = 1e-6
"""Restlessness that never matters, rad/s (0.2 deg/h)."""
LEAST_FORCE: Final = 1e-4
"""Restlessness that never matters, m/s^2 (10 ug)."""
_LEAST_VELOCITY: Final = 1e-6
"""Rounding of sums over hours, m/s: no noise is taken to be smaller."""

# The state: what a step needs, then the sums of the running block, as a row of the blocks has them.
_Q, _T1, _DTHETA1, _DV1, _SUMS = 0, 4, 5, 8, 11
_DT, _VELOCITY, _ANGLE, _FORCE = 0, slice(1, 4), slice(4, 7), slice(7, 10)
_BLOCK: Final = 10
_STATE: Final = _SUMS + _BLOCK


@dataclass(frozen=True)
class Aligned:
    """Attitude at the end of an alignment.

    Attributes
    ----------
    counter, t_ns : int
        Of the last sample of the window.
    q_nb : ndarray, shape (4,)
        Attitude there, scalar first.
    duration_s : float
        Length of the window.
    level_sigma_rad, heading_sigma_rad : float
        Predicted, 1 sigma: each tilt, and heading.
    motion : str or None
        When and how much the unit moved; None: it stood still.
    """

    counter: int
    t_ns: int
    q_nb: Array
    duration_s: float
    level_sigma_rad: float
    heading_sigma_rad: float
    motion: str | None

    @property
    def heading_rad(self) -> float:
        """Azimuth of the body's Y axis, from north to east, rad."""
        w, x, y, z = self.q_nb.tolist()
        C_nb = rows_of((w, x, y, z))
        return atan2(C_nb[0][1], C_nb[1][1])


class Alignment:
    """Alignment of a unit at rest; feed it in any pieces, the result is the same bits.

    Time for which there are no increments does not count.

    Parameters
    ----------
    latitude_rad : float
        Of the place.
    gyro_bias_sigma : float
        Gyro bias that the calibration leaves, 1 sigma, rad/s.
    accelerometer_bias_sigma : float
        Accelerometer bias that it leaves, 1 sigma, m/s^2.
    duration_s : float
        Length of the window.

    Raises
    ------
    InputError
        A place too near to a pole, or a length or sigma that makes no sense.
    """

    def __init__(
        self,
        latitude_rad: float,
        gyro_bias_sigma: float,
        accelerometer_bias_sigma: float,
        duration_s: float = DURATION_S,
    ) -> None:
        if not abs(latitude_rad) <= MAX_LATITUDE:
            raise InputError(
                f"alignment: expected a latitude within {MAX_LATITUDE / DEG:g} deg of the equator, got "
                f"{latitude_rad / DEG:g} deg; nearer to a pole give the attitude by other means"
            )
        if not SHORTEST_S <= duration_s <= LONGEST_S:
            raise InputError(
                f"alignment: expected a length of {SHORTEST_S:g} to {LONGEST_S:g} s, got {duration_s:g} s"
            )
        if not (0.0 <= gyro_bias_sigma < np.inf and 0.0 <= accelerometer_bias_sigma < np.inf):
            raise InputError(
                "alignment: expected the sigmas of gyro and accelerometer bias as numbers from 0 up, got "
                f"{gyro_bias_sigma!r} rad/s and {accelerometer_bias_sigma!r} m/s^2"
            )
        self._latitude = latitude_rad
        self._gyro_bias_sigma = gyro_bias_sigma
        self._accelerometer_bias_sigma = accelerometer_bias_sigma
        self._duration_ns = round(duration_s / NS)
        self._state = np.zeros(_STATE)
        self._state[_Q] = 1.0
        self._clock = np.zeros(2, np.int64)  # ns since the beginning, ns of the running block
        self._blocks = np.empty((self._duration_ns // BLOCK_NS + 1, _BLOCK))
        self._filled = 0
        self._last = (0, 0)

    @property
    def elapsed_s(self) -> float:
        """Length of what was fed, s."""
        return float(self._clock[0] * NS)

    @property
    def done(self) -> bool:
        """Whether the window is full."""
        return bool(self._clock[0] >= self._duration_ns)

    def feed(self, increments: Records) -> Records:
        """Take increments up to the end of the window.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order.

        Returns
        -------
        ndarray of INCREMENTS
            Those behind the window: navigation goes on with them.
        """
        used, self._filled = _integrate(
            increments, self._state, self._clock, self._blocks, self._filled, self._duration_ns
        )
        if used:
            self._last = (int(increments["counter"][used - 1]), int(increments["t_ns"][used - 1]))
        return increments[used:]

    def result(self) -> Aligned:
        """Attitude at the end of what was fed, also before the window is full.

        Returns
        -------
        Aligned

        Raises
        ------
        InputError
            Too little was fed yet, or it shows neither gravity nor the Earth's rotation.
        """
        if self.elapsed_s < SHORTEST_S:
            raise InputError(
                f"alignment: expected {SHORTEST_S:g} s of samples at least, got {self.elapsed_s:g} s; "
                "feed more"
            )
        blocks = self._blocks[: self._filled]
        q0, q1, q2, q3 = self._state[_Q:_T1].tolist()
        C_ib = np.array(rows_of((q0, q1, q2, q3)))
        _, omega_north, omega_up = earth_rate_n(self._latitude)
        seconds = _seconds(blocks)
        gravity = float(np.linalg.norm(seconds.velocity_i, axis=1).sum() / seconds.dt.sum())
        C_ni = _coarse(blocks, self._latitude) @ C_ib.T
        for _ in range(_ROUNDS):
            v = _navigated(seconds, C_ni, self._latitude)
            tilt, rate, covariance = _filtered(v, seconds.dt, gravity, _noise(v, seconds.dt, gravity))
            phi_up = (omega_up * tilt[1] - rate[0]) / omega_north
            C_ni = np.array(rows_of(quaternion_of_vector((tilt[0], tilt[1], phi_up)))) @ C_ni
        # the last second ends with the last whole block; over the samples behind it n turns with the Earth
        C_nb = rotation((0.0, omega_north, omega_up), -EARTH_RATE * self._clock[1] * NS) @ C_ni @ C_ib
        level_bias = self._accelerometer_bias_sigma / gravity
        heading_noise = sqrt(covariance[2, 2] + omega_up**2 * covariance[1, 1]) / omega_north
        heading_bias = hypot(self._gyro_bias_sigma / omega_north, tan(self._latitude) * level_bias)
        return Aligned(
            counter=self._last[0],
            t_ns=self._last[1],
            q_nb=quaternion_of_matrix(C_nb),
            duration_s=self.elapsed_s,
            level_sigma_rad=hypot(sqrt(covariance[1, 1]), level_bias),
            heading_sigma_rad=hypot(heading_noise, heading_bias),
            motion=_motion(blocks),
        )


@kernel
def _integrate(
    increments: Records,
    state: Array,
    clock: NDArray[np.int64],
    blocks: Array,
    filled: int,
    duration_ns: int,
) -> tuple[int, int]:
    """Sum increments into blocks, velocity in the frame i; how many are used, how many blocks are filled."""
    q = (state[0], state[1], state[2], state[3])
    T1 = state[_T1]
    dtheta1, dv1 = vector_at(state, _DTHETA1), vector_at(state, _DV1)
    used = 0
    while used < increments.shape[0] and clock[0] < duration_ns:
        sample = increments[used]
        T = sample["interval_ns"] * NS
        dtheta = (sample["dtheta_b"][0], sample["dtheta_b"][1], sample["dtheta_b"][2])
        dv = (sample["dv_b"][0], sample["dv_b"][1], sample["dv_b"][2])
        if T1 == 0.0:
            T1, dtheta1, dv1 = T, dtheta, dv
        phi, dv_b = body_step(T, dtheta, dv, T1, dtheta1, dv1)
        state[_SUMS] += T
        put(state, _SUMS + 1, add(vector_at(state, _SUMS + 1), turn(q, dv_b)))
        put(state, _SUMS + 4, add(vector_at(state, _SUMS + 4), dtheta))
        put(state, _SUMS + 7, add(vector_at(state, _SUMS + 7), dv))
        q = unit(product(q, quaternion_of_vector(phi)))
        T1, dtheta1, dv1 = T, dtheta, dv
        used += 1
        clock[0] += sample["interval_ns"]
        clock[1] += sample["interval_ns"]
        if clock[1] >= BLOCK_NS:
            blocks[filled] = state[_SUMS:]
            state[_SUMS:] = 0.0
            clock[1] = 0
            filled += 1
    state[0], state[1], state[2], state[3] = q
    state[_T1] = T1
    put(state, _DTHETA1, dtheta1)
    put(state, _DV1, dv1)
    return used, filled


class _Seconds(NamedTuple):
    """Blocks put together to seconds, the last one ending with the last block."""

    dt: Array  # (n,)
    velocity_i: Array  # (n, 3), gained, m/s
    middle: Array  # (n,), time from the end, negative


class _Noise(NamedTuple):
    velocity: float  # white, m/s
    tilt: float  # random walk, rad/sqrt(s)


def _seconds(blocks: Array) -> _Seconds:
    n = len(blocks) // _BLOCKS_A_SECOND
    whole = blocks[len(blocks) - n * _BLOCKS_A_SECOND :].reshape(n, _BLOCKS_A_SECOND, _BLOCK).sum(axis=1)
    dt = whole[:, _DT]
    begins = -np.cumsum(dt[::-1])[::-1]
    return _Seconds(dt, whole[:, _VELOCITY], begins + 0.5 * dt)


def _coarse(blocks: Array, latitude_rad: float) -> Array:
    """C_nb from the mean specific force and the mean rate."""
    total = blocks.sum(axis=0)
    force, rate = total[_FORCE] / total[_DT], total[_ANGLE] / total[_DT]
    size = float(np.linalg.norm(force))
    if not 9.5 < size < 10.1:
        raise InputError(
            f"alignment: expected gravity, 9.5 to 10.1 m/s^2, as the mean specific force, got {size:.6g} "
            "m/s^2; check the accelerometers' scale factors and that the unit stands still"
        )
    up = force / size
    east = np.cross(rate, up)
    horizontal, expected = float(np.linalg.norm(east)), earth_rate_n(latitude_rad)[1]
    if not 0.5 * expected < horizontal < 1.5 * expected:
        raise InputError(
            f"alignment: expected the horizontal part of the Earth's rotation, {expected:.4g} rad/s at this "
            f"latitude, as the mean rate, got {horizontal:.4g} rad/s; check the gyros' calibration and that "
            "the unit stands still"
        )
    east /= horizontal
    return np.array([east, np.cross(up, east), up])


def _navigated(seconds: _Seconds, C_ni: Array, latitude_rad: float) -> Array:
    """Velocity east and north at the seconds' ends, for an attitude of n, at the window's end, to i.

    Returns
    -------
    ndarray, shape (n, 2)
        m/s.
    """
    axis = np.array(earth_rate_n(latitude_rad)) / EARTH_RATE
    angle = -EARTH_RATE * seconds.middle[:, None]  # n turns with the Earth, so vectors in it turn back
    dv = seconds.velocity_i @ C_ni.T
    along = np.outer(dv @ axis, axis)
    dv_n = along + np.cos(angle) * (dv - along) + np.sin(angle) * np.cross(axis, dv)
    velocity: Array = np.cumsum(dv_n[:, :2], axis=0)
    return velocity


def _noise(v: Array, dt: Array, gravity: float) -> _Noise:
    """Noise from the third differences of velocity over lags of 1, 2, 4, ... seconds."""
    lags = 2 ** np.arange(int(np.log2(len(v) / 6)) + 1)
    thirds = [v[3 * k :] - 3.0 * v[2 * k : -k] + 3.0 * v[k : -2 * k] - v[: -3 * k] for k in lags]
    variance = np.array([np.mean(third**2) for third in thirds])
    laws = np.stack([np.full(len(lags), 20.0), gravity**2 * (lags * dt.mean()) ** 3], axis=1)
    # a variance over lag L comes from 1 / L as many independent differences
    weight = 1.0 / (np.maximum(variance, _LEAST_VELOCITY**2) * np.sqrt(lags))
    size = np.linalg.norm(laws * weight[:, None], axis=0)
    parts, _ = nnls(laws * weight[:, None] / size, variance * weight)
    velocity, tilt = np.sqrt(parts / size).tolist()
    return _Noise(max(velocity, _LEAST_VELOCITY), tilt)


def _filtered(v: Array, dt: Array, gravity: float, noise: _Noise) -> tuple[Array, Array, Array]:
    """Tilts about east and north at the end, their rates, and the covariance of (velocity, tilt, rate)."""
    measured = np.stack(
        [v[:, 1], -v[:, 0]], axis=1
    )  # the velocities that tilts about east and north drive by +g
    x = np.zeros((3, 2))
    covariance = np.diag([1.0, 0.1, 1e-4]) ** 2  # wide open
    white = noise.velocity**2
    for z, T in zip(measured, dt, strict=True):
        g, q = gravity * T, noise.tilt**2 * T
        F = np.array([[1.0, g, 0.5 * g * T], [0.0, 1.0, T], [0.0, 0.0, 1.0]])
        walk = q * np.array([[g * g / 3.0, 0.5 * g, 0.0], [0.5 * g, 1.0, 0.0], [0.0, 0.0, 0.0]])
        x, covariance = F @ x, F @ covariance @ F.T + walk
        K = covariance[:, 0] / (covariance[0, 0] + white)
        x = x + np.outer(K, z - x[0])
        keep = np.eye(3)
        keep[:, 0] -= K
        covariance = keep @ covariance @ keep.T + white * np.outer(K, K)  # Joseph's form stays positive
    return x[1], x[2], covariance


def _motion(blocks: Array) -> str | None:
    """Say the worst stretch that is much more restless than the quietest ones, if there is one."""
    n = len(blocks) // WINDOW_BLOCKS
    ends = np.cumsum(blocks[:, _DT])
    worst, found = 1.0, None
    for what, columns, unit_name, least in (
        ("rate", _ANGLE, "rad/s", LEAST_RATE),
        ("specific force", _FORCE, "m/s^2", LEAST_FORCE),
    ):
        mean = blocks[:, columns] / blocks[:, [_DT]]
        deviation = ((mean - np.median(mean, axis=0)) ** 2).sum(axis=1)
        restless = np.sqrt(deviation[: n * WINDOW_BLOCKS].reshape(n, WINDOW_BLOCKS).mean(axis=1))
        limit = max(MOTION_RATIO * float(np.quantile(restless, 0.2)), least)
        k = int(np.argmax(restless))
        if restless[k] > worst * limit:
            worst = float(restless[k]) / limit
            end = ends[(k + 1) * WINDOW_BLOCKS - 1]
            begin = end - blocks[k * WINDOW_BLOCKS : (k + 1) * WINDOW_BLOCKS, _DT].sum()
            found = (
                f"the unit moved {begin:.0f} to {end:.0f} s after the start: {what} {restless[k]:.3g} "
                f"{unit_name} rms off its median, limit {limit:.3g} {unit_name} "
                f"({MOTION_RATIO:g} times the quietest fifth); align again, at rest"
            )
    return found
