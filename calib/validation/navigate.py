"""Compare navigation of the same pulses with and without size-effect compensation.

Both navigations are complete: each compensates, aligns on the first rest and navigates to the end. They are
evaluated in the rests, where the true velocity is known to be zero; during the motion it is not, and depends
on the gauge. In a single sample it does so even at rest, because a lever arm common to all three points turns
the noise of the rate into velocity. Therefore the velocity is always that of the centroid of the three
sensing points, whatever the gauge of the calibration.

**Fast motion** (`reduced`): compensation has to reduce the mean horizontal velocity over the first second of
the rest after the motion by `MIN_REDUCTION`. Only the first second, because residual biases and tilts cause a
velocity ramp that is independent of the lever arms and the same in both navigations. A simulation also gives
the lower bound: the velocity of a twin, the same unit with the same noise and motion but with accelerometers
that all sense at one point.

**No motion, or vibration** (`unchanged`): over the whole rest, the rms difference of the two navigations must
be less than `MAX_CHANGE` of the velocity without compensation, and less than the velocity that the sensor
noise causes in the time t since the alignment,

    variance = q_v^2 (t/2 + sin(2 W t) / 4 W) + (g q_a / W)^2 (t/2 - sin(2 W t) / 4 W),    W^2 = g / R

for each axis, with q_v and q_a the random walks of velocity and tilt estimated in the rests: Schuler's
oscillator driven by white noise (Titterton and Weston, Strapdown Inertial Navigation Technology, 2nd ed.,
chapter 12).
"""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from calib.detection.blocks import BLOCK_NS
from calib.detection.noise import pooled_noise
from calib.detection.segments import Segments, find_segments
from calib.estimation.priors import Priors
from calib.estimation.runs import GUARD_S
from calib.validation.skew import SkewCorrection
from calib.validation.trial import BEFORE_S, FIRST_S, NavigatedVelocity, Trial, TrialSettings
from imudrv.arrays import Array
from imudrv.calibration import coefficients
from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.nav.alignment import Aligned, Alignment
from imudrv.nav.mechanisation import Navigator
from imudrv.records import Records
from imudrv.units import NS


def navigate(
    name: str, pulses: Iterable[Records], settings: TrialSettings, twin: Iterable[Records] | None = None
) -> Trial:
    """Navigate pulses twice in parallel, without and with compensation.

    Parameters
    ----------
    name : str
        Name of the trial in reports.
    pulses : iterable of ndarray of PULSES
        Pulses of the unit, in their order.
    settings : TrialSettings
        Calibration, site and processing.
    twin : iterable of ndarray of PULSES, optional
        Pulses of the same unit without lever arms.

    Returns
    -------
    Trial

    Raises
    ------
    InputError
        The first rest is too short for the alignment, or none follows the motion.
    """
    bare = coefficients(settings.calibration.without_size_effect())
    normal = _NavigationChain(settings, bare)
    compensated = _NavigationChain(settings, settings.coefficients())

    def uncompensated() -> Iterator[Records]:
        for piece in pulses:
            compensated.feed(piece)
            yield normal.feed(piece)
        compensated.close()
        normal.close()

    segments = find_segments(uncompensated())
    moved_s = _motion(name, segments, settings.align_s)
    v_n = normal.v_n(), compensated.v_n()
    n = min(map(len, v_n))
    return Trial(
        name,
        t_s=BLOCK_NS * NS * (np.arange(n, dtype=np.float64) + 0.5),
        normal=NavigatedVelocity(normal.aligned(), v_n[0][:n]),
        compensated=NavigatedVelocity(compensated.aligned(), v_n[1][:n]),
        twin=None if twin is None else _navigate_twin(settings, bare, twin, n),
        moved_s=moved_s,
        peak_deg_per_s=max((rotation.peak_deg_per_s for rotation in segments.rotations), default=0.0),
        noise=pooled_noise(rest.differences for rest in segments.rests),
        gravity=settings.site.gravity,
    )


def _motion(name: str, segments: Segments, align_s: float) -> tuple[float, float] | None:
    """Return start of the first and end of the last motion, s from the end of the alignment."""
    if not segments.rotations:
        return None
    rotations = segments.rotations
    rest_s = rotations[0].start_s
    if rest_s < align_s + BEFORE_S:
        raise InputError(
            f"{name}: expected a rest of {align_s + BEFORE_S:g} s at the beginning, {align_s:g} s of it for "
            f"the alignment, got {rest_s:.1f} s; use a shorter alignment, or record a longer rest"
        )
    last = rotations[-1].after
    if last is None or last.duration_s < FIRST_S + GUARD_S:
        raise InputError(f"{name}: expected a rest of {FIRST_S + GUARD_S:g} s after the motion, got none")
    return rest_s - align_s, rotations[-1].stop_s - align_s


def _navigate_twin(
    settings: TrialSettings, bare: Coefficients, pulses: Iterable[Records], n: int
) -> NavigatedVelocity:
    chain = _NavigationChain(replace(settings, skew_s=0.0), bare)
    for piece in pulses:
        chain.feed(piece)
    chain.close()
    return NavigatedVelocity(chain.aligned(), chain.v_n()[:n])


class _NavigationChain:
    """Pulses to velocities: compensate, correct the skew, align, navigate."""

    def __init__(self, settings: TrialSettings, known: Coefficients) -> None:
        site, layout = settings.site, settings.layout
        self._site = site
        self._compensator = Compensator(known, layout, settings.rate_filter)
        self._skew = SkewCorrection(settings) if settings.skew_s else None
        priors = Priors()
        self._alignment = Alignment(
            site.latitude_rad, priors.gyro_bias, priors.accelerometer_bias, settings.align_s
        )
        self._navigator: Navigator | None = None
        self._samples = BLOCK_NS // layout.interval_ns
        self._means: list[Array] = []
        self._remainder = np.zeros((0, 3))

    def feed(self, pulses: Records) -> Records:
        """Navigate pulses; return their increments."""
        increments = self._compensator.feed(pulses)
        if self._skew is not None:
            increments = self._skew.feed(pulses, increments)
        self._navigate(increments)
        return increments

    def close(self) -> None:
        """Check that navigation has started; the last samples, whose rate is unknown, are not navigated."""
        if self._navigator is None:
            raise InputError(
                f"validation: expected samples beyond the alignment, got {self._alignment.elapsed_s:.1f} s "
                "in all; use a shorter alignment, or record more"
            )

    def aligned(self) -> Aligned:
        """Return the alignment from which navigation started."""
        return self._alignment.result()

    def v_n(self) -> Array:
        """Return the mean velocity of each 20 ms, m/s, shape (n, 3)."""
        return np.concatenate(self._means)

    def _navigate(self, increments: Records) -> None:
        if self._navigator is None:
            increments = self._alignment.feed(increments)
            if not self._alignment.done:
                return
            self._navigator = Navigator(self._site.place, self._alignment.result().q_nb)
        v_n = np.concatenate([self._remainder, self._navigator.feed(increments)["v_n"]])
        whole = len(v_n) - len(v_n) % self._samples
        self._means.append(v_n[:whole].reshape(-1, self._samples, 3).mean(axis=1))
        self._remainder = v_n[whole:].copy()
