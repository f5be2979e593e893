"""Tests of a joint estimate: scatter at rest, redundancy of the turns, and each turn against the others.

With a free step of velocity at every turn the arms have no effect on the fit. Then

    scatter      chi-square of that fit: whether the velocity within each rest is as the noise makes it.
                 Degrees of freedom: the readings less two for each turn, and less the parameters of the runs.
    redundancy   what chi-square grows by when the steps are zero and the arms explain the velocities: whether
                 the turns agree on the arms. 2 n - d degrees of freedom for n turns and d components of R.

The prior of an error of the calibration is an equation for a parameter: it adds no degree of freedom. The
priors of the parameters of the runs are bounds, far wider than what they allow for, so that each such
parameter takes a degree of freedom as far as the data determine it. The noise itself is an estimate with f
degrees of freedom. Near a turn the readings' own errors, which are known, exceed the random walk. Where only
a share w of the scatter is due to the walk, an error of the noise changes the scatter by w times as much: it
follows an F distribution with f / w^2 degrees of freedom of the noise. What a turn gains is a walk: w is 1.

**Each turn against the others.** Freeing the step of one turn takes it out. The arms shift by the difference
of the estimates, whose covariance is the difference of their covariances, and chi-square falls by a value
with two degrees of freedom.
"""

from collections.abc import Sequence

import numpy as np

from calib.estimation.linear_system import NormalEquations
from calib.estimation.noise import SensorNoise
from calib.estimation.result import ChiSquare, LeaveOneOut
from imudrv.arrays import Array

_NO_ARMS = np.zeros((9, 0))


def scatter_and_redundancy(
    system: NormalEquations,
    x: Array,
    covariance: Array,
    basis: Array,
    noise: SensorNoise,
    *,
    in_motion: bool,
) -> tuple[ChiSquare | None, ChiSquare]:
    """Return the two tests of an estimate.

    Parameters
    ----------
    system : NormalEquations
        Equations of the session.
    x, covariance : ndarray
        Its solution.
    basis : ndarray, shape (9, d)
        Basis of the arms that were solved for.
    noise : SensorNoise
        Noise that the equations were whitened with.
    in_motion : bool
        Whether velocities in motion are used: then all of them test the arms, and there is one test.

    Returns
    -------
    tuple of ChiSquare
        Scatter, or None if it cannot be tested on its own, and redundancy.
    """
    if in_motion:
        freedom = system.count - basis.shape[1] - _determined(system, covariance)
        return None, ChiSquare(system.chi_square(x), freedom, _of_noise(system, x, noise))
    free, spread = system.solve(_NO_ARMS, system.turns)
    scatter = system.chi_square(free)
    all_turns = sum(len(part.accepted) for part in system.parts)
    redundant = max(0, 2 * len(system.turns) - basis.shape[1])
    freedom = system.count - 2 * all_turns - _determined(system, spread)
    return (
        # level accelerometers that send hardly a pulse are read at the ends of the rests alone
        ChiSquare(scatter, freedom, _of_noise(system, free, noise)) if freedom > 0 else None,
        ChiSquare(system.chi_square(x) - scatter, redundant, noise.degrees_of_freedom)
        if redundant
        else ChiSquare(0.0, 0),
    )


def _of_noise(system: NormalEquations, x: Array, noise: SensorNoise) -> int:
    """Return the degrees of freedom of the noise as far as chi-square depends on it."""
    return round(noise.degrees_of_freedom / max(system.walk_share(x), 1e-3) ** 2)


def _determined(system: NormalEquations, covariance: Array) -> int:
    """Return how many parameters of the runs the data determine."""
    prior = np.diag(system.parameters.covariance)
    posterior = np.diag(covariance)[9 : 9 + len(prior)]
    return round(float((1.0 - posterior / prior)[system.parameters.shared :].sum()))


def leave_one_out(
    system: NormalEquations, x: Array, covariance: Array, basis: Array, limit: float, labels: Sequence[str]
) -> tuple[LeaveOneOut, ...]:
    """Return the estimate without each accepted turn.

    Parameters
    ----------
    system : NormalEquations
        Equations of the session.
    x, covariance : ndarray
        Their solution.
    basis : ndarray, shape (9, d)
        Basis of the arms that were solved for.
    limit : float
        Sigma of an observable direction of R, m.
    labels : sequence of str
        Labels of the accepted turns.

    Returns
    -------
    tuple of LeaveOneOut
    """
    chi_square = system.chi_square(x)
    results = []
    for label, turn in zip(labels, system.turns.tolist(), strict=True):
        rank = int((system.directions([turn])[0] < limit).sum())
        if rank < basis.shape[1]:
            results.append(LeaveOneOut(label, rank, None, None, None))
            continue
        other, spread = system.solve(basis, [turn])
        variance = np.diag(spread)[:9] - np.diag(covariance)[:9]
        results.append(
            LeaveOneOut(
                label,
                rank,
                (other - x)[:9].reshape(3, 3),
                np.sqrt(np.maximum(variance, 0.0)).reshape(3, 3),
                ChiSquare(chi_square - system.chi_square(other), 2),
            )
        )
    return tuple(results)
