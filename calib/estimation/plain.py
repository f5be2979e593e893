"""Least-squares solution of V = H R, as in the literature."""

from collections.abc import Sequence

import numpy as np
from scipy.linalg import solve_triangular

from calib.detection.noise import Noise
from calib.estimation.linear_system import (
    ROUNDING,
    Parameters,
    bin_variance,
    design_columns,
    gain_rows,
    noise_covariance,
    parameter_groups,
    prior_parameters,
    rank_reason,
    require_runs,
    rest_noise,
    run_result,
    singular_values_of,
    unobservable_text,
    velocity_at_rest,
    velocity_gain,
    whole_bins,
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
    gains = [velocity_gain(run) for run in runs]
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
        runs=tuple(
            run_result(run, *gain, R, *velocity_at_rest(run, R))
            for run, gain in zip(runs, gains, strict=True)
        ),
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
    rows = []
    S = np.zeros((2 * len(runs), 2 * len(runs)))
    for k, run in enumerate(runs):
        at = parameters.columns_of(k, len(runs))
        still = whole_bins(run.before, True)
        columns = design_columns(run, terms)[:, :2]
        A, t = columns[still].mean(axis=1), run.t_s[still].mean(axis=1)
        single = [bin_variance(rest, noise) for rest in (run.rotation.before, run.rotation.after)]
        K = noise_covariance(t, np.full(len(t), single[0]), noise, run.gravity)
        white = solve_triangular(np.linalg.cholesky(K), A.reshape(len(t), -1), lower=True)
        white = white.reshape(-1, A.shape[2])
        information[np.ix_(at, at)] += white.T @ white
        before, after = gain_rows(run)
        row = np.zeros((2, len(information)))
        row[:, at] = columns[after].mean(axis=0) - columns[before].mean(axis=0)
        rows.append(row)
        t = np.array([run.t_s[before].mean(), run.t_s[after].mean()])
        K = noise_covariance(t, np.array(single), noise, run.gravity)
        S[2 * k, 2 * k] = S[2 * k + 1, 2 * k + 1] = K[0, 0] + K[1, 1] - 2.0 * K[0, 1]
    stacked = np.concatenate(rows)
    return S + stacked @ np.linalg.solve(information, stacked.T)
