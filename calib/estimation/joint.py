"""Runs to the inner lever arms: the literature's plain solution, and the joint estimate (the default).

The velocity that a run leaves at rest answers linearly to what is left in the increments (mathematics,
section 4; the matrices H, B, P, Q are those of `imudrv.nav.mechanisation`). Measured minus true, horizontal
parts:

    delta v = H R + B b_a + A vec(dA) + f x ( integral of phi )
    phi(t)  = (I - t [omega_ie x]) phi_0 - B b_g - P vec(dG)

with the integral of C_nb dA f_b = A vec(dA). Tilt and heading in error at the start of each run, phi_0, are
unknowns of that run; all else is common to the session. Heading is among them because the Earth's rotation
makes a tilt rate of it, as large as that of a gyro's bias: the alignment has chosen the heading that hides
the bias in the first pose, and the turn brings both to light.

**Noise.** Pulses leave white noise in velocity and, once a run, that of its start; accelerometers a random
walk q_v; gyros a random walk q_a of tilt, which gravity integrates. Over a run

    cov(s, t) = q_v^2 min(s, t) + g^2 q_a^2 s^2 (3 t - s) / 6 + start^2 + white^2 [s = t],      s <= t

Their sizes are those that the rests themselves show. Rows are whitened by the Cholesky factor.

**Rank.** Of the information on R, all else marginalised, each eigenvalue l sees its direction with 1 /
sqrt(l). What is seen no better than `Priors.arm` is not seen. Rotations between rests never see a common
shift of the three points (the gauge): R is solved for in the six-space that has none, which is the gauge
`centroid`.
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
    velocity_gain,
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
"""Chi-square that a pivot of each rotation's own may explain, for each of its components."""


PIVOT_SIGMA: Final = 0.1
"""Prior of such a pivot, m."""


def estimate_joint(
    runs: Sequence[Run],
    priors: Priors | None = None,
    *,
    pivot: Literal["free", "fixed"] = "free",
    nine: bool = False,
    extra: Sequence[Extra] = (),
) -> LeverArmEstimate:
    """Estimate R with all that the rests before and after tell; the default method.

    Parameters
    ----------
    runs : sequence of Run
        Any number, poses and signs, from any captures of one unit.
    priors : Priors, optional
        What the static calibration leaves.
    pivot : {'free', 'fixed'}
        `fixed`: the origin of b is known to stay still while the unit turns, as on a turntable; velocity is
        then known during the motion too, and R is told from that origin.
    nine : bool
        All nine components are wanted, which needs a known pivot.
    extra : sequence of {'quadratic'}
        More unknowns: a quadratic term on each sensing axis, 1/(m/s^2). Those that are not observable stay
        at their prior, and a note says so.

    Returns
    -------
    Identification

    Raises
    ------
    InputError
        No runs; nine components without a known pivot; rotations that do not see what is asked for; a pivot
        that the data contradict.
    """
    priors = priors or Priors()
    terms = parameter_groups(priors, extra)
    require_runs(runs)
    if nine and pivot == "free":
        raise InputError(
            "identification: nine components of the lever arms were asked for, but rotations between rests "
            "see six: a common shift of the three sensing points leaves no velocity at rest; name a gauge, "
            "or turn the unit about a pivot that stays still and say so (pivot fixed)"
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
    names = system.unknowns.names
    spread = np.sqrt(np.diag(covariance))
    parameters = tuple(
        ParameterEstimate(name, float(value), float(s), float(prior))
        for name, value, s, prior in zip(names, x[9:], spread[9:], system.unknowns.sigma, strict=True)
    )
    told = [velocity_gain(run) for run in runs]
    seen = sigma[sigma < priors.arm]
    return LeverArmEstimate(
        method="joint",
        gauge="given" if pivot == "fixed" else "centroid",
        R_b=x[:9].reshape(3, 3),
        covariance=covariance[:9, :9],
        rank=rank,
        direction_sigma=sigma,
        singular_values=singular_values_of(told),
        reason=rank_reason(rank, seen[-1], sigma, priors.arm),
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        noise=noise,
        parameters=parameters,
        correlation=covariance[:9, 9:] / np.outer(np.maximum(spread[:9], 1e-300), spread[9:]),
        leave_one_out=tuple(
            _left_out(system, k, run.label, x, basis, priors.arm) for k, run in enumerate(runs)
        ),
        runs=tuple(
            run_result(run, *told[k], x[:9], part.t_s, part.v_n, part.columns @ x[system.columns_of(k)])
            for k, (run, part) in enumerate(zip(runs, system.parts, strict=True))
        ),
        notes=tuple(
            f"{n.name} not observable in these runs: sigma {_readable(n.name, n.sigma)}"
            for n in parameters
            if n.name.split("_")[0] in extra and not n.seen
        ),
    )


def _check_pivot(system: NormalEquations, chi_square: float, freedom: int) -> None:
    """Refuse a pivot that the data contradict: one for each rotation must not explain much more."""
    runs, cut = len(system.parts), 9 + system.unknowns.shared
    own = np.split(system.unknowns.sigma[system.unknowns.shared :], runs)
    sigma = np.concatenate([np.append(phi, np.full(3, PIVOT_SIGMA)) for phi in own])
    size = cut + len(own[0])
    M = np.zeros((size, size + 3))  # a shift of the origin is one of all three points
    M[:, :size], M[:9, size:] = np.eye(size), np.tile(np.eye(3), (3, 1))
    apart = NormalEquations(
        [
            part._replace(columns=part.columns @ M, N=M.T @ part.N @ M, b=M.T @ part.b)
            for part in system.parts
        ],
        Parameters((), np.concatenate([system.unknowns.sigma[: system.unknowns.shared], sigma]), cut - 9),
    )
    x, _ = apart.solve(np.eye(9))
    better, _ = apart.chi_square(x, 9)
    if chi_square - better > PIVOT_LIMIT * 3 * runs or chi_square > CHI_SQUARE_LIMIT * freedom:
        raise InputError(
            "identification: pivot fixed: expected the origin of b to stay still, but the velocities "
            f"contradict it: chi-square {chi_square:.0f}, expected about {freedom}, and {better:.0f} with an "
            "origin of its own for each rotation; use pivot free, or look for what moved"
        )


def _left_out(
    system: NormalEquations, k: int, label: str, x: Array, basis: Array, least: float
) -> LeaveOneOut:
    other = system.without(k)
    rank = int((other.directions()[0] < least).sum())
    if rank < basis.shape[1]:
        return LeaveOneOut(label, rank, None)
    return LeaveOneOut(label, rank, (other.solve(basis)[0] - x)[:9].reshape(3, 3))


def _readable(name: str, value: float) -> str:
    if name.startswith("skew"):
        return f"{value * 1e3:.3g} ms"
    return f"{value * STANDARD_GRAVITY**2 / UG:.3g} ug/g^2"
