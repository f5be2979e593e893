"""The adjustment: Gauss-Newton on all parameters and attitudes, and the size of the wander.

What the equations do not show stays where it started: each step is damped by the priors of the contract, 3.6,
about the present point, not about the start, so that a start far from the truth leaves nothing in the result.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from calib.estimation.result import CENTROID_BASIS
from calib.sensors.equations import (
    ACCELEROMETER_WANDER_CEILING,
    GYRO_WANDER_CEILING,
    Equations,
    LinearSystem,
)
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
WANDER_ITERATIONS: Final = (3, 4, 5)
"""Iterations in which the size of the wander is found; it is kept from then on."""
CONVERGED: Final = 1e-4
"""Largest step of a parameter, in its sigma, at which the iteration ends."""


@dataclass(frozen=True)
class Free:
    """Which parameters are free.

    Attributes
    ----------
    pivot : {'free', 'fixed'}
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
        others = [k for k in range(COLUMNS) if k not in fixed and not 27 <= k < 36]
        return np.concatenate([one[:, others], arms], axis=1)


@dataclass(frozen=True)
class Adjustment:
    """Result of an adjustment.

    Attributes
    ----------
    p : Parameters
    attitudes : tuple of ndarray, shape (3, 3)
        C_nb of each rest.
    covariance : ndarray, shape (COLUMNS, COLUMNS)
    attitude_covariance : ndarray, shape (3 k, 3 k)
    residual : ndarray
        Of the equations at the end.
    residual_sigma : ndarray
        Expected scatter of each residual.
    system : LinearSystem
    V : ndarray
        Covariance of the equations, wander included.
    chi_square : float
    degrees_of_freedom : int
    wander : tuple of float
        Of gyros, rad/s, and accelerometers, m/s^2.
    iterations : int
    """

    p: Parameters
    attitudes: tuple[Array, ...]
    covariance: Array
    attitude_covariance: Array
    residual: Array
    residual_sigma: Array
    system: LinearSystem
    V: Array
    chi_square: float
    degrees_of_freedom: int
    wander: tuple[float, float]
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
    wander = (0.0, 0.0)
    for iteration in range(1, MOST_ITERATIONS + 1):
        system = equations.system(p, attitudes)
        if not np.isfinite(system.residual).all():
            raise NoConvergence("the adjustment does not converge: its numbers grow without bounds")
        Z = _whole_basis(free, len(attitudes))
        settled = iteration > WANDER_ITERATIONS[-1]
        if iteration in WANDER_ITERATIONS:
            wander = _wander(system, Z, p, site_gravity, gravity_sigma)
        solver = _Solver(system, Z, p, site_gravity, gravity_sigma, wander)
        step, sigma = solver.step()
        p = p.moved(step[:COLUMNS])
        for k, psi in enumerate(step[COLUMNS:].reshape(-1, 3)):
            attitudes[k] = Rotation.from_rotvec(psi).as_matrix() @ attitudes[k]
        largest = float(np.max(np.abs(solver.reduced_step) / sigma))
        if settled and largest < CONVERGED:
            return _result(equations, p, attitudes, free, site_gravity, gravity_sigma, wander, iteration)
    raise NoConvergence(
        f"the adjustment does not converge: after {MOST_ITERATIONS} iterations a parameter still moves by "
        f"{largest:.2g} of its sigma"
    )


def _whole_basis(free: Free, rests: int) -> Array:
    basis = free.basis
    Z = np.zeros((COLUMNS + 3 * rests, basis.shape[1] + 3 * rests))
    Z[:COLUMNS, : basis.shape[1]] = basis
    Z[COLUMNS:, basis.shape[1] :] = np.eye(3 * rests)
    return Z


