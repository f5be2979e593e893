r"""Equations of the rests and motions, with their Jacobians and covariance (contract, 3.2 to 3.4).

With up = (0, 0, 1), f = g up, C_k = C_nb of rest k, n level and turning with the Earth, and T of a motion:

    rest      W nu - beta - C_k^T omega_ie = 0              M (e - q e^2) - C_k^T f = 0                  (2)
    motion    log( E^T C_k dC C_k+1^T ) = 0                                                             (3)
              C_k u - G1 f - omega_ie x x(T) = 0            x(T) = C_k w - G2 f                           (4)
              x(T) = 0                                      where the origin of b stays where it is       (5)

with E = exp(omega_ie T x), G1 and G2 its first and second integral. A row is in the axes of b for a rest and
of n for a motion. Each rest has an attitude error psi, `C_k <- exp(psi x) C_k`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from calib.detection.rest_bins import Noise, RestBins
from calib.sensors.evidence import Evidence, Link, edge_variance
from calib.sensors.motion import integrate
from calib.sensors.parameters import (
    ACCELEROMETER_SCALE_T,
    B_T,
    BASE,
    BETA,
    BETA_T,
    COLUMNS,
    EARTH,
    GRAVITY,
    GYRO_SCALE_T,
    B,
    M,
    Parameters,
    Q,
    W,
)
from imudrv.arrays import Array
from imudrv.units import DEG_PER_H, UG

WANDER_S: Final = 750.0
"""Time constant of the wander of the biases, s."""
GYRO_WANDER_CEILING: Final = 0.01 * DEG_PER_H
ACCELEROMETER_WANDER_CEILING: Final = 10 * UG
"""Most wander that is believed, rad/s and m/s^2: more would hide faults."""


class Block(NamedTuple):
    """Rows of a rest or of a motion."""

    rows: slice
    is_motion: bool
    number: int  # of the rest or of the link


@dataclass(frozen=True)
class LinearSystem:
    """Residuals of the equations at a point, and how they change.

    Attributes
    ----------
    residual : ndarray, shape (n,)
    J : ndarray, shape (n, COLUMNS + 3 k)
        By the parameters and the attitudes of the k rests.
    V : ndarray, shape (n, n)
        Covariance by the noise and the pulses at the edges of the rests.
    wander : tuple of two ndarray, shape (n, n)
        Covariance by a wander of the gyros, and of the accelerometers, of 1 rad/s and 1 m/s^2.
    blocks : tuple of Block
    """

    residual: Array
    J: Array
    V: Array
    wander: tuple[Array, Array]
    blocks: tuple[Block, ...]


def skew_matrix(v: Array) -> Array:
    """Return `[v x]`."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def at_temperature(p: Parameters, degc: Array, reference: Array) -> Parameters:
    """Return the parameters at the temperatures of the gyros and of each accelerometer, shape (4,)."""
    dt, s = _kelvins(degc, reference), p.slopes
    lengths = 1.0 + s.accelerometer_scale * dt[1:]
    # s / lengths - b dt is kept as one change of M, b and q on the sensing axes
    return replace(
        p,
        W=p.W * (1.0 + s.gyro_scale * dt[0]),
        beta=p.beta + s.beta * dt[0],
        M=p.M / lengths,
        b=(p.b + s.b * dt[1:]) * lengths,
        q=p.q / lengths if p.nonlinearity == "quadratic" else p.q,
    )


def _kelvins(degc: Array, reference: Array) -> Array:
    return np.nan_to_num(np.asarray(degc) - reference)


def temperature_columns(J: Array, p: Parameters, degc: Array, reference: Array) -> Array:
    """Return columns of the parameters, slopes included, from those of the base, shape (n, COLUMNS)."""
    dt = _kelvins(degc, reference)
    out = np.zeros((len(J), COLUMNS))
    out[:, :BASE] = J
    out[:, BETA_T] = dt[0] * J[:, BETA]
    out[:, B_T] = dt[1:] * J[:, B]
    by_w, by_m = J[:, W].reshape(-1, 3, 3), J[:, M].reshape(-1, 3, 3)
    out[:, GYRO_SCALE_T] = dt[0] * np.einsum("nij,ij->nj", by_w, p.W)
    out[:, ACCELEROMETER_SCALE_T] = -dt[1:] * (np.einsum("nij,ij->nj", by_m, p.M) - p.b * J[:, B])
    return out


