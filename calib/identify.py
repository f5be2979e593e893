"""Runs to the inner lever arms: the literature's plain solution, and the joint estimate (the default).

The velocity that a run leaves at rest answers linearly to what is left in the increments (mathematics,
section 4; the matrices H, B, P, Q are those of `imudrv.nav.mechanisation`). Measured minus true, horizontal
parts:

    delta v = H R + B b_a + A vec(dA) + f x ( integral of phi )
    phi(t)  = (I - t [omega_ie x]) phi_0 - B b_g - P vec(dG)

with the integral of C_nb dA f_b = A vec(dA). Tilt and heading in error at the start of each run, phi_0, are
unknowns of that run; all else is common to the session. Heading is among them because the Earth's rotation
makes a tilt rate of it, as large as that of a gyro's bias: the alignment has chosen the heading that hides
the bias in the first pose, and the turn brings both to light.

**Noise.** Pulses leave white noise in velocity and, once a run, that of its start; accelerometers a random
walk q_v; gyros a random walk q_a of tilt, which gravity integrates. Over a run

    cov(s, t) = q_v^2 min(s, t) + g^2 q_a^2 s^2 (3 t - s) / 6 + start^2 + white^2 [s = t],      s <= t

Their sizes are those that the rests themselves show. Rows are whitened by the Cholesky factor.

**Rank.** Of the information on R, all else marginalised, each eigenvalue l sees its direction with 1 /
sqrt(l). What is seen no better than `Priors.arm` is not seen. Rotations between rests never see a common
shift of the three points (the gauge): R is solved for in the six-space that has none, which is the gauge
`centroid`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, tan
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation as Attitude

from calib.runs import AFTER_S, BEFORE_S, GUARD_S, Priors, Run
from calib.segments import BIN_S, BLOCK_NS, Noise, Rest, Rotation, pooled_noise
from imudrv.errors import InputError
from imudrv.nav.alignment import ALIGNMENT_S, Aligned
from imudrv.nav.earth import earth_rate_n, normal_gravity
from imudrv.nav.mechanisation import Navigator
from imudrv.records import INCREMENTS
from imudrv.units import DEG, MM, NS, STANDARD_GRAVITY, UG

Array = NDArray[np.float64]
Extra = Literal["quadratic"]

ROWS_A_BIN: Final = round(BIN_S / (BLOCK_NS * NS))
"""Rows at rest that make one equation."""
ROWS_A_POINT: Final = 5
"""With a known pivot each so-manieth row of the motion is an equation too."""
TOLD_S: Final = 0.5
"""`plain` takes the mean velocity over so long after the rotation, s."""
CHI_SQUARE_LIMIT: Final = 2.0
"""Chi-square per degree of freedom from which data contradict the model."""
REST_H_LIMIT: Final = 2e-3
"""H at the end of a rest, m/s per m, above which the gyros' increments are not those of a unit at rest."""
PIVOT_LIMIT: Final = 10.0
"""Chi-square that a pivot of each rotation's own may explain, for each of its components."""
PIVOT_SIGMA: Final = 0.1
"""Prior of such a pivot, m."""
OWN_RATIO: Final = 2.0
"""White noise of a rest counts as its own when it is so much more than that of all."""
SEEN_RATIO: Final = 0.5
"""An extra unknown whose sigma is not below this part of its prior is not seen."""
TILT_SIGMA: Final = 5e-3
"""Prior of the tilts at a run's start, rad: none, for a run's own rest tells them."""


LEAST_NOISE: Final = Noise(angle_walk=1e-7, velocity_walk=1e-6, velocity_white=3e-6, velocity_pulse=3e-5)
"""What linear equations leave out: no noise is taken to be smaller."""
ROUNDING: Final = 1e-7
"""A direction seen so much worse than the best one is not told from rounding."""
_PLAN_INTERVAL_NS: Final = 5_000_000


def _shift_free() -> Array:
    basis: Array = np.linalg.svd(np.tile(np.eye(3), (3, 1)))[0][:, 3:]
    return basis


