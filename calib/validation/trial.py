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

Expected: TypeAlias = Literal["reduced", "unchanged"]


FAST_DEG_PER_S: Final = 10.0
"""Peak rate above which a motion is fast."""


RATE_FILTER: Final[RateFilterName] = "centred"
"""Default rate filter for the size effect; `causal` would amplify the dither of the case."""


FIRST_S: Final = 1.0
"""Averaging window for the velocity after the motion, s."""


BEFORE_S: Final = 5.0
"""Minimum rest between alignment and motion, s."""


@dataclass(frozen=True)
class TrialSettings:
    """Settings for navigating a trial.

    Attributes
    ----------
    layout : Layout
        Layout of the profile.
    calibration : Calibration
        Calibration with lever arms, in any gauge.
    site : Site
        Site of the unit.
    align_s : float
        Length of the alignment, s.
    rate_filter : str
        Rate filter for the size effect.
    skew_s : float
        Time by which the accelerometer samples end later than those of the gyros, s; is corrected.
    """

    layout: Layout
    calibration: Calibration
    site: Site
    align_s: float = ALIGNMENT_S
    rate_filter: RateFilterName = RATE_FILTER
    skew_s: float = 0.0

    def coefficients(self) -> Coefficients:
        """Return the coefficients of the calibration, with lever arms from their centroid."""
        r_b = convert(lever_arms_of(self.calibration, "validation"), "centroid").r_b
        return replace(coefficients(self.calibration), r_b=r_b)


@dataclass(frozen=True)
class NavigatedVelocity:
    """Result of one navigation.

    Attributes
    ----------
    aligned : Aligned
        Initial attitude.
    v_n : ndarray, shape (n, 3)
        Velocity over ground: east, north, up, m/s, mean over each 20 ms.
    """

    aligned: Aligned
    v_n: Array


@dataclass(frozen=True)
class Trial:
    """The same pulses, navigated without and with the size effect.

    Attributes
    ----------
    name : str
        Name in reports.
    t_s : ndarray, shape (n,)
        Middle of each mean, s from the end of the alignment.
    normal, compensated : NavigatedVelocity
        Without and with compensation.
    twin : NavigatedVelocity or None
        Velocity of the same unit without lever arms; in simulations only.
    moved_s : tuple of 2 float, or None
        Start of the first and end of the last motion, on the time scale of `t_s`; None: no motion.
    peak_deg_per_s : float
        Peak rate, of means over 20 ms.
    noise : Noise
        Noise of the sensors, estimated in the rests.
    gravity : float
        Gravity, m/s^2.
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
        """Required effect of compensation on the velocity."""
        return "reduced" if self.peak_deg_per_s > FAST_DEG_PER_S else "unchanged"

    @property
    def before(self) -> NDArray[np.bool_]:
        """Mask of the rest before the motion."""
        return self.t_s < (self.moved_s[0] - GUARD_S if self.moved_s else 0.0)

    @property
    def after(self) -> NDArray[np.bool_]:
        """Mask of the rest after the motion; without a motion, everything."""
        return self.t_s >= (self.moved_s[1] + GUARD_S if self.moved_s else 0.0)
