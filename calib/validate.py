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
from dataclasses import dataclass, replace
from math import floor
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from calib.certificate import arms_of
from calib.gauge import convert
from calib.runs import GUARD_S, Priors
from calib.segments import BLOCK_NS, Noise, Segments, find_segments, pooled_noise
from imudrv.calibration import Calibration, coefficients
from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import RateFilterName, rate_filter
from imudrv.nav.alignment import ALIGNMENT_S, Aligned, Alignment
from imudrv.nav.earth import SEMI_MAJOR_AXIS, normal_gravity
from imudrv.nav.mechanisation import Navigator
from imudrv.records import Flag, Records
from imudrv.site import Site
from imudrv.units import NS
from imudrv.wire.layout import Layout

Array = NDArray[np.float64]
Expected: TypeAlias = Literal["smaller", "same"]

SMALLER: Final = 0.95
"""By so much compensation has to make the velocity after a fast motion smaller."""
SAME: Final = 0.05
"""So much of the velocity it may change where nothing turns fast."""
FAST_DEG_PER_S: Final = 10.0
"""A motion whose peak rate is above this is a fast one."""
RATE_FILTER: Final[RateFilterName] = "centred"
"""For the size effect, unless another is asked for; `causal` amplifies what the dither does to the case."""
FIRST_S: Final = 1.0
"""The mean velocity over so long after the motion is judged, s."""
BEFORE_S: Final = 5.0
"""Least rest between alignment and motion, s."""


@dataclass(frozen=True)
class Setting:
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
        r_b = convert(arms_of(self.calibration, "validation"), "centroid").r_b
        return replace(coefficients(self.calibration), r_b=r_b)


@dataclass(frozen=True)
class Course:
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
    normal: Course
    compensated: Course
    twin: Course | None
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


@dataclass(frozen=True)
class Judged:
    """A trial in figures; m/s, horizontal where it is not said otherwise.

    Attributes
    ----------
    expected : {'smaller', 'same'}
        What compensation should do.
    before : tuple of 2 float
        rms in the rest before the motion, without and with; NaN where there is none.
    first : tuple of 3 float
        Speed of the mean velocity over the first second after the motion: without, with, and of the twin.
        The twin's is NaN where there is none.
    first_n : ndarray, shape (2, 3)
        That mean velocity, without and with: east, north, up.
    whole : tuple of 3 float
        rms over the rest after the motion: without, with, and of the twin.
    effect : tuple of 2 float
        rms of the difference from the twin over that rest, without and with.
    change : float
        rms of the difference between with and without.
    noise : float
        What the sensors' noise makes of velocity meanwhile, rms.
    """

    expected: Expected
    before: tuple[float, float]
    first: tuple[float, float, float]
    first_n: Array
    whole: tuple[float, float, float]
    effect: tuple[float, float]
    change: float
    noise: float

    @property
    def smaller_by(self) -> float:
        """By how much compensation makes the velocity right after the motion smaller; 1: all of it."""
        return 1.0 - self.first[1] / self.first[0]

    @property
    def good(self) -> bool:
        """Whether compensation does what it should."""
        if self.expected == "smaller":
            return self.smaller_by >= SMALLER
        return self.change < min(SAME * self.whole[0], self.noise)


def navigate(
    name: str, pulses: Iterable[Records], setting: Setting, twin: Iterable[Records] | None = None
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
    normal, compensated = _Chain(setting, replace(known, r_b=None)), _Chain(setting, known)

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
        normal=Course(normal.aligned(), v_n[0][:n]),
        compensated=Course(compensated.aligned(), v_n[1][:n]),
        twin=None if twin is None else _alone(setting, known, twin, n),
        moved_s=moved_s,
        peak_deg_per_s=max((rotation.peak_deg_per_s for rotation in segments.rotations), default=0.0),
        noise=pooled_noise(segments.rests),
        gravity=site.gravity_m_s2 or normal_gravity(site.latitude_rad, site.height_m),
    )


def judge(trial: Trial) -> Judged:
    """Put a trial into figures.

    Parameters
    ----------
    trial : Trial
        As navigated.

    Returns
    -------
    Judged
    """
    after, before = trial.after, trial.before
    first = after & (trial.t_s < trial.t_s[after][0] + FIRST_S)
    v = trial.normal.v_n, trial.compensated.v_n
    floor_v = np.full_like(v[0], np.nan) if trial.twin is None else trial.twin.v_n
    mean = [one[first].mean(axis=0) for one in (*v, floor_v)]
    noise = noise_velocity(trial.t_s[after], trial.noise, trial.gravity)
    return Judged(
        trial.expected,
        before=(_rms(v[0][before]), _rms(v[1][before])) if before.any() else (np.nan, np.nan),
        first=(_speed(mean[0]), _speed(mean[1]), _speed(mean[2])),
        first_n=np.array(mean[:2]),
        whole=(_rms(v[0][after]), _rms(v[1][after]), _rms(floor_v[after])),
        effect=(_rms((v[0] - floor_v)[after]), _rms((v[1] - floor_v)[after])),
        change=_rms((v[1] - v[0])[after]),
        noise=float(np.sqrt(2.0 * (noise**2).mean())),
    )


