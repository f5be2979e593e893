"""Cramer-Rao bound of the lever arms: what the random walks leave, were the velocities at rest known exactly.

It has the noise, the priors and the turns of an estimate, and every velocity of the rests up to the turns
instead of the readings of pulses. What pulses hide it does not know: an estimate is 1 % above it with pulses
of 0.5 mm/s, and 12 to 17 % with those of 5 mm/s, where reading every edge of a pulse would gain 0.03 %.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from calib.estimation.design import Design, Known
from calib.estimation.linear_system import NormalEquations, extra_terms, prior_parameters, run_equations
from calib.estimation.priors import Priors
from calib.estimation.readings import LEAST_VARIANCE, Readings
from calib.estimation.result import CENTROID_BASIS, TO_DIFFERENCES, LeverArmEstimate
from calib.estimation.runs import Run

NEAR_S: Final = 0.4
"""Distance from a turn up to which every row is used, s: there the velocities count most."""

EVERY: Final = 5
"""Every n-th row is used farther away."""


def sigma_over_bound(estimate: LeverArmEstimate, runs: Sequence[Run], priors: Priors) -> float:
    """Return the rms sigma of the six differences over that of the bound.

    Parameters
    ----------
    estimate : LeverArmEstimate
        Result of `calib.estimation.joint.estimate_joint`.
    runs : sequence of Run
        The runs that it was made from.
    priors : Priors
        Its priors.

    Returns
    -------
    float
        1 at best.
    """
    known = [replace(run, readings=_exact(run)) for run in runs]
    terms, R = extra_terms(priors, ()), estimate.R_b.ravel()
    equations = [
        run_equations(run, estimate.noise, "free", Design(run, terms, Known(R, run.rows["H"] @ R)))
        for run in known
    ]
    covariance = NormalEquations(equations, prior_parameters(runs, priors, terms)).solve(CENTROID_BASIS)[1]
    bound = TO_DIFFERENCES @ covariance[:9, :9] @ TO_DIFFERENCES.T
    return float(np.sqrt(np.trace(estimate.differences_covariance) / np.trace(bound)))


def _exact(run: Run) -> Readings:
    """Return velocities east and north of the rows at rest, without error."""
    counter, numbers = run.rows["counter"], np.arange(len(run.rows))
    begins = np.array([counter[0], *(turn.stop for turn in run.turns)])
    ends = np.array([*(turn.start for turn in run.turns), counter[-1] + 1])
    at, arrest = [], []
    for k, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        rest = numbers[(begin <= counter) & (counter < end)]
        t_s = run.t_s[rest]
        is_near = (t_s < t_s[0] + NEAR_S) & (k > 0) | (t_s > t_s[-1] - NEAR_S)
        chosen = rest[is_near | (np.arange(len(rest)) % EVERY == 0)]
        at.append(chosen)
        arrest.append(np.full(len(chosen), k))
    rows = np.repeat(np.concatenate(at), 2)
    direction_n = np.tile(np.eye(3)[:2], (len(rows) // 2, 1))
    return Readings(
        run.t_s[rows],
        np.repeat(np.concatenate(arrest), 2),
        direction_n,
        np.einsum("ni,ni->n", direction_n, run.rows["v_n"][rows]),
        np.full(len(rows), LEAST_VARIANCE),
        np.zeros((3, 3)),
        np.zeros((3, 3)),
    )
