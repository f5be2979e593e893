"""Derivatives of the navigated velocity by the lever arms and the residual errors.

Measured minus true velocity of a run (mathematics, section 4; the matrices H, B, P, Q are those of
`imudrv.nav.mechanisation`):

    d/dt delta v = C_nb (S R + b_a + dA f_b + dS R) + f_n x phi - 2 omega_ie x delta v
    phi(t)       = (I - t [omega_ie x]) phi_0 - B b_g - P vec(dG)

with f_n and f_b the specific force at the origin: as navigated, less d/dt delta v. b_a and b_g are the biases
common to all runs and the change of this run together. phi_0, the error of tilt and heading at the start, is
a parameter of the run. Heading is included because the Earth's rotation turns its error into a tilt rate as
large as that of a gyro bias.

**Second order.** The misalignments act on the acceleration of the origin and on the size effect, too: S R is
computed with rates and sensing directions that are off by dG and dA. For a known R this is linear in them,

    dS R = C_ba [ a_i . ( dA Omega R_i - dOmega(dG omega) R_i ) ]
    dOmega(w) = [w' x] + [w x][omega x] + [omega x][w x]

so that the estimate is made twice, first without acceleration and without dS. 1 mrad makes 35 um of 35 mm.

**Back action.** The navigator answers a velocity error with Coriolis' acceleration, which H contains and the
other columns get here, and with transport rate: after many turns metres per second have become a tilt, and

    delta v(t) + g / R_e  integral integral delta v

is free of it (Schuler). The true motion of the unit, some centimetres, does not matter there.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation as Attitude

from calib.estimation.runs import Run
from imudrv.arrays import Array
from imudrv.nav.earth import SEMI_MAJOR_AXIS, earth_rate_n

EARTH_RADIUS: Final = SEMI_MAJOR_AXIS
"""m; a difference of half a percent makes 1e-5 of the velocity."""


class Known(NamedTuple):
    """A first estimate."""

    R: Array  # (9,), m
    error_n: Array  # (n, 3), velocity error of each row, m/s


class Design:
    """Derivatives of the velocity of a run by its parameters.

    Columns are those of R (9); of b_a, dA, b_g, dG and the terms; of phi_0 and the changes of b_a and b_g;
    and two for each turn, a step of velocity east and north.

    Parameters
    ----------
    run : Run
        A navigated run.
    terms : sequence of {'skew', 'quadratic'}
        Parameters beyond biases and matrices.
    known : Known, optional
        A first estimate, for the second order.
    """

    def __init__(self, run: Run, terms: Sequence[str], known: Known | None = None) -> None:
        self._run = run
        self._turning = np.cross(np.eye(3), earth_rate_n(float(run.rows["latitude_rad"][0])))  # [omega_ie x]
        self._columns = self._rows(terms, known)
        self._H = [run.rows["H"][at].mean(axis=0) for at in run.arrests]
        self._middle_s = [float(run.t_s[at].mean()) for at in run.arrests]
        self._H[0] = np.zeros((3, 9))

    def at(self, t_s: Array, arrest: NDArray[np.int64]) -> Array:
        """Return the columns at some times in the arrests, shape (n, 3, columns).

        At rest H is constant except for the Coriolis acceleration, and zero before the first turn: the noise
        of the rate at a row's end, up to 2e-3 m/s per metre, would look like a signal of the gauge.
        """
        turns = len(self._run.turns)
        H, middle_s = np.array(self._H)[arrest], np.array(self._middle_s)[arrest]
        H = H - (t_s - middle_s)[:, None, None] * (2.0 * self._turning @ H)
        begins = np.array([self._run.t_s[at][0] for at in self._run.arrests])
        steps = np.zeros((len(t_s), 3, turns, 2))
        for k in range(turns):
            since = (t_s - begins[k + 1])[:, None, None]
            step = (np.eye(3) - since * 2.0 * self._turning)[:, :, :2]
            steps[:, :, k] = np.where((arrest > k)[:, None, None], step, 0.0)
        return np.concatenate([H, self._others(t_s), steps.reshape(len(t_s), 3, -1)], axis=2)

    def of_rows(self, rows: NDArray[np.int64]) -> Array:
        """Return the columns of rows in motion, H as navigated and no steps, shape (n, 3, columns)."""
        steps = np.zeros((len(rows), 3, 2 * len(self._run.turns)))
        return np.concatenate([self._run.rows["H"][rows], self._columns[rows], steps], axis=2)

    def known(self, x: Array) -> Known:
        """Return an estimate of all parameters of the run as the first one for another design."""
        columns = self._columns.shape[2]
        return Known(x[:9], self._run.rows["H"] @ x[:9] + self._columns @ x[9 : 9 + columns])

    def _others(self, t_s: Array) -> Array:
        return interpolated(self._run.t_s, self._columns, t_s)

    def _rows(self, terms: Sequence[str], known: Known | None) -> Array:
        """Return the columns between those of R and the steps, of each row."""
        rows, t = self._run.rows, self._run.t_s
        n, dt = len(t), np.diff(t, prepend=0.0)
        dB = np.diff(rows["B"], axis=0, prepend=np.zeros((1, 3, 3)))
        C = dB / dt[:, None, None]  # C_nb, mean of a row
        f_n = _force(self._run, dt, known)
        f_b = np.einsum("nji,nj->ni", C, f_n)
        dQ = np.diff(rows["Q"], axis=0, prepend=np.zeros((1, 3, 9)))
        of_dA, of_dG = _second_order(self._run, C, dt, np.zeros(9) if known is None else known.R)

        def summed(rate: Array) -> Array:
            """Integral of a rate, with the Coriolis acceleration of the velocity that it makes."""
            velocity = np.cumsum(dt[:, None, None] * rate, axis=0)
            middle = velocity - 0.5 * dt[:, None, None] * rate
            return np.asarray(
                velocity - 2.0 * self._turning @ np.cumsum(dt[:, None, None] * middle, axis=0), np.float64
            )

        def tilted(phi: Array) -> Array:
            """Velocity due to tilts and heading errors phi, means of a row, (n, 3, m)."""
            return summed(np.cross(f_n[:, :, None], phi, axis=1))

        acceleration_bias = summed(C)
        gyro_bias = tilted(0.5 * dB - rows["B"])
        parts = [
            acceleration_bias,
            summed(np.einsum("nij,nk->nijk", C, f_b).reshape(n, 3, 9) + of_dA),
            gyro_bias,
            tilted(-dQ / dt[:, None, None]) + summed(of_dG),
        ]
        if "skew" in terms:
            parts.append(_skew_column(self._run, C, dt))
        if "quadratic" in terms:
            parts.append(summed(C * (f_b * f_b)[:, None, :]))
        phi_0 = tilted(np.eye(3) - (t - 0.5 * dt)[:, None, None] * self._turning)
        return np.concatenate([*parts, phi_0, acceleration_bias, gyro_bias], axis=2)


def back_action(run: Run) -> Array:
    """Return what has to be added to the velocity of each row to free it of Schuler's back action, m/s."""
    dt = np.diff(run.t_s, prepend=0.0)[:, None]
    position = np.cumsum(dt * run.v_n, axis=0)
    added = run.gravity / EARTH_RADIUS * np.cumsum(dt * position, axis=0)
    added[:, 2] = 0.0
    return np.asarray(added, np.float64)


