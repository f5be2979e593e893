"""Joint estimate of the lever arms and the residual calibration errors from all rests.

The velocity at rest is linear in the residual errors of the increments (`calib.estimation.design`); its noise
and the equations are those of `calib.estimation.linear_system`. R is estimated twice: the effect of the
misalignments on the size effect itself is linear only for known arms.

**Rank.** An eigenvalue l of the information on R, all other parameters marginalised, gives its direction a
sigma of 1 / sqrt(l). A direction whose sigma is not below `Priors.arm` is unobservable. Rotations between
rests do not determine a common shift of the three points (the gauge): R is solved for in the six-dimensional
space without such a shift, which is the gauge `centroid`.
"""

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import numpy as np

from calib.estimation.consistency import leave_one_out, scatter_and_redundancy
from calib.estimation.design import Design, Known
from calib.estimation.gains import Fit, rest_growth, run_result, singular_values_of, velocity_gains
from calib.estimation.linear_system import (
    NormalEquations,
    Parameters,
    extra_terms,
    prior_parameters,
    run_equations,
)
from calib.estimation.noise import SensorNoise, noise_of
from calib.estimation.observability import rank_reason, require_axes, require_runs, unobservable_text
from calib.estimation.priors import Priors
from calib.estimation.result import (
    CENTROID_BASIS,
    SCATTER_LIMIT,
    TO_DIFFERENCES,
    Extra,
    LeverArmEstimate,
    ParameterEstimate,
)
from calib.estimation.runs import Run
from calib.messages import message
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.units import STANDARD_GRAVITY, UG

