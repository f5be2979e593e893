"""Normal equations of a session: all readings of all runs, and the priors.

**Noise.** The readings of a run along the directions d and e have the covariance

    cov = d . e ( q_v^2 s + g^2 q_a^2 s^2 (3 t - s) / 6 ) + d (Sigma_0 + n Sigma_1) e,      s <= t

plus the variance of each reading on its own. Accelerometers make a random walk q_v of velocity, gyros a
random walk q_a of tilt, which gravity integrates; Sigma_0 is the fraction of a pulse at the start of the run,
and Sigma_1 what the pulses add at each of the n turns before s. The arrests of a run are readings of one
walk: rows are whitened by the Cholesky factor, as differences of successive arrests would be for q_v alone.

**Unknowns** are R; the errors common to all runs; those of each run; and a step of velocity at each turn,
east and north. The step is zero, except at a turn outside its limits. Freeing it takes a turn out of the
estimate and leaves its rests in.
"""

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular

from calib.estimation.design import Design, back_action, interpolated
from calib.estimation.noise import SensorNoise
from calib.estimation.priors import SHARED, Priors
from calib.estimation.readings import Readings
from calib.estimation.result import Extra
from calib.estimation.runs import Run
from imudrv.arrays import Array

TILT_SIGMA: Final = 5e-3
"""Prior sigma of the initial tilts, rad; wide, because the rest before the first turn determines them."""


OWN: Final = {
    "phi": ("east", "north", "up"),
    "accelerometer_bias": ("x", "y", "z"),
    "gyro_bias": ("x", "y", "z"),
}
"""Parameters of a run."""


STEP_SIGMA: Final = 10.0
"""Prior sigma of the step of velocity at a turn outside its limits, m/s."""


ROWS_PER_POINT: Final = 5
"""With a known pivot, every n-th row during the motion also becomes an equation."""


LEAST_MOTION: Final = 3e-5
"""Smallest error of a velocity in motion, m/s, for what linear equations neglect."""


ROUNDING: Final = 1e-7
"""Directions weaker than the best by this factor are below numerical precision."""


class Parameters(NamedTuple):
    """All parameters but R and the steps: those common to all runs, then those of each run.

    Attributes
    ----------
    names : tuple of str
        Such as 'accelerometer_bias_x'.
    expected : ndarray, shape (n,)
        Expected values, SI.
    covariance : ndarray, shape (n, n)
        Prior covariance.
    shared : int
        Number of parameters common to all runs.
    terms : tuple of {'skew', 'quadratic'}
        Those beyond biases and matrices.
    """

    names: tuple[str, ...]
    expected: Array
    covariance: Array
    shared: int
    terms: tuple[str, ...]

    @property
    def sigma(self) -> Array:
        """Prior sigmas, SI."""
        return np.asarray(np.sqrt(np.diag(self.covariance)), np.float64)


class RunEquations(NamedTuple):
    """Whitened equations of a run, `v = A @ (R, shared, own, steps)`."""

    L: Array  # (n, n), Cholesky factor of the covariance of the noise
    walk: Array  # (n, n), part of that covariance by the random walk of velocity
    A: Array
    v: Array  # (n,)
    accepted: tuple[bool, ...]  # of each turn
    readings: Readings  # of the equations

    def whitened(self, y: Array) -> Array:
        """Return whitened values of the first equations; those of the others are zero."""
        padded = np.zeros(len(self.L))
        padded[: len(y)] = y
        return np.asarray(solve_triangular(self.L, padded, lower=True), np.float64)


def extra_terms(priors: Priors, extra: Sequence[Extra]) -> tuple[str, ...]:
    """Return the parameters beyond biases and matrices: skew, unless known exactly, and the extra ones."""
    return (*(("skew",) if priors.skew else ()), *extra)


def prior_parameters(runs: Sequence[Run], priors: Priors, terms: Sequence[str]) -> Parameters:
    """Return names and priors of all parameters but R and the steps."""
    names, variances = list(SHARED), [priors.shared_covariance]
    expected = np.zeros(len(SHARED))
    if "skew" in terms:
        names.append("skew_s")
        variances.append(np.array([[priors.skew**2]]))
        expected = np.append(expected, priors.expected_skew)
    if "quadratic" in terms:
        names += [f"quadratic_{axis}" for axis in "xyz"]
        variances.append(priors.quadratic**2 * np.eye(3))
    shared = len(names)
    for run in runs:
        for name, parts in (
            ("phi", ("east", "north", "up")),
            ("accelerometer_bias", "xyz"),
            ("gyro_bias", "xyz"),
        ):
            names += [f"{name} {run.label}_{part}" for part in parts]
        sigma = [TILT_SIGMA, TILT_SIGMA, run.aligned.heading_sigma_rad]
        sigma += 3 * [priors.accelerometer_bias_of_run] + 3 * [priors.gyro_bias_of_run]
        variances.append(np.diag(np.square(sigma)))
    expected = np.concatenate([expected, np.zeros(len(names) - len(expected))])
    return Parameters(
        tuple(names), expected, np.asarray(block_diag(*variances), np.float64), shared, tuple(terms)
    )