def interpolated(t_s: Array, x: Array, at_s: Array) -> Array:
    """Interpolate rows, which are zero at time zero, linearly."""
    t_s = np.concatenate([[0.0], t_s])
    k = np.clip(np.searchsorted(t_s, at_s), 1, len(t_s) - 1)
    share = ((at_s - t_s[k - 1]) / (t_s[k] - t_s[k - 1])).reshape(-1, *[1] * (x.ndim - 1))
    before = np.where((k > 1).reshape(share.shape), x[np.maximum(k - 2, 0)], 0.0)
    return np.asarray(before + share * (x[k - 1] - before), np.float64)


def _force(run: Run, dt: Array, known: Known | None) -> Array:
    """Return the mean specific force of the origin in each row, in n, at rest without noise."""
    acceleration = np.zeros((len(dt), 3)) if known is None else _acceleration(run, dt, known.error_n)
    return np.asarray(acceleration + np.array([0.0, 0.0, run.gravity]), np.float64)


def _acceleration(run: Run, dt: Array, error_n: Array) -> Array:
    """Return the acceleration of each row in n: as navigated, less that of a velocity error."""
    velocity = run.rows["v_n"] - error_n
    acceleration = np.diff(velocity, axis=0, prepend=np.zeros((1, 3))) / dt[:, None]
    acceleration[run.at_rest] = 0.0
    return np.asarray(acceleration, np.float64)


