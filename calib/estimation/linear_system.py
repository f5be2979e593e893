"""Design matrix, noise covariance and normal equations of a session; observability."""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation as Attitude

from calib.detection.blocks import BLOCK_NS
from calib.detection.noise import BIN_S, Noise, pooled_noise
from calib.detection.segments import Rest
from calib.estimation.result import Extra, RunResult, TurnResult
from calib.estimation.runs import Priors, Run
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.nav.earth import earth_rate_n
from imudrv.units import MM, NS

ROWS_PER_BIN: Final = round(BIN_S / (BLOCK_NS * NS))
"""Rows at rest that are averaged into one equation."""


ROWS_PER_POINT: Final = 5
"""With a known pivot, every n-th row during the motion also becomes an equation."""


GAIN_WINDOW_S: Final = 0.5
"""Averaging window for the velocity before and after the rotation, s."""


OWN_RATIO: Final = 2.0
"""A rest whose white noise exceeds the pooled value by this factor keeps its own."""


TILT_SIGMA: Final = 5e-3
"""Prior sigma of the initial tilts, rad; wide, because the rest before the rotation determines them."""


LEAST_NOISE: Final = Noise(angle_walk=1e-7, velocity_walk=1e-6, velocity_white=3e-6, velocity_pulse=3e-5)
"""Lower bound of the noise, for the effects that linear equations neglect."""


ROUNDING: Final = 1e-7
"""Directions weaker than the best by this factor are below numerical precision."""


class Parameters(NamedTuple):
    """Names and priors of a session's parameters other than R, in the order of their columns.

    Attributes
    ----------
    names : tuple of str
        Such as 'accelerometer_bias_x'.
    sigma : ndarray, shape (n,)
        Prior sigmas, SI.
    shared : int
        Number of parameters common to all runs; those of the first run, the second, ... follow.
    """

    names: tuple[str, ...]
    sigma: Array
    shared: int

    def columns_of(self, k: int, runs: int) -> NDArray[np.int64]:
        """Return the columns, R first, of the parameters of run k of `runs`."""
        own = (len(self.sigma) - self.shared) // runs
        shared = 9 + self.shared
        return np.concatenate([np.arange(shared), shared + own * k + np.arange(own)])


class RunEquations(NamedTuple):
    """Equations of a run, `v = columns @ (R, shared, phi_0)`, and their whitened sums."""

    t_s: Array  # (n,)
    v_n: Array  # (n, 2), or (n, 3) with a known pivot
    columns: Array  # (n, 2 or 3, 9 + shared + 3)
    N: Array
    b: Array
    yy: float


class NormalEquations:
    """Normal equations of a session for R, the parameters common to all runs, and phi_0 of each run."""

    def __init__(self, parts: Sequence[RunEquations], parameters: Parameters) -> None:
        self.parts, self.parameters = parts, parameters
        self.scale = np.concatenate([np.full(9, 0.1), parameters.sigma])
        n = len(self.scale)
        self.N, self.b = np.diag(np.concatenate([np.zeros(9), parameters.sigma**-2])), np.zeros(n)
        for k, part in enumerate(parts):
            at = self.columns_of(k)
            self.N[np.ix_(at, at)] += part.N
            self.b[at] += part.b

    def columns_of(self, k: int) -> NDArray[np.int64]:
        """Return the columns of a run's parameters."""
        return self.parameters.columns_of(k, len(self.parts))

    def without(self, k: int) -> "NormalEquations":
        """Return the equations without the data of a run."""
        other = object.__new__(NormalEquations)
        other.parts, other.parameters, other.scale = self.parts, self.parameters, self.scale
        other.N, other.b = self.N.copy(), self.b.copy()
        at = self.columns_of(k)
        other.N[np.ix_(at, at)] -= self.parts[k].N
        other.b[at] -= self.parts[k].b
        return other

    def directions(self) -> tuple[Array, Array]:
        """Return 1-sigma of the principal directions of R, best first, and the directions as columns."""
        N = self.N * np.outer(self.scale, self.scale)
        information = N[:9, :9] - N[:9, 9:] @ np.linalg.solve(N[9:, 9:], N[9:, :9])
        values, vectors = np.linalg.eigh(0.5 * (information + information.T))
        least = ROUNDING**2 * values[-1]
        return self.scale[0] / np.sqrt(np.maximum(values[::-1], least)), vectors[:, ::-1]

    def solve(self, basis: Array) -> tuple[Array, Array]:
        """Return estimate and covariance of all parameters, R within the span of `basis`."""
        n = len(self.scale)
        T = np.zeros((n, n - 9 + basis.shape[1]))
        T[:9, : basis.shape[1]], T[9:, basis.shape[1] :] = basis, np.eye(n - 9)
        T *= self.scale[:, None]
        covariance = T @ np.linalg.inv(T.T @ self.N @ T) @ T.T
        return covariance @ self.b, covariance

    def chi_square(self, x: Array, of_R: int) -> tuple[float, int]:
        """Return chi-square of residuals and priors, and degrees of freedom; each prior is an equation."""
        yy = sum(part.yy for part in self.parts)
        count = sum(part.v_n.size for part in self.parts)
        return float(yy - 2.0 * self.b @ x + x @ self.N @ x), count - of_R