SHIFT_FREE: Final = _shift_free()
"""Orthonormal basis, (9, 6), of the arms whose centroid is the origin."""
DIFFERENCES: Final = np.kron([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]], np.eye(3))
"""(6, 9): from (r_x, r_y, r_z) to (r_x - r_y, r_x - r_z)."""


class Unknowns(NamedTuple):
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


@dataclass(frozen=True)
class Nuisance:
    """An unknown beside R, SI.

    Attributes
    ----------
    name : str
        Such as 'accelerometer_bias_x'.
    value, sigma, prior : float
        Estimate, its sigma, and the sigma it had before.
    """

    name: str
    value: float
    sigma: float
    prior: float

    @property
    def seen(self) -> bool:
        """Whether the data tell more than the prior."""
        return self.sigma < SEEN_RATIO * self.prior


@dataclass(frozen=True)
class RunResult:
    """One rotation in the light of the result.

    Attributes
    ----------
    label : str
        Of the run.
    axis : str
        Body axis that was up, '+X' to '-Z'.
    angle_deg : float
        Turned, right-handed about up.
    V_n : ndarray, shape (3,)
        Velocity gained by the rotation, the mean over half a second after it less that before it, east,
        north, up, m/s.
    H : ndarray, shape (3, 9)
        The same of the measurement matrix.
    compensated_n : ndarray, shape (3,)
        `V_n - H R`.
    H_rest : float
        Largest horizontal element of H at the end of the rest before, m/s per m: 0 in theory. Dither or
        vibration left in the gyros' increments is rectified by the squared rates and makes it grow.
    t_s : ndarray, shape (n,)
        Middle of each bin at rest, from the start of navigation.
    v_n, fitted_n : ndarray, shape (n, 2)
        Velocity in the bin, east and north, and what the estimate says of it, m/s; `plain`: `H R` alone.
    """

    label: str
    axis: str
    angle_deg: float
    V_n: Array
    H: Array
    compensated_n: Array
    H_rest: float
    t_s: Array
    v_n: Array
    fitted_n: Array


@dataclass(frozen=True)
class LeftOut:
    """The estimate without one rotation.

    Attributes
    ----------
    label : str
        Of the run left out.
    rank : int
        Directions still seen.
    shift_m : ndarray, shape (3, 3), or None
        R without it minus R with it; None: the others do not see enough.
    """

    label: str
    rank: int
    shift_m: Array | None