class _Solver:
    """One step of the iteration, and its covariance."""

    def __init__(
        self,
        system: LinearSystem,
        Z: Array,
        p: Parameters,
        site_gravity: float,
        gravity_sigma: float,
        wander: tuple[float, float],
    ) -> None:
        self.Z = Z
        self.V = covariance_of(system, wander)
        self.J = system.J @ Z
        factor = cho_factor(self.V, lower=True)
        weighted = cho_solve(factor, self.J)
        at_gravity = np.zeros(len(Z))
        at_gravity[GRAVITY] = 1.0 / gravity_sigma
        row = at_gravity @ Z
        damping = np.zeros((len(Z), len(Z)))
        damping[:COLUMNS, :COLUMNS] = prior_information(p)
        N = self.J.T @ weighted + np.outer(row, row) + Z.T @ damping @ Z
        rhs = weighted.T @ system.residual + row * (p.gravity - site_gravity) / gravity_sigma
        scale = 1.0 / np.sqrt(np.diag(N))
        self.covariance = np.linalg.inv(N * scale * scale[:, None]) * scale * scale[:, None]
        self.reduced_step = -self.covariance @ rhs

    def step(self) -> tuple[Array, Array]:
        """Return the step of parameters and attitudes, and the sigma of what is free."""
        return self.Z @ self.reduced_step, np.sqrt(np.diag(self.covariance))


def covariance_of(system: LinearSystem, wander: tuple[float, float]) -> Array:
    """Return the covariance of the equations, wander included."""
    V: Array = system.V + wander[0] ** 2 * system.wander[0] + wander[1] ** 2 * system.wander[1]
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


def _wander(
    system: LinearSystem, Z: Array, p: Parameters, site_gravity: float, gravity_sigma: float
) -> tuple[float, float]:
    """Return the size of the wander that the residuals show, below its ceiling (restricted likelihood)."""
    ceilings = np.array([GYRO_WANDER_CEILING, ACCELEROMETER_WANDER_CEILING])
    J = system.J @ Z
    damping = np.zeros((len(Z), len(Z)))
    damping[:COLUMNS, :COLUMNS] = prior_information(p)
    damping[GRAVITY, GRAVITY] += 1.0 / gravity_sigma**2
    prior = Z.T @ damping @ Z

    def deviance(ratio: Array) -> float:
        sizes = ceilings * ratio
        factor = cho_factor(covariance_of(system, (sizes[0], sizes[1])), lower=True)
        weighted = cho_solve(factor, J)
        N = J.T @ weighted + prior
        scale = 1.0 / np.sqrt(np.diag(N))
        inner = cho_factor(N * scale * scale[:, None], lower=True)
        rhs = weighted.T @ system.residual
        fitted = rhs @ (scale * cho_solve(inner, scale * rhs))
        logs = np.log(np.diag(factor[0])).sum() + np.log(np.diag(inner[0])).sum() - np.log(scale).sum()
        return float(2.0 * logs + system.residual @ cho_solve(factor, system.residual) - fitted)

    found = minimize(deviance, np.array([0.2, 0.2]), bounds=[(0.0, 1.0)] * 2, method="L-BFGS-B")
    gyro, accelerometer = (ceilings * np.clip(found.x, 0.0, 1.0)).tolist()
    return gyro, accelerometer


def _result(
    equations: Equations,
    p: Parameters,
    attitudes: Sequence[Array],
    free: Free,
    site_gravity: float,
    gravity_sigma: float,
    wander: tuple[float, float],
    iterations: int,
) -> Adjustment:
    system = equations.system(p, attitudes)
    Z = _whole_basis(free, len(attitudes))
    solver = _Solver(system, Z, p, site_gravity, gravity_sigma, wander)
    whole = Z @ solver.covariance @ Z.T
    fitted = solver.J @ solver.covariance @ solver.J.T
    variance = np.maximum(np.diag(solver.V) - np.diag(fitted), 1e-12 * np.diag(solver.V))
    factor = cho_factor(solver.V, lower=True)
    chi_square = float(system.residual @ cho_solve(factor, system.residual))
    information = np.trace(solver.covariance @ (solver.J.T @ cho_solve(factor, solver.J)))
    return Adjustment(
        p,
        tuple(attitudes),
        whole[:COLUMNS, :COLUMNS],
        whole[COLUMNS:, COLUMNS:],
        system.residual,
        np.sqrt(variance),
        system,
        solver.V,
        chi_square,
        len(system.residual) - round(float(information)),
        wander,
        iterations,
    )
