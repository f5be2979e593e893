"""Least-squares solution of V = H R, as in the literature."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from calib.detection.noise import Noise
from calib.estimation.linear_system import (
    ROUNDING,
    Parameters,
    arrest_bins,
    bin_variance,
    design_columns,
    gain_rows,
    noise_covariance,
    parameter_groups,
    prior_parameters,
    rank_reason,
    require_runs,
    rest_noise,
    rests_of,
    run_result,
    singular_values_of,
    unobservable_text,
    velocity_at_rest,
    velocity_gains,
)
from calib.estimation.result import CENTROID_BASIS, LeverArmEstimate
from calib.estimation.runs import Priors, Run
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
    noise = rest_noise(runs)
    terms = parameter_groups(priors, ())
    parameters = prior_parameters(runs, priors, terms)
    gains = velocity_gains(runs)
    V = np.concatenate([v[:2] for v, _ in gains])
    H = np.concatenate([h[:2] for _, h in gains])
    S = _plain_covariance(runs, noise, parameters, terms)
    sigma_v = float(np.sqrt(np.trace(S) / len(S)))
    s = singular_values_of(gains)
    sigma = sigma_v / np.maximum(s, ROUNDING * s[0])
    rank = int((sigma < priors.arm).sum())
    if rank < 6:
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
        chi_square=float((residual**2 / values[len(V) - freedom :]).sum()),
        degrees_of_freedom=freedom,
        noise=noise,
        parameters=(),
        correlation=np.zeros((9, 0)),
        leave_one_out=(),
        runs=tuple(run_result(run, R, *velocity_at_rest(run, R)) for run in runs),
        notes=(),
    )


def _plain_covariance(
    runs: Sequence[Run], noise: Noise, parameters: Parameters, terms: Sequence[str]
) -> Array:
    """Covariance of the stacked velocities of `velocity_gain`, from priors and noise.

    The alignment has chosen tilt and heading so that the rest before shows no acceleration: the remaining
    uncertainty is that of the priors given this rest.
    """
    information = np.diag(
        np.concatenate([np.full(9, 1e12), parameters.sigma**-2])
    )  # R has no effect before the rotation
    rows, blocks = [], []
    for k, run in enumerate(runs):
        at = parameters.columns_of(k, len(runs))
        still = arrest_bins(run)[0]
        columns = design_columns(run, terms)[:, :2]
        A, t = columns[still].mean(axis=1), run.t_s[still].mean(axis=1)
        single = [bin_variance(rest, noise) for rest in rests_of(run)]
        K = noise_covariance(t, np.full(len(t), single[0]), noise, run.gravity)
        white = solve_triangular(np.linalg.cholesky(K), A.reshape(len(t), -1), lower=True)
        white = white.reshape(-1, A.shape[2])
        information[np.ix_(at, at)] += white.T @ white
        accepted = [j for j, turn in enumerate(run.turns) if turn.accepted]
        windows = [(j + later, at) for j in accepted for later, at in enumerate(gain_rows(run, j))]
        row = np.zeros((len(windows), 2, len(information)))
        row[:, :, at] = [columns[rows_at].mean(axis=0) for _, rows_at in windows]
        rows.append((row[1::2] - row[::2]).reshape(-1, row.shape[2]))
        t = np.array([run.t_s[at].mean() for _, at in windows])
        K = noise_covariance(t, np.array([single[j] for j, _ in windows]), noise, run.gravity)
        gains = K[1::2, 1::2] - K[1::2, ::2] - K[::2, 1::2] + K[::2, ::2]
        blocks.append(np.kron(gains, np.eye(2)))
    stacked = np.concatenate(rows)
    return np.asarray(block_diag(*blocks) + stacked @ np.linalg.solve(information, stacked.T), np.float64)