@dataclass(frozen=True)
class Identification:
    """The inner lever arms.

    Attributes
    ----------
    method : {'joint', 'plain'}
        How they were found.
    gauge : {'centroid', 'given'}
        `given`: the origin of b is the pivot.
    R_b : ndarray, shape (3, 3)
        Row i: sensing point of accelerometer i, m, body axes.
    covariance : ndarray, shape (9, 9)
        Of (r_x, r_y, r_z), m^2; rank 6, with a known pivot 9.
    rank : int
        Directions of R that the data see.
    direction_sigma : ndarray, shape (9,)
        1-sigma of each principal direction of R, m, best first.
    singular_values : ndarray, shape (9,)
        Of the stacked horizontal H after the rotations, m/s a metre.
    reason : str
        Why the rank is what it is.
    chi_square, degrees_of_freedom : float, int
        Of the whitened residuals and the priors; `plain`: of V = H R.
    noise : Noise
        Of the sensors, from the rests.
    nuisances : tuple of Nuisance
        All else that was estimated.
    correlation : ndarray, shape (9, n)
        Of R with the nuisances.
    left_out : tuple of LeftOut
        Stability: each rotation left out in turn.
    runs : tuple of RunResult
        Each rotation.
    notes : tuple of str
        What a reader has to know.
    """

    method: Literal["joint", "plain"]
    gauge: Literal["centroid", "given"]
    R_b: Array
    covariance: Array
    rank: int
    direction_sigma: Array
    singular_values: Array
    reason: str
    chi_square: float
    degrees_of_freedom: int
    noise: Noise
    nuisances: tuple[Nuisance, ...]
    correlation: Array
    left_out: tuple[LeftOut, ...]
    runs: tuple[RunResult, ...]
    notes: tuple[str, ...]

    @property
    def sigma(self) -> Array:
        """1-sigma of `R_b` in its gauge, m, shape (3, 3)."""
        sigma: Array = np.sqrt(np.diag(self.covariance)).reshape(3, 3)
        return sigma

    @property
    def differences(self) -> Array:
        """`r_x - r_y` and `r_x - r_z`, m, shape (2, 3): the same in every gauge."""
        differences: Array = (DIFFERENCES @ self.R_b.ravel()).reshape(2, 3)
        return differences

    @property
    def differences_covariance(self) -> Array:
        """Covariance of the six differences, m^2, shape (6, 6)."""
        covariance: Array = DIFFERENCES @ self.covariance @ DIFFERENCES.T
        return covariance

    @property
    def differences_sigma(self) -> Array:
        """1-sigma of the six differences, m, shape (2, 3)."""
        sigma: Array = np.sqrt(np.diag(self.differences_covariance)).reshape(2, 3)
        return sigma

    @property
    def consistent(self) -> bool:
        """Whether chi-square is one that the model allows; without degrees of freedom nothing can differ."""
        return self.chi_square <= CHI_SQUARE_LIMIT * self.degrees_of_freedom or not self.degrees_of_freedom

    @property
    def refusals(self) -> tuple[str, ...]:
        """Why no certificate may be made of the result, with what to do; empty: one may."""
        refusals = []
        if not self.consistent:
            refusals.append(
                f"the velocities contradict the model: expected chi-square of about "
                f"{self.degrees_of_freedom}, got {self.chi_square:.0f}; the report's figures show which "
                "rotation stands out: leave it out, or look for what moved"
            )
        worst = max(self.runs, key=lambda run: run.H_rest)
        if worst.H_rest > REST_H_LIMIT:
            refusals.append(
                "the gyro increments carry dither or vibration: expected H of at most "
                f"{REST_H_LIMIT:g} m/s per m at the end of the rest before the rotation, got "
                f"{worst.H_rest:.2g} ({worst.label}); the squared rates rectify it and the arms come out "
                "wrong: let the unit remove its dither from the increments, or stop what shakes the bench, "
                "and record again"
            )
        return tuple(refusals)


@dataclass(frozen=True)
class Planned:
    """A rotation that is planned.

    Attributes
    ----------
    up : str
        Body axis that points up, '+X' to '-Z'.
    angle_deg : float
        Right-handed about up.
    duration_s : float
        From rest to rest, with least jerk.
    after_s : float
        Rest after it.
    offset_m : float
        Distance of the origin of b from the axis of the rotation, through which a skew acts.
    """

    up: str
    angle_deg: float = 180.0
    duration_s: float = 2.5
    after_s: float = 15.0
    offset_m: float = 0.05


@dataclass(frozen=True)
class Prediction:
    """What a plan will give.

    Attributes
    ----------
    covariance : ndarray, shape (9, 9)
        Of (r_x, r_y, r_z) in gauge centroid, m^2.
    differences_sigma : ndarray, shape (2, 3)
        1-sigma of `r_x - r_y` and `r_x - r_z`, m.
    """

    covariance: Array
    differences_sigma: Array


