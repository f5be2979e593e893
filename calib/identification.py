"""Identify the lever arms from captures; the result with everything that it was computed from.

Certificate and report are functions of `IdentificationResult` and compute nothing again.
"""

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from html import escape
from importlib.metadata import version
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from calib.detection.acceptance import RotationLimits
from calib.estimation.joint import estimate_joint
from calib.estimation.low_pass import FilterChoice
from calib.estimation.plain import estimate_plain
from calib.estimation.priors import Priors, certified_priors
from calib.estimation.result import TO_DIFFERENCES, Extra, LeverArmEstimate, RunResult
from calib.estimation.runs import CaptureRuns, NavigationOptions, Run, navigate_capture
from calib.inputs import StrPath, profile_of, require_six_axes, site_of
from calib.lever_arms.gauge import LeverArms
from calib.messages import english
from imudrv.arrays import Array
from imudrv.calibration import Calibration, read_calibration_file
from imudrv.capture import Capture
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.files.atomic import sha256, unchanged
from imudrv.imu.sequence import SampleCounts
from imudrv.profiles.schema import Profile
from imudrv.recording.reader import Recording
from imudrv.records import Records
from imudrv.site import Site
from imudrv.units import MM


def software() -> str:
    """Return name and version of the software."""
    return f"imu50 {version('imu50')}"


@dataclass(frozen=True)
class EstimationOptions:
    """Choice of the estimator.

    Attributes
    ----------
    method : {'joint', 'plain'}
        `joint` uses the velocity of the rests before and after; `plain` solves `V = H R`.
    pivot : {'free', 'fixed'}
        `fixed`: the origin of b is known to stay still while the unit turns.
    nine : bool
        Whether all nine components are required; needs a fixed pivot.
    extra : tuple of {'quadratic'}
        Additional parameters to estimate.
    rate_filter : {'auto', 'causal', 'centred', 'dither'}
        Filter of the rates of H; `auto`: `dither` wherever the sample rate allows it.
    priors : Priors, optional
        Uncertainty of the static calibration; default: that of the certificate, or else wide.
    skew_sigma_s : float, optional
        1-sigma of the gyro-accelerometer skew about that of the certificate; 0: known exactly.

    Raises
    ------
    InputError
        Method `plain` with another option.
    """

    method: Literal["joint", "plain"] = "joint"
    pivot: Literal["free", "fixed"] = "free"
    nine: bool = False
    extra: tuple[Extra, ...] = ()
    rate_filter: FilterChoice = "auto"
    priors: Priors | None = None
    skew_sigma_s: float | None = None

    def __post_init__(self) -> None:
        if self.method == "plain" and (self.pivot == "fixed" or self.nine or self.extra):
            raise InputError(
                "method plain: expected pivot free, six components and no extra parameters, as it solves "
                "V = H R only; use method joint"
            )

    def priors_of(self, calibration: Calibration) -> Priors:
        """Return the priors for a unit."""
        priors = certified_priors(calibration)
        if self.priors is not None:
            priors = replace(self.priors, skew=priors.skew, expected_skew=priors.expected_skew)
        return priors if self.skew_sigma_s is None else replace(priors, skew=self.skew_sigma_s)


class PriorCalibration(NamedTuple):
    """Calibration that the increments were computed with.

    Attributes
    ----------
    calibration : Calibration
        Its size effect, if it has one, is not used.
    name : str
        Name of its file or recording.
    sha256 : str
        SHA-256 of its content.
    """

    calibration: Calibration
    name: str
    sha256: str


class Temperature(NamedTuple):
    """Temperature range of a channel over a capture, degrees Celsius."""

    channel: str
    least_degc: float
    most_degc: float


def temperature_ranges(channels: Sequence[str], least: Array, most: Array) -> tuple[Temperature, ...]:
    """Return the temperature range of each channel that the unit reported: those that are not NaN."""
    ranges = zip(channels, least.tolist(), most.tolist(), strict=False)
    return tuple(Temperature(channel, low, high) for channel, low, high in ranges if low <= high)


@dataclass(frozen=True)
class CaptureSummary:
    """A capture and its rotations.

    Attributes
    ----------
    label : str
        Prefix of the labels of its runs.
    name : str
        File name.
    sha256 : str
        SHA-256 of the file.
    profile : str
        Name of the wire format.
    counts : SampleCounts
        Samples and losses.
    temperatures : tuple of Temperature
        Range of each channel that the unit reported.
    rotations : CaptureRuns
        Rests, rotations, runs.
    channel : str or None
        CAN channel that was read from a candump log.
    """

    label: str
    name: str
    sha256: str
    profile: str
    counts: SampleCounts
    temperatures: tuple[Temperature, ...]
    rotations: CaptureRuns
    channel: str | None = None


