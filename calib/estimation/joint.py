"""Joint estimate of the lever arms and the residual calibration errors from all rests.

The velocity at rest is linear in the residual errors of the increments (mathematics, section 4; the matrices
H, B, P, Q are those of `imudrv.nav.mechanisation`). Measured minus true, horizontal components:

    delta v = H R + B b_a + A vec(dA) + f x ( integral of phi )
    phi(t)  = (I - t [omega_ie x]) phi_0 - B b_g - P vec(dG)

with the integral of C_nb dA f_b = A vec(dA). The errors of tilt and heading at the start of each run, phi_0,
are parameters of that run; all others are common to the session. Heading is included because the Earth's
rotation turns its error into a tilt rate as large as that of a gyro bias: the alignment has chosen the
heading that compensates the bias in the first pose, and the rotation makes both observable.

**Noise.** Pulses cause white noise of velocity, once more at the start of a run; accelerometers a random
walk q_v; gyros a random walk q_a of tilt, which gravity integrates. Over a run

    cov(s, t) = q_v^2 min(s, t) + g^2 q_a^2 s^2 (3 t - s) / 6 + start^2 + white^2 [s = t],      s <= t

Their magnitudes are estimated from the rests. Rows are whitened by the Cholesky factor.

**Rank.** An eigenvalue l of the information on R, all other parameters marginalised, gives its direction a
sigma of 1 / sqrt(l). A direction whose sigma is not below `Priors.arm` is unobservable. Rotations between
rests do not determine a common shift of the three points (the gauge): R is solved for in the six-dimensional
space without such a shift, which is the gauge `centroid`.
"""

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np

from calib.estimation.linear_system import (
    NormalEquations,
    Parameters,
    parameter_groups,
    prior_parameters,
    rank_reason,
    require_runs,
    rest_noise,
    run_equations,
    run_result,
    singular_values_of,
    unobservable_text,
    velocity_gains,
)
from calib.estimation.result import (
    CENTROID_BASIS,
    CHI_SQUARE_LIMIT,
    Extra,
    LeaveOneOut,
    LeverArmEstimate,
    ParameterEstimate,
)
from calib.estimation.runs import Priors, Run
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.units import STANDARD_GRAVITY, UG

PIVOT_LIMIT: Final = 10.0
"""Largest reduction of chi-square per component by a separate pivot for each rotation."""


PIVOT_SIGMA: Final = 0.1
"""Prior sigma of such a pivot, m."""