def joint(
    runs: Sequence[Run],
    priors: Priors | None = None,
    *,
    pivot: Literal["free", "fixed"] = "free",
    nine: bool = False,
    extra: Sequence[Extra] = (),
) -> Identification:
    """Estimate R with all that the rests before and after tell; the default method.

    Parameters
    ----------
    runs : sequence of Run
        Any number, poses and signs, from any captures of one unit.
    priors : Priors, optional
        What the static calibration leaves.
    pivot : {'free', 'fixed'}
        `fixed`: the origin of b is known to stay still while the unit turns, as on a turntable; velocity is
        then known during the motion too, and R is told from that origin.
    nine : bool
        All nine components are wanted, which needs a known pivot.
    extra : sequence of {'quadratic'}
        More unknowns: a quadratic term on each sensing axis, 1/(m/s^2). Those that are not observable stay
        at their prior, and a note says so.

    Returns
    -------
    Identification

    Raises
    ------
    InputError
        No runs; nine components without a known pivot; rotations that do not see what is asked for; a pivot
        that the data contradict.
    """
    priors = priors or Priors()
    terms = _terms(priors, extra)
    _some(runs)
    if nine and pivot == "free":
        raise InputError(
            "identification: nine components of the lever arms were asked for, but rotations between rests "
            "see six: a common shift of the three sensing points leaves no velocity at rest; name a gauge, "
            "or turn the unit about a pivot that stays still and say so (pivot fixed)"
        )
    noise = _noise(runs)
    system = _System([_equations(run, noise, pivot, terms) for run in runs], _priors(runs, priors, terms))
    basis = np.eye(9) if pivot == "fixed" else SHIFT_FREE
    sigma, directions = system.directions()
    rank = int((sigma < priors.arm).sum())
    wanted = basis.shape[1]
    if rank < wanted:
        raise InputError(_unseen(sigma, directions, basis, priors.arm))
    x, covariance = system.solve(basis)
    chi_square, freedom = system.chi_square(x, wanted)
    if pivot == "fixed":
        _check_pivot(system, chi_square, freedom)
    names = system.unknowns.names
    spread = np.sqrt(np.diag(covariance))
    nuisances = tuple(
        Nuisance(name, float(value), float(s), float(prior))
        for name, value, s, prior in zip(names, x[9:], spread[9:], system.unknowns.sigma, strict=True)
    )
    told = [_told(run) for run in runs]
    seen = sigma[sigma < priors.arm]
    return Identification(
        method="joint",
        gauge="given" if pivot == "fixed" else "centroid",
        R_b=x[:9].reshape(3, 3),
        covariance=covariance[:9, :9],
        rank=rank,
        direction_sigma=sigma,
        singular_values=_singular_values(told),
        reason=_reason(rank, seen[-1], sigma, priors.arm),
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        noise=noise,
        nuisances=nuisances,
        correlation=covariance[:9, 9:] / np.outer(np.maximum(spread[:9], 1e-300), spread[9:]),
        left_out=tuple(_left_out(system, k, run.label, x, basis, priors.arm) for k, run in enumerate(runs)),
        runs=tuple(
            _run_result(run, *told[k], x[:9], part.t_s, part.v_n, part.columns @ x[system.columns_of(k)])
            for k, (run, part) in enumerate(zip(runs, system.parts, strict=True))
        ),
        notes=tuple(
            f"{n.name} not observable in these runs: sigma {_readable(n.name, n.sigma)}"
            for n in nuisances
            if n.name.split("_")[0] in extra and not n.seen
        ),
    )


