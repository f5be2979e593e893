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
from calib.estimation.result import Extra, RunResult
from calib.estimation.runs import Priors, Run
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.nav.earth import earth_rate_n
from imudrv.units import MM, NS

ROWS_PER_BIN: Final = round(BIN_S / (BLOCK_NS * NS))
"""Rows at rest that make one equation."""


ROWS_PER_POINT: Final = 5
"""With a known pivot each so-manieth row of the motion is an equation too."""


GAIN_WINDOW_S: Final = 0.5
"""`plain` takes the mean velocity over so long after the rotation, s."""


OWN_RATIO: Final = 2.0
"""White noise of a rest counts as its own when it is so much more than that of all."""


TILT_SIGMA: Final = 5e-3
"""Prior of the tilts at a run's start, rad: none, for a run's own rest tells them."""


LEAST_NOISE: Final = Noise(angle_walk=1e-7, velocity_walk=1e-6, velocity_white=3e-6, velocity_pulse=3e-5)
"""What linear equations leave out: no noise is taken to be smaller."""


ROUNDING: Final = 1e-7
"""A direction seen so much worse than the best one is not told from rounding."""


class Parameters(NamedTuple):
    """Names and priors of a session's unknowns but R, in the order of their columns.

    Attributes
    ----------
    names : tuple of str
        Such as 'accelerometer_bias_x'.
    sigma : ndarray, shape (n,)
        Priors, SI.
    shared : int
        So many are common to all runs; behind them come those of the first run, the second, ...
    """

    names: tuple[str, ...]
    sigma: Array
    shared: int

    def columns_of(self, k: int, runs: int) -> NDArray[np.int64]:
        """Places, R first, of the unknowns that run k of so many depends on."""
        own = (len(self.sigma) - self.shared) // runs
        shared = 9 + self.shared
        return np.concatenate([np.arange(shared), shared + own * k + np.arange(own)])


class RunEquations(NamedTuple):
    """A run's equations `v = columns @ (R, shared, phi_0)`, and their whitened sums."""

    t_s: Array  # (n,)
    v_n: Array  # (n, 2), or (n, 3) with a known pivot
    columns: Array  # (n, 2 or 3, 9 + shared + 3)
    N: Array
    b: Array
    yy: float


class NormalEquations:
    """Normal equations of a session; the unknowns are R, what all runs share, and phi_0 of each run."""

    def __init__(self, parts: Sequence[RunEquations], unknowns: Parameters) -> None:
        self.parts, self.unknowns = parts, unknowns
        self.scale = np.concatenate([np.full(9, 0.1), unknowns.sigma])
        n = len(self.scale)
        self.N, self.b = np.diag(np.concatenate([np.zeros(9), unknowns.sigma**-2])), np.zeros(n)
        for k, part in enumerate(parts):
            at = self.columns_of(k)
            self.N[np.ix_(at, at)] += part.N
            self.b[at] += part.b

    def columns_of(self, k: int) -> NDArray[np.int64]:
        """Places of a run's unknowns among all."""
        return self.unknowns.columns_of(k, len(self.parts))

    def without(self, k: int) -> "NormalEquations":
        """The same without a run's data."""
        other = object.__new__(NormalEquations)
        other.parts, other.unknowns, other.scale = self.parts, self.unknowns, self.scale
        other.N, other.b = self.N.copy(), self.b.copy()
        at = self.columns_of(k)
        other.N[np.ix_(at, at)] -= self.parts[k].N
        other.b[at] -= self.parts[k].b
        return other

    def directions(self) -> tuple[Array, Array]:
        """1-sigma of the principal directions of R, best first, and the directions, (9, 9), as columns."""
        N = self.N * np.outer(self.scale, self.scale)
        information = N[:9, :9] - N[:9, 9:] @ np.linalg.solve(N[9:, 9:], N[9:, :9])
        values, vectors = np.linalg.eigh(0.5 * (information + information.T))
        least = ROUNDING**2 * values[-1]
        return self.scale[0] / np.sqrt(np.maximum(values[::-1], least)), vectors[:, ::-1]

    def solve(self, basis: Array) -> tuple[Array, Array]:
        """Estimate and covariance of all unknowns, R within `basis`."""
        n = len(self.scale)
        T = np.zeros((n, n - 9 + basis.shape[1]))
        T[:9, : basis.shape[1]], T[9:, basis.shape[1] :] = basis, np.eye(n - 9)
        T *= self.scale[:, None]
        covariance = T @ np.linalg.inv(T.T @ self.N @ T) @ T.T
        return covariance @ self.b, covariance

    def chi_square(self, x: Array, of_R: int) -> tuple[float, int]:
        """Chi-square of residuals and priors, and degrees of freedom: each prior pays for its unknown."""
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
    """Noise of all rests of the runs, each taken once."""
    rests = {
        (run.label.rpartition("#")[0], rest.start): rest
        for run in runs
        for rest in (run.rotation.before, run.rotation.after)
    }
    found = vars(pooled_noise(rest.differences for rest in rests.values()))
    return Noise(**{name: max(value, getattr(LEAST_NOISE, name)) for name, value in found.items()})