def estimate_joint(
    runs: Sequence[Run],
    priors: Priors | None = None,
    *,
    pivot: Literal["free", "fixed"] = "free",
    nine: bool = False,
    extra: Sequence[Extra] = (),
) -> LeverArmEstimate:
    """Estimate R jointly with the residual calibration errors; the default method.

    Parameters
    ----------
    runs : sequence of Run
        Any number, poses and signs, from any captures of one unit.
    priors : Priors, optional
        Uncertainty of the static calibration.
    pivot : {'free', 'fixed'}
        `fixed`: the origin of b is known to stay still while the unit turns, as on a turntable; velocity is
        then known during the motion too, and R refers to that origin.
    nine : bool
        Whether all nine components are required, which needs a known pivot.
    extra : sequence of {'quadratic'}
        Additional parameters: a quadratic term of each sensing axis, 1/(m/s^2). Unobservable ones stay at
        their prior, with a note.

    Returns
    -------
    LeverArmEstimate

    Raises
    ------
    InputError
        There are no runs; nine components without a known pivot; the rotations do not determine the
        required directions; or the data contradict the pivot.
    """
    priors = priors or Priors()
    terms = parameter_groups(priors, extra)
    require_runs(runs)
    if nine and pivot == "free":
        raise InputError(
            "identification: expected a fixed pivot for nine components of the lever arms, got pivot free: "
            "rotations between rests determine six, as a common shift of the three sensing points causes no "
            "velocity at rest; choose another gauge, or turn the unit about a fixed point and use pivot fixed"
        )
    noise = rest_noise(runs)
    system = NormalEquations(
        [run_equations(run, noise, pivot, terms) for run in runs], prior_parameters(runs, priors, terms)
    )
    basis = np.eye(9) if pivot == "fixed" else CENTROID_BASIS
    sigma, directions = system.directions()
    rank = int((sigma < priors.arm).sum())
    wanted = basis.shape[1]
    if rank < wanted:
        raise InputError(unobservable_text(sigma, directions, basis, priors.arm))
    x, covariance = system.solve(basis)
    chi_square, freedom = system.chi_square(x, wanted)
    if pivot == "fixed":
        _check_pivot(system, chi_square, freedom)
    names = system.parameters.names
    spread = np.sqrt(np.diag(covariance))
    parameters = tuple(
        ParameterEstimate(name, float(value), float(s), float(prior))
        for name, value, s, prior in zip(names, x[9:], spread[9:], system.parameters.sigma, strict=True)
    )
    return LeverArmEstimate(
        method="joint",
        gauge="given" if pivot == "fixed" else "centroid",
        R_b=x[:9].reshape(3, 3),
        covariance=covariance[:9, :9],
        rank=rank,
        direction_sigma=sigma,
        singular_values=singular_values_of(velocity_gains(runs)),
        reason=rank_reason(rank, sigma, priors.arm),
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        noise=noise,
        parameters=parameters,
        correlation=covariance[:9, 9:] / np.outer(np.maximum(spread[:9], 1e-300), spread[9:]),
        leave_one_out=tuple(
            _without(system, k, run.label, x, basis, priors.arm) for k, run in enumerate(runs)
        ),
        runs=tuple(
            run_result(run, x[:9], part.t_s, part.v_n, part.columns @ x[system.columns_of(k)])
            for k, (run, part) in enumerate(zip(runs, system.parts, strict=True))
        ),
        notes=tuple(
            f"{n.name} not observable in these runs: sigma {n.sigma * STANDARD_GRAVITY**2 / UG:.3g} ug/g^2"
            for n in parameters
            if n.name.startswith("quadratic") and not n.observable
        ),
    )


def _check_pivot(system: NormalEquations, chi_square: float, freedom: int) -> None:
    """Refuse a pivot that the data contradict: a separate one for each rotation fits much better."""
    runs, cut = len(system.parts), 9 + system.parameters.shared
    own = np.split(system.parameters.sigma[system.parameters.shared :], runs)
    sigma = np.concatenate([np.append(phi, np.full(3, PIVOT_SIGMA)) for phi in own])
    size = cut + len(own[0])
    M = np.zeros((size, size + 3))  # a shift of the origin shifts all three points
    M[:, :size], M[:9, size:] = np.eye(size), np.tile(np.eye(3), (3, 1))
    separate = NormalEquations(
        [
            part._replace(columns=part.columns @ M, N=M.T @ part.N @ M, b=M.T @ part.b)
            for part in system.parts
        ],
        Parameters((), np.concatenate([system.parameters.sigma[: system.parameters.shared], sigma]), cut - 9),
    )
    x, _ = separate.solve(np.eye(9))
    better, _ = separate.chi_square(x, 9)
    if chi_square - better > PIVOT_LIMIT * 3 * runs or chi_square > CHI_SQUARE_LIMIT * freedom:
        raise InputError(
            "identification: pivot fixed: expected the origin of b to stay still, but the velocities "
            f"contradict it: chi-square {chi_square:.0f}, expected about {freedom}, and {better:.0f} with an "
            "origin of its own for each rotation; use pivot free, or look for what moved"
        )


def _without(
    system: NormalEquations, k: int, label: str, x: Array, basis: Array, limit: float
) -> LeaveOneOut:
    """Return the estimate without run k."""
    other = system.without(k)
    rank = int((other.directions()[0] < limit).sum())
    if rank < basis.shape[1]:
        return LeaveOneOut(label, rank, None)
    return LeaveOneOut(label, rank, (other.solve(basis)[0] - x)[:9].reshape(3, 3))