@dataclass(frozen=True, repr=False)
class IdentificationResult:
    """Result of an identification.

    Attributes
    ----------
    result : LeverArmEstimate
        The estimate.
    prior_calibration : PriorCalibration
        The calibration that it extends.
    site : Site
        Place of the unit.
    limits : RotationLimits
        Limits of an accepted rotation.
    priors : Priors
        Uncertainty of the static calibration.
    sources : tuple of CaptureSummary
        The captures.
    created : datetime
        Time of the identification, UTC.
    software : str
        Name and version of the software.
    """

    result: LeverArmEstimate
    prior_calibration: PriorCalibration
    site: Site
    limits: RotationLimits
    priors: Priors
    sources: tuple[CaptureSummary, ...]
    created: datetime = field(default_factory=lambda: datetime.now(UTC).replace(microsecond=0))
    software: str = field(default_factory=software)

    def __repr__(self) -> str:
        return f"<IdentificationResult: {self._summary}>"

    def _repr_html_(self) -> str:
        return f"<p>{escape(self._summary)}</p>{self.arms._repr_html_()}"

    @property
    def _summary(self) -> str:
        result, n = self.result, len(self.result.turns)
        verdict = "; ".join(result.refusals) or "usable for a certificate"
        return (
            f"unit {self.prior_calibration.calibration.serial_number}, method {result.method}, "
            f"{n} rotation{'s' if n > 1 else ''}, rank {result.rank}, sigma of the differences up to "
            f"{result.differences_sigma.max() / MM:.3f} mm: {verdict}"
        )

    @property
    def arms(self) -> LeverArms:
        """The lever arms in the gauge of the estimate."""
        return self.result.arms

    @property
    def differences_correlation(self) -> Array:
        """Correlation of the six differences with the parameters other than R, shape (6, n)."""
        result = self.result
        covariance = TO_DIFFERENCES @ (result.sigma.reshape(9, 1) * result.correlation)
        correlation: Array = covariance / result.differences_sigma.reshape(6, 1)
        return correlation

    @property
    def runs(self) -> tuple[Run, ...]:
        """The runs, in the order of `result.runs`."""
        return tuple(run for source in self.sources for run in source.rotations.runs)


def scatter(run: RunResult) -> float:
    """Return the scatter of a run's velocity residuals, rms about their mean, m/s.

    The mean is the error of the first velocity, which the pulses leave uncertain.
    """
    residual = run.v_n - run.fitted_n
    return float(np.sqrt(np.mean((residual - residual.mean(axis=0)) ** 2)))