def noise_velocity(t_s: Array, noise: Noise, gravity: float) -> Array:
    """Velocity of an axis that noise makes in the time t, 1 sigma, m/s; see the module's text."""
    W = (gravity / SEMI_MAJOR_AXIS) ** 0.5
    even, odd = 0.5 * t_s, np.sin(2.0 * W * t_s) / (4.0 * W)
    of_velocity, of_tilt = noise.velocity_walk, noise.angle_walk * gravity / W
    sigma: Array = np.sqrt(of_velocity**2 * (even + odd) + of_tilt**2 * (even - odd))
    return sigma


def _speed(v_n: Array) -> float:
    return float(np.hypot(v_n[0], v_n[1]))


def _rms(v_n: Array) -> float:
    """Of the horizontal speed."""
    return float(np.sqrt((v_n[:, :2] ** 2).sum(axis=1).mean()))


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


def _alone(setting: Setting, known: Coefficients, pulses: Iterable[Records], n: int) -> Course:
    chain = _Chain(replace(setting, skew_s=0.0), replace(known, r_b=None))
    for piece in pulses:
        chain.feed(piece)
    chain.close()
    return Course(chain.aligned(), chain.v_n()[:n])


class _Chain:
    """Pulses to velocities: compensate, put a skew right, align, navigate."""

    def __init__(self, setting: Setting, known: Coefficients) -> None:
        site, layout = setting.site, setting.layout
        self._site = site
        self._compensator = Compensator(known, layout, rate_filter(setting.rate_filter, layout.interval_ns))
        self._skew = _Skew(setting, known) if setting.skew_s else None
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


class _Skew:
    """Specific force back to the time of the gyros.

    Velocity felt up to `t + skew` is known at the end of each sample; in between a cubic through the four
    samples around tells it (Lagrange). The size effect is that of the gyros' own time and is not moved.
    """

    def __init__(self, setting: Setting, known: Coefficients) -> None:
        layout = setting.layout
        self._interval_ns = layout.interval_ns
        self._bare = Compensator(
            replace(known, r_b=None), layout, rate_filter(setting.rate_filter, layout.interval_ns)
        )
        at = -setting.skew_s / (layout.interval_ns * NS)
        first = floor(at)
        u = at - first
        self._weights = (
            -u * (u - 1.0) * (u - 2.0) / 6.0,
            (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0,
            -(u + 1.0) * u * (u - 2.0) / 2.0,
            (u + 1.0) * u * (u - 1.0) / 6.0,
        )
        self._offsets = range(first - 1, first + 3)
        self._behind, self._ahead = max(0, 1 - first), max(0, first + 2)
        self._felt = np.zeros((0, 3))  # of samples whose increments are still held back here
        self._waiting: Records | None = None
        self._bare_dv = np.zeros((0, 3))

    def feed(self, pulses: Records, increments: Records) -> Records:
        """Take pulses and their increments; increments with the specific force of their own time."""
        bare = self._bare.feed(pulses)
        if (bare["flags"] & Flag.MISSING_BEFORE).any() or (bare["interval_ns"] != self._interval_ns).any():
            raise InputError(
                "skew: expected samples without gaps, got one; it cannot be put right over a gap"
            )
        self._bare_dv = np.concatenate([self._bare_dv, bare["dv_b"]])
        felt, self._bare_dv = self._bare_dv[: len(increments)], self._bare_dv[len(increments) :]
        effect = felt - increments["dv_b"]
        rows = increments.copy()
        rows["dv_b"] = effect
        rows = rows if self._waiting is None else np.concatenate([self._waiting, rows])
        felt = np.concatenate([self._felt, felt])
        stop = len(rows) - self._ahead
        if stop <= self._behind:
            self._waiting, self._felt = rows, felt
            return rows[:0]
        out = rows[self._behind : stop].copy()
        moved = np.zeros((len(out), 3))
        for weight, offset in zip(self._weights, self._offsets, strict=True):
            moved += weight * felt[self._behind + offset : stop + offset]
        out["dv_b"] = moved - out["dv_b"]
        self._waiting, self._felt = rows[stop - self._behind :].copy(), felt[stop - self._behind :].copy()
        return out
