"""Result of the estimation of the lever arms."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc, fdtri

from calib.estimation.dither_line import DitherLine
from calib.estimation.noise import SensorNoise
from calib.lever_arms.gauge import LeverArms
from calib.messages import Message, english, message
from imudrv.arrays import Array
from imudrv.imu.rate_filter import RateFilterName
from imudrv.units import ARCSEC

Extra = Literal["quadratic"]


SCATTER_LIMIT: Final = 2.0
"""Scatter over its degrees of freedom above which the rests were no rests."""


CONTRADICTION_P: Final = 1e-4
"""Probability of a larger chi-square below which the turns contradict each other."""


OBSERVABLE_RATIO: Final = 0.5
"""A parameter is unobservable if its posterior sigma exceeds this fraction of its prior."""


DITHER_LIMIT: Final = 0.1
"""Largest error of a difference, in its sigma, that rectified dither or vibration may cause."""


def _shift_free() -> Array:
    basis: Array = np.linalg.svd(np.tile(np.eye(3), (3, 1)))[0][:, 3:]
    return basis


CENTROID_BASIS: Final = _shift_free()
"""Orthonormal basis, (9, 6), of the arms whose centroid is the origin."""


TO_DIFFERENCES: Final = np.kron([[1.0, -1.0, 0.0], [1.0, 0.0, -1.0]], np.eye(3))
"""(6, 9): from (r_x, r_y, r_z) to (r_x - r_y, r_x - r_z)."""


@dataclass(frozen=True)
class ChiSquare:
    """A chi-square test.

    Attributes
    ----------
    value : float
        Chi-square.
    degrees_of_freedom : int
        0: there is nothing to test.
    noise_degrees_of_freedom : int or None
        Those of the noise that it was divided by; None: that is known.
    """

    value: float
    degrees_of_freedom: int
    noise_degrees_of_freedom: int | None = None

    @property
    def band(self) -> tuple[float, float]:
        """95 % band of the value."""
        n, m = self.degrees_of_freedom, self.noise_degrees_of_freedom
        if not n:
            return 0.0, 0.0
        if m:
            return n * float(fdtri(n, m, 0.025)), n * float(fdtri(n, m, 0.975))
        return float(chdtri(n, 0.975)), float(chdtri(n, 0.025))

    @property
    def p_value(self) -> float:
        """Probability of a larger value."""
        n, m = self.degrees_of_freedom, self.noise_degrees_of_freedom
        if not n:
            return 1.0
        return float(fdtrc(n, m, self.value / n) if m else chdtrc(n, self.value))


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
    rate_filter : str
        Filter of the rates of H.
    lines : tuple of DitherLine
        Dither in the angle increments.
    t_s : ndarray, shape (n,)
        Middle of each bin at rest, from the start of navigation.
    v_n, fitted_n : ndarray, shape (n, 2)
        Mean velocity of each bin, east and north, and its fit, m/s; method `plain`: `H R` alone.
    """

    label: str
    turns: tuple[TurnResult, ...]
    H_rest: float
    rate_filter: RateFilterName
    lines: tuple[DitherLine, ...]
    t_s: Array
    v_n: Array
    fitted_n: Array


@dataclass(frozen=True)
class LeaveOneOut:
    """The estimate without one turn.

    Attributes
    ----------
    label : str
        Label of the turn left out.
    rank : int
        Number of directions that remain observable.
    shift_m, sigma_m : ndarray, shape (3, 3), or None
        R without it minus R with it, and 1-sigma of that; None: the other turns do not determine R.
    test : ChiSquare or None
        Whether the turn agrees with the others.
    """

    label: str
    rank: int
    shift_m: Array | None
    sigma_m: Array | None
    test: ChiSquare | None


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
    reason : Message
        Explanation of the rank.
    scatter : ChiSquare or None
        Whether the velocity within each rest is as the noise makes it; None: method `plain` does not test it.
    redundancy : ChiSquare
        Whether the turns agree on the arms.
    noise : SensorNoise
        Noise of the sensors, from the alignments.
    dither_error : float
        Largest error of a difference by dither or vibration that is left in the rates of H, in its sigma.
    parameters : tuple of ParameterEstimate
        All other parameters.
    correlation : ndarray, shape (9, n)
        Correlation of R with the parameters.
    leave_one_out : tuple of LeaveOneOut
        The estimate without each turn.
    runs : tuple of RunResult
        Each run.
    notes : tuple of Message
        Remarks for the reader.
    """

    method: Literal["joint", "plain"]
    gauge: Literal["centroid", "given"]
    R_b: Array
    covariance: Array
    rank: int
    direction_sigma: Array
    singular_values: Array
    reason: Message
    scatter: ChiSquare | None
    redundancy: ChiSquare
    noise: SensorNoise
    dither_error: float
    parameters: tuple[ParameterEstimate, ...]
    correlation: Array
    leave_one_out: tuple[LeaveOneOut, ...]
    runs: tuple[RunResult, ...]
    notes: tuple[Message, ...]

    @property
    def arms(self) -> LeverArms:
        """The lever arms with covariance and gauge."""
        return LeverArms(self.R_b, self.covariance, self.gauge)

    @property
    def turns(self) -> tuple[TurnResult, ...]:
        """The turns of all runs."""
        return tuple(turn for run in self.runs for turn in run.turns)

    @property
    def accepted(self) -> int:
        """Number of accepted turns."""
        return sum(turn.accepted for turn in self.turns)

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
    def refusals(self) -> tuple[str, ...]:
        """`faults` in English."""
        return tuple(map(english, self.faults))

    @property
    def faults(self) -> tuple[Message, ...]:
        """Reasons against a certificate from this result, with what to do; empty: none."""
        faults = []
        scatter, redundancy = self.scatter, self.redundancy
        if scatter is not None and scatter.value > SCATTER_LIMIT * scatter.degrees_of_freedom:
            faults.append(message("fault_scatter", n=scatter.degrees_of_freedom, value=scatter.value))
        if redundancy.p_value < CONTRADICTION_P:
            faults.append(
                message(
                    "fault_redundancy",
                    n=redundancy.degrees_of_freedom,
                    value=redundancy.value,
                    once_in=1.0 / max(redundancy.p_value, 1e-99),
                )
            )
        if self.dither_error > DITHER_LIMIT:
            faults.append(_dither_fault(self.dither_error, self.runs))
        return tuple(faults)


def dither_lines(run: RunResult) -> tuple[Message, ...]:
    """Return the dither lines of a run as messages."""
    return tuple(
        message(
            "dither_of_gyro",
            amplitude_arcsec=line.amplitude_rad / ARCSEC,
            frequency_hz=line.frequency_hz,
            axis=line.axis,
        )
        for line in run.lines
    )


def _dither_fault(error: float, runs: Sequence[RunResult]) -> Message:
    worst = max(runs, key=lambda run: run.H_rest)
    return message(
        "fault_dither",
        lines=dither_lines(worst) or message("no_single_line"),
        filter=worst.rate_filter,
        H_rest=worst.H_rest,
        run=worst.label,
        error_sigma=error,
        limit_sigma=DITHER_LIMIT,
    )
