"""Result of the estimation of the lever arms."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from calib.detection.noise import Noise
from calib.lever_arms.gauge import LeverArms
from imudrv.arrays import Array

Extra = Literal["quadratic"]


CHI_SQUARE_LIMIT: Final = 2.0
"""Reduced chi-square above which the data contradict the model."""


OBSERVABLE_RATIO: Final = 0.5
"""A parameter is unobservable if its posterior sigma exceeds this fraction of its prior."""


REST_H_LIMIT: Final = 2e-3
"""Largest H at the end of a rest, m/s per m, of a unit without residual dither or vibration."""


def _shift_free() -> Array:
    basis: Array = np.linalg.svd(np.tile(np.eye(3), (3, 1)))[0][:, 3:]
    return basis


CENTROID_BASIS: Final = _shift_free()
"""Orthonormal basis, (9, 6), of the arms whose centroid is the origin."""


TO_DIFFERENCES: Final = np.kron([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]], np.eye(3))
"""(6, 9): from (r_x, r_y, r_z) to (r_x - r_y, r_x - r_z)."""


@dataclass(frozen=True)
class ParameterEstimate:
    """Estimate of a parameter other than R, SI.

    Attributes
    ----------
    name : str
        Such as 'accelerometer_bias_x'.
    value, sigma, prior : float
        Estimate, its posterior sigma and its prior sigma.
    """

    name: str
    value: float
    sigma: float
    prior: float

    @property
    def observable(self) -> bool:
        """Whether the data determine the parameter better than the prior."""
        return self.sigma < OBSERVABLE_RATIO * self.prior


@dataclass(frozen=True)
class TurnResult:
    """Velocity that one turn gained.

    Attributes
    ----------
    label : str
        Label of the turn.
    accepted : bool
        Whether the turn is within its limits.
    V_n : ndarray, shape (3,)
        Mean velocity over half a second after the turn minus that before it, east, north, up, m/s.
    H : ndarray, shape (3, 9)
        The same difference of the measurement matrix.
    compensated_n : ndarray, shape (3,)
        `V_n - H R`.
    """

    label: str
    accepted: bool
    V_n: Array
    H: Array
    compensated_n: Array


@dataclass(frozen=True)
class RunResult:
    """Velocity of one run and its fit.

    Attributes
    ----------
    label : str
        Label of the run.
    turns : tuple of TurnResult
        Its turns.
    H_rest : float
        Largest horizontal element of H at the end of the rest before the first turn, m/s per m: 0 in theory.
        The squared rates rectify residual dither or vibration in the gyros' increments, which makes it grow.
    t_s : ndarray, shape (n,)
        Middle of each bin at rest, from the start of navigation.
    v_n, fitted_n : ndarray, shape (n, 2)
        Mean velocity of each bin, east and north, and its fit, m/s; method `plain`: `H R` alone.
    """

    label: str
    turns: tuple[TurnResult, ...]
    H_rest: float
    t_s: Array
    v_n: Array
    fitted_n: Array


@dataclass(frozen=True)
class LeaveOneOut:
    """The estimate without one rotation.

    Attributes
    ----------
    label : str
        Label of the run left out.
    rank : int
        Number of directions that remain observable.
    shift_m : ndarray, shape (3, 3), or None
        R without it minus R with it; None: the other runs do not determine R.
    """

    label: str
    rank: int
    shift_m: Array | None


@dataclass(frozen=True)
class LeverArmEstimate:
    """Estimate of the inner lever arms.

    Attributes
    ----------
    method : {'joint', 'plain'}
        Estimator.
    gauge : {'centroid', 'given'}
        `given`: the origin of b is the pivot.
    R_b : ndarray, shape (3, 3)
        Row i: sensing point of accelerometer i, m, body axes.
    covariance : ndarray, shape (9, 9)
        Covariance of (r_x, r_y, r_z), m^2; rank 6, with a known pivot 9.
    rank : int
        Number of observable directions of R.
    direction_sigma : ndarray, shape (9,)
        1-sigma of each principal direction of R, m, best first.
    singular_values : ndarray, shape (9,)
        Singular values of the stacked horizontal H after the rotations, m/s per m.
    reason : str
        Explanation of the rank.
    chi_square, degrees_of_freedom : float, int
        Of the whitened residuals and the priors; method `plain`: of V = H R.
    noise : Noise
        Noise of the sensors, from the rests.
    parameters : tuple of ParameterEstimate
        All other parameters.
    correlation : ndarray, shape (9, n)
        Correlation of R with the parameters.
    leave_one_out : tuple of LeaveOneOut
        The estimate without each rotation in turn.
    runs : tuple of RunResult
        Each run.
    notes : tuple of str
        Remarks for the reader.
    """

    method: Literal["joint", "plain"]
    gauge: Literal["centroid", "given"]
    R_b: Array
    covariance: Array
    rank: int
    direction_sigma: Array
    singular_values: Array
    reason: str
    chi_square: float
    degrees_of_freedom: int
    noise: Noise
    parameters: tuple[ParameterEstimate, ...]
    correlation: Array
    leave_one_out: tuple[LeaveOneOut, ...]
    runs: tuple[RunResult, ...]
    notes: tuple[str, ...]

    @property
    def arms(self) -> LeverArms:
        """The lever arms with covariance and gauge."""
        return LeverArms(self.R_b, self.covariance, self.gauge)

    @property
    def turns(self) -> tuple[TurnResult, ...]:
        """The turns of all runs."""
        return tuple(turn for run in self.runs for turn in run.turns)

    @property
    def sigma(self) -> Array:
        """1-sigma of `R_b` in its gauge, m, shape (3, 3)."""
        sigma: Array = np.sqrt(np.diag(self.covariance)).reshape(3, 3)
        return sigma

    @property
    def differences(self) -> Array:
        """`r_x - r_y` and `r_x - r_z`, m, shape (2, 3): the same in every gauge."""
        differences: Array = (TO_DIFFERENCES @ self.R_b.ravel()).reshape(2, 3)
        return differences

    @property
    def differences_covariance(self) -> Array:
        """Covariance of the six differences, m^2, shape (6, 6)."""
        covariance: Array = TO_DIFFERENCES @ self.covariance @ TO_DIFFERENCES.T
        return covariance

    @property
    def differences_sigma(self) -> Array:
        """1-sigma of the six differences, m, shape (2, 3)."""
        sigma: Array = np.sqrt(np.diag(self.differences_covariance)).reshape(2, 3)
        return sigma

    @property
    def consistent(self) -> bool:
        """Whether the model allows this chi-square; without degrees of freedom it always does."""
        return self.chi_square <= CHI_SQUARE_LIMIT * self.degrees_of_freedom or not self.degrees_of_freedom

    @property
    def refusals(self) -> tuple[str, ...]:
        """Reasons against a certificate from this result, with what to do; empty: none."""
        refusals = []
        if not self.consistent:
            refusals.append(
                f"the velocities contradict the model: expected chi-square of about "
                f"{self.degrees_of_freedom}, got {self.chi_square:.0f}; the report's figures show which "
                "rotation deviates: leave it out, or look for what moved"
            )
        worst = max(self.runs, key=lambda run: run.H_rest)
        if worst.H_rest > REST_H_LIMIT:
            refusals.append(
                "the gyro increments carry dither or vibration: expected H of at most "
                f"{REST_H_LIMIT:g} m/s per m at the end of the rest before the rotation, got "
                f"{worst.H_rest:.2g} ({worst.label}); the squared rates rectify it and the arms come out "
                "wrong: let the unit remove its dither from the increments, or stop what shakes the bench, "
                "and record again"
            )
        return tuple(refusals)
