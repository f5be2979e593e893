"""Metrics and verdict of a trial."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.detection.noise import Noise
from calib.html_table import html_table
from calib.validation.trial import FIRST_S, Trial
from imudrv.arrays import Array
from imudrv.nav.earth import SEMI_MAJOR_AXIS
from imudrv.units import MM

MIN_REDUCTION: Final = 0.95
"""Required reduction of the velocity after a fast motion, as a fraction."""


MAX_CHANGE: Final = 0.05
"""Largest change of the velocity without fast rotation, as a fraction."""


@dataclass(frozen=True, repr=False)
class Validation:
    """Metrics of a trial, m/s; of the horizontal velocity unless stated.

    Attributes
    ----------
    trial : Trial
        The velocities.
    before : tuple of 2 float
        rms in the rest before the motion, without and with compensation; NaN without such a rest.
    first : tuple of 3 float
        Speed of the mean velocity over the first second after the motion: without and with compensation,
        and of the twin (NaN without a twin).
    first_n : ndarray, shape (2, 3)
        That mean velocity without and with compensation: east, north, up.
    whole : tuple of 3 float
        rms over the rest after the motion: without and with compensation, and of the twin.
    effect : tuple of 2 float
        rms difference from the twin over that rest, without and with compensation.
    change : float
        rms difference between with and without compensation.
    noise : float
        rms velocity that the sensor noise causes over that rest.
    """

    trial: Trial
    before: tuple[float, float]
    first: tuple[float, float, float]
    first_n: Array
    whole: tuple[float, float, float]
    effect: tuple[float, float]
    change: float
    noise: float

    def __repr__(self) -> str:
        return f"<Validation: {self._summary}>"

    def _repr_html_(self) -> str:
        head = ("horizontal velocity, mm/s", "not compensated", "compensated")
        rows = [("first second after the motion", self.first), ("whole rest, rms", self.whole)]
        return html_table(
            self._summary, head, [(name, *(f"{v / MM:.2f}" for v in pair[:2])) for name, pair in rows]
        )

    @property
    def _summary(self) -> str:
        without, compensated = (v / MM for v in self.first[:2])
        return (
            f"{self.trial.name}: {'good' if self.good else 'bad'}; velocity after the motion "
            f"{without:.2f} mm/s, compensated {compensated:.2f} mm/s"
        )

    @property
    def reduction(self) -> float:
        """Reduction of the velocity after the motion by compensation, as a fraction."""
        return 1.0 - self.first[1] / self.first[0]

    @property
    def good(self) -> bool:
        """Whether compensation has the required effect."""
        if self.trial.expected == "reduced":
            return self.reduction >= MIN_REDUCTION
        return self.change < min(MAX_CHANGE * self.whole[0], self.noise)


def evaluate(trial: Trial) -> Validation:
    """Compute the metrics of a trial.

    Parameters
    ----------
    trial : Trial
        The trial.

    Returns
    -------
    Validation
    """
    after, before = trial.after, trial.before
    first = after & (trial.t_s < trial.t_s[after][0] + FIRST_S)
    v = trial.normal.v_n, trial.compensated.v_n
    twin_v = np.full_like(v[0], np.nan) if trial.twin is None else trial.twin.v_n
    mean = [one[first].mean(axis=0) for one in (*v, twin_v)]
    noise = noise_velocity(trial.t_s[after], trial.noise, trial.gravity)
    return Validation(
        trial,
        before=(_rms(v[0][before]), _rms(v[1][before])) if before.any() else (np.nan, np.nan),
        first=(_speed(mean[0]), _speed(mean[1]), _speed(mean[2])),
        first_n=np.array(mean[:2]),
        whole=(_rms(v[0][after]), _rms(v[1][after]), _rms(twin_v[after])),
        effect=(_rms((v[0] - twin_v)[after]), _rms((v[1] - twin_v)[after])),
        change=_rms((v[1] - v[0])[after]),
        noise=float(np.sqrt(2.0 * (noise**2).mean())),
    )


def noise_velocity(t_s: Array, noise: Noise, gravity: float) -> Array:
    """Return the velocity of one axis that noise causes in the time t, 1 sigma, m/s; see `navigate`."""
    W = (gravity / SEMI_MAJOR_AXIS) ** 0.5
    even, odd = 0.5 * t_s, np.sin(2.0 * W * t_s) / (4.0 * W)
    of_velocity, of_tilt = noise.velocity_walk, noise.angle_walk * gravity / W
    sigma: Array = np.sqrt(of_velocity**2 * (even + odd) + of_tilt**2 * (even - odd))
    return sigma


def _speed(v_n: Array) -> float:
    return float(np.hypot(v_n[0], v_n[1]))


def _rms(v_n: Array) -> float:
    """Return the rms horizontal speed."""
    return float(np.sqrt((v_n[:, :2] ** 2).sum(axis=1).mean()))
