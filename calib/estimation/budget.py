"""Uncertainty of the lever arms by source.

The estimate is linear in the readings v of the runs and in the expected values x_0 of the parameters:

    x = C (sum over the runs of A' K^-1 v  +  P^-1 x_0)

with the covariances C of the estimate, K of the noise and P of the priors. A source that gives v, or x_0, the
covariance S contributes G S G' with G = C A' K^-1, or G = C P^-1. Over all sources this adds up to C.

The sources of the noise are those of `calib.estimation.linear_system`. A certificate may state correlations
between the errors of a unit: what these add is a source of its own, and may be negative.

The site is not in the model, as it contributes less than what is neglected: a wrong latitude tilts the
horizontal at a constant rate, and a wrong gravity makes a vertical velocity with its Coriolis acceleration.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from calib.estimation.joint import Solution, solve
from calib.estimation.linear_system import RunEquations, extra_terms, noise_sources
from calib.estimation.priors import Priors
from calib.estimation.runs import Run
from imudrv.arrays import Array
from imudrv.nav.earth import earth_rate_n
from imudrv.units import DEG, MGAL

LATITUDE_SIGMA: Final = 0.01 * DEG
"""Standard uncertainty of the latitude of a site, rad: 1 km."""

NORMAL_GRAVITY_SIGMA: Final = 50.0 * MGAL
"""Standard uncertainty of normal gravity, m/s^2: anomalies."""

MEASURED_GRAVITY_SIGMA: Final = 1.0 * MGAL
"""Standard uncertainty of measured gravity, m/s^2."""


def uncertainty_by_source(
    runs: Sequence[Run], priors: Priors, gravity_sigma: float = NORMAL_GRAVITY_SIGMA
) -> dict[str, Array]:
    """Return the covariance of the lever arms by source, in the gauge `centroid`.

    Parameters
    ----------
    runs : sequence of Run
        The runs of an estimate with a free pivot, and without extra parameters.
    priors : Priors
        Its priors.
    gravity_sigma : float
        Standard uncertainty of the site's gravity, m/s^2.

    Returns
    -------
    dict of str to ndarray, shape (9, 9)
        m^2, by source: `velocity_walk`, `angle_walk`, `pulses`, `accelerometer_bias`, `accelerometer_scale`,
        `accelerometer_misalignment`, the same of the gyros, `skew`, `alignment`, `correlation` and `site`.
        All but the site add up to the covariance of the estimate.
    """
    solution = solve(runs, priors, terms=extra_terms(priors, ()))
    return {**_noise(runs, solution), **_priors(solution), "site": _site(runs, solution, gravity_sigma)}


def _noise(runs: Sequence[Run], solution: Solution) -> dict[str, Array]:
    total: dict[str, Array] = {}
    for k, (run, part) in enumerate(zip(runs, solution.system.parts, strict=True)):
        G = _gain(solution, k, part)
        for name, S in noise_sources(part.readings, solution.noise, run.gravity).items():
            total[name] = total.get(name, 0.0) + G @ S @ G.T
    return total


def _gain(solution: Solution, k: int, part: RunEquations) -> Array:
    """Return the derivative of R by the readings of run k, shape (9, n)."""
    whitened = part.A @ solution.covariance[:9, solution.system.columns_of(k)].T
    return np.asarray(solve_triangular(part.L, whitened, lower=True, trans="T").T, np.float64)


def _priors(solution: Solution) -> dict[str, Array]:
    parameters = solution.system.parameters
    P = parameters.covariance
    G = solution.covariance[:9, 9 : 9 + len(P)] @ np.linalg.inv(P)
    sources = np.array([source_of(name) for name in parameters.names])
    total = {}
    for name in dict.fromkeys(sources.tolist()):
        at: NDArray[np.int64] = np.flatnonzero(sources == name)
        total[name] = G[:, at] @ P[np.ix_(at, at)] @ G[:, at].T
    is_between = sources[:, None] != sources
    if P[is_between].any():
        total["correlation"] = G @ np.where(is_between, P, 0.0) @ G.T
    return total


def source_of(parameter: str) -> str:
    """Return the source that a parameter of the estimate belongs to."""
    if parameter.startswith("phi "):
        return "alignment"
    if parameter.startswith("skew"):
        return "skew"
    sensor, _, rest = parameter.partition("_")
    if rest.startswith("bias"):
        return f"{sensor}_bias"
    return f"{sensor}_{'scale' if rest.endswith(('_xx', '_yy', '_zz')) else 'misalignment'}"


def _site(runs: Sequence[Run], solution: Solution, gravity_sigma: float) -> Array:
    """Return the covariance by latitude and gravity of the site, with the velocities that these make."""
    shifts = np.zeros((2, 9))
    for k, (run, part) in enumerate(zip(runs, solution.system.parts, strict=True)):
        latitude_rad = float(run.rows["latitude_rad"][0])
        earth = np.array(earth_rate_n(latitude_rad))
        rate = earth_rate_n(latitude_rad + LATITUDE_SIGMA) - earth
        tilting = 0.5 * run.gravity * np.cross(rate, [0.0, 0.0, 1.0])
        falling = np.cross(earth, [0.0, 0.0, -gravity_sigma])
        t_s, direction_n = part.readings.t_s, part.readings.direction_n
        shifts += (t_s**2 * (np.array([tilting, falling]) @ direction_n.T)) @ _gain(solution, k, part).T
    return np.asarray(shifts.T @ shifts, np.float64)
