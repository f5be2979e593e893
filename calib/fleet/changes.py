"""Which units drift and which benches are off, from all results of a fleet at once.

Each result of a unit is its level, what its bench is off by, and its drift times its age, with the covariance
of the certificate:

    y = level(unit) + offset(bench) + drift(unit) (t - t0) + noise

At first no bench is off and no unit drifts. The offset or drift that lowers chi-square most is then added, as
long as chance does that in less than one fleet of a hundred; so a bench that is off makes neither the others
seem so nor its units seem to drift. An offset is relative to the benches that are not off.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import chi2

from imudrv.arrays import Array

FALSE_ALARM: Final = 0.01
"""Probability of any change in a fleet where nothing has changed."""
MONTH_DAYS: Final = 365.25 / 12
_RANK: Final = 1e-6
"""Smallest part of a change that the levels of the units do not explain, relative to the whole."""


class Measurement(NamedTuple):
    """A result of a unit.

    Attributes
    ----------
    unit, bench : str
    t_days : float
        Its date.
    value : ndarray, shape (k,)
    covariance : ndarray, shape (k, k)
    """

    unit: str
    bench: str
    t_days: float
    value: Array
    covariance: Array


class Change(NamedTuple):
    """An offset of a bench, or the drift of a unit a month.

    Attributes
    ----------
    kind : {'bench', 'unit'}
    name : str
    value, sigma : ndarray, shape (k,)
    p : float
        Probability that chance lowers chi-square as much, for any of the benches and units.
    """

    kind: str
    name: str
    value: Array
    sigma: Array
    p: float


def unchanged(measurements: Sequence[Measurement]) -> tuple[float, int, float]:
    """Return chi-square, degrees of freedom and probability of "nothing has changed" for one unit."""
    weights = [np.linalg.inv(m.covariance) for m in measurements]
    mean = np.linalg.solve(
        np.sum(weights, axis=0),
        np.sum([W @ m.value for W, m in zip(weights, measurements, strict=True)], axis=0),
    )
    rest = [m.value - mean for m in measurements]
    chi_square = float(sum(r @ W @ r for r, W in zip(rest, weights, strict=True)))
    freedom = len(mean) * (len(measurements) - 1)
    return chi_square, freedom, float(chi2.sf(chi_square, freedom)) if freedom else 1.0


def find_changes(measurements: Sequence[Measurement], false_alarm: float = FALSE_ALARM) -> tuple[Change, ...]:
    """Find the benches that are off and the units that drift.

    Parameters
    ----------
    measurements : sequence of Measurement
        Of all units and benches; all of the same k.
    false_alarm : float
        Probability of any change where nothing has changed.

    Returns
    -------
    tuple of Change
        In the order of their significance.
    """
    if not measurements:
        return ()
    whitened = _Whitened(measurements)
    candidates = whitened.candidates()
    found: list[tuple[tuple[str, str], float]] = []
    while len(found) < len(candidates):
        basis = whitened.basis([key for key, _ in found])
        rest = whitened.y - basis @ (basis.T @ whitened.y)
        lower = {
            key: _lower_chi_square(columns, basis, rest)
            for key, columns in candidates.items()
            if key not in dict(found)
        }
        best = max(lower, key=lambda key: lower[key])
        p = min(1.0, float(chi2.sf(lower[best], whitened.k)) * len(candidates))
        if p >= false_alarm:
            break
        found.append((best, p))
    values = whitened.estimate([key for key, _ in found])
    return tuple(Change(*key, *values[key], p) for key, p in found)


class _Whitened:
    """Measurements and columns of the design, divided by the square root of the covariance."""

    def __init__(self, measurements: Sequence[Measurement]) -> None:
        self._measurements = measurements
        self.k = len(measurements[0].value)
        self._W = [np.linalg.inv(np.linalg.cholesky(m.covariance)) for m in measurements]
        self.y = np.concatenate([W @ m.value for W, m in zip(self._W, measurements, strict=True)])
        units = sorted({m.unit for m in measurements})
        self._levels = np.hstack(
            [self._columns(np.array([float(m.unit == unit) for m in measurements])) for unit in units]
        )

    def candidates(self) -> dict[tuple[str, str], Array]:
        """Return the columns of each change, by its kind and name."""
        all_of, t = self._measurements, np.array([m.t_days for m in self._measurements])
        months = (t - t.mean()) / MONTH_DAYS
        columns = {
            ("bench", name): np.array([float(m.bench == name) for m in all_of])
            for name in sorted({m.bench for m in all_of})
        }
        columns |= {
            ("unit", name): np.where([m.unit == name for m in all_of], months, 0.0)
            for name in sorted({m.unit for m in all_of})
        }
        self._changes = {key: self._columns(column) for key, column in columns.items()}
        return self._changes

    def basis(self, changes: Sequence[tuple[str, str]]) -> Array:
        """Return an orthonormal basis of the levels and these changes."""
        design = np.hstack([self._levels, *(self._changes[key] for key in changes)])
        basis: Array = np.linalg.qr(design).Q  # of full rank: what the rest explains is no candidate
        return basis

    def estimate(self, changes: Sequence[tuple[str, str]]) -> dict[tuple[str, str], tuple[Array, Array]]:
        """Return value and sigma of each change, all estimated together."""
        design = np.hstack([self._levels, *(self._changes[key] for key in changes)])
        inverse = np.linalg.pinv(design, rcond=_RANK)
        value, sigma = inverse @ self.y, np.linalg.norm(inverse, axis=1)
        begin, k = self._levels.shape[1], self.k
        parts = {key: slice(begin + n * k, begin + (n + 1) * k) for n, key in enumerate(changes)}
        return {key: (value[part], sigma[part]) for key, part in parts.items()}

    def _columns(self, of_measurement: Array) -> Array:
        """Return the k columns of a change that each measurement has to this extent."""
        return np.concatenate([x * W for x, W in zip(of_measurement, self._W, strict=True)])


def _lower_chi_square(columns: Array, basis: Array, rest: Array) -> float:
    """Return by how much these columns lower chi-square, 0 if the levels explain them.

    They explain a bench whose units were on no other one, and the drift of a unit that was measured once.
    """
    own = columns - basis @ (basis.T @ columns)
    squares, V = np.linalg.eigh(own.T @ own)
    if squares[0] <= (_RANK * np.linalg.norm(columns)) ** 2:
        return 0.0
    return float(np.sum((V.T @ (own.T @ rest)) ** 2 / squares))
