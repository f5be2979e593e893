"""From capture files to findings: what was found, and all that it was made of.

Certificate and report are functions of `IdentificationResult`; nothing is computed a second time behind it.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from calib.detection.acceptance import RotationLimits
from calib.estimation.joint import estimate_joint
from calib.estimation.plain import estimate_plain
from calib.estimation.result import TO_DIFFERENCES, Extra, LeverArmEstimate, RunResult
from calib.estimation.runs import CaptureRuns, Priors, Run, navigate_rotations
from calib.lever_arms.gauge import LeverArms
from imudrv.arrays import Array
from imudrv.calibration import Calibration, coefficients
from imudrv.capture import Capture
from imudrv.errors import InputError
from imudrv.files.atomic import sha256, unchanged
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import rate_filter
from imudrv.profiles.schema import Profile
from imudrv.records import Records
from imudrv.site import Site


class PriorCalibration(NamedTuple):
    """The calibration that the increments were made with.

    Attributes
    ----------
    calibration : Calibration
        Its size effect, if there is one, was not used.
    name : str
        Where it came from.
    sha256 : str
        Of its file.
    """

    calibration: Calibration
    name: str
    sha256: str


class Temperature(NamedTuple):
    """A channel's range over a capture, degrees Celsius."""

    channel: str
    least_degc: float
    most_degc: float


@dataclass(frozen=True)
class CaptureSummary:
    """A capture and what was in it.

    Attributes
    ----------
    label : str
        How its runs are called.
    name : str
        Of the file.
    sha256 : str
        Of the file.
    profile : str
        What the unit sent.
    books : str
        Where every sample went, in one line.
    temperatures : tuple of Temperature
        Of the channels that were heard.
    evidence : Evidence
        Rests, rotations, runs.
    channel : str or None
        The CAN channel that was chosen of a candump log.
    """

    label: str
    name: str
    sha256: str
    profile: str
    books: str
    temperatures: tuple[Temperature, ...]
    evidence: CaptureRuns
    channel: str | None = None


@dataclass(frozen=True)
class IdentificationResult:
    """What a session found.

    Attributes
    ----------
    result : Identification
        The estimate.
    basis : Basis
        The calibration that it continues.
    site : Site
        Where the unit stood.
    limits : Limits
        What a rotation had to keep.
    priors : Priors
        What was taken to be known before.
    sources : tuple of Source
        The captures.
    created : datetime
        When, UTC.
    software : str
        What computed it.
    """

    result: LeverArmEstimate
    basis: PriorCalibration
    site: Site
    limits: RotationLimits
    priors: Priors
    sources: tuple[CaptureSummary, ...]
    created: datetime
    software: str

    @property
    def arms(self) -> LeverArms:
        """The lever arms in the gauge of the estimate."""
        return LeverArms(self.result.R_b, self.result.covariance, self.result.gauge)

    @property
    def differences_correlation(self) -> Array:
        """Correlation of the six differences with the nuisances, shape (6, n)."""
        result = self.result
        covariance = TO_DIFFERENCES @ (result.sigma.reshape(9, 1) * result.correlation)
        correlation: Array = covariance / result.differences_sigma.reshape(6, 1)
        return correlation

    @property
    def runs(self) -> tuple[Run, ...]:
        """The runs, in the order of `result.runs`."""
        return tuple(run for source in self.sources for run in source.evidence.runs)


def scatter(run: RunResult) -> float:
    """Scatter of a run's residuals, rms about their mean, m/s.

    Their mean is that of the first velocity, which the pulses leave uncertain.
    """
    left = run.v_n - run.fitted_n
    return float(np.sqrt(np.mean((left - left.mean(axis=0)) ** 2)))