def bin_variance(rest: Rest, noise: Noise) -> float:
    """What a bin's mean varies by beside the random walk to its middle.

    White noise is a rest's own where that is much more: a level accelerometer with a pulse a second or less
    does not average out in a bin. The mean of a random walk varies less than its value in the middle.
    """
    own = rest.noise.velocity_white if rest.noise is not None else 0.0
    white = own if own > OWN_RATIO * noise.velocity_white else noise.velocity_white
    return white**2 - noise.velocity_walk**2 * BIN_S / 6.0


def noise_covariance(t: Array, single: Array, noise: Noise, gravity: float) -> Array:
    """Covariance of velocities of one axis at the times t; `single` is each one's own variance."""
    s, u = np.minimum.outer(t, t), np.maximum.outer(t, t)
    walk, tilt = noise.velocity_walk**2, (gravity * noise.angle_walk) ** 2
    K = walk * s + tilt * s * s * (3.0 * u - s) / 6.0 + noise.velocity_pulse**2 + np.diag(single)
    return np.asarray(K, np.float64)


def design_columns(run: Run, terms: Sequence[str]) -> Array:
    """What each row's velocity owes to R, to what is shared, and to phi_0: (n, 3, 9 + shared + 3)."""
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
    """What a skew s does; felt is `f_b(t + s)`, so that velocity gains s times the sum of these.

        integral of C_nb df_b = f_n(t) - f_n(0) - integral of dC_nb f_b

    At rest the first two cancel. In motion f_n is the mean of the rows beside, for a row's own noise is in
    the velocity that it explains.
    """
    moving = ~(run.before | run.after)
    column = -np.cumsum(np.einsum("nij,nj->ni", np.diff(C_nb, axis=0, prepend=C_nb[:1]), f_b), axis=0)
    later = np.concatenate([f_n[1:], f_n[-1:]])
    column[moving] += 0.5 * (f_n + later)[moving] - [0.0, 0.0, run.gravity]
    return column[:, :, None]


def _settled_H(run: Run, coriolis: Array) -> Array:
    """H of each row, at rest without the noise of the rate at a row's end.

    At rest H does not change, but for Coriolis' acceleration, and before the motion it is zero. That noise,
    up to 2e-3 m/s a metre in a single row, would pass for a signal of the gauge.
    """
    H = run.rows["H"].copy()
    H[run.before] = 0.0
    t = run.t_s[run.after]
    H[run.after] = H[run.after].mean(axis=0) - (t - t.mean())[:, None, None] * (
        coriolis @ H[run.after].mean(axis=0)
    )
    return H


def _tilted(phi: Array, gravity: float) -> Array:
    """`f_n x phi` for columns phi, (n, 3, m), in a body that does not accelerate."""
    out = np.zeros_like(phi)
    out[:, 0], out[:, 1] = -gravity * phi[:, 1], gravity * phi[:, 0]
    return out


def run_equations(run: Run, noise: Noise, pivot: str, terms: Sequence[str]) -> RunEquations:
    """Bins of the rests; with a known pivot points of the motion, and the vertical, too."""
    parts = 3 if pivot == "fixed" else 2
    rows = [whole_bins(run.before, True), whole_bins(run.after, False)]
    if pivot == "fixed":
        rows.insert(1, np.flatnonzero(~(run.before | run.after))[::ROWS_PER_POINT, None])
    columns = design_columns(run, terms)[:, :parts]

    def mean(x: Array) -> Array:
        return np.concatenate([x[at].mean(axis=1) for at in rows])

    v_n = np.where((run.before | run.after)[:, None], run.v_n, run.rows["v_n"])[:, :parts]
    t, v, A = mean(run.t_s), mean(v_n), mean(columns)
    single = [bin_variance(rest, noise) for rest in (run.rotation.before, run.rotation.after)]
    if pivot == "fixed":
        single.insert(1, noise.velocity_pulse**2)
    own = np.repeat(single, [len(at) for at in rows])
    L = np.linalg.cholesky(noise_covariance(t, own, noise, run.gravity))
    white_A = solve_triangular(L, A.reshape(len(t), -1), lower=True).reshape(-1, A.shape[2])
    white_v = solve_triangular(L, v, lower=True).ravel()
    return RunEquations(t, v, A, white_A.T @ white_A, white_A.T @ white_v, float(white_v @ white_v))