def prior_parameters(runs: Sequence[Run], priors: Priors, terms: Sequence[str]) -> Parameters:
    """Return names and priors of all parameters but R."""
    off = ~np.eye(3, dtype=bool)
    accelerometer = np.where(off, priors.accelerometer_misalignment, priors.accelerometer_scale)
    gyro = np.where(off, priors.gyro_misalignment, priors.gyro_scale)
    entries = [f"{a}{b}" for a in "xyz" for b in "xyz"]
    groups: list[tuple[str, Sequence[str], Array]] = [
        ("accelerometer_bias", "xyz", np.full(3, priors.accelerometer_bias)),
        ("accelerometer_matrix", entries, accelerometer.ravel()),
        ("gyro_bias", "xyz", np.full(3, priors.gyro_bias)),
        ("gyro_matrix", entries, gyro.ravel()),
    ]
    if "skew" in terms:
        groups.append(("skew", ("s",), np.array([priors.skew])))
    if "quadratic" in terms:
        groups.append(("quadratic", "xyz", np.full(3, priors.quadratic)))
    shared = sum(len(sigma) for _, _, sigma in groups)
    groups += [
        (
            f"phi {run.label}",
            ("east", "north", "up"),
            np.array([TILT_SIGMA, TILT_SIGMA, run.aligned.heading_sigma_rad]),
        )
        for run in runs
    ]
    names = tuple(f"{name}_{part}" for name, parts, _ in groups for part in parts)
    return Parameters(names, np.concatenate([sigma for _, _, sigma in groups]), shared)


def rest_noise(runs: Sequence[Run]) -> Noise:
    """Return the noise of all rests of the runs, each counted once."""
    rests = {(run.label.partition("#")[0], rest.start): rest for run in runs for rest in rests_of(run)}
    found = vars(pooled_noise(rest.differences for rest in rests.values()))
    return Noise(**{name: max(value, getattr(LEAST_NOISE, name)) for name, value in found.items()})


def rests_of(run: Run) -> list[Rest]:
    """Return the rest of each arrest."""
    return [run.turns[0].before, *(turn.after for turn in run.turns)]


def bin_variance(rest: Rest, noise: Noise) -> float:
    """Return the variance of a bin's mean beyond that of the random walk to its middle.

    A rest with much more white noise keeps its own: a level accelerometer with at most one pulse per second
    does not average out in a bin. The mean of a random walk varies less than its value in the middle.
    """
    own = rest.noise.velocity_white if rest.noise is not None else 0.0
    white = own if own > OWN_RATIO * noise.velocity_white else noise.velocity_white
    return white**2 - noise.velocity_walk**2 * BIN_S / 6.0


def noise_covariance(t: Array, single: Array, noise: Noise, gravity: float) -> Array:
    """Return the covariance of velocities of one axis at the times t; `single`: independent variances."""
    s, u = np.minimum.outer(t, t), np.maximum.outer(t, t)
    walk, tilt = noise.velocity_walk**2, (gravity * noise.angle_walk) ** 2
    K = walk * s + tilt * s * s * (3.0 * u - s) / 6.0 + noise.velocity_pulse**2 + np.diag(single)
    return np.asarray(K, np.float64)


