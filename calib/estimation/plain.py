"""Least-squares solution of V = H R, as in the literature."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag

from calib.estimation.design import Design
from calib.estimation.gains import Fit, gain_rows, rest_growth, run_result, singular_values_of, velocity_gains
from calib.estimation.linear_system import (
    ROUNDING,
    NormalEquations,
    extra_terms,
    prior_parameters,
    run_equations,
    walk_covariances,
)
from calib.estimation.noise import SensorNoise, noise_of
from calib.estimation.observability import rank_reason, require_axes, require_runs, unobservable_text
from calib.estimation.priors import Priors
from calib.estimation.result import CENTROID_BASIS, TO_DIFFERENCES, ChiSquare, LeverArmEstimate
from calib.estimation.runs import Run
from imudrv.arrays import Array
from imudrv.errors import InputError


def estimate_plain(runs: Sequence[Run], priors: Priors | None = None) -> LeverArmEstimate:
    """Solve `V = H R` as in the literature: one velocity for each rotation, no other parameters.

    V and H are the gains of a rotation: means over the half second after it minus those before it. The
    minimum-norm solution has its centroid at the origin. Its covariance follows from the effect of bias,
    misalignment and noise on such a velocity, given that the alignment removed the acceleration of the rest
    before.

    Parameters
    ----------
    runs : sequence of Run
        As for `estimate_joint`.
    priors : Priors, optional
        Uncertainty of the static calibration.

    Returns
    -------
    LeverArmEstimate

    Raises
    ------
    InputError
        There are no runs, or they do not determine the six differences.
    """
    priors = priors or Priors()
    require_runs(runs)
    noise = noise_of(runs)
    gains = velocity_gains(runs)
    V = np.concatenate([v[:2] for v, _ in gains])
    H = np.concatenate([h[:2] for _, h in gains])
    S = _plain_covariance(runs, noise, priors)
    sigma_v = float(np.sqrt(np.trace(S) / len(S)))
    s = singular_values_of(gains)
    sigma = sigma_v / np.maximum(s, ROUNDING * s[0])
    rank = int((sigma < priors.arm).sum())
    if rank < 6:
        require_axes(runs)
        raise InputError(unobservable_text(sigma, np.linalg.svd(H)[2].T, CENTROID_BASIS, priors.arm))
    inverse = CENTROID_BASIS @ np.linalg.pinv(H @ CENTROID_BASIS)
    R = inverse @ V
    to_residual = np.eye(len(V)) - H @ inverse  # of least squares, not of minimum chi-square
    freedom = max(0, len(V) - 6)
    values, vectors = np.linalg.eigh(to_residual @ S @ to_residual.T)
    residual = (vectors.T @ (to_residual @ V))[len(V) - freedom :]
    return LeverArmEstimate(
        method="plain",
        gauge="centroid",
        R_b=R.reshape(3, 3),
        covariance=inverse @ S @ inverse.T,
        rank=rank,
        direction_sigma=sigma,
        singular_values=s,
        reason=rank_reason(rank, sigma, priors.arm),
        scatter=None,
        redundancy=ChiSquare(float((residual**2 / values[len(V) - freedom :]).sum()), freedom),
        noise=noise,
        dither_error=_dither_error(runs, R, inverse, S),
        parameters=(),
        correlation=np.zeros((9, 0)),
        leave_one_out=(),
        runs=tuple(run_result(run, R, _fit(Design(run, ()), R)) for run in runs),
        notes=(),
    )


def _fit(design: Design, R: Array) -> Fit:
    """Return the function of the velocity `H R`."""
    return lambda t_s, arrest: np.asarray(design.at(t_s, arrest)[:, :, :9] @ R, np.float64)


def _plain_covariance(runs: Sequence[Run], noise: SensorNoise, priors: Priors) -> Array:
    """Covariance of the stacked velocities of `velocity_gain`, from priors and noise.

    The alignment has chosen tilt and heading so that the rest before shows no acceleration: the remaining
    uncertainty is that of the priors given this rest.
    """
    terms = extra_terms(priors, ())
    designs = [Design(run, terms) for run in runs]
    before = [
        replace(run, readings=run.readings.take(np.flatnonzero(run.readings.arrest == 0))) for run in runs
    ]
    system = NormalEquations(
        [run_equations(run, noise, "free", design) for run, design in zip(before, designs, strict=True)],
        prior_parameters(runs, priors, terms),
    )
    cut = 9 + len(system.parameters.names)
    rows, blocks = [], []
    for k, (run, design) in enumerate(zip(runs, designs, strict=True)):
        turns = [j for j, turn in enumerate(run.turns) if turn.accepted]
        windows = [(j + later, at) for j in turns for later, at in enumerate(gain_rows(run, j))]
        means = np.array(
            [design.at(run.t_s[at], np.full(len(at), arrest))[:, :2].mean(axis=0) for arrest, at in windows]
        )
        row = np.zeros((len(turns), 2, len(system.b)))
        row[:, :, system.columns_of(k)] = means[1::2] - means[::2]
        rows.append(row.reshape(-1, len(system.b))[:, 9:cut])
        t = np.array([run.t_s[at].mean() for _, at in windows])
        walk, tilt = walk_covariances(t, np.tile([1.0, 0.0, 0.0], (len(t), 1)), noise, run.gravity)
        K = walk + tilt
        gains = K[1::2, 1::2] - K[1::2, ::2] - K[::2, 1::2] + K[::2, ::2]
        pulses = np.kron(np.eye(len(turns)), 2.0 * run.readings.turn[:2, :2])
        blocks.append(np.kron(gains, np.eye(2)) + pulses)
    stacked = np.concatenate(rows)
    of_parameters = stacked @ np.linalg.solve(system.N[9:cut, 9:cut], stacked.T)
    return np.asarray(block_diag(*blocks) + of_parameters, np.float64)


def _dither_error(runs: Sequence[Run], R: Array, inverse: Array, S: Array) -> float:
    """Return the largest error of a difference by the H that grows at rest, in its sigma."""
    error = np.concatenate(
        [turn.duration_s * rest_growth(run)[:2] @ R for run in runs for turn in run.turns if turn.accepted]
    )
    sigma = np.sqrt(np.diag(TO_DIFFERENCES @ inverse @ S @ inverse.T @ TO_DIFFERENCES.T))
    return float(np.abs(TO_DIFFERENCES @ inverse @ error / sigma).max())