def whole_bins(mask: NDArray[np.bool_], from_the_end: bool) -> NDArray[np.int64]:
    """Rows of each whole bin, (bins, rows a bin); what is over lies far from the rotation."""
    at = np.flatnonzero(mask)
    over = len(at) % ROWS_PER_BIN
    at = at[over:] if from_the_end else at[: len(at) - over]
    return at.reshape(-1, ROWS_PER_BIN)


def velocity_gain(run: Run) -> tuple[Array, Array]:
    """V and H that a rotation has gained: means over the half second after it less those before it."""
    before, after = gain_rows(run)
    rows = run.rows
    V = run.v_n[after].mean(axis=0) - run.v_n[before].mean(axis=0)
    return V, rows["H"][after].mean(axis=0) - rows["H"][before].mean(axis=0)


def gain_rows(run: Run) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows of the half second before a rotation and of that after it."""
    n = round(GAIN_WINDOW_S / (BLOCK_NS * NS))
    return np.flatnonzero(run.before)[-n:], np.flatnonzero(run.after)[:n]


def velocity_at_rest(run: Run, R: Array) -> tuple[Array, Array, Array]:
    """Times, velocities and H R of the bins at rest."""
    at = np.concatenate([whole_bins(run.before, True), whole_bins(run.after, False)])
    rows = run.rows[at]
    return (
        run.t_s[at].mean(axis=1),
        run.v_n[at][..., :2].mean(axis=1),
        (rows["H"][..., :2, :] @ R).mean(axis=1),
    )


def run_result(run: Run, V: Array, H: Array, R: Array, t_s: Array, v_n: Array, fitted_n: Array) -> RunResult:
    """Return one rotation as the result shows it."""
    rotation = run.rotation
    H_rest = run.rows["H"][gain_rows(run)[0], :2].mean(axis=0)
    return RunResult(
        run.label,
        rotation.axis,
        rotation.angle_deg,
        V,
        H,
        V - H @ R,
        float(np.abs(H_rest).max()),
        t_s,
        v_n[:, :2],
        fitted_n[:, :2],
    )


def singular_values_of(told: Sequence[tuple[Array, Array]]) -> Array:
    """Return the singular values of the stacked horizontal H, nine of them."""
    s = np.zeros(9)
    H = np.concatenate([h[:2] for _, h in told])
    s[: min(H.shape)] = np.linalg.svd(H, compute_uv=False)
    return s


def rank_reason(rank: int, worst: float, sigma: Array, least: float) -> str:
    """Return the reason for the rank, in words."""
    seen = f"rank {rank}: the directions seen have a sigma of {worst / MM:.3g} mm or less"
    if rank == 9:
        return seen
    return f"{seen}, the next {sigma[rank] / MM:.3g} mm, where {least / MM:g} mm counts as not seen"


def unobservable_text(sigma: Array, directions: Array, basis: Array, least: float) -> str:
    """Message for rotations that do not see what is wanted; names the directions."""
    wanted = basis.shape[1]
    rank = min(wanted, int((sigma < least).sum()))
    inside = basis @ basis.T @ directions[:, sigma >= least]
    left, size, _ = np.linalg.svd(inside, full_matrices=False)
    unseen = left[:, size > 0.5]
    names = "; ".join(_direction(d) for d in unseen.T)
    return (
        f"identification: expected rotations that see {wanted} directions of the lever arms, got {rank}; not "
        f"seen to {least / MM:g} mm: {names}; add rotations with another axis up"
    )


def _direction(d: Array) -> str:
    """Such as '+0.71 x_Z -0.71 y_Z': components of r_x, r_y and r_z along body axes."""
    terms = [f"{a}_{b}" for a in "xyz" for b in "XYZ"]
    d = d * np.sign(d[np.argmax(np.abs(d))])
    return " ".join(f"{value:+.2f} {term}" for value, term in zip(d, terms, strict=True) if abs(value) > 0.1)


def require_runs(runs: Sequence[Run]) -> None:
    """Raise `InputError` unless there is a run."""
    if not runs:
        raise InputError(
            "identification: expected one good rotation at least, got none; see why they were rejected"
        )


def parameter_groups(priors: Priors, extra: Sequence[Extra]) -> tuple[str, ...]:
    """Terms beside biases and matrices: skew, unless it is known to be none, and what is asked for."""
    return (*(("skew",) if priors.skew else ()), *extra)