def plain(runs: Sequence[Run], priors: Priors | None = None) -> Identification:
    """Solve `V = H R`, the literature's way: one velocity for each rotation, nothing else estimated.

    V and H are what the rotation gained: means over the half second after it less those before it. The
    solution is that of least norm, which has its centroid in the origin. Its covariance is what bias,
    misalignment and noise do to such a velocity, given that the alignment has made the rest before look
    level.

    Parameters
    ----------
    runs : sequence of Run
        As for `joint`.
    priors : Priors, optional
        What the static calibration leaves.

    Returns
    -------
    Identification

    Raises
    ------
    InputError
        No runs, or rotations that do not see the six differences.
    """
    priors = priors or Priors()
    _some(runs)
    noise = _noise(runs)
    terms = _terms(priors, ())
    unknowns = _priors(runs, priors, terms)
    told = [_told(run) for run in runs]
    V = np.concatenate([v[:2] for v, _ in told])
    H = np.concatenate([h[:2] for _, h in told])
    S = _plain_covariance(runs, noise, unknowns, terms)
    sigma_v = float(np.sqrt(np.trace(S) / len(S)))
    singular = _singular_values(told)
    s, directions = np.zeros(9), np.linalg.svd(H)[2]
    s[: min(H.shape)] = np.linalg.svd(H, compute_uv=False)
    sigma = sigma_v / np.maximum(s, ROUNDING * s[0])
    rank = int((sigma < priors.arm).sum())
    if rank < 6:
        raise InputError(_unseen(sigma, directions.T, SHIFT_FREE, priors.arm))
    inverse = SHIFT_FREE @ np.linalg.pinv(H @ SHIFT_FREE)
    R = inverse @ V
    rest = np.eye(len(V)) - H @ inverse  # what a solution of least squares leaves, not of least chi-square
    left, freedom = rest @ V, max(0, len(V) - 6)
    values, vectors = np.linalg.eigh(rest @ S @ rest.T)
    of_left = (vectors.T @ left)[len(V) - freedom :]
    return Identification(
        method="plain",
        gauge="centroid",
        R_b=R.reshape(3, 3),
        covariance=inverse @ S @ inverse.T,
        rank=rank,
        direction_sigma=sigma,
        singular_values=singular,
        reason=_reason(rank, sigma[rank - 1], sigma, priors.arm),
        chi_square=float((of_left**2 / values[len(V) - freedom :]).sum()),
        degrees_of_freedom=freedom,
        noise=noise,
        nuisances=(),
        correlation=np.zeros((9, 0)),
        left_out=(),
        runs=tuple(
            _run_result(run, *told_run, R, *_at_rest(run, R))
            for run, told_run in zip(runs, told, strict=True)
        ),
        notes=(),
    )


def predict(
    plan: Sequence[Planned], latitude_rad: float, noise: Noise, priors: Priors | None = None
) -> Prediction:
    """Covariance that a plan will give, from an ideal motion and without data.

    Parameters
    ----------
    plan : sequence of Planned
        The rotations.
    latitude_rad : float
        Of the place.
    noise : Noise
        Of the sensors, as an earlier session found it.
    priors : Priors, optional
        What the static calibration leaves.

    Returns
    -------
    Prediction

    Raises
    ------
    InputError
        An empty plan, or one that does not see the six differences; says which it does not see.
    """
    priors = priors or Priors()
    if not plan:
        raise InputError("plan: expected one rotation at least, got none")
    runs = [_ideal(planned, k, latitude_rad, priors) for k, planned in enumerate(plan)]
    terms = _terms(priors, ())
    system = _System([_equations(run, noise, "free", terms) for run in runs], _priors(runs, priors, terms))
    sigma, directions = system.directions()
    if int((sigma < priors.arm).sum()) < 6:
        raise InputError(_unseen(sigma, directions, SHIFT_FREE, priors.arm))
    covariance = system.solve(SHIFT_FREE)[1][:9, :9]
    spread = np.sqrt(np.diag(DIFFERENCES @ covariance @ DIFFERENCES.T))
    return Prediction(covariance, spread.reshape(2, 3))


class _Part(NamedTuple):
    """A run's equations `v = columns @ (R, shared, phi_0)`, and their whitened sums."""

    t_s: Array  # (n,)
    v_n: Array  # (n, 2), or (n, 3) with a known pivot
    columns: Array  # (n, 2 or 3, 9 + shared + 3)
    N: Array
    b: Array
    yy: float


class _System:
    """Normal equations of a session; the unknowns are R, what all runs share, and phi_0 of each run."""

    def __init__(self, parts: Sequence[_Part], unknowns: Unknowns) -> None:
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

    def without(self, k: int) -> "_System":
        """The same without a run's data."""
        other = object.__new__(_System)
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


