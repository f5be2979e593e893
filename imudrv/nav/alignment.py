"""Attitude of a unit at rest, from gravity and the Earth's rotation.

**Coarse.** Mean specific force points up, mean rate along the Earth's axis: two vectors make an attitude.

**Fine.** The gyros carry an inertial frame i (the body's at the start), in which the velocity gained from the
specific force is summed. Transformed to n with an attitude in error by phi, `C_nb' = (I - [phi x]) C_nb`, and
reduced by that of gravity it is the velocity that a navigator at rest would show:

    d/dt v_E = -g phi_N        d/dt phi_E = Omega_U phi_N - Omega_N phi_U - d_E
    d/dt v_N =  g phi_E        d/dt phi_N = -Omega_U phi_E - d_N

with the drifts d. Each horizontal axis is a Kalman filter with three states, velocity, tilt and tilt rate,
that every second measures a velocity that should be zero. The tilts give the level at the end of the window,
the tilt rate about east the heading, `phi_U = (Omega_U phi_N - rate_E) / Omega_N`; the tilt rate about north
is drift and remains free. The correction is applied and all repeated, as the equations hold for small angles.

Reasons: errors of quantisation or shaking are bounded in velocity, and their weight in a tilt rate falls with
the square of time (0.5 mm/s pulses: 1e-6 rad of heading in 370 s); a body that rocks and returns does no
harm, for its true tilt is measured. A mean of the gyros over the window would take every such tilt for the
Earth's rotation.

**Noise** is estimated from the data. Third differences of v over a lag L contain neither tilt nor tilt rate;
white noise s of velocity and a random walk q of tilt contribute

    variance = 20 s^2 + g^2 q^2 L^3

(the last: two triangles of height L, opposite and L apart, squared and integrated). A random walk of velocity
is attributed to the tilt, which makes the predicted heading error rather too large: the few pulses of a level
accelerometer make noise that looks like one. Constant errors are not observable: bias b and drift d enter by
the given priors, b / g in level and `hypot(d / Omega_N, tan(latitude) b / g)` in heading (Groves, Principles
of GNSS, Inertial, and Multisensor Integrated Navigation Systems, 2nd ed., section 5.6).
"""

from dataclasses import dataclass
from math import atan2, hypot, sqrt, tan
from typing import Final, NamedTuple

import numpy as np

from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.kernels import kernel
from imudrv.nav.attitude import (
    product,
    put_quaternion,
    quaternion_at,
    quaternion_of_matrix,
    quaternion_of_vector,
    rotation,
    rows_of,
    turn,
    unit,
)
from imudrv.nav.earth import EARTH_RATE, earth_rate_n
from imudrv.nav.mechanisation import body_step
from imudrv.nav.noise import fit_noise_model
from imudrv.records import Records
from imudrv.units import DEG, DEG_PER_H, NS, NS_PER_S
from imudrv.vectors import Vector, add, put, vector_at

ALIGNMENT_S: Final = 370.0
"""Usual length of an alignment, s."""
MIN_ALIGNMENT_S: Final = 30.0
"""Minimum length, s."""
MAX_ALIGNMENT_S: Final = 7200.0
"""Maximum length, s."""
MAX_LATITUDE: Final = 85.0 * DEG
"""Nearer to a pole the Earth's rotation does not give the heading."""

BLOCK_NS: Final = 100_000_000
"""Samples are summed over blocks of this length, ns."""
_BLOCKS_A_SECOND: Final = NS_PER_S // BLOCK_NS
_ROUNDS: Final = 5

LEAST_VERTICAL: Final = 5.0 * DEG_PER_H
"""Deviation of the Earth's vertical rate that is never taken for the other hemisphere, rad/s."""
PARTS: Final = 8
"""Parts of a window whose means show how well the whole mean is known."""