def design_columns(run: Run, terms: Sequence[str]) -> Array:
    """Return the derivatives of velocity by R, shared parameters and phi_0, (n, 3, 9 + shared + 3)."""
    rows, t = run.rows, run.t_s
    C_nb = Attitude.from_quat(np.roll(rows["q_nb"], -1, axis=1)).as_matrix()
    dt = np.diff(t, prepend=0.0)
    B = rows["B"]
    dB = np.diff(B, axis=0, prepend=np.zeros((1, 3, 3)))
    dB_dt = dB / dt[:, None, None]  # the mean C_nb over a row
    f_n = np.diff(rows["v_n"], axis=0, prepend=np.zeros((1, 3))) / dt[:, None] + [0.0, 0.0, run.gravity]
    f_b = np.einsum("nji,nj->ni", dB_dt, f_n)
    A = np.cumsum(np.einsum("nij,nk->nijk", dB, f_b).reshape(-1, 3, 9), axis=0)
    integral_of_B = np.cumsum(dt[:, None, None] * (B - 0.5 * dB), axis=0)
    earth = earth_rate_n(float(rows["latitude_rad"][0]))
    turning = np.cross(np.eye(3), earth)  # [omega_ie x]
    integral_of_phi = t[:, None, None] * np.eye(3) - 0.5 * (t * t)[:, None, None] * turning
    parts = [
        _settled_H(run, 2.0 * turning),
        B,
        A,
        _tilted(-integral_of_B, run.gravity),
        _tilted(-rows["Q"], run.gravity),
    ]
    if "skew" in terms:
        parts.append(_skew_column(run, C_nb, f_n, f_b))
    if "quadratic" in terms:
        parts.append(np.cumsum(dB * (f_b * f_b)[:, None, :], axis=0))
    return np.concatenate([*parts, _tilted(integral_of_phi, run.gravity)], axis=2)


def _skew_column(run: Run, C_nb: Array, f_n: Array, f_b: Array) -> Array:
    """Return the derivative of the velocity by a skew s: the accelerometers sense `f_b(t + s)`.

        integral of C_nb df_b = f_n(t) - f_n(0) - integral of dC_nb f_b

    At rest the first two cancel. In motion f_n is the mean of the adjacent rows, because a row's own noise is
    also in its velocity.
    """
    moving = ~run.at_rest
    column = -np.cumsum(np.einsum("nij,nj->ni", np.diff(C_nb, axis=0, prepend=C_nb[:1]), f_b), axis=0)
    later = np.concatenate([f_n[1:], f_n[-1:]])
    column[moving] += 0.5 * (f_n + later)[moving] - [0.0, 0.0, run.gravity]
    return column[:, :, None]


def _settled_H(run: Run, coriolis: Array) -> Array:
    """Return H of each row, at rest without the noise of the rate at a row's end.

    At rest H is constant except for the Coriolis acceleration; before the first turn it is zero. That noise,
    up to 2e-3 m/s per metre in a single row, would look like a signal of the gauge.
    """
    H = run.rows["H"].copy()
    H[run.arrests[0]] = 0.0
    for at in run.arrests[1:]:
        t, mean = run.t_s[at], H[at].mean(axis=0)
        H[at] = mean - (t - t.mean())[:, None, None] * (coriolis @ mean)
    return H


def _tilted(phi: Array, gravity: float) -> Array:
    """Return `f_n x phi` for columns phi, (n, 3, m), of a body that does not accelerate."""
    out = np.zeros_like(phi)
    out[:, 0], out[:, 1] = -gravity * phi[:, 1], gravity * phi[:, 0]
    return out


def run_equations(run: Run, noise: Noise, pivot: str, terms: Sequence[str]) -> RunEquations:
    """Return the equations of the rests; with a known pivot also of the motion and the vertical."""
    parts = 3 if pivot == "fixed" else 2
    rows = arrest_bins(run)
    single = [bin_variance(rest, noise) for rest in rests_of(run)]
    if pivot == "fixed":
        rows.append(np.flatnonzero(~run.at_rest)[::ROWS_PER_POINT, None])
        single.append(noise.velocity_pulse**2)
    columns = design_columns(run, terms)[:, :parts]

    def mean(x: Array) -> Array:
        return np.concatenate([x[at].mean(axis=1) for at in rows])

    v_n = np.where(run.at_rest[:, None], run.v_n, run.rows["v_n"])[:, :parts]
    t, v, A = mean(run.t_s), mean(v_n), mean(columns)
    own = np.repeat(single, [len(at) for at in rows])
    L = np.linalg.cholesky(noise_covariance(t, own, noise, run.gravity))
    white_A = solve_triangular(L, A.reshape(len(t), -1), lower=True).reshape(-1, A.shape[2])
    white_v = solve_triangular(L, v, lower=True).ravel()
    return RunEquations(t, v, A, white_A.T @ white_A, white_A.T @ white_v, float(white_v @ white_v))


def arrest_bins(run: Run) -> list[NDArray[np.int64]]:
    """Return the rows of the bins of each arrest, (bins, rows per bin)."""
    return [whole_bins(at, from_the_end=k == 0) for k, at in enumerate(run.arrests)]


