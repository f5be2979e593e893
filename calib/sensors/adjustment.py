"""The adjustment: Gauss-Newton on all parameters and attitudes, and the size of the wander.

Directions of the parameters that the equations do not show are held at the start by the priors of the
contract, 3.6; the others are free of them, so that a start far from the truth leaves nothing in the result.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
import scipy  # its parts are loaded when they are used
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.spatial.transform import Rotation

from calib.estimation.result import CENTROID_BASIS
from calib.sensors.equations import (
    ACCELEROMETER_WANDER_CEILING,
    GYRO_WANDER_CEILING,
    Equations,
    LinearSystem,
)
from calib.sensors.observability import RATIO
from calib.sensors.parameters import (
    ACCELEROMETER_SCALE_PRIOR,
    ACCELEROMETER_SCALE_T,
    AXIS_PRIOR,
    B_T,
    BETA,
    BETA_T,
    COLUMNS,
    EARTH,
    GRAVITY,
    GYRO_SCALE_PRIOR,
    GYRO_SCALE_T,
    K2,
    SKEW,
    UPPER,
    B,
    M,
    Parameters,
    Q,
    R,
    W,
)
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.units import DEG_PER_H, MM, PPM, UG

MOST_ITERATIONS: Final = 30
LARGER_WANDER: Final = 2.0
AT_CEILING: Final = 0.999
CHI_SQUARE_95: Final = 3.84
"""Wander at its ceiling is too large if twice as much explains the residuals significantly better."""
LEAST_FREEDOM: Final = 4.0
"""Fewest degrees of freedom of the wander that count: at most they double its variance."""
CONVERGED: Final = 1e-4
"""Largest step of a parameter, in its sigma, at which the iteration ends."""


MEASURED_GRAVITY: Final = 1e-5
NORMAL_GRAVITY: Final = 50e-5
"""Uncertainty of gravity that was measured, and of normal gravity, m/s^2."""


@dataclass(frozen=True)
class Free:
    """Which parameters are free.

    Attributes
    ----------
    fixed_pivot : bool
        The unit turns about one point: the arms to it are free, and not their differences alone.
    temperature : bool
        Slopes per kelvin.
    quadratic, skew : bool
        Quadratic term or asymmetry; skew.
    earth : bool
        Earth rate: to measure it where it contradicts the site.
    """

    fixed_pivot: bool = False
    temperature: bool = False
    quadratic: bool = True
    skew: bool = True
    earth: bool = False

    @property
    def basis(self) -> Array:
        """Free directions of the parameters as columns, shape (COLUMNS, n)."""
        fixed = list(UPPER)
        if not self.temperature:
            for columns in (BETA_T, GYRO_SCALE_T, B_T, ACCELEROMETER_SCALE_T):
                fixed += range(COLUMNS)[columns]
        if not self.quadratic:
            fixed += range(COLUMNS)[Q]
        if not self.skew:
            fixed += range(COLUMNS)[SKEW]
        if not self.earth:
            fixed += range(COLUMNS)[EARTH]
        one = np.eye(COLUMNS)
        arms = np.zeros((COLUMNS, 9 if self.fixed_pivot else 6))
        arms[R] = np.eye(9) if self.fixed_pivot else CENTROID_BASIS
        others = [k for k in range(COLUMNS) if k not in fixed and k not in range(COLUMNS)[R]]
        return np.concatenate([one[:, others], arms], axis=1)


class Wander(NamedTuple):
    """Size of the wander of the biases, rad/s and m/s^2, and whether it is larger than its ceiling."""

    gyro: float
    accelerometer: float
    gyro_exceeds: bool = False
    accelerometer_exceeds: bool = False


@dataclass(frozen=True)
class Adjustment:
    """Result of an adjustment.

    Attributes
    ----------
    p : Parameters
    attitudes : tuple of ndarray, shape (3, 3)
        C_nb of each rest.
    covariance : ndarray, shape (COLUMNS, COLUMNS)
    residual : ndarray
        Of the equations at the end.
    residual_sigma : ndarray
        Expected scatter of each residual.
    system : LinearSystem
    V : ndarray
        Covariance of the equations, wander included.
    chi_square : float
    degrees_of_freedom : int
    wander : Wander
    iterations : int
    """

    p: Parameters
    attitudes: tuple[Array, ...]
    covariance: Array
    residual: Array
    residual_sigma: Array
    system: LinearSystem
    V: Array
    chi_square: float
    degrees_of_freedom: int
    wander: Wander
    iterations: int

    @property
    def reduced(self) -> float:
        """Reduced chi-square; 0 without redundancy."""
        return self.chi_square / self.degrees_of_freedom if self.degrees_of_freedom > 0 else 0.0


class NoConvergence(InputError):  # noqa: N818  the fact, as the verdict names it
    """The iteration did not end."""


def adjust(
    equations: Equations,
    p: Parameters,
    attitudes: Sequence[Array],
    free: Free,
    gravity_sigma: float,
    site_gravity: float | None = None,
) -> Adjustment:
    """Adjust the parameters to the equations.

    Parameters
    ----------
    equations : Equations
    p : Parameters
        Starting values.
    attitudes : sequence of ndarray, shape (3, 3)
        Starting attitudes of the rests.
    free : Free
    gravity_sigma : float
        Uncertainty of the gravity of the site, m/s^2.
    site_gravity : float, optional
        Gravity of the site, m/s^2; default: that of the starting values.

    Returns
    -------
    Adjustment

    Raises
    ------
    NoConvergence
    """
    site_gravity = p.gravity if site_gravity is None else site_gravity
    attitudes = list(attitudes)
    wander, is_wander_known = Wander(0.0, 0.0), False  # found once, where the residuals are small
    Z = _whole_basis(free, len(attitudes))
    moved = np.zeros(Z.shape[1])
    for iteration in range(1, MOST_ITERATIONS + 1):
        system = equations.system(p, attitudes)
        if not np.isfinite(system.residual).all():
            raise NoConvergence("the adjustment does not converge: its numbers grow without bounds")
        solver = _Solver(system, Z, p, site_gravity, gravity_sigma, wander)
        step = solver.step(moved)
        moved = moved + step
        whole = Z @ step
        p = p.moved(whole[:COLUMNS])
        for k, psi in enumerate(whole[COLUMNS:].reshape(-1, 3)):
            attitudes[k] = Rotation.from_rotvec(psi).as_matrix() @ attitudes[k]
        largest = float(np.max(np.abs(step) / np.sqrt(np.diag(solver.covariance))))
        if largest > CONVERGED:
            continue
        if is_wander_known:
            return _result(equations, p, attitudes, free, site_gravity, gravity_sigma, wander, iteration)
        wander = _wander(equations.system(p, attitudes), Z, p, gravity_sigma)
        is_wander_known = True
    raise NoConvergence(
        f"the adjustment does not converge: after {MOST_ITERATIONS} iterations a parameter still moves by "
        f"{largest:.2g} of its sigma"
    )


def information(system: LinearSystem, rests: int, free: Free) -> Array:
    """Return what a system says of the free parameters, whatever the attitudes.

    Parameters
    ----------
    system : LinearSystem
    rests : int
        Number of rests.
    free : Free

    Returns
    -------
    ndarray, shape (n, n)
        By the columns of `Free.basis`. That of independent systems adds up.
    """
    n = free.basis.shape[1]
    J = system.J @ _whole_basis(free, rests)
    N = J.T @ cho_solve(cho_factor(system.V, lower=True), J)
    reduced: Array = N[:n, :n] - N[:n, n:] @ np.linalg.solve(N[n:, n:], N[n:, :n])
    return reduced


def posterior(information: Array, p: Parameters, free: Free, gravity_sigma: float) -> tuple[Array, Array]:
    """Return the covariance of the free parameters with their priors, and that of the priors alone."""
    prior = prior_information(p)
    prior[GRAVITY, GRAVITY] += 1.0 / gravity_sigma**2
    own = free.basis.T @ prior @ free.basis
    return _inverse(information + own), _inverse(own)


def leave_one_out(found: Adjustment, free: Free, gravity_sigma: float) -> tuple[float, ...]:
    """Return for each rest by how much the sigma of a parameter grows at most without it and its motions."""
    system, rests = found.system, len(found.attitudes)
    attitudes = system.J[:, COLUMNS:].reshape(-1, rests, 3)

    def sigma(kept: NDArray[np.bool_], without: list[int]) -> Array:
        J = np.delete(system.J[kept], [COLUMNS + 3 * k + i for k in without for i in range(3)], axis=1)
        part = replace(system, J=J, V=found.V[np.ix_(kept, kept)])
        P, _ = posterior(information(part, rests - len(without), free), found.p, free, gravity_sigma)
        return np.sqrt(np.diag(P))

    whole = sigma(np.ones(len(attitudes), np.bool_), [])
    growths = []
    for k in range(rests):
        kept = np.ones(len(attitudes), np.bool_)
        for block in system.blocks:
            kept[block.rows] = not attitudes[block.rows, k].any()
        growths.append(float((sigma(kept, [k]) / whole).max()))
    return tuple(growths)


def earth_rate_shift(found: Adjustment, free: Free, gravity_sigma: float) -> tuple[Array, Array]:
    """Return by how much the equations would move the Earth rate north and up, and its covariance.

    Parameters
    ----------
    found : Adjustment
        Converged, the Earth rate that of the site.
    free : Free
        Its free parameters.
    gravity_sigma : float
        As in `adjust`.

    Returns
    -------
    tuple of ndarray, shape (2,), and ndarray, shape (2, 2)
        rad/s.
    """
    Z = _whole_basis(replace(free, earth=True), len(found.attitudes))
    solver = _Solver(found.system, Z, found.p, found.p.gravity, gravity_sigma, found.wander)
    covariance = Z @ solver.covariance @ Z.T
    return (Z @ solver.step(np.zeros(Z.shape[1])))[EARTH], covariance[EARTH, EARTH]


def _whole_basis(free: Free, rests: int) -> Array:
    basis = free.basis
    Z = np.zeros((COLUMNS + 3 * rests, basis.shape[1] + 3 * rests))
    Z[:COLUMNS, : basis.shape[1]] = basis
    Z[COLUMNS:, basis.shape[1] :] = np.eye(3 * rests)
    return Z


class _Solver:
    """One step of the iteration, and its covariance.

    Attributes
    ----------
    covariance : ndarray, shape (n, n)
        Of what is free, with the priors of the parameters.
    """

    def __init__(
        self,
        system: LinearSystem,
        Z: Array,
        p: Parameters,
        site_gravity: float,
        gravity_sigma: float,
        wander: Wander,
    ) -> None:
        self.Z = Z
        self.V = covariance_of(system, wander)
        self.J = system.J @ Z
        weighted = cho_solve(cho_factor(self.V, lower=True), self.J)
        gravity = Z[GRAVITY.start] / gravity_sigma
        self._N = self.J.T @ weighted + np.outer(gravity, gravity)
        self._gradient = weighted.T @ system.residual + gravity * (p.gravity - site_gravity) / gravity_sigma
        self._n = int(np.count_nonzero(np.any(Z[:COLUMNS] != 0.0, axis=0)))  # parameters; then attitudes
        basis = Z[:COLUMNS, : self._n]
        self._prior = basis.T @ prior_information(p) @ basis
        whole = self._N.copy()
        whole[: self._n, : self._n] += self._prior
        self.covariance = _inverse(whole)

    def step(self, moved: Array) -> Array:
        """Return the step of what is free.

        What is observable goes where the equations say. What is not is held by its prior at the start.

        Parameters
        ----------
        moved : ndarray, shape (n,)
            Sum of the steps before this one.
        """
        n, N, g = self._n, self._N, self._gradient
        by_attitude = np.linalg.solve(N[n:, n:], np.concatenate([N[n:, :n], g[n:, None]], axis=1))
        own = N[:n, :n] - N[:n, n:] @ by_attitude[:, :n]
        gradient = g[:n] - N[:n, n:] @ by_attitude[:, n]
        prior = self._prior + 1e-6 * np.diag(np.diag(own))
        ratio, directions = eigh(0.5 * (own + own.T), prior)
        held = ratio < 1.0 / RATIO**2 - 1.0
        pull = directions.T @ gradient + held * (directions.T @ (prior @ moved[:n]))
        parameters = -directions @ (pull / (ratio + held))
        attitudes = -(by_attitude[:, n] + by_attitude[:, :n] @ parameters)
        return np.concatenate([parameters, attitudes])


def _inverse(N: Array) -> Array:
    """Return the inverse of a positive definite matrix of numbers of different size."""
    scale = 1.0 / np.sqrt(np.diag(N))
    inverse: Array = np.linalg.inv(N * scale * scale[:, None]) * scale * scale[:, None]
    return inverse


def covariance_of(system: LinearSystem, wander: Wander) -> Array:
    """Return the covariance of the equations, wander included."""
    by_gyro, by_accelerometer = system.wander
    V: Array = system.V + wander.gyro**2 * by_gyro + wander.accelerometer**2 * by_accelerometer
    return V


def prior_information(p: Parameters) -> Array:
    """Return the inverse of the prior covariance of the parameters, shape (COLUMNS, COLUMNS).

    Scales and axes are uncertain in their own right: W and M are both at once.
    """
    information = np.zeros((COLUMNS, COLUMNS))
    for columns, matrix, scale_prior in (
        (W, p.W, GYRO_SCALE_PRIOR),
        (M, p.M, ACCELEROMETER_SCALE_PRIOR),
    ):
        by_scale, by_axis = _scale_and_axes(matrix)
        information[columns, columns] = (
            by_scale.T @ by_scale / scale_prior**2 + by_axis.T @ by_axis / AXIS_PRIOR**2
        )
    for columns, sigma in PRIORS:
        k = range(COLUMNS)[columns]
        information[k, k] = 1.0 / sigma**2
    return information


PRIORS: Final = (
    (BETA, 2 * DEG_PER_H),
    (B, 2000 * UG),
    (Q, 100 * K2),
    (R, 30 * MM),
    (SKEW, 1e-3),
    (BETA_T, 0.05 * DEG_PER_H),
    (GYRO_SCALE_T, 5 * PPM),
    (B_T, 100 * UG),
    (ACCELEROMETER_SCALE_T, 100 * PPM),
    (EARTH, 5 * DEG_PER_H),
)
"""Priors of the other parameters, 1 sigma."""


def _scale_and_axes(matrix: Array) -> tuple[Array, Array]:
    """Return how lengths (relative) and directions of the rows of the inverse change with a matrix."""
    S = np.linalg.inv(matrix)
    lengths = np.linalg.norm(S, axis=1)
    directions = S / lengths[:, None]
    by_scale, by_axis = np.zeros((3, 9)), np.zeros((9, 9))
    for k in range(9):
        change = -np.outer(S[:, k // 3], S[k % 3]) / lengths[:, None]
        along = (directions * change).sum(axis=1)
        by_scale[:, k] = along
        by_axis[:, k] = (change - along[:, None] * directions).ravel()
    return by_scale, by_axis


def _wander(system: LinearSystem, Z: Array, p: Parameters, gravity_sigma: float) -> Wander:
    """Return the size of the wander that the residuals show, below its ceiling (restricted likelihood).

    Few residuals show it, so that its variance is uncertain, and errors over it are those of Student's t.
    With n degrees of freedom their variance is larger by n / (n - 2): that is the size returned.
    """
    ceilings = np.array([GYRO_WANDER_CEILING, ACCELEROMETER_WANDER_CEILING])
    J = system.J @ Z
    damping = np.zeros((len(Z), len(Z)))
    damping[:COLUMNS, :COLUMNS] = prior_information(p)
    damping[GRAVITY, GRAVITY] += 1.0 / gravity_sigma**2
    prior = Z.T @ damping @ Z

    def deviance(share: Array) -> float:
        """Twice the negative logarithm, by the variances as shares of the largest."""
        sizes = ceilings * np.sqrt(share)
        factor = cho_factor(covariance_of(system, Wander(*sizes.tolist())), lower=True)
        weighted = cho_solve(factor, J)
        N = J.T @ weighted + prior
        scale = 1.0 / np.sqrt(np.diag(N))
        inner = cho_factor(N * scale * scale[:, None], lower=True)
        rhs = weighted.T @ system.residual
        fitted = rhs @ (scale * cho_solve(inner, scale * rhs))
        logs = np.log(np.diag(factor[0])).sum() + np.log(np.diag(inner[0])).sum() - np.log(scale).sum()
        return float(2.0 * logs + system.residual @ cho_solve(factor, system.residual) - fitted)

    found = scipy.optimize.minimize(
        deviance,
        np.array([0.1, 0.1]),
        bounds=[(0.0, 1.0)] * 2,
        method="L-BFGS-B",
        options={"eps": 1e-4, "ftol": 1e-10},  # the step: of differences of numbers of a thousand
    )
    shares = np.clip(found.x, 0.0, 1.0)
    exceeds = []
    for k in range(2):  # by a likelihood ratio: one rest more or less does not decide it
        larger = shares.copy()
        larger[k] = LARGER_WANDER**2
        exceeds.append(bool(shares[k] > AT_CEILING and deviance(shares) - deviance(larger) > CHI_SQUARE_95))
    freedom = _freedom_of_wander(system, J, prior)
    shares = np.minimum(shares / (1.0 - 2.0 / np.maximum(freedom, LEAST_FREEDOM)), 1.0)
    return Wander(*(ceilings * np.sqrt(shares)).tolist(), *exceeds)


def _freedom_of_wander(system: LinearSystem, J: Array, prior: Array) -> Array:
    """Return the degrees of freedom of the wander: how many residuals show it (Satterthwaite).

    Parameters
    ----------
    system : LinearSystem
    J, prior : ndarray
        Of what is free.

    Returns
    -------
    ndarray, shape (2,)
        Of gyros and accelerometers.
    """
    factor = cho_factor(system.V, lower=True)
    weighted = cho_solve(factor, J)
    P = _inverse(J.T @ weighted + prior)
    freedom = np.zeros(2)
    for k, by_variance in enumerate(system.wander):
        shown = cho_solve(factor, by_variance) - weighted @ P @ (weighted.T @ by_variance)
        squares = np.trace(shown @ shown)
        freedom[k] = np.trace(shown) ** 2 / squares if squares > 0.0 else 0.0
    return freedom


def _result(
    equations: Equations,
    p: Parameters,
    attitudes: Sequence[Array],
    free: Free,
    site_gravity: float,
    gravity_sigma: float,
    wander: Wander,
    iterations: int,
) -> Adjustment:
    system = equations.system(p, attitudes)
    Z = _whole_basis(free, len(attitudes))
    solver = _Solver(system, Z, p, site_gravity, gravity_sigma, wander)
    basis = Z[:COLUMNS]
    fitted = solver.J @ solver.covariance @ solver.J.T
    # below a hundredth of redundancy a residual has no information
    variance = np.maximum(np.diag(solver.V) - np.diag(fitted), 0.01 * np.diag(solver.V))
    factor = cho_factor(solver.V, lower=True)
    chi_square = float(system.residual @ cho_solve(factor, system.residual))
    information = np.trace(solver.covariance @ (solver.J.T @ cho_solve(factor, solver.J)))
    return Adjustment(
        p,
        tuple(attitudes),
        basis @ solver.covariance @ basis.T,
        system.residual,
        np.sqrt(variance),
        system,
        solver.V,
        chi_square,
        len(system.residual) - round(float(information)),
        wander,
        iterations,
    )