class Equations:
    """Equations of an evidence.

    Parameters
    ----------
    evidence : Evidence
    reference_degc : float
        Temperature at which the slopes add nothing; NaN where none is measured.
    fixed_pivot : bool
        Whether the origin of b stays where it is.
    """

    def __init__(self, evidence: Evidence, reference_degc: float, fixed_pivot: bool) -> None:
        self.evidence = evidence
        self.rests, self.links = evidence.rests, evidence.links
        self.reference_degc = np.full(4, reference_degc)
        self.fixed_pivot = fixed_pivot
        self._edges = [edge_sigmas(rest, evidence.noise, evidence.quanta) for rest in self.rests]
        self._correlation = wander_correlation(self.rests)

    def system(self, p: Parameters, attitudes: Sequence[Array]) -> LinearSystem:
        """Return the equations linearised at parameters and attitudes."""
        K, noise = len(self.rests), self.evidence.noise
        parts: list[_Part] = []
        at = [at_temperature(p, rest.degc, self.reference_degc) for rest in self.rests]
        readings = [_reading(rest, own) for rest, own in zip(self.rests, at, strict=True)]
        for k, rest in enumerate(self.rests):
            parts.append(self._rest(k, rest, at[k], p, attitudes[k], noise))
        for number, link in enumerate(self.links):
            parts.append(self._motion(number, link, p, attitudes, readings, noise))
        n = sum(len(part.residual) for part in parts)
        residual, J, V = np.zeros(n), np.zeros((n, COLUMNS + 3 * K)), np.zeros((n, n))
        edges, wander, blocks, begin = np.zeros((n, 12 * K)), np.zeros((n, 6 * K)), [], 0
        for part in parts:
            rows = slice(begin, begin + len(part.residual))
            begin = rows.stop
            residual[rows], V[rows, rows] = part.residual, part.V
            J[rows, :COLUMNS] = part.J
            for k, psi in part.psi.items():
                J[rows, COLUMNS + 3 * k : COLUMNS + 3 * k + 3] = psi
            for (k, end), by_edge in part.edges.items():
                edges[rows, 12 * k + 6 * end : 12 * k + 6 * end + 6] = by_edge
            for k, by_bias in part.wander.items():
                wander[rows, 6 * k : 6 * k + 6] += by_bias
            blocks.append(Block(rows, part.is_motion, part.number))
        scaled = edges * np.concatenate([np.tile(e, 2) for e in self._edges])
        V += scaled @ scaled.T
        return LinearSystem(residual, J, V, self._wander(wander), tuple(blocks))

    def _wander(self, by_bias: Array) -> tuple[Array, Array]:
        """Return the covariance of wandering gyros and accelerometers of unit size."""
        n, K = by_bias.shape[0], len(self.rests)
        by_rest = by_bias.reshape(n, K, 6)
        gyro, accelerometer = (
            np.einsum("nka,kl,mla->nm", own, self._correlation, own, optimize=True)
            for own in (by_rest[:, :, :3], by_rest[:, :, 3:])
        )
        return gyro, accelerometer

    def _rest(
        self, k: int, rest: RestBins, own: Parameters, p: Parameters, C: Array, noise: Noise
    ) -> "_Part":
        nu, s = rest.rate[:3], rest.rate[3:]
        e = s - own.b
        curve = curved(e, own)
        omega = own.W @ nu - own.beta
        force = own.M @ (e - own.q * curve)
        residual = np.concatenate([omega - C.T @ p.omega_ie_n, force - C.T @ p.f_n])
        base = np.zeros((6, BASE))
        base[:3, W], base[:3, BETA] = np.kron(np.eye(3), nu), -np.eye(3)
        base[3:, M], base[3:, B], base[3:, Q] = np.kron(np.eye(3), e - own.q * curve), -own.M, -own.M * curve
        J = temperature_columns(base, p, rest.degc, self.reference_degc)
        J[:3, EARTH], J[3:, GRAVITY] = -C.T[:, 1:], -C.T[:, 2:]
        psi = np.concatenate([-C.T @ skew_matrix(p.omega_ie_n), -C.T @ skew_matrix(p.f_n)])
        D = rest.duration_s
        V = np.diag(np.repeat([noise.angle_walk**2 / D, noise.velocity_walk**2 / D], 3))
        by_count = np.zeros((6, 6))
        by_count[:3, :3], by_count[3:, 3:] = own.W / D, own.M / D
        by_bias = -np.eye(6)
        return _Part(residual, J, V, {k: psi}, {(k, 0): -by_count, (k, 1): by_count}, {k: by_bias}, False, k)

    def _motion(
        self,
        number: int,
        link: Link,
        p: Parameters,
        attitudes: Sequence[Array],
        readings: Sequence[tuple[Array, Array]],
        noise: Noise,
    ) -> "_Part":
        a, z = link.before, link.after
        before, after = self.rests[a], self.rests[z]
        degc = 0.5 * (before.degc + after.degc)
        own = at_temperature(p, degc, self.reference_degc)
        motion = integrate(
            link.samples,
            own,
            (readings[a][0], readings[z][0]),
            (readings[a][1], readings[z][1]),
            self.evidence.rate_filter,
        )
        C, C_after, f, omega = attitudes[a], attitudes[z], p.f_n, p.omega_ie_n
        T = motion.duration_s
        E, G1, G2 = _earth_turns(omega, T)
        x = C @ motion.w - G2 @ f
        turn = E.T @ C @ motion.C @ C_after.T
        phi = Rotation.from_matrix(turn).as_rotvec()
        v = C @ motion.u - G1 @ f - np.cross(omega, x)
        residual = np.concatenate([phi, v, x])

        across, up = skew_matrix(omega), np.array([0.0, 0.0, 1.0])
        base = np.zeros((9, BASE))
        base[:3, W], base[:3, BETA] = E.T @ C @ motion.P[:, :9], E.T @ C @ motion.P[:, 9:]
        base[6:] = C @ motion.X
        base[3:6] = C @ motion.U - across @ base[6:]
        J = temperature_columns(base, p, degc, self.reference_degc)
        J[3:6, GRAVITY] = -(G1 @ up - across @ G2 @ up)[:, None]
        J[6:, GRAVITY] = -(G2 @ up)[:, None]
        J[:3, EARTH] = -T * np.eye(3)[:, 1:]
        J[3:6, EARTH] = (0.5 * T * T * skew_matrix(f))[:, 1:]
        J[6:, EARTH] = (T**3 / 6.0 * skew_matrix(f))[:, 1:]
        psi = np.zeros((9, 3))
        psi[:3], psi[6:] = E.T, -skew_matrix(C @ motion.w)
        psi[3:6] = -skew_matrix(C @ motion.u) - across @ psi[6:]
        psi_after = np.zeros((9, 3))
        psi_after[:3] = -turn

        begin, end = np.zeros((9, 6)), np.zeros((9, 6))
        CW, CM = C @ own.W, C @ own.M
        begin[:3, :3], end[:3, :3] = -CW, C_after @ own.W
        begin[3:6, :3], begin[3:6, 3:], end[3:6, 3:] = skew_matrix(C @ motion.u) @ CW, -CM, C_after @ own.M
        begin[6:, :3], begin[6:, 3:] = skew_matrix(C @ motion.w) @ CW, -T * CM
        by_bias = np.concatenate([base[:, BETA], base[:, B] @ np.linalg.inv(own.M)], axis=1)
        V = motion_covariance(noise, f, T)
        used = slice(0, 9 if self.fixed_pivot else 6)
        return _Part(
            residual[used],
            J[used],
            V[used, used],
            {a: psi[used], z: psi_after[used]},
            {(a, 1): begin[used], (z, 0): end[used]},
            {a: 0.5 * by_bias[used], z: 0.5 * by_bias[used]},
            True,
            number,
        )