def _second_order(run: Run, C: Array, dt: Array, R: Array) -> tuple[Array, Array]:
    """Return the rates of velocity by dA and dG through the size effect of known arms, (n, 3, 9) each."""
    A, r = np.linalg.inv(run.C_ba), R.reshape(3, 3)
    dP = np.diff(run.rows["P"], axis=0, prepend=np.zeros((1, 3, 9))).reshape(-1, 3, 3, 3)
    omega = np.einsum("ncj,ncjk->nk", C, dP) / (3.0 * dt[:, None])
    omega_dot = np.gradient(omega, run.t_s, axis=0)
    cross = _cross_matrix(omega)
    moved = np.einsum("nij,kj->nki", _cross_matrix(omega_dot) + cross @ cross, r)  # Omega R_k
    M = C @ run.C_ba
    of_dA = np.einsum("nci,ij,nik->ncjk", M, A, moved)
    unit = _cross_matrix(np.eye(3))  # [e_j x]
    tangential = np.einsum("ia,jab,ib->ij", A, unit, r)
    centripetal = np.einsum("ia,njab,ib->nij", A, unit @ cross[:, None] + cross[:, None] @ unit, r)
    sensitivity = np.einsum("ij,nk->nijk", tangential, omega_dot) + np.einsum(
        "nij,nk->nijk", centripetal, omega
    )
    of_dG = -np.einsum("nci,nijk->ncjk", M, sensitivity)
    return of_dA.reshape(-1, 3, 9), of_dG.reshape(-1, 3, 9)


def _cross_matrix(v: Array) -> Array:
    """Return [v x] of each row, (n, 3, 3)."""
    return np.asarray(np.cross(np.eye(3), v[:, None, :]), np.float64)


def _skew_column(run: Run, C: Array, dt: Array) -> Array:
    """Return the derivative of the velocity by a skew s: the accelerometers sense `f_b(t + s)`.

        integral of C_nb df_b = f_n(t) - f_n(0) - integral of dC_nb f_b

    with the specific force as navigated. At rest the first two cancel, up to the very turn: velocities change
    there by pulses and noise, which may not determine the skew. In a turn their difference is the
    acceleration between the means over a row before and after, which a vibration of the case is not in.
    """
    C_nb = Attitude.from_quat(np.roll(run.rows["q_nb"], -1, axis=1)).as_matrix()
    f_n = _acceleration(run, dt, np.zeros((len(dt), 3))) + np.array([0.0, 0.0, run.gravity])
    f_b = np.einsum("nji,nj->ni", C, f_n)
    counter = run.rows["counter"]
    moving = np.any([(turn.start <= counter) & (counter < turn.stop) for turn in run.turns], axis=0)
    column = -np.cumsum(np.einsum("nij,nj->ni", np.diff(C_nb, axis=0, prepend=C_nb[:1]), f_b), axis=0)
    of_means = np.diff(run.v_n, axis=0, append=run.v_n[-1:]) / dt[:, None]
    column[moving] += of_means[moving]
    return np.asarray(column[:, :, None], np.float64)
