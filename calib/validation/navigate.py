"""Does compensation help? The same pulses navigated twice, without and with the size effect, and judged.

Both courses are complete: each compensates, aligns on the first rest and navigates through what follows. They
are judged where the true velocity is known to be zero, in the rests; during the motion it is not, and there
it depends on the gauge. So it does, by noise of the rate, in a single sample at rest: a lever arm common to
all three points turns it into velocity. Therefore velocity is always that of the centroid of the three
sensing points, whichever gauge the calibration is in.

**Fast motion** (`smaller`): horizontal velocity, its mean over the first second of the rest after the motion,
has to be smaller by `SMALLER` with compensation. The first second, because residual biases and tilts make a
ramp of velocity that has nothing to do with lever arms and is in both courses alike. Where a simulation can
give it, the floor is told too: the course of a twin, the same unit with the same noise and motion but
accelerometers that all sense in one point.

**No motion, or vibration** (`same`): over the whole rest, rms, the two courses must not differ by more than
`SAME` of the velocity without compensation, nor by more than the sensors' noise makes of velocity in the time
since the alignment,

    variance = q_v^2 (t/2 + sin(2 W t) / 4 W) + (g q_a / W)^2 (t/2 - sin(2 W t) / 4 W),    W^2 = g / R

for each axis, q_v and q_a the random walks of velocity and tilt that the rests show: Schuler's oscillator,
driven by white noise (Titterton and Weston, Strapdown Inertial Navigation Technology, 2nd ed., chapter 12).
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from calib.detection.blocks import BLOCK_NS
from calib.detection.noise import pooled_noise
from calib.detection.segments import Segments, find_segments
from calib.estimation.runs import GUARD_S, Priors
from calib.validation.skew import SkewCorrection
from calib.validation.trial import BEFORE_S, FIRST_S, NavigatedVelocity, Trial, TrialSettings
from imudrv.arrays import Array
from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import rate_filter
from imudrv.nav.alignment import Aligned, Alignment
from imudrv.nav.earth import normal_gravity
from imudrv.nav.mechanisation import Navigator
from imudrv.records import Records
from imudrv.units import NS


def navigate(
    name: str, pulses: Iterable[Records], setting: TrialSettings, twin: Iterable[Records] | None = None
) -> Trial:
    """Navigate pulses twice, side by side.

    Parameters
    ----------
    name : str
        How reports call the trial.
    pulses : iterable of ndarray of PULSES
        In order.
    setting : Setting
        How.
    twin : iterable of ndarray of PULSES, optional
        Of the same unit without lever arms.

    Returns
    -------
    Trial

    Raises
    ------
    InputError
        The first rest is too short for the alignment, or none follows the motion.
    """
    known = setting.known()
    normal, compensated = (
        _NavigationChain(setting, replace(known, r_b=None)),
        _NavigationChain(setting, known),
    )

    def passing() -> Iterator[Records]:
        for piece in pulses:
            compensated.feed(piece)
            yield normal.feed(piece)
        compensated.close()
        normal.close()

    segments = find_segments(passing())
    moved_s = _motion(name, segments, setting.align_s)
    v_n = normal.v_n(), compensated.v_n()
    n = min(map(len, v_n))
    site = setting.site
    return Trial(
        name,
        t_s=BLOCK_NS * NS * (np.arange(n, dtype=np.float64) + 0.5),
        normal=NavigatedVelocity(normal.aligned(), v_n[0][:n]),
        compensated=NavigatedVelocity(compensated.aligned(), v_n[1][:n]),
        twin=None if twin is None else _navigate_twin(setting, known, twin, n),
        moved_s=moved_s,
        peak_deg_per_s=max((rotation.peak_deg_per_s for rotation in segments.rotations), default=0.0),
        noise=pooled_noise(rest.differences for rest in segments.rests),
        gravity=site.gravity_m_s2 or normal_gravity(site.latitude_rad, site.height_m),
    )


def _motion(name: str, segments: Segments, align_s: float) -> tuple[float, float] | None:
    """From the beginning of the first motion to the end of the last one, s from the end of the alignment."""
    if not segments.rotations:
        return None
    rotations = segments.rotations
    rest_s = rotations[0].start_s
    if rest_s < align_s + BEFORE_S:
        raise InputError(
            f"{name}: expected a rest of {align_s + BEFORE_S:g} s at the beginning, {align_s:g} s of it for "
            f"the alignment, got {rest_s:.1f} s; give a shorter alignment, or record a longer rest"
        )
    last = rotations[-1].after
    if last is None or last.duration_s < FIRST_S + GUARD_S:
        raise InputError(f"{name}: expected a rest of {FIRST_S + GUARD_S:g} s after the motion, got none")
    return rest_s - align_s, rotations[-1].stop_s - align_s


def _navigate_twin(
    setting: TrialSettings, known: Coefficients, pulses: Iterable[Records], n: int
) -> NavigatedVelocity:
    chain = _NavigationChain(replace(setting, skew_s=0.0), replace(known, r_b=None))
    for piece in pulses:
        chain.feed(piece)
    chain.close()
    return NavigatedVelocity(chain.aligned(), chain.v_n()[:n])


class _NavigationChain:
    """Pulses to velocities: compensate, put a skew right, align, navigate."""

    def __init__(self, setting: TrialSettings, known: Coefficients) -> None:
        site, layout = setting.site, setting.layout
        self._site = site
        self._compensator = Compensator(known, layout, rate_filter(setting.rate_filter, layout.interval_ns))
        self._skew = SkewCorrection(setting, known) if setting.skew_s else None
        priors = Priors()
        self._alignment = Alignment(
            site.latitude_rad, priors.gyro_bias, priors.accelerometer_bias, setting.align_s
        )
        self._navigator: Navigator | None = None
        self._size = BLOCK_NS // layout.interval_ns
        self._means: list[Array] = []
        self._over = np.zeros((0, 3))

    def feed(self, pulses: Records) -> Records:
        """Take pulses; the increments that they gave."""
        increments = self._compensator.feed(pulses)
        if self._skew is not None:
            increments = self._skew.feed(pulses, increments)
        self._take(increments)
        return increments

    def close(self) -> None:
        """End of the pulses; the last few, whose rate is not known any more, do not count."""
        if self._navigator is None:
            raise InputError(
                f"validation: expected samples beyond the alignment, got {self._alignment.elapsed_s:.1f} s "
                "in all; give a shorter alignment, or record more"
            )

    def aligned(self) -> Aligned:
        """The attitude that navigation started from."""
        return self._alignment.result()

    def v_n(self) -> Array:
        """Velocities of each 20 ms."""
        return np.concatenate(self._means)

    def _take(self, increments: Records) -> None:
        if self._navigator is None:
            increments = self._alignment.feed(increments)
            if not self._alignment.done:
                return
            site = self._site
            self._navigator = Navigator(
                site.latitude_rad,
                site.longitude_rad,
                site.height_m,
                site.gravity_m_s2,
                self._alignment.result().q_nb,
            )
        v_n = np.concatenate([self._over, self._navigator.feed(increments)["v_n"]])
        whole = len(v_n) - len(v_n) % self._size
        self._means.append(v_n[:whole].reshape(-1, self._size, 3).mean(axis=1))
        self._over = v_n[whole:].copy()