class _Part(NamedTuple):
    """Rows of one rest or motion."""

    residual: Array
    J: Array  # (n, COLUMNS)
    V: Array
    psi: dict[int, Array]  # by the attitude of a rest
    edges: dict[tuple[int, int], Array]  # by the count at the begin (0) or end (1) of a rest
    wander: dict[int, Array]  # by the biases of a rest, rad/s and m/s^2, body axes
    is_motion: bool
    number: int


def _reading(rest: RestBins, own: Parameters) -> tuple[Array, Array]:
    """Return rate and force of a rest, body axes."""
    e = rest.rate[3:] - own.b
    return own.W @ rest.rate[:3] - own.beta, own.M @ (e - own.q * curved(e, own))


def curved(e: Array, p: Parameters) -> Array:
    """Return e^2, or |e| / 2."""
    return e * e if p.nonlinearity == "quadratic" else 0.5 * np.abs(e)


def edge_sigmas(rest: RestBins, noise: Noise, quanta: tuple[float, float]) -> Array:
    """Return the uncertainty of the counts at both ends of a rest, shape (6,), rad and m/s.

    The pulse, and the walk within the bin that the count is the mean of.
    """
    walk = np.repeat([noise.angle_walk**2, noise.velocity_walk**2], 3) * rest.bin_s / 3.0
    quantum = np.repeat(quanta, 3)
    with np.errstate(divide="ignore", invalid="ignore"):
        pulses = np.where(quantum > 0.0, rest.rate * rest.bin_s / quantum, 0.0)
    sigma: Array = np.sqrt(walk + edge_variance(pulses) * quantum**2)
    return sigma


