"""Captures of a unit at rest to its noise: one pass, in a memory that does not depend on their length."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from calib.identification import PriorCalibration, prior_calibration, software
from calib.inputs import StrPath, profile_of, require_six_axes
from calib.messages import Message, english, message
from calib.noise.bounds import Bound, bounds, is_of_pulses
from calib.noise.estimates import EstimatesCovariance
from calib.noise.fit import MOST_CHI_SQUARE, PART, Fit, fit, usable
from calib.noise.model import ACCELEROMETER, GYRO, Coefficient
from calib.noise.pyramid import AllanVariance, Pyramid
from calib.noise.stretches import Disturbance, StretchSplitter
from imudrv.arrays import Array
from imudrv.calibration import coefficients
from imudrv.capture import Capture
from imudrv.errors import InputError
from imudrv.files.atomic import sha256, unchanged
from imudrv.profiles.schema import Profile
from imudrv.recording.reader import Recording
from imudrv.records import Records
from imudrv.units import ARCSEC, NS
from imudrv.wire.layout import Sensor, Values

CHANNELS: Final = ("gyro X", "gyro Y", "gyro Z", "accelerometer X", "accelerometer Y", "accelerometer Z")
LEAST_S: Final = 20.0
"""Shortest stretch at rest that shows a noise."""


@dataclass(frozen=True)
class ChannelNoise:
    """Noise of one sensor.

    Attributes
    ----------
    name : str
        One of `CHANNELS`.
    units : tuple of Coefficient
        Names and units of the coefficients.
    deviation : ndarray, shape (n,)
        Allan deviation at `NoiseResult.tau_s`, rad/s or m/s^2.
    fit : Fit
        The fitted model.
    bounds : tuple of Bound
        Upper limits for any data.
    is_of_pulses : bool
        Whether nothing but the count of pulses can be seen beside a random walk.
    """

    name: str
    units: tuple[Coefficient, ...]
    deviation: Array
    fit: Fit
    bounds: tuple[Bound, ...]
    is_of_pulses: bool


class NoiseCapture(NamedTuple):
    """A capture, and where it was not at rest."""

    name: str
    sha256: str
    profile: str
    counts: str
    disturbances: tuple[Disturbance, ...]
    disturbed: int


@dataclass(frozen=True)
class NoiseResult:
    """Noise of a unit.

    Attributes
    ----------
    tau_s : ndarray, shape (n,)
        Averaging times.
    usable : int
        Number of them that the longest stretch allows to be fitted.
    channels : tuple of ChannelNoise
        In the order of `CHANNELS`.
    at_rest_s, longest_s : float
        Time at rest in all, and of the longest stretch.
    captures : tuple of NoiseCapture
        The captures.
    calibration : PriorCalibration or None
        Whose scale factors were used; None: the nominal ones of the profile.
    created : datetime
        UTC.
    software : str
        Name and version.
    """

    tau_s: Array
    usable: int
    channels: tuple[ChannelNoise, ...]
    at_rest_s: float
    longest_s: float
    captures: tuple[NoiseCapture, ...]
    calibration: PriorCalibration | None
    created: datetime = field(default_factory=lambda: datetime.now(UTC).replace(microsecond=0))
    software: str = field(default_factory=software)

    @property
    def verdicts(self) -> tuple[tuple[str, str], ...]:
        """Mark and reason in English, the worst first."""
        return tuple((mark, english(why)) for mark, why in self.judgements)

    @property
    def judgements(self) -> tuple[tuple[str, Message], ...]:
        """Mark and reason, the worst first."""
        rejected = [channel for channel in self.channels if not channel.fit.is_accepted]
        regular = [channel for channel in rejected if channel.is_of_pulses]
        moved = [channel for channel in rejected if not channel.is_of_pulses]
        nothing = len(rejected) == len(self.channels)
        marks = []
        if moved:
            worst = max(channel.fit.reduced_chi_square for channel in moved)
            why = message("not_noise_at_rest", names=_names(moved), reduced=worst, limit=MOST_CHI_SQUARE)
            marks.append(("bad" if nothing else "caution", why))
        if regular:
            marks.append(("bad" if nothing else "note", message("regular_pulses", names=_names(regular))))
        if disturbed := sum(capture.disturbed for capture in self.captures):
            marks.append(("note", message("places_left_out", places=disturbed)))
        if self.calibration is None:
            marks.append(("note", message("nominal_scale_factors")))
        if not rejected:
            marks.append(("good", message("noise_at_rest")))
        order = ("bad", "caution", "note", "good")
        return tuple(sorted(marks, key=lambda mark: order.index(mark[0])))

    @property
    def is_bad(self) -> bool:
        """Whether nothing but upper limits was found."""
        return self.verdicts[0][0] == "bad"


def _names(channels: Sequence[ChannelNoise]) -> tuple[str, ...]:
    return tuple(channel.name for channel in channels)


def analyse_noise(
    captures: Sequence[StrPath],
    *,
    calibration: StrPath | PriorCalibration | None = None,
    profile: StrPath | Profile | None = None,
    window_s: tuple[float, float] | None = None,
    channel: str | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> NoiseResult:
    """Compute the noise of a unit from captures at rest.

    Parameters
    ----------
    captures : sequence of path-like
        Wire bytes, CAN logs or recordings of one unit.
    calibration : path-like or PriorCalibration, optional
        Calibration whose scale factors are used; default: that of the recordings, otherwise the nominal ones
        of the profile.
    profile : path-like or Profile, optional
        Wire format: a shipped profile's name or a file. Recordings contain it.
    window_s : (float, float), optional
        Begin and end of what is used, from the beginning of the capture; default: all.
    channel : str, optional
        CAN channel of candump logs; required where a log has several.
    advance : callable
        Called with the number of bytes read.

    Returns
    -------
    NoiseResult

    Raises
    ------
    InputError
        A file cannot be read, there are no scale factors, or no stretch at rest is long enough.
    """
    paths = [Path(path) for path in captures]
    if window_s is not None and not (len(paths) == 1 and 0.0 <= window_s[0] < window_s[1]):
        begin_s, end_s = window_s
        raise InputError(
            "--from, --to: expected one capture, and a begin before the end, got "
            f"{len(paths)} of them and {begin_s:g} to {end_s:g} s"
        )
    if not isinstance(calibration, PriorCalibration) and (
        calibration is not None or _have_calibrations(paths)
    ):
        calibration = prior_calibration(paths, calibration)
    pyramid = Pyramid(len(CHANNELS))
    read: list[NoiseCapture] = []
    intervals = set()
    pulses = np.zeros(len(CHANNELS))
    for path in paths:
        try:
            with unchanged(path):  # a second pass is for the hash
                opened = Capture(path, profile_of(profile), channel)
                intervals.add(opened.layout.interval)
                scales, resolution = _scales(opened, calibration)
                pulses = np.maximum(pulses, resolution)
                splitter = StretchSplitter(float(opened.layout.interval) * NS, scales, resolution)
                for piece in opened.pulses(advance):
                    pyramid.feed(*splitter.feed(_within(piece, window_s)))
                pyramid.feed(*splitter.close())
                pyramid.end_stretch()
                digest = sha256(path)
        except InputError as error:
            raise error if str(path) in str(error) else InputError(f"{path}: {error}") from None
        if any(other.sha256 == digest for other in read):
            raise InputError(f"{path}: expected another capture, got one that was given before")
        disturbances = tuple(splitter.disturbances)
        counts = str(opened.tracker.counts)
        read.append(
            NoiseCapture(path.name, digest, opened.layout.name, counts, disturbances, splitter.disturbed)
        )
    if len(intervals) > 1:
        raise InputError("captures: expected one sample rate, got several; analyse them one by one")
    return _result(pyramid.result(), float(intervals.pop()) * NS, pulses, tuple(read), calibration)


def _have_calibrations(paths: Sequence[Path]) -> bool:
    """Return whether all captures are recordings with a calibration."""
    return all(path.suffix == ".mcap" and Recording(path).calibration_text is not None for path in paths)


def _within(samples: Records, window_s: tuple[float, float] | None) -> Records:
    """Return the samples that lie in the window."""
    if window_s is None:
        return samples
    begin_ns, end_ns = (t / NS for t in window_s)
    begins = samples["elapsed_ns"] - samples["interval_ns"]
    inside: Records = samples[(begins >= begin_ns) & (samples["elapsed_ns"] <= end_ns)]
    return inside


def _scales(capture: Capture, calibration: PriorCalibration | None) -> tuple[Array, Array]:
    """Return the value of a count of each sensor of a unit, and the smallest change of its increments."""
    layout = require_six_axes(capture.layout)
    interval_s = float(layout.interval) * NS
    if calibration is not None:
        c = coefficients(calibration.calibration)
        scales = np.concatenate([c.gyro_scale, 1.0 / c.accelerometer_scale])
    else:
        scales = _nominal_scales(capture.profile)
    return scales, scales * np.repeat([_count(sensor, interval_s) for sensor in layout.sensors], 3)


def _nominal_scales(profile: Profile) -> Array:
    nominal, layout = profile.nominal, profile.layout()
    gyro = nominal.gyro_arcsec_per_pulse if nominal else None
    accelerometer = nominal.accelerometer_pulse_per_m_s if nominal else None
    for name, sensor, scale in zip(
        ("gyros", "accelerometers"), layout.sensors, (gyro, accelerometer), strict=True
    ):
        if sensor.in_pulses and scale is None:
            raise InputError(
                f"expected the scale factor of the {name}, got none in the profile {profile.name}; give the "
                "unit's calibration (--calibration), or `nominal` in the profile"
            )
    return np.repeat([1.0 if gyro is None else gyro * ARCSEC, 1.0 / (accelerometer or 1.0)], 3)


def _count(sensor: Sensor, interval_s: float) -> float:
    """Return the smallest change of an increment of a sensor, in units of its scale factor."""
    if sensor.in_pulses:
        return 1.0
    if any(axis is not None and axis.is_float for axis in sensor.axes):
        return 0.0
    return max(sensor.per_count) * (interval_s if sensor.values is Values.RATE else 1.0)


def _result(
    allan: AllanVariance,
    interval_s: float,
    pulses: Array,
    captures: tuple[NoiseCapture, ...],
    calibration: PriorCalibration | None,
) -> NoiseResult:
    longest_s = allan.longest * interval_s
    if longest_s < LEAST_S:
        where = "\n  ".join(
            [
                f"expected at least {LEAST_S:g} s at rest without a gap, got {longest_s:.1f} s, which show "
                f"an averaging time of {longest_s / PART:.2g} s at most; a longer rest shows more",
                *_places(captures),
            ]
        )
        raise InputError(where)
    fitted = usable(allan)
    if constant := [
        name for name, least in zip(CHANNELS, fitted.variance.min(axis=0), strict=True) if not least
    ]:
        raise InputError(
            f"{', '.join(constant)}: expected increments with noise, got the same ones again and again; the "
            "sensor is dead, or the data are no pulses of a unit at rest"
        )
    estimates = EstimatesCovariance(fitted, interval_s)
    channels = tuple(
        ChannelNoise(
            name,
            GYRO if k < 3 else ACCELEROMETER,
            np.sqrt(allan.variance[:, k]) / interval_s,
            fit(fitted, k, interval_s, estimates),
            bounds(allan, k, interval_s),
            is_of_pulses(allan, k, interval_s, float(pulses[k])),
        )
        for k, name in enumerate(CHANNELS)
    )
    return NoiseResult(
        allan.tau_s(interval_s),
        len(fitted.factors),
        channels,
        allan.samples * interval_s,
        longest_s,
        captures,
        calibration,
    )


def _places(captures: Sequence[NoiseCapture]) -> Iterator[str]:
    """Yield where the captures were not at rest, one line each."""
    for capture in captures:
        for what, begin_s, end_s in capture.disturbances:
            yield f"{capture.name}: {what} at {begin_s:.1f}..{end_s:.1f} s"