def _check_pivot(system: _System, chi_square: float, freedom: int) -> None:
    """Refuse a pivot that the data contradict: one for each rotation must not explain much more."""
    runs, cut = len(system.parts), 9 + system.unknowns.shared
    own = np.split(system.unknowns.sigma[system.unknowns.shared :], runs)
    sigma = np.concatenate([np.append(phi, np.full(3, PIVOT_SIGMA)) for phi in own])
    size = cut + len(own[0])
    M = np.zeros((size, size + 3))  # a shift of the origin is one of all three points
    M[:, :size], M[:9, size:] = np.eye(size), np.tile(np.eye(3), (3, 1))
    apart = _System(
        [
            part._replace(columns=part.columns @ M, N=M.T @ part.N @ M, b=M.T @ part.b)
            for part in system.parts
        ],
        Unknowns((), np.concatenate([system.unknowns.sigma[: system.unknowns.shared], sigma]), cut - 9),
    )
    x, _ = apart.solve(np.eye(9))
    better, _ = apart.chi_square(x, 9)
    if chi_square - better > PIVOT_LIMIT * 3 * runs or chi_square > CHI_SQUARE_LIMIT * freedom:
        raise InputError(
            "identification: pivot fixed: expected the origin of b to stay still, but the velocities "
            f"contradict it: chi-square {chi_square:.0f}, expected about {freedom}, and {better:.0f} with an "
            "origin of its own for each rotation; use pivot free, or look for what moved"
        )


def _ideal(planned: Planned, k: int, latitude_rad: float, priors: Priors) -> Run:
    """The run that a planned rotation would make: level, about the vertical, nothing in error."""
    T, n = _PLAN_INTERVAL_NS * NS, round(planned.duration_s / (_PLAN_INTERVAL_NS * NS))
    before, after = round(BEFORE_S / T), round(min(planned.after_s, AFTER_S) / T)
    up_b = np.array([planned.up == f"+{a}" for a in "XYZ"], np.float64)
    up_b -= [planned.up == f"-{a}" for a in "XYZ"]
    if not up_b.any() or n < 1 or after * T < TOLD_S:
        raise InputError(
            f"plan: expected an axis up from +X to -Z, a duration, and a rest of {TOLD_S:g} s at least, "
            f"got {planned}"
        )
    u = np.clip((np.arange(before + n + after + 1) - before) / n, 0.0, 1.0)
    angle = planned.angle_deg * DEG * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
    gravity = normal_gravity(latitude_rad, 0.0)
    C_nb0 = Attitude.align_vectors([[0.0, 0.0, 1.0]], [up_b])[0]
    turned = Attitude.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))
    C_nb = turned * C_nb0
    increments = np.zeros(len(angle) - 1, INCREMENTS)
    increments["counter"] = np.arange(len(increments))
    increments["interval_ns"] = _PLAN_INTERVAL_NS
    increments["dtheta_b"] = np.outer(np.diff(angle), up_b) + T * C_nb[1:].inv().apply(
        earth_rate_n(latitude_rad)
    )
    v_n = np.gradient(turned.apply([planned.offset_m, 0.0, 0.0]), T, axis=0)
    increments["dv_b"] = gravity * T * up_b + C_nb[1:].inv().apply(np.diff(v_n, axis=0))
    q_nb = np.roll(C_nb0.as_quat(), 1)
    navigator = Navigator(
        latitude_rad, 0.0, 0.0, None, q_nb, C_ba=np.eye(3), every=BLOCK_NS // _PLAN_INTERVAL_NS
    )
    rows = navigator.feed(increments)
    guard = round(GUARD_S / T)
    level = priors.accelerometer_bias / gravity
    heading = hypot(
        priors.gyro_bias / earth_rate_n(latitude_rad)[1],
        tan(latitude_rad) * priors.accelerometer_bias / gravity,
    )
    rotation = Rotation(
        before, before + n, before * T, (before + n) * T, None, None, planned.angle_deg, planned.up,
        planned.up[1], 0.0, 0.0, 0, 0,
    )  # fmt: skip
    return Run(
        f"plan#{k + 1}",
        rotation,
        Aligned(0, 0, q_nb, ALIGNMENT_S, level, heading, None),
        gravity,
        rows,
        rows["v_n"],
        (rows["counter"] + 1) * T,
        rows["counter"] < before - guard,
        rows["counter"] >= before + n + guard,
    )


def _some(runs: Sequence[Run]) -> None:
    if not runs:
        raise InputError(
            "identification: expected one good rotation at least, got none; see why they were rejected"
        )


def _terms(priors: Priors, extra: Sequence[Extra]) -> tuple[str, ...]:
    """Terms beside biases and matrices: skew, unless it is known to be none, and what is asked for."""
    return (*(("skew",) if priors.skew else ()), *extra)