def run_equations(run: Run, noise: SensorNoise, pivot: str, design: Design) -> RunEquations:
    """Return the equations of the readings; with a known pivot also of the motion and the vertical."""
    readings = run.readings
    columns = design.at(readings.t_s, readings.arrest)
    added = interpolated(run.t_s, back_action(run), readings.t_s)
    readings = readings._replace(v=readings.v + np.einsum("ni,ni->n", readings.direction_n, added))
    A = np.einsum("ni,nij->nj", readings.direction_n, columns)
    if pivot == "fixed":
        readings, of_motion = _with_motion(readings, run, design)
        A = np.concatenate([A, of_motion])
    sources = noise_sources(readings, noise, run.gravity)
    L = np.asarray(np.linalg.cholesky(sum(sources.values())), np.float64)
    white = solve_triangular(L, np.column_stack([A, readings.v]), lower=True)
    accepted = tuple(turn.accepted for turn in run.turns)
    walk = sources["velocity_walk"]
    return RunEquations(L, walk, white[:, :-1], white[:, -1], accepted, readings)


def noise_sources(readings: Readings, noise: SensorNoise, gravity: float) -> dict[str, Array]:
    """Return the covariance of the readings by source; the sum is that of their noise."""
    t, d, passed = readings.t_s, readings.direction_n, readings.arrest
    velocity_walk, angle_walk = walk_covariances(t, d, noise, gravity)
    pulses = d @ readings.start @ d.T + np.minimum.outer(passed, passed) * (d @ readings.turn @ d.T)
    return {
        "velocity_walk": velocity_walk,
        "angle_walk": angle_walk,
        "pulses": pulses + np.diag(readings.variance),
    }


def _with_motion(readings: Readings, run: Run, design: Design) -> tuple[Readings, Array]:
    """Return the readings with those of the motion and the vertical, and the columns of these."""
    t, d, v, A = _motion(run, design)
    coarse = float(np.trace(readings.turn)) + LEAST_MOTION**2
    more = {
        "t_s": t,
        "arrest": np.zeros(len(t), np.int64),
        "direction_n": d,
        "v": v,
        "variance": np.full(len(t), coarse),
    }
    joined = {key: np.concatenate([getattr(readings, key), x]) for key, x in more.items()}
    return readings._replace(**joined), A


def _motion(run: Run, design: Design) -> tuple[Array, Array, Array, Array]:
    """Return time, direction, velocity and columns of rows in motion, and of the vertical at rest."""
    moving = np.flatnonzero(~run.at_rest)[::ROWS_PER_POINT]
    still = np.flatnonzero(run.at_rest)[:: 5 * ROWS_PER_POINT]
    arrest = run.arrests[:, still].argmax(axis=0)
    v_n = run.rows["v_n"] + back_action(run)
    of_motion, of_rest = design.of_rows(moving), design.at(run.t_s[still], arrest)
    up = np.tile([0.0, 0.0, 1.0], (len(still), 1))
    return (
        np.concatenate([np.repeat(run.t_s[moving], 3), run.t_s[still]]),
        np.concatenate([np.tile(np.eye(3), (len(moving), 1)), up]),
        np.concatenate([v_n[moving].ravel(), run.v_n[still, 2]]),
        np.concatenate([of_motion.reshape(3 * len(moving), -1), of_rest[:, 2]]),
    )


def walk_covariances(t: Array, d: Array, noise: SensorNoise, gravity: float) -> tuple[Array, Array]:
    """Return the covariances of the random walks of velocity and of angle at times t along directions d."""
    s, u = np.minimum.outer(t, t), np.maximum.outer(t, t)
    tilt = (gravity * noise.angle_walk) ** 2 * s * s * (3.0 * u - s) / 6.0
    level = d[:, :2]
    velocity_walk = noise.velocity_walk**2 * s * (d @ d.T)
    return np.asarray(velocity_walk, np.float64), np.asarray(tilt * (level @ level.T), np.float64)


