"""A trial: settings, velocities, expected noise."""

from dataclasses import dataclass, replace
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib.certificate import lever_arms_of
from calib.detection.noise import Noise
from calib.estimation.runs import GUARD_S
from calib.lever_arms.gauge import convert
from imudrv.arrays import Array
from imudrv.calibration import Calibration, coefficients
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.rate_filter import RateFilterName
from imudrv.nav.alignment import ALIGNMENT_S, Aligned
from imudrv.site import Site
from imudrv.wire.layout import Layout

Expected: TypeAlias = Literal["smaller", "same"]


FAST_DEG_PER_S: Final = 10.0
"""A motion whose peak rate is above this is a fast one."""


RATE_FILTER: Final[RateFilterName] = "centred"
"""For the size effect, unless another is asked for; `causal` amplifies what the dither does to the case."""


FIRST_S: Final = 1.0
"""The mean velocity over so long after the motion is judged, s."""


BEFORE_S: Final = 5.0
"""Least rest between alignment and motion, s."""


@dataclass(frozen=True)
class TrialSettings:
    """How pulses become velocities.

    Attributes
    ----------
    layout : Layout
        Of the profile.
    calibration : Calibration
        With lever arms, in any gauge.
    site : Site
        Where the unit stands.
    align_s : float
        Length of the alignment.
    rate_filter : str
        For the size effect.
    skew_s : float
        By how much the accelerometers' sample ends later than the gyros', which is put right.
    """

    layout: Layout
    calibration: Calibration
    site: Site
    align_s: float = ALIGNMENT_S
    rate_filter: RateFilterName = RATE_FILTER
    skew_s: float = 0.0

    def known(self) -> Coefficients:
        """The calibration, its lever arms told from their centroid."""
        r_b = convert(lever_arms_of(self.calibration, "validation"), "centroid").r_b
        return replace(coefficients(self.calibration), r_b=r_b)


@dataclass(frozen=True)
class NavigatedVelocity:
    """One navigation.

    Attributes
    ----------
    aligned : Aligned
        Where it starts.
    v_n : ndarray, shape (n, 3)
        Velocity over ground, means over each 20 ms, east, north, up, m/s.
    """

    aligned: Aligned
    v_n: Array


@dataclass(frozen=True)
class Trial:
    """The same pulses, navigated without and with the size effect.

    Attributes
    ----------
    name : str
        How reports call it.
    t_s : ndarray, shape (n,)
        Time of the middle of each mean, from the end of the alignment.
    normal, compensated : Course
        Without and with.
    twin : Course or None
        The course of a unit without lever arms, all else equal; only a simulation has one.
    moved_s : tuple of 2 float, or None
        First and last motion, on the time of `t_s`; None: all is rest.
    peak_deg_per_s : float
        Largest rate, means over 20 ms.
    noise : Noise
        Of the sensors, from the rests.
    gravity : float
        m/s^2.
    """

    name: str
    t_s: Array
    normal: NavigatedVelocity
    compensated: NavigatedVelocity
    twin: NavigatedVelocity | None
    moved_s: tuple[float, float] | None
    peak_deg_per_s: float
    noise: Noise
    gravity: float

    @property
    def expected(self) -> Expected:
        """What compensation should do to the velocity."""
        return "smaller" if self.peak_deg_per_s > FAST_DEG_PER_S else "same"

    @property
    def before(self) -> NDArray[np.bool_]:
        """Means of the rest before the motion."""
        return self.t_s < (self.moved_s[0] - GUARD_S if self.moved_s else 0.0)

    @property
    def after(self) -> NDArray[np.bool_]:
        """Means of the rest after the motion; without one, all."""
        return self.t_s >= (self.moved_s[1] + GUARD_S if self.moved_s else 0.0)
