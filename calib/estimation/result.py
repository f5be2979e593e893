"""The estimate of the lever arms, and what it consists of."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from calib.detection.noise import Noise
from imudrv.arrays import Array

Extra = Literal["quadratic"]


CHI_SQUARE_LIMIT: Final = 2.0
"""Chi-square per degree of freedom from which data contradict the model."""


OBSERVABLE_RATIO: Final = 0.5
"""An extra unknown whose sigma is not below this part of its prior is not seen."""


def _shift_free() -> Array:
    basis: Array = np.linalg.svd(np.tile(np.eye(3), (3, 1)))[0][:, 3:]
    return basis


CENTROID_BASIS: Final = _shift_free()
"""Orthonormal basis, (9, 6), of the arms whose centroid is the origin."""


TO_DIFFERENCES: Final = np.kron([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]], np.eye(3))
"""(6, 9): from (r_x, r_y, r_z) to (r_x - r_y, r_x - r_z)."""


@dataclass(frozen=True)
class ParameterEstimate:
    """An unknown beside R, SI.

    Attributes
    ----------
    name : str
        Such as 'accelerometer_bias_x'.
    value, sigma, prior : float
        Estimate, its sigma, and the sigma it had before.
    """

    name: str
    value: float
    sigma: float
    prior: float

    @property
    def seen(self) -> bool:
        """Whether the data tell more than the prior."""
        return self.sigma < OBSERVABLE_RATIO * self.prior


@dataclass(frozen=True)
class RunResult:
    """One rotation in the light of the result.

    Attributes
    ----------
    label : str
        Of the run.
    axis : str
        Body axis that was up, '+X' to '-Z'.
    angle_deg : float
        Turned, right-handed about up.
    V_n : ndarray, shape (3,)
        Velocity gained by the rotation, the mean over half a second after it less that before it, east,
        north, up, m/s.
    H : ndarray, shape (3, 9)
        The same of the measurement matrix.
    compensated_n : ndarray, shape (3,)
        `V_n - H R`.
    H_rest : float
        Largest horizontal element of H at the end of the rest before, m/s per m: 0 in theory. Dither or
        vibration left in the gyros' increments is rectified by the squared rates and makes it grow.
    t_s : ndarray, shape (n,)
        Middle of each bin at rest, from the start of navigation.
    v_n, fitted_n : ndarray, shape (n, 2)
        Velocity in the bin, east and north, and what the estimate says of it, m/s; `plain`: `H R` alone.
    """

    label: str
    axis: str
    angle_deg: float
    V_n: Array
    H: Array
    compensated_n: Array
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
        Of the run left out.
    rank : int
        Directions still seen.
    shift_m : ndarray, shape (3, 3), or None
        R without it minus R with it; None: the others do not see enough.
    """

    label: str
    rank: int
    shift_m: Array | None


@dataclass(frozen=True)
class LeverArmEstimate:
    """The inner lever arms.

    Attributes
    ----------
    method : {'joint', 'plain'}
        How they were found.
    gauge : {'centroid', 'given'}
        `given`: the origin of b is the pivot.
    R_b : ndarray, shape (3, 3)
        Row i: sensing point of accelerometer i, m, body axes.
    covariance : ndarray, shape (9, 9)
        Of (r_x, r_y, r_z), m^2; rank 6, with a known pivot 9.
    rank : int
        Directions of R that the data see.
    direction_sigma : ndarray, shape (9,)
        1-sigma of each principal direction of R, m, best first.
    singular_values : ndarray, shape (9,)
        Of the stacked horizontal H after the rotations, m/s a metre.
    reason : str
        Why the rank is what it is.
    chi_square, degrees_of_freedom : float, int
        Of the whitened residuals and the priors; `plain`: of V = H R.
    noise : Noise
        Of the sensors, from the rests.
    nuisances : tuple of Nuisance
        All else that was estimated.
    correlation : ndarray, shape (9, n)
        Of R with the nuisances.
    left_out : tuple of LeftOut
        Stability: each rotation left out in turn.
    runs : tuple of RunResult
        Each rotation.
    notes : tuple of str
        What a reader has to know.
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
        """Whether chi-square is one that the model allows; without degrees of freedom nothing can differ."""
        return self.chi_square <= CHI_SQUARE_LIMIT * self.degrees_of_freedom or not self.degrees_of_freedom

    @property
    def refusals(self) -> tuple[str, ...]:
        """Why no certificate may be made of the result, with what to do; empty: one may."""
        refusals = []
        if not self.consistent:
            refusals.append(
                f"the velocities contradict the model: expected chi-square of about "
                f"{self.degrees_of_freedom}, got {self.chi_square:.0f}; the report's figures show which "
                "rotation stands out: leave it out, or look for what moved"
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


REST_H_LIMIT: Final = 2e-3
"""H at the end of a rest, m/s per m, above which the gyros' increments are not those of a unit at rest."""