def identify(
    captures: StrPath | Sequence[StrPath],
    *,
    site: StrPath | Site,
    calibration: StrPath | PriorCalibration | None = None,
    profile: StrPath | Profile | None = None,
    options: EstimationOptions | None = None,
    channel: str | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> IdentificationResult:
    """Identify the inner lever arms from captures of one unit.

    Parameters
    ----------
    captures : path-like or sequence of path-like
        Wire bytes, candump logs or recordings.
    site : path-like or Site
        Place of the unit.
    calibration : path-like or PriorCalibration, optional
        Calibration of the unit, whose size effect is not used. Recordings contain one.
    profile : path-like or Profile, optional
        Wire format: a shipped profile's name or a file. Recordings contain it.
    options : EstimationOptions, optional
        Method, pivot and additional parameters.
    channel : str, optional
        CAN channel of candump logs; required where a log has several.
    advance : callable
        Called with the number of bytes read; each capture is read twice.

    Returns
    -------
    IdentificationResult

    Raises
    ------
    InputError
        A file cannot be read, a capture is given twice, no rotation is usable (with the reasons), or the
        rotations do not determine the lever arms.
    """
    options = options or EstimationOptions()
    paths = _paths(captures)
    if not isinstance(calibration, PriorCalibration):
        calibration = prior_calibration(paths, calibration)
    site, limits = site_of(site), RotationLimits()
    priors = options.priors_of(calibration.calibration)
    sources: list[CaptureSummary] = []
    for path in paths:
        source = _read(
            path,
            _label(path, [source.label for source in sources]),
            calibration=calibration.calibration.without_size_effect().without_skew(),
            site=site,
            navigation=NavigationOptions(limits, priors, rate_filter=options.rate_filter),
            profile=profile_of(profile),
            channel=channel,
            advance=advance,
        )
        for other in sources:
            if other.sha256 == source.sha256:
                raise InputError(f"{path}: expected another capture, got that of {other.name} once more")
        sources.append(source)
    runs = [run for source in sources for run in source.rotations.runs]
    if not runs:
        raise InputError(
            "\n  ".join(["expected at least one usable rotation, got none:", *_rejections(sources)])
        )
    try:
        result = _estimate(runs, priors, options)
    except InputError as error:
        raise InputError("\n  ".join([str(error), *_rejections(sources)])) from None
    return IdentificationResult(result, calibration, site, limits, priors, tuple(sources))


def prior_calibration(
    captures: Sequence[StrPath], calibration: StrPath | None = None, unit: str | None = None
) -> PriorCalibration:
    """Read the calibration of the unit: from its file, or the one that all recordings contain.

    Parameters
    ----------
    captures : sequence of path-like
        Captures, searched for a calibration where no file is given.
    calibration : path-like, optional
        Calibration file.
    unit : str, optional
        Serial number that the calibration must have.

    Returns
    -------
    PriorCalibration

    Raises
    ------
    InputError
        The file cannot be read; a capture contains no calibration, or recordings contain different ones; or
        it is the calibration of another unit.
    """
    if calibration is not None:
        file = read_calibration_file(calibration, unit)
        return PriorCalibration(file.model, Path(calibration).name, file.sha256)
    texts: dict[str, Path] = {}
    for path in map(Path, captures):
        text = Recording(path).calibration_text if path.suffix == ".mcap" else None
        if text is None:
            raise InputError(
                f"{path}: expected a calibration, got a capture without one; give its file (--calibration)"
            )
        texts.setdefault(text, path)
    if not texts:
        raise InputError("captures: expected one file at least, got none")
    if len(texts) > 1:
        raise InputError(
            "expected recordings made with one calibration, got different ones in "
            f"{' and '.join(map(str, texts.values()))}; give the right one (--calibration)"
        )
    ((text, path),) = texts.items()
    model = settings_file.parse_text(text.encode(), Calibration, f"{path}: calibration")
    if unit not in (None, model.serial_number):
        raise InputError(f"{path}: expected a recording of unit {unit!r}, got one of {model.serial_number!r}")
    return PriorCalibration(model, f"calibration in {path.name}", hashlib.sha256(text.encode()).hexdigest())


def _paths(captures: StrPath | Sequence[StrPath]) -> list[Path]:
    return [Path(captures)] if isinstance(captures, str | os.PathLike) else [Path(path) for path in captures]


def _estimate(runs: Sequence[Run], priors: Priors, options: EstimationOptions) -> LeverArmEstimate:
    if options.method == "joint":
        return estimate_joint(runs, priors, pivot=options.pivot, nine=options.nine, extra=options.extra)
    return estimate_plain(runs, priors)


def _label(path: Path, taken: Sequence[str]) -> str:
    """Return the file's name without suffix, numbered where that name is taken."""
    label, n = path.stem, 1
    while label in taken:
        n += 1
        label = f"{path.stem}.{n}"
    return label


def _read(
    path: Path,
    label: str,
    *,
    calibration: Calibration,
    site: Site,
    navigation: NavigationOptions,
    profile: Profile | None,
    channel: str | None,
    advance: Callable[[int], None],
) -> CaptureSummary:
    """Find and navigate the rotations of a capture, with its sample counts and temperatures."""
    low, high = np.full(6, np.inf), np.full(6, -np.inf)

    def pulses() -> Iterator[Records]:
        for piece in capture.pulses(advance):
            if len(piece):
                np.fmin(low, np.fmin.reduce(piece["temperature_degc"], axis=0), out=low)
                np.fmax(high, np.fmax.reduce(piece["temperature_degc"], axis=0), out=high)
            yield piece

    try:
        with unchanged(path):  # two passes, and one for the hash
            capture = Capture(path, profile, channel)
            layout = require_six_axes(capture.layout)
            rotations = navigate_capture(pulses, layout, calibration, site, label, navigation)
            digest = sha256(path)
    except InputError as error:
        raise error if str(path) in str(error) else InputError(f"{path}: {error}") from None
    temperatures = temperature_ranges(layout.temperature_names, low, high)
    counts = capture.tracker.counts
    return CaptureSummary(label, path.name, digest, layout.name, counts, temperatures, rotations, channel)


def _rejections(sources: Sequence[CaptureSummary]) -> list[str]:
    """Return why each motion was rejected, one line each; one line for a capture without motion."""
    lines = []
    for source in sources:
        if not source.rotations.segments.rotations:
            seconds = source.rotations.segments.duration_s
            lines.append(f"{source.name}: {seconds:.1f} s at rest, no motion at all")
        lines += [
            f"{source.name}: motion at {rotation.start_s:.1f}..{rotation.stop_s:.1f} s: "
            + "; ".join(map(english, reasons))
            for rotation, reasons in source.rotations.rejected
        ]
    return lines