def whole_bins(mask: NDArray[np.bool_], from_the_end: bool) -> NDArray[np.int64]:
    """Return the rows of each whole bin, (bins, rows per bin); surplus rows are far from the rotation."""
    at = np.flatnonzero(mask)
    over = len(at) % ROWS_PER_BIN
    at = at[over:] if from_the_end else at[: len(at) - over]
    return at.reshape(-1, ROWS_PER_BIN)


def velocity_gain(run: Run, k: int = 0) -> tuple[Array, Array]:
    """Return the gains V and H of turn k: means over the half second after minus those before."""
    before, after = gain_rows(run, k)
    rows = run.rows
    V = run.v_n[after].mean(axis=0) - run.v_n[before].mean(axis=0)
    return V, rows["H"][after].mean(axis=0) - rows["H"][before].mean(axis=0)


def velocity_gains(runs: Sequence[Run]) -> list[tuple[Array, Array]]:
    """Return the gains V and H of all accepted turns."""
    return [velocity_gain(run, k) for run in runs for k, turn in enumerate(run.turns) if turn.accepted]


def gain_rows(run: Run, k: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of the half second before turn k and of that after it."""
    n = round(GAIN_WINDOW_S / (BLOCK_NS * NS))
    return np.flatnonzero(run.arrests[k])[-n:], np.flatnonzero(run.arrests[k + 1])[:n]


def velocity_at_rest(run: Run, R: Array) -> tuple[Array, Array, Array]:
    """Return times, velocities and H R of the bins at rest."""
    at = np.concatenate(arrest_bins(run))
    rows = run.rows[at]
    return (
        run.t_s[at].mean(axis=1),
        run.v_n[at][..., :2].mean(axis=1),
        (rows["H"][..., :2, :] @ R).mean(axis=1),
    )


def run_result(run: Run, R: Array, t_s: Array, v_n: Array, fitted_n: Array) -> RunResult:
    """Return the result of one run."""
    H_rest = run.rows["H"][gain_rows(run, 0)[0], :2].mean(axis=0)
    turns = []
    for k, (turn, label) in enumerate(zip(run.turns, run.turn_labels, strict=True)):
        V, H = velocity_gain(run, k)
        turns.append(TurnResult(label, turn.accepted, V, H, V - H @ R))
    return RunResult(
        run.label,
        tuple(turns),
        float(np.abs(H_rest).max()),
        t_s,
        v_n[:, :2],
        fitted_n[:, :2],
    )


def singular_values_of(gains: Sequence[tuple[Array, Array]]) -> Array:
    """Return the singular values of the stacked horizontal H, nine of them."""
    s = np.zeros(9)
    H = np.concatenate([h[:2] for _, h in gains])
    s[: min(H.shape)] = np.linalg.svd(H, compute_uv=False)
    return s


def rank_reason(rank: int, sigma: Array, limit: float) -> str:
    """Return the reason for the rank, in words."""
    observable = (
        f"rank {rank}: the observable directions have a sigma of at most {sigma[rank - 1] / MM:.3g} mm"
    )
    if rank == 9:
        return observable
    return f"{observable}, the next one {sigma[rank] / MM:.3g} mm; the limit is {limit / MM:g} mm"


def unobservable_text(sigma: Array, directions: Array, basis: Array, limit: float) -> str:
    """Return the message for rotations that do not determine R; names the directions."""
    wanted = basis.shape[1]
    rank = min(wanted, int((sigma < limit).sum()))
    inside = basis @ basis.T @ directions[:, sigma >= limit]
    vectors, size, _ = np.linalg.svd(inside, full_matrices=False)
    names = "; ".join(_direction(d) for d in vectors[:, size > 0.5].T)
    return (
        f"identification: expected rotations that determine {wanted} directions of the lever arms, "
        f"got {rank}; unobservable to {limit / MM:g} mm: {names}; add rotations with another axis up"
    )


def _direction(d: Array) -> str:
    """Return a direction as text: '+0.71 x_Z -0.71 y_Z', components of r_x, r_y, r_z along body axes."""
    terms = [f"{a}_{b}" for a in "xyz" for b in "XYZ"]
    d = d * np.sign(d[np.argmax(np.abs(d))])
    return " ".join(f"{value:+.2f} {term}" for value, term in zip(d, terms, strict=True) if abs(value) > 0.1)


def require_runs(runs: Sequence[Run]) -> None:
    """Raise `InputError` unless there is a run."""
    if not runs:
        raise InputError(
            "identification: expected at least one accepted rotation, got none; see why they were rejected"
        )


def parameter_groups(priors: Priors, extra: Sequence[Extra]) -> tuple[str, ...]:
    """Return the parameters beyond biases and matrices: skew, unless known to be none, and the extra ones."""
    return (*(("skew",) if priors.skew else ()), *extra)