def identify_captures(
    captures: Sequence[Path],
    profile: Profile | None,
    basis: PriorCalibration,
    site: Site,
    *,
    method: Literal["joint", "plain"] = "joint",
    pivot: Literal["free", "fixed"] = "free",
    nine: bool = False,
    extra: Sequence[Extra] = (),
    channel: str | None = None,
    advance: Callable[[int], None] = lambda _: None,
) -> IdentificationResult:
    """Identify the inner lever arms from captures of one unit.

    Parameters
    ----------
    captures : sequence of Path
        Wire bytes, candump logs or recordings.
    profile : Profile or None
        What the unit sends; recordings know it.
    basis : Basis
        The unit's calibration; its size effect is not used.
    site : Site
        Where the unit stands.
    method, pivot, nine, extra
        See `calib.estimation.estimate_joint.estimate_joint`; `estimate_plain` knows no others.
    channel : str or None
        The CAN channel to read, of candump logs; needed where a log has several.
    advance : callable
        Told the number of bytes read, of twice their sum.

    Returns
    -------
    Findings

    Raises
    ------
    InputError
        A capture cannot be read or is given twice; no rotation serves, with the reasons; or what
        `estimate_joint` and `estimate_plain` refuse.
    """
    if method == "plain" and (pivot == "fixed" or nine or extra):
        raise InputError(
            "method plain: expected neither a known pivot, nor nine components, nor more unknowns: it solves "
            "V = H R and nothing else; use method joint"
        )
    limits, priors = RotationLimits(), Priors()
    sources: list[CaptureSummary] = []
    for path in captures:
        label = _label(path, [source.label for source in sources])
        source = _read(path, label, profile, channel, basis.calibration, site, limits, priors, advance)
        for other in sources:
            if other.sha256 == source.sha256:
                raise InputError(f"{path}: expected another capture, got that of {other.name} once more")
        sources.append(source)
    runs = [run for source in sources for run in source.evidence.runs]
    if not runs:
        raise InputError(
            "\n  ".join(["expected one usable rotation at least, got none:", *_rejections(sources)])
        )
    try:
        if method == "plain":
            result = estimate_plain(runs, priors)
        else:
            result = estimate_joint(runs, priors, pivot=pivot, nine=nine, extra=extra)
    except InputError as error:
        raise InputError("\n  ".join([str(error), *_rejections(sources)])) from None
    return IdentificationResult(
        result,
        basis,
        site,
        limits,
        priors,
        tuple(sources),
        datetime.now(UTC).replace(microsecond=0),
        f"imu50 {version('imu50')}",
    )


def _label(path: Path, taken: Sequence[str]) -> str:
    """The file's name without its suffix, with a number where that is taken."""
    label, n = path.stem, 1
    while label in taken:
        n += 1
        label = f"{path.stem}.{n}"
    return label


def _read(
    path: Path,
    label: str,
    profile: Profile | None,
    channel: str | None,
    calibration: Calibration,
    site: Site,
    limits: RotationLimits,
    priors: Priors,
    advance: Callable[[int], None],
) -> CaptureSummary:
    """Take a capture through both passes, with its books and temperatures."""
    known = replace(coefficients(calibration), r_b=None)
    capture = Capture(path, profile, channel)
    low, high = np.full(6, np.inf), np.full(6, -np.inf)

    def increments() -> Iterator[Records]:
        nonlocal capture
        capture = Capture(path, profile, channel)
        layout = capture.layout
        compensator = Compensator(known, layout, rate_filter("causal", layout.interval_ns))
        for pulses in capture.pulses(advance):
            if len(pulses):
                np.fmin(low, np.fmin.reduce(pulses["temperature_degc"], axis=0), out=low)
                np.fmax(high, np.fmax.reduce(pulses["temperature_degc"], axis=0), out=high)
            yield compensator.feed(pulses)
        yield compensator.close()

    try:
        with unchanged(path):  # two passes, and one for the hash
            evidence = navigate_rotations(
                increments, known.C_ba, site, label=label, limits=limits, priors=priors
            )
            digest = sha256(path)
    except InputError as error:
        raise error if str(path) in str(error) else InputError(f"{path}: {error}") from None
    names = capture.layout.temperature_names
    return CaptureSummary(
        label,
        path.name,
        digest,
        capture.layout.name,
        str(capture.tracker.counts),
        tuple(
            Temperature(name, float(least), float(most))
            for name, least, most in zip(names, low, high, strict=False)
            if least <= most
        ),
        evidence,
        channel,
    )


def _rejections(sources: Sequence[CaptureSummary]) -> list[str]:
    """Why motions did not serve, a line each; a line for a capture without any."""
    lines = []
    for source in sources:
        if not source.evidence.segments.rotations:
            seconds = source.evidence.segments.duration_s
            lines.append(f"{source.name}: {seconds:.1f} s at rest, no motion at all")
        lines += [
            f"{source.name}: motion at {rotation.start_s:.1f}..{rotation.stop_s:.1f} s: {'; '.join(reasons)}"
            for rotation, reasons in source.evidence.rejected
        ]
    return lines