def _priors(runs: Sequence[Run], priors: Priors, terms: Sequence[str]) -> Unknowns:
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
    return Unknowns(names, np.concatenate([sigma for _, _, sigma in groups]), shared)


def _noise(runs: Sequence[Run]) -> Noise:
    """Noise of all rests of the runs, each taken once."""
    rests = {
        (run.label.rpartition("#")[0], rest.start): rest
        for run in runs
        for rest in (run.rotation.before, run.rotation.after)
        if rest is not None
    }
    found = vars(pooled_noise(rests.values()))
    return Noise(**{name: max(value, getattr(LEAST_NOISE, name)) for name, value in found.items()})


def _bin_variance(rest: Rest | None, noise: Noise) -> float:
    """What a bin's mean varies by beside the random walk to its middle.

    White noise is a rest's own where that is much more: a level accelerometer with a pulse a second or less
    does not average out in a bin. The mean of a random walk varies less than its value in the middle.
    """
    own = rest.noise.velocity_white if rest is not None and rest.noise is not None else 0.0
    white = own if own > OWN_RATIO * noise.velocity_white else noise.velocity_white
    return white**2 - noise.velocity_walk**2 * BIN_S / 6.0


def _covariance(t: Array, single: Array, noise: Noise, gravity: float) -> Array:
    """Covariance of velocities of one axis at the times t; `single` is each one's own variance."""
    s, u = np.minimum.outer(t, t), np.maximum.outer(t, t)
    walk, tilt = noise.velocity_walk**2, (gravity * noise.angle_walk) ** 2
    K = walk * s + tilt * s * s * (3.0 * u - s) / 6.0 + noise.velocity_pulse**2 + np.diag(single)
    return np.asarray(K, np.float64)


def _columns(run: Run, terms: Sequence[str]) -> Array:
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


def _equations(run: Run, noise: Noise, pivot: str, terms: Sequence[str]) -> _Part:
    """Bins of the rests; with a known pivot points of the motion, and the vertical, too."""
    parts = 3 if pivot == "fixed" else 2
    rows = [_bins(run.before, True), _bins(run.after, False)]
    if pivot == "fixed":
        rows.insert(1, np.flatnonzero(~(run.before | run.after))[::ROWS_A_POINT, None])
    columns = _columns(run, terms)[:, :parts]

    def mean(x: Array) -> Array:
        return np.concatenate([x[at].mean(axis=1) for at in rows])

    v_n = np.where((run.before | run.after)[:, None], run.v_n, run.rows["v_n"])[:, :parts]
    t, v, A = mean(run.t_s), mean(v_n), mean(columns)
    single = [_bin_variance(rest, noise) for rest in (run.rotation.before, run.rotation.after)]
    if pivot == "fixed":
        single.insert(1, noise.velocity_pulse**2)
    own = np.repeat(single, [len(at) for at in rows])
    L = np.linalg.cholesky(_covariance(t, own, noise, run.gravity))
    white_A = solve_triangular(L, A.reshape(len(t), -1), lower=True).reshape(-1, A.shape[2])
    white_v = solve_triangular(L, v, lower=True).ravel()
    return _Part(t, v, A, white_A.T @ white_A, white_A.T @ white_v, float(white_v @ white_v))


def _bins(mask: NDArray[np.bool_], from_the_end: bool) -> NDArray[np.int64]:
    """Rows of each whole bin, (bins, rows a bin); what is over lies far from the rotation."""
    at = np.flatnonzero(mask)
    over = len(at) % ROWS_A_BIN
    at = at[over:] if from_the_end else at[: len(at) - over]
    return at.reshape(-1, ROWS_A_BIN)


def _told(run: Run) -> tuple[Array, Array]:
    """V and H that a rotation has gained: means over the half second after it less those before it."""
    before, after = _told_rows(run)
    rows = run.rows
    V = run.v_n[after].mean(axis=0) - run.v_n[before].mean(axis=0)
    return V, rows["H"][after].mean(axis=0) - rows["H"][before].mean(axis=0)