def wander_correlation(rests: Sequence[RestBins]) -> Array:
    """Return the correlation of the wander of rests; none between captures."""
    t = np.array([0.5 * (rest.start_s + rest.stop_s) for rest in rests])
    session = np.array([rest.session for rest in rests])
    together = session[:, None] == session
    return np.where(together, np.exp(-np.abs(t[:, None] - t) / WANDER_S), 0.0)


def motion_covariance(noise: Noise, f: Array, T: float) -> Array:
    """Return the covariance of angle, velocity and displacement of a motion, shape (9, 9), axes of n.

    Random walks of angle and velocity, and the specific force f all the time (contract, 3.4).
    """
    qa, qv = noise.angle_walk**2, noise.velocity_walk**2
    F, one = skew_matrix(f), np.eye(3)
    FF = F @ F.T
    V = np.zeros((9, 9))
    V[:3, :3] = qa * T * one
    V[3:6, :3] = -F * qa * T**2 / 2
    V[3:6, 3:6] = qv * T * one + FF * qa * T**3 / 3
    V[6:, :3] = -F * qa * T**3 / 6
    V[6:, 3:6] = qv * T**2 / 2 * one + FF * qa * T**4 / 8
    V[6:, 6:] = qv * T**3 / 3 * one + FF * qa * T**5 / 20
    for i, j in ((3, 0), (6, 0), (6, 3)):
        V[j : j + 3, i : i + 3] = V[i : i + 3, j : j + 3].T
    return V


def _earth_turns(omega: Array, T: float) -> tuple[Array, Array, Array]:
    """Return E, G1 and G2: the turn of the Earth, and its integrals."""
    X = skew_matrix(omega)
    XX = X @ X
    one = np.eye(3)
    E = Rotation.from_rotvec(omega * T).as_matrix()
    G1 = T * one + T**2 / 2 * X + T**3 / 6 * XX
    G2 = T**2 / 2 * one + T**3 / 6 * X + T**4 / 24 * XX
    return E, G1, G2


def start_attitudes(p: Parameters, evidence: Evidence, reference_degc: float) -> list[Array]:
    """Return the attitude of each rest from its rate and force (two vectors)."""
    reference = np.full(4, reference_degc)
    attitudes = []
    for rest in evidence.rests:
        rate, force = _reading(rest, at_temperature(p, rest.degc, reference))
        up = force / np.linalg.norm(force)
        east = np.cross(rate, up)
        size = float(np.linalg.norm(east))
        east = east / size if size > 0.0 else np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        east = east / np.linalg.norm(east)
        attitudes.append(np.stack([east, np.cross(up, east), up]))
    return attitudes
