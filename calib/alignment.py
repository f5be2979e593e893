"""Alignment of a rest in a capture: level and heading, and its readings against those of the site."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import atan2, hypot
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from calib.axes import axis_name
from calib.detection.segments import find_segments
from calib.estimation.priors import Priors
from calib.identification import PriorCalibration, prior_calibration
from calib.inputs import StrPath, profile_of, require_six_axes, site_of
from imudrv.arrays import Array
from imudrv.calibration import coefficients
from imudrv.capture import Capture
from imudrv.errors import InputError
from imudrv.files.atomic import unchanged
from imudrv.imu.compensation import Compensator
from imudrv.nav.alignment import MAX_ALIGNMENT_S, Aligned, Alignment, RestReadings
from imudrv.nav.attitude import quaternion_at, rows_of
from imudrv.nav.earth import earth_rate_n
from imudrv.profiles.schema import Profile
from imudrv.records import Records
from imudrv.site import Site
from imudrv.units import DEG, NS, STANDARD_GRAVITY, UG

SIGMAS: Final = 5.0
"""Deviation from the site that is reported, 1-sigma."""


NORMAL_GRAVITY_SIGMA: Final = 50.0 * UG
"""Difference of real from normal gravity, 1 sigma, m/s^2: 50 mGal."""


GUARD_S: Final = 1.0
"""Margin at both ends of a rest that is not used, s."""


class Comparison(NamedTuple):
    """A reading and what it is at the site, SI, with the 1-sigma of their difference."""

    name: str
    measured: float
    of_site: float
    sigma: float

    @property
    def agrees(self) -> bool:
        """Whether the difference is within `SIGMAS`."""
        return abs(self.measured - self.of_site) <= SIGMAS * self.sigma


@dataclass(frozen=True)
class RestAlignment:
    """Alignment of a rest.

    Attributes
    ----------
    name : str
        File name of the capture.
    begin_s, end_s : float
        The rest, from the beginning of the capture.
    aligned : Aligned
        Attitude at its end.
    comparisons : tuple of Comparison
        The Earth's rotation along and across the vertical, and the specific force.
    """

    name: str
    begin_s: float
    end_s: float
    aligned: Aligned
    comparisons: tuple[Comparison, ...]

    @property
    def C_nb(self) -> Array:
        """Attitude at the end of the rest, shape (3, 3)."""
        return np.array(rows_of(quaternion_at(self.aligned.q_nb)))

    @property
    def up(self) -> str:
        """Body axis that points up, '+X' to '-Z'."""
        return axis_name(self.C_nb[2])

    @property
    def azimuth_deg(self) -> Array:
        """Azimuth of each body axis, from north to east, shape (3,); of little use for the vertical one."""
        east, north, _ = self.C_nb
        return np.array([atan2(e, n) / DEG for e, n in zip(east, north, strict=True)])

    @property
    def elevation_deg(self) -> Array:
        """Angle of each body axis above the horizon, shape (3,)."""
        elevation: Array = np.degrees(np.arcsin(np.clip(self.C_nb[2], -1.0, 1.0)))
        return elevation

    @property
    def verdicts(self) -> tuple[tuple[str, str], ...]:
        """Mark and reason, the worst first."""
        marks = [("bad", str(self.aligned.motion))] if self.aligned.motion else []
        for name, measured, of_site, sigma in (c for c in self.comparisons if not c.agrees):
            off = abs(measured - of_site) / sigma
            what_to_do = "check latitude, height and gravity of the site, and the calibration"
            marks.append(("caution", f"{name} is {off:.0f} sigma off that of the site; {what_to_do}"))
        return tuple(marks) or (("good", "at rest, and the readings are those of the site"),)


def align(
    capture: StrPath,
    *,
    site: StrPath | Site,
    calibration: StrPath | PriorCalibration | None = None,
    profile: StrPath | Profile | None = None,
    window_s: tuple[float, float] | None = None,
    channel: str | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> RestAlignment:
    """Align a rest of a capture.

    Parameters
    ----------
    capture : path-like
        Wire bytes, candump log or recording.
    site : path-like or Site
        Place of the unit.
    calibration : path-like or PriorCalibration, optional
        Calibration of the unit. Recordings contain one.
    profile : path-like or Profile, optional
        Wire format: a shipped profile's name or a file. Recordings contain it.
    window_s : (float, float), optional
        Begin and end of the rest, from the beginning of the capture; default: the longest rest.
    channel : str, optional
        CAN channel of a candump log.
    advance : callable
        Called with the number of bytes read; the capture is read twice without `window_s`.

    Returns
    -------
    RestAlignment

    Raises
    ------
    InputError
        A file cannot be read, there is no rest of at least `MIN_ALIGNMENT_S`, or gravity or the Earth's
        rotation is not in it.
    """
    path, site = Path(capture), site_of(site)
    if not isinstance(calibration, PriorCalibration):
        calibration = prior_calibration([path], calibration)
    bare = coefficients(calibration.calibration.without_size_effect().without_skew())
    try:
        with unchanged(path):
            opened = Capture(path, profile_of(profile), channel)
            layout = require_six_axes(opened.layout)

            def increments() -> Iterator[Records]:
                return opened.increments(Compensator(bare, layout), advance)

            begin_s, end_s = window_s or _longest_rest(increments)
            return _aligned(path.name, increments(), layout.interval * NS, begin_s, end_s, site)
    except InputError as error:
        raise error if str(path) in str(error) else InputError(f"{path}: {error}") from None


def _longest_rest(increments: Callable[[], Iterator[Records]]) -> tuple[float, float]:
    rests = find_segments(increments()).rests
    if not rests:
        raise InputError("expected a rest, got none; give its begin and end (--from, --to)")
    rest = max(rests, key=lambda rest: rest.duration_s)
    return rest.start_s + GUARD_S, rest.stop_s - GUARD_S


def _aligned(
    name: str, pieces: Iterator[Records], interval_s: float, begin_s: float, end_s: float, site: Site
) -> RestAlignment:
    if not 0.0 <= begin_s < end_s:
        raise InputError(f"expected a rest that begins before it ends, got {begin_s:g} to {end_s:g} s")
    end_s = min(end_s, begin_s + MAX_ALIGNMENT_S)
    priors = Priors()
    alignment = Alignment(site.latitude_rad, priors.gyro_bias, priors.accelerometer_bias, end_s - begin_s)
    zero: int | None = None  # counter of the first sample
    for piece in pieces:
        if not len(piece):
            continue
        zero = int(piece["counter"][0]) if zero is None else zero
        edges = [zero + round(t / interval_s) for t in (begin_s, end_s)]
        first, stop = np.searchsorted(piece["counter"], edges)
        alignment.feed(piece[first:stop])
    if not alignment.done and end_s - begin_s - alignment.elapsed_s > GUARD_S:
        raise InputError(
            f"expected samples from {begin_s:g} to {end_s:g} s, got {alignment.elapsed_s:.1f} s of them; "
            "check --from and --to, and the losses that imudrv decode reports"
        )
    comparisons = _compared(alignment.readings(), site, priors)
    return RestAlignment(name, begin_s, end_s, alignment.result(), comparisons)


def _compared(readings: RestReadings, site: Site, priors: Priors) -> tuple[Comparison, ...]:
    _, north, up = earth_rate_n(site.latitude_rad)
    rate_sigma = hypot(readings.rate_sigma, priors.gyro_bias)
    force_sigma = hypot(
        readings.force_sigma,
        priors.accelerometer_bias,
        priors.accelerometer_scale * STANDARD_GRAVITY,
        0.0 if site.gravity_m_s2 is not None else NORMAL_GRAVITY_SIGMA,
    )
    return (
        Comparison("the vertical part of the Earth's rotation", readings.rate_up, up, rate_sigma),
        Comparison("the level part of the Earth's rotation", readings.rate_level, north, rate_sigma),
        Comparison("the specific force", readings.force, site.gravity, force_sigma),
    )