class NormalEquations:
    """Normal equations for R, the parameters, and the steps of all turns.

    Parameters
    ----------
    parts : sequence of RunEquations
        Each run.
    parameters : Parameters
        Their priors.
    """

    def __init__(self, parts: Sequence[RunEquations], parameters: Parameters) -> None:
        self.parts, self.parameters = parts, parameters
        cut = 9 + len(parameters.names)
        steps = 2 * sum(len(part.accepted) for part in parts)
        accepted = [accepted for part in parts for accepted in part.accepted]
        self.turns = np.flatnonzero(accepted)
        """Numbers of the accepted turns."""
        information = np.linalg.inv(parameters.covariance)
        self.N = np.zeros((cut + steps, cut + steps))
        self.b = np.zeros(cut + steps)
        self.N[9:cut, 9:cut] = information
        self.b[9:cut] = information @ parameters.expected
        self._yy = float(parameters.expected @ self.b[9:cut]) + sum(float(part.v @ part.v) for part in parts)
        for k, part in enumerate(parts):
            at = self.columns_of(k)
            self.N[np.ix_(at, at)] += part.A.T @ part.A
            self.b[at] += part.A.T @ part.v
        self._steps = np.arange(cut, cut + steps).reshape(-1, 2)
        odd = self._steps[~np.array(accepted)].ravel()
        self.N[odd, odd] += STEP_SIGMA**-2
        self._scale = np.concatenate([np.full(9, 0.1), parameters.sigma, np.full(steps, 0.1)])
        self._always = np.concatenate([np.arange(9, cut), odd])

    def columns_of(self, k: int) -> NDArray[np.int64]:
        """Return the columns of the unknowns of run k: R, shared, own, steps."""
        shared = 9 + self.parameters.shared
        size = (len(self.parameters.names) - self.parameters.shared) // len(self.parts)
        own = shared + size * k + np.arange(size)
        turns = [len(part.accepted) for part in self.parts]
        steps = 9 + len(self.parameters.names) + 2 * sum(turns[:k]) + np.arange(2 * turns[k])
        return np.concatenate([np.arange(shared), own, steps])

    def directions(self, free: Iterable[int] = ()) -> tuple[Array, Array]:
        """Return 1-sigma of the principal directions of R, best first, and the directions as columns.

        `free` are the numbers of accepted turns whose steps are free.
        """
        other = self._others(free)
        scale = self._scale[other]
        cross = self.N[other, :9] * scale[:, None]
        information = self.N[:9, :9] - cross.T @ np.linalg.solve(
            self.N[np.ix_(other, other)] * np.outer(scale, scale), cross
        )
        values, vectors = np.linalg.eigh(0.5 * (information + information.T))
        least = ROUNDING**2 * values[-1]
        return 1.0 / np.sqrt(np.maximum(values[::-1], least)), vectors[:, ::-1]

    def solve(self, basis: Array, free: Iterable[int] = ()) -> tuple[Array, Array]:
        """Return estimate and covariance of all unknowns, R within the span of `basis`."""
        n, other = len(self.b), self._others(free)
        T = np.zeros((n, basis.shape[1] + len(other)))
        T[:9, : basis.shape[1]] = basis
        T[other, basis.shape[1] + np.arange(len(other))] = 1.0
        T *= self._scale[:, None]
        covariance = T @ np.linalg.inv(T.T @ self.N @ T) @ T.T
        return covariance @ self.b, covariance

    def chi_square(self, x: Array) -> float:
        """Return chi-square of the residuals and the priors."""
        return float(self._yy - 2.0 * self.b @ x + x @ self.N @ x)

    def walk_share(self, x: Array) -> float:
        """Return the share of the random walk of velocity in chi-square, -d ln(chi-square) / d ln(q_v^2)."""
        total = 0.0
        for k, part in enumerate(self.parts):
            residual = part.v - part.A @ x[self.columns_of(k)]
            z = solve_triangular(part.L, residual, lower=True, trans="T")
            total += float(z @ part.walk @ z)
        return total / self.chi_square(x)

    def with_pivots(self, sigma: float) -> "NormalEquations":
        """Return the equations with a shift of the origin of b in each run, 1-sigma in m."""
        shared, runs = self.parameters.shared, len(self.parts)
        own = (len(self.parameters.names) - shared) // runs
        names, expected, blocks = list(self.parameters.names[:shared]), self.parameters.expected[:shared], []
        covariance = self.parameters.covariance
        blocks.append(covariance[:shared, :shared])
        for k in range(runs):
            at = slice(shared + own * k, shared + own * (k + 1))
            names += [*self.parameters.names[at], *(f"pivot {k}_{axis}" for axis in "xyz")]
            expected = np.concatenate([expected, self.parameters.expected[at], np.zeros(3)])
            blocks += [covariance[at, at], sigma**2 * np.eye(3)]
        cut = 9 + shared + own
        shift = np.tile(np.eye(3), (3, 1))  # of the origin shifts all three points
        parts = [
            part._replace(A=np.column_stack([part.A[:, :cut], part.A[:, :9] @ shift, part.A[:, cut:]]))
            for part in self.parts
        ]
        parameters = self.parameters._replace(
            names=tuple(names), expected=expected, covariance=np.asarray(block_diag(*blocks), np.float64)
        )
        return NormalEquations(parts, parameters)

    @property
    def count(self) -> int:
        """Number of equations beside the priors."""
        return sum(len(part.v) for part in self.parts)

    def _others(self, free: Iterable[int]) -> NDArray[np.int64]:
        """Return the unknowns other than R."""
        return np.concatenate([self._always, self._steps[list(free)].ravel()])