def _told_rows(run: Run) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    n = round(TOLD_S / (BLOCK_NS * NS))
    return np.flatnonzero(run.before)[-n:], np.flatnonzero(run.after)[:n]


def _plain_covariance(runs: Sequence[Run], noise: Noise, unknowns: Unknowns, terms: Sequence[str]) -> Array:
    """Covariance of the stacked velocities of `_told`, from priors and noise.

    The alignment has chosen tilt and heading so that the rest before shows no acceleration: what is not known
    is what remains of the priors once that rest is seen.
    """
    known = np.diag(np.concatenate([np.full(9, 1e12), unknowns.sigma**-2]))  # R does not matter before
    rows = []
    S = np.zeros((2 * len(runs), 2 * len(runs)))
    for k, run in enumerate(runs):
        at = unknowns.columns_of(k, len(runs))
        still = _bins(run.before, True)
        columns = _columns(run, terms)[:, :2]
        A, t = columns[still].mean(axis=1), run.t_s[still].mean(axis=1)
        single = [_bin_variance(rest, noise) for rest in (run.rotation.before, run.rotation.after)]
        K = _covariance(t, np.full(len(t), single[0]), noise, run.gravity)
        white = solve_triangular(np.linalg.cholesky(K), A.reshape(len(t), -1), lower=True)
        white = white.reshape(-1, A.shape[2])
        known[np.ix_(at, at)] += white.T @ white
        before, after = _told_rows(run)
        row = np.zeros((2, len(known)))
        row[:, at] = columns[after].mean(axis=0) - columns[before].mean(axis=0)
        rows.append(row)
        t = np.array([run.t_s[before].mean(), run.t_s[after].mean()])
        K = _covariance(t, np.array(single), noise, run.gravity)
        S[2 * k, 2 * k] = S[2 * k + 1, 2 * k + 1] = K[0, 0] + K[1, 1] - 2.0 * K[0, 1]
    stacked = np.concatenate(rows)
    return S + stacked @ np.linalg.solve(known, stacked.T)


def _at_rest(run: Run, R: Array) -> tuple[Array, Array, Array]:
    """Times, velocities and H R of the bins at rest."""
    at = np.concatenate([_bins(run.before, True), _bins(run.after, False)])
    rows = run.rows[at]
    return (
        run.t_s[at].mean(axis=1),
        run.v_n[at][..., :2].mean(axis=1),
        (rows["H"][..., :2, :] @ R).mean(axis=1),
    )


def _run_result(run: Run, V: Array, H: Array, R: Array, t_s: Array, v_n: Array, fitted_n: Array) -> RunResult:
    rotation = run.rotation
    H_rest = run.rows["H"][_told_rows(run)[0], :2].mean(axis=0)
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


def _singular_values(told: Sequence[tuple[Array, Array]]) -> Array:
    s = np.zeros(9)
    H = np.concatenate([h[:2] for _, h in told])
    s[: min(H.shape)] = np.linalg.svd(H, compute_uv=False)
    return s


def _left_out(system: _System, k: int, label: str, x: Array, basis: Array, least: float) -> LeftOut:
    other = system.without(k)
    rank = int((other.directions()[0] < least).sum())
    if rank < basis.shape[1]:
        return LeftOut(label, rank, None)
    return LeftOut(label, rank, (other.solve(basis)[0] - x)[:9].reshape(3, 3))


def _reason(rank: int, worst: float, sigma: Array, least: float) -> str:
    seen = f"rank {rank}: the directions seen have a sigma of {worst / MM:.3g} mm or less"
    if rank == 9:
        return seen
    return f"{seen}, the next {sigma[rank] / MM:.3g} mm, where {least / MM:g} mm counts as not seen"


def _unseen(sigma: Array, directions: Array, basis: Array, least: float) -> str:
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


def _readable(name: str, value: float) -> str:
    if name.startswith("skew"):
        return f"{value * 1e3:.3g} ms"
    return f"{value * STANDARD_GRAVITY**2 / UG:.3g} ug/g^2"