WINDOW_BLOCKS: Final = 50
"""Length of the intervals that are compared to detect motion, blocks."""
MOTION_RATIO: Final = 8.0
"""An interval with this many times the deviation of the quietest fifth is motion."""
LEAST_RATE: Final = 1e-6
"""Deviation that is never motion, rad/s (0.2 deg/h)."""
LEAST_FORCE: Final = 1e-4
"""Deviation that is never motion, m/s^2 (10 ug)."""
_LEAST_VELOCITY: Final = 1e-6
"""Rounding of sums over hours, m/s: no noise is taken to be smaller."""

BLOCK: Final = np.dtype(
    [
        ("dt", np.float64),  # s
        ("velocity_i", np.float64, 3),  # gained, m/s
        ("dtheta_b", np.float64, 3),  # sum of the increments, rad
        ("dv_b", np.float64, 3),  # m/s
    ]
)
"""Sums over the samples of a block."""

STATE: Final = np.dtype(
    [
        ("q_ib", np.float64, 4),
        ("T1", np.float64),  # the interval before, s, rad, m/s; T1 = 0: there is none
        ("dtheta1", np.float64, 3),
        ("dv1", np.float64, 3),
        ("elapsed_ns", np.int64),  # since the beginning
        ("block_ns", np.int64),  # of the block that is being summed
        ("filled", np.int64),  # blocks
    ],
    align=True,
)
"""State that a call of the kernel leaves to the next, beside the blocks."""


class RestMotion(NamedTuple):
    """Motion of a unit that should have been at rest.

    Parameters
    ----------
    begin_s, end_s : float
        Interval with the largest deviation, since the start.
    quantity, unit : str
        ``rate``, rad/s, or ``specific force``, m/s^2.
    rms, limit : float
        Deviation from the median in that interval, and its limit.
    """

    begin_s: float
    end_s: float
    quantity: str
    unit: str
    rms: float
    limit: float

    def __str__(self) -> str:
        """Return a sentence."""
        return (
            f"the unit moved {self.begin_s:.0f} to {self.end_s:.0f} s after the start: {self.quantity} "
            f"{self.rms:.3g} {self.unit} rms off its median, limit {self.limit:.3g} {self.unit} "
            f"({MOTION_RATIO:g} times the quietest fifth); align again, at rest"
        )


@dataclass(frozen=True)
class Aligned:
    """Attitude at the end of an alignment.

    Attributes
    ----------
    counter, t_ns : int
        Those of the last sample of the window.
    q_nb : ndarray, shape (4,)
        Attitude there, scalar first.
    duration_s : float
        Length of the window.
    level_sigma_rad, heading_sigma_rad : float
        Predicted 1-sigma error of each tilt, and of the heading.
    motion : RestMotion or None
        When and how much the unit moved; None: it was at rest.
    """

    counter: int
    t_ns: int
    q_nb: Array
    duration_s: float
    level_sigma_rad: float
    heading_sigma_rad: float
    motion: RestMotion | None

    @property
    def heading_rad(self) -> float:
        """Azimuth of the body's Y axis, from north to east, rad."""
        C_nb = rows_of(quaternion_at(self.q_nb))
        return atan2(C_nb[0][1], C_nb[1][1])


class RestReadings(NamedTuple):
    """Mean readings at rest that do not depend on the attitude, and the 1-sigma noise of the means."""

    force: float  # m/s^2
    force_sigma: float
    rate_up: float  # along the specific force, rad/s
    rate_level: float  # across it
    rate_sigma: float