PIVOT_LIMIT: Final = 10.0
"""Largest reduction of chi-square per component by a separate pivot for each run."""


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
        There are no runs, or no pulses for the noise; nine components without a known pivot; the rotations do
        not determine the required directions; or the data contradict the pivot.
    """
    priors = priors or Priors()
    terms = extra_terms(priors, extra)
    require_runs(runs)
    if nine and pivot == "free":
        raise InputError(
            "identification: expected a fixed pivot for nine components of the lever arms, got pivot free: "
            "rotations between rests determine six, as a common shift of the three sensing points causes no "
            "velocity at rest; choose another gauge, or turn the unit about a fixed point and use pivot fixed"
        )
    solution = solve(runs, priors, pivot=pivot, terms=terms)
    designs, system, noise, basis, x, covariance = solution
    parameters = system.parameters
    sigma, _ = system.directions()
    rank = int((sigma < priors.arm).sum())
    R = x[:9]
    scatter, redundancy = scatter_and_redundancy(
        system, x, covariance, basis, noise, in_motion=pivot == "fixed"
    )
    if pivot == "fixed":
        _check_pivot(system, x)
    cut = 9 + len(parameters.names)
    spread = np.sqrt(np.diag(covariance))
    found = tuple(
        ParameterEstimate(name, float(value), float(s), float(prior))
        for name, value, s, prior in zip(
            parameters.names, x[9:cut], spread[9:cut], parameters.sigma, strict=True
        )
    )
    labels = [
        label for run in runs for label, turn in zip(run.turn_labels, run.turns, strict=True) if turn.accepted
    ]
    return LeverArmEstimate(
        method="joint",
        gauge="given" if pivot == "fixed" else "centroid",
        R_b=R.reshape(3, 3),
        covariance=covariance[:9, :9],
        rank=rank,
        direction_sigma=sigma,
        singular_values=singular_values_of(velocity_gains(runs)),
        reason=rank_reason(rank, sigma, priors.arm),
        scatter=scatter,
        redundancy=redundancy,
        noise=noise,
        dither_error=_dither_error(runs, system, R, covariance),
        parameters=found,
        correlation=covariance[:9, 9:cut] / np.outer(np.maximum(spread[:9], 1e-300), spread[9:cut]),
        leave_one_out=leave_one_out(system, x, covariance, basis, priors.arm, labels),
        runs=tuple(
            run_result(run, R, _fit(designs[k], x[system.columns_of(k)])) for k, run in enumerate(runs)
        ),
        notes=tuple(
            message("not_observable", name=n.name, sigma_ug_per_g2=n.sigma * STANDARD_GRAVITY**2 / UG)
            for n in found
            if n.name.startswith("quadratic") and not n.observable
        ),
    )


class Solution(NamedTuple):
    """Solution of the equations of all runs."""

    designs: list[Design]  # of each run
    system: NormalEquations
    noise: SensorNoise
    basis: Array  # (9, d), of R
    x: Array
    covariance: Array


def solve(
    runs: Sequence[Run], priors: Priors, *, pivot: Literal["free", "fixed"] = "free", terms: Sequence[str]
) -> Solution:
    """Return the estimate of all unknowns, to second order; see `estimate_joint`.

    Parameters
    ----------
    runs, priors, pivot
        As for `estimate_joint`.
    terms : sequence of {'skew', 'quadratic'}
        Parameters beyond biases and matrices.

    Returns
    -------
    Solution

    Raises
    ------
    InputError
        The rotations do not determine the directions of R.
    """
    noise = noise_of(runs)
    parameters = prior_parameters(runs, priors, terms)
    basis = np.eye(9) if pivot == "fixed" else CENTROID_BASIS
    designs, system = _equations(runs, noise, pivot, parameters)
    sigma, directions = system.directions()
    if int((sigma < priors.arm).sum()) < basis.shape[1]:
        require_axes(runs)
        raise InputError(unobservable_text(sigma, directions, basis, priors.arm))
    x, _ = system.solve(basis)
    known = [design.known(x[system.columns_of(k)]) for k, design in enumerate(designs)]
    designs, system = _equations(runs, noise, pivot, parameters, known)
    return Solution(designs, system, noise, basis, *system.solve(basis))


def _equations(
    runs: Sequence[Run],
    noise: SensorNoise,
    pivot: str,
    parameters: Parameters,
    known: Sequence[Known | None] | None = None,
) -> tuple[list[Design], NormalEquations]:
    """Return the equations of all runs, to second order with a first estimate."""
    known = known or [None] * len(runs)
    designs = [Design(run, parameters.terms, first) for run, first in zip(runs, known, strict=True)]
    equations = [run_equations(run, noise, pivot, design) for run, design in zip(runs, designs, strict=True)]
    return designs, NormalEquations(equations, parameters)


def _fit(design: Design, x: Array) -> Fit:
    """Return the function of the estimated velocity at rest."""
    return lambda t_s, arrest: np.asarray(design.at(t_s, arrest) @ x, np.float64)


def _dither_error(runs: Sequence[Run], system: NormalEquations, R: Array, covariance: Array) -> float:
    """Return the largest error of a difference by the H that grows at rest, in its sigma.

    In a turn H grows by the same rate in error, which H R takes for size effect.
    """
    b = np.zeros(len(covariance))
    for k, run in enumerate(runs):
        durations = np.cumsum([0.0, *(turn.duration_s for turn in run.turns)])
        error = run.readings.direction_n @ (rest_growth(run) @ R) * durations[run.readings.arrest]
        part = system.parts[k]
        b[system.columns_of(k)] += part.A.T @ part.whitened(error)
    shift = TO_DIFFERENCES @ (covariance @ b)[:9]
    sigma = np.sqrt(np.diag(TO_DIFFERENCES @ covariance[:9, :9] @ TO_DIFFERENCES.T))
    return float(np.abs(shift / sigma).max())


def _check_pivot(system: NormalEquations, x: Array) -> None:
    """Refuse a pivot that the data contradict: a separate one for each run fits much better."""
    separate = system.with_pivots(PIVOT_SIGMA)
    chi_square, better = system.chi_square(x), separate.chi_square(separate.solve(np.eye(9))[0])
    freedom, runs = system.count - 9, len(system.parts)
    if chi_square - better > PIVOT_LIMIT * 3 * runs or chi_square > SCATTER_LIMIT * freedom:
        raise InputError(
            "identification: pivot fixed: expected the origin of b to stay still, but the velocities "
            f"contradict it: chi-square {chi_square:.0f}, expected about {freedom}, and {better:.0f} with an "
            "origin of its own for each run; use pivot free, or look for what moved"
        )