class Alignment:
    """Alignment of a unit at rest; feed it in any pieces, the result is the same bits.

    Time without increments does not count.

    Parameters
    ----------
    latitude_rad : float
        Geodetic latitude, rad.
    gyro_bias_sigma : float
        Residual gyro bias after calibration, 1 sigma, rad/s.
    accelerometer_bias_sigma : float
        Residual accelerometer bias, 1 sigma, m/s^2.
    duration_s : float
        Length of the window.

    Raises
    ------
    InputError
        A latitude too near to a pole, or a length or sigma out of range.
    """

    def __init__(
        self,
        latitude_rad: float,
        gyro_bias_sigma: float,
        accelerometer_bias_sigma: float,
        duration_s: float = ALIGNMENT_S,
    ) -> None:
        if not abs(latitude_rad) <= MAX_LATITUDE:
            raise InputError(
                f"alignment: expected a latitude within {MAX_LATITUDE / DEG:g} deg of the equator, got "
                f"{latitude_rad / DEG:g} deg; nearer to a pole give the attitude by other means"
            )
        if not MIN_ALIGNMENT_S <= duration_s <= MAX_ALIGNMENT_S:
            raise InputError(
                f"alignment: expected a length of {MIN_ALIGNMENT_S:g} to {MAX_ALIGNMENT_S:g} s, "
                f"got {duration_s:g} s"
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
        self._state = np.zeros(1, STATE)
        self._state["q_ib"] = 1.0, 0.0, 0.0, 0.0
        # the row after the filled ones is being summed
        self._blocks = np.zeros(self._duration_ns // BLOCK_NS + 2, BLOCK)
        self._last = (0, 0)

    @property
    def elapsed_s(self) -> float:
        """Length of what was fed, s."""
        return float(self._state[0]["elapsed_ns"] * NS)

    @property
    def done(self) -> bool:
        """Whether the window is full."""
        return bool(self._state[0]["elapsed_ns"] >= self._duration_ns)

    def feed(self, increments: Records) -> Records:
        """Take increments up to the end of the window.

        Parameters
        ----------
        increments : ndarray of INCREMENTS
            In order.

        Returns
        -------
        ndarray of INCREMENTS
            Those after the window: navigation continues with them.
        """
        used = _integrate(increments, self._state, self._blocks, self._duration_ns)
        if used:
            self._last = (int(increments["counter"][used - 1]), int(increments["t_ns"][used - 1]))
        return increments[used:]

    def readings(self) -> RestReadings:
        """Return the mean readings of what was fed, to be compared with those of the site."""
        blocks = self._blocks[: self._state[0]["filled"]]
        size = len(blocks) // PARTS
        parts = _summed(blocks[: size * PARTS], size)
        f_b, omega_b = (parts[name] / parts["dt"][:, None] for name in ("dv_b", "dtheta_b"))
        up = f_b.mean(axis=0) / np.linalg.norm(f_b.mean(axis=0))
        force, rate_up = f_b @ up, omega_b @ up
        level = omega_b.mean(axis=0) - rate_up.mean() * up
        force_sigma, rate_sigma = (float(x.std(ddof=1)) / sqrt(PARTS) for x in (force, rate_up))
        return RestReadings(
            float(np.linalg.norm(f_b.mean(axis=0))),
            force_sigma,
            float(rate_up.mean()),
            float(np.linalg.norm(level)),
            rate_sigma,
        )

    def result(self) -> Aligned:
        """Attitude at the end of what was fed, even before the window is full.

        Returns
        -------
        Aligned

        Raises
        ------
        InputError
            Too little was fed, or gravity or the Earth's rotation is not in it.
        """
        if self.elapsed_s < MIN_ALIGNMENT_S:
            raise InputError(
                f"alignment: expected {MIN_ALIGNMENT_S:g} s of samples at least, got {self.elapsed_s:g} s; "
                "feed more"
            )
        s = self._state[0]
        blocks = self._blocks[: s["filled"]]
        C_ib = np.array(rows_of(quaternion_at(s["q_ib"])))
        _, omega_north, omega_up = earth_rate_n(self._latitude)
        seconds = _seconds(blocks)
        gravity = float(np.linalg.norm(seconds.velocity_i, axis=1).sum() / seconds.dt.sum())
        C_ni = _coarse(blocks, self._latitude) @ C_ib.T
        for _ in range(_ROUNDS):
            v = _navigated(seconds, C_ni, self._latitude)
            tilt, rate, covariance = _filtered(v, seconds.dt, gravity, _noise(v, seconds.dt, gravity))
            phi_up = (omega_up * tilt[1] - rate[0]) / omega_north
            C_ni = np.array(rows_of(quaternion_of_vector((tilt[0], tilt[1], phi_up)))) @ C_ni
        # the last second ends with the last whole block; over the samples after it n turns with the Earth
        C_nb = rotation((0.0, omega_north, omega_up), -EARTH_RATE * s["block_ns"] * NS) @ C_ni @ C_ib
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
def _integrate(increments: Records, state: Records, blocks: Records, duration_ns: int) -> int:
    """Sum increments into blocks, velocity in the frame i; return how many were used."""
    s = state[0]
    q = quaternion_at(s["q_ib"])
    T1, dtheta1, dv1 = s["T1"], vector_at(s["dtheta1"], 0), vector_at(s["dv1"], 0)
    used = 0
    while used < increments.shape[0] and s["elapsed_ns"] < duration_ns:
        sample = increments[used]
        T = sample["interval_ns"] * NS
        dtheta, dv = vector_at(sample["dtheta_b"], 0), vector_at(sample["dv_b"], 0)
        if T1 == 0.0:
            T1, dtheta1, dv1 = T, dtheta, dv
        gained = body_step(T, dtheta, dv, T1, dtheta1, dv1)
        _add_to(blocks[s["filled"]], T, turn(q, gained.dv_b), dtheta, dv)
        q = unit(product(q, quaternion_of_vector(gained.phi)))
        T1, dtheta1, dv1 = T, dtheta, dv
        used += 1
        s["elapsed_ns"] += sample["interval_ns"]
        s["block_ns"] += sample["interval_ns"]
        if s["block_ns"] >= BLOCK_NS:
            s["filled"] += 1
            s["block_ns"] = 0
    put_quaternion(s["q_ib"], q)
    s["T1"] = T1
    put(s["dtheta1"], 0, dtheta1)
    put(s["dv1"], 0, dv1)
    return used


@kernel
def _add_to(block: np.void, T: float, velocity_i: Vector, dtheta: Vector, dv: Vector) -> None:
    """Add a sample to a block."""
    block["dt"] += T
    _gain(block["velocity_i"], velocity_i)
    _gain(block["dtheta_b"], dtheta)
    _gain(block["dv_b"], dv)


@kernel
def _gain(total: Array, v: Vector) -> None:
    put(total, 0, add(vector_at(total, 0), v))


class _Seconds(NamedTuple):
    """Blocks joined to seconds, the last one ending with the last block."""

    dt: Array  # (n,)
    velocity_i: Array  # (n, 3), gained, m/s
    middle: Array  # (n,), time from the end, negative


class _Noise(NamedTuple):
    velocity: float  # white, m/s
    tilt: float  # random walk, rad/sqrt(s)


def _summed(blocks: Records, count: int) -> Records:
    """Sum groups of `count` blocks; `count` divides their number."""
    columns = blocks.view(np.float64).reshape(len(blocks) // count, count, -1)
    summed: Records = columns.sum(axis=1).view(BLOCK)[:, 0]
    return summed


def _seconds(blocks: Records) -> _Seconds:
    n = len(blocks) // _BLOCKS_A_SECOND
    whole = _summed(blocks[len(blocks) - n * _BLOCKS_A_SECOND :], _BLOCKS_A_SECOND)
    dt = whole["dt"]
    begins = -np.cumsum(dt[::-1])[::-1]
    return _Seconds(dt, whole["velocity_i"], begins + 0.5 * dt)


def _coarse(blocks: Records, latitude_rad: float) -> Array:
    """C_nb from the mean specific force and the mean rate."""
    total = _summed(blocks, len(blocks))[0]
    force, rate = total["dv_b"] / total["dt"], total["dtheta_b"] / total["dt"]
    size = float(np.linalg.norm(force))
    if not 9.5 < size < 10.1:
        raise InputError(
            f"alignment: expected gravity, 9.5 to 10.1 m/s^2, as the mean specific force, got {size:.6g} "
            "m/s^2; check the accelerometers' scale factors and that the unit is at rest"
        )
    up = force / size
    east = np.cross(rate, up)
    horizontal, expected = float(np.linalg.norm(east)), earth_rate_n(latitude_rad)[1]
    if not 0.5 * expected < horizontal < 1.5 * expected:
        raise InputError(
            f"alignment: expected the horizontal part of the Earth's rotation, {expected:.4g} rad/s at this "
            f"latitude, as the mean rate, got {horizontal:.4g} rad/s; check the gyros' calibration and that "
            "the unit is at rest"
        )
    vertical, of_site = float(rate @ up), earth_rate_n(latitude_rad)[2]
    if abs(vertical - of_site) > max(abs(of_site), LEAST_VERTICAL):
        raise InputError(
            "alignment: expected the vertical part of the Earth's rotation, "
            f"{of_site / DEG_PER_H:+.2f} deg/h at this latitude, in the mean rate, got "
            f"{vertical / DEG_PER_H:+.2f} deg/h; check the sign of the latitude, the gyros' signs, and that "
            "the unit is at rest"
        )
    east /= horizontal
    return np.array([east, np.cross(up, east), up])


def _navigated(seconds: _Seconds, C_ni: Array, latitude_rad: float) -> Array:
    """Velocity east and north at the end of each second, with n at the window's end in the attitude C_ni.

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
    model = np.stack([np.full(len(lags), 20.0), gravity**2 * (lags * dt.mean()) ** 3], axis=1)
    # a variance over lag L comes from 1 / L as many independent differences
    weight = 1.0 / (np.maximum(variance, _LEAST_VELOCITY**2) * np.sqrt(lags))
    velocity, tilt = np.sqrt(fit_noise_model(variance, model, weight)).tolist()
    return _Noise(max(velocity, _LEAST_VELOCITY), tilt)


def _filtered(v: Array, dt: Array, gravity: float, noise: _Noise) -> tuple[Array, Array, Array]:
    """Tilts about east and north at the end, their rates, and the covariance of (velocity, tilt, rate)."""
    # the velocities whose derivatives are +g times the tilts about east and north
    measured = np.stack([v[:, 1], -v[:, 0]], axis=1)
    x = np.zeros((3, 2))
    covariance = np.diag([1.0, 0.1, 1e-4]) ** 2  # nothing is known
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
        covariance = keep @ covariance @ keep.T + white * np.outer(K, K)  # the Joseph form stays positive
    return x[1], x[2], covariance


def _motion(blocks: Records) -> RestMotion | None:
    """Return the interval with the largest deviation, if it is much larger than in the quietest ones."""
    n = len(blocks) // WINDOW_BLOCKS
    ends = np.cumsum(blocks["dt"])
    worst, found = 1.0, None
    for what, name, unit_name, least in (
        ("rate", "dtheta_b", "rad/s", LEAST_RATE),
        ("specific force", "dv_b", "m/s^2", LEAST_FORCE),
    ):
        mean = blocks[name] / blocks["dt"][:, None]
        deviation = ((mean - np.median(mean, axis=0)) ** 2).sum(axis=1)
        rms = np.sqrt(deviation[: n * WINDOW_BLOCKS].reshape(n, WINDOW_BLOCKS).mean(axis=1))
        limit = max(MOTION_RATIO * float(np.quantile(rms, 0.2)), least)
        k = int(np.argmax(rms))
        if rms[k] > worst * limit:
            worst = float(rms[k]) / limit
            end = ends[(k + 1) * WINDOW_BLOCKS - 1]
            begin = end - blocks["dt"][k * WINDOW_BLOCKS : (k + 1) * WINDOW_BLOCKS].sum()
            found = RestMotion(float(begin), float(end), what, unit_name, float(rms[k]), limit)
    return found
