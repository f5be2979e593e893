"""Verdict of an identification: a mark and a sentence for each test, the overall mark first."""

from collections.abc import Iterator
from math import atan2, sqrt
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np

from calib.estimation.result import CONTRADICTION_P, ChiSquare, LeverArmEstimate
from calib.identification import IdentificationResult
from calib.messages import english
from calib.reports.document import sanitise
from calib.reports.format import counted, mm
from imudrv.units import ARCSEC, DEG, MM

Level: TypeAlias = Literal["good", "note", "caution", "bad"]
LEVELS: Final[tuple[Level, ...]] = ("good", "note", "caution", "bad")
"""From the best to the worst."""

TURN_P: Final = 0.01
"""Probability, shared by all turns, below which a turn deviates from the others."""

PRIOR_LIMIT: Final = 3.0
"""Estimate of an error of the calibration, in its prior sigma, above which the prior is too narrow."""

LATITUDE_LIMIT: Final = 0.5 * DEG
"""Difference of the latitude that the Earth's rotation shows from the site's that is reported, rad."""

GRAVITY_LIMIT: Final = 250e-5
"""Difference of the mean specific force from the site's gravity that is reported, m/s^2: 250 mGal."""


class Mark(NamedTuple):
    """A mark, and a sentence with the reason."""

    level: Level
    text: str


def verdict(identification: IdentificationResult) -> tuple[Mark, ...]:
    """Evaluate an identification.

    Parameters
    ----------
    identification : IdentificationResult
        Result of the identification.

    Returns
    -------
    tuple of Mark
        The first one is the worst mark of all, and says what was determined and tested.
    """
    marks = tuple(_marks(identification))
    worst = max((mark.level for mark in marks), key=LEVELS.index)
    return (Mark(worst, _overall(identification.result)), *marks)


def _overall(result: LeverArmEstimate) -> str:
    largest = float(result.differences_sigma.max())
    what = "All nine components" if result.gauge == "given" else "The six differences"
    tested = []
    if result.scatter is not None:
        tested.append(f"the scatter at rest ({_freedom(result.scatter)})")
    if result.redundancy.degrees_of_freedom:
        tested.append(f"the agreement of the rotations ({_freedom(result.redundancy)})")
    return (
        f"{what} of the sensing points are determined by {counted(result.accepted, 'rotation')}, method "
        f"{result.method}; the largest standard uncertainty of a difference is {mm(largest, '.4f')} mm. "
        f"Tested: {' and '.join(tested) or 'nothing'}."
    )


def _marks(identification: IdentificationResult) -> Iterator[Mark]:
    result = identification.result
    for refusal in result.refusals:
        yield Mark("bad", f"{sanitise(refusal[0].upper() + refusal[1:])}. No certificate is made.")
    yield scatter_mark(result)
    yield redundancy_mark(result)
    if result.redundancy.degrees_of_freedom and result.leave_one_out:
        yield _turn_mark(result)
    for n in result.parameters:
        if n.name == "skew_s" and not n.observable:
            yield Mark(
                "note",
                "These rotations do not determine the gyro-accelerometer skew; the uncertainties include one "
                f"of {n.prior * 1e3:g} ms (1 sigma).",
            )
    yield from _pulled(identification)
    yield from _dither(result)
    yield from _site(identification)
    for k, run in enumerate(identification.runs):
        if run.aligned.motion is not None:
            yield Mark("caution", f"Run {k + 1} moved during its alignment: {sanitise(run.aligned.motion)}.")
        for turn, label in zip(run.turns, run.turn_labels, strict=True):
            if not turn.accepted:
                reasons = "; ".join(map(english, turn.reasons))
                yield Mark(
                    "note", f"Turn {sanitise(label)} is not used ({reasons}); the rests after it are used."
                )
    for source in identification.sources:
        for restart_s in source.rotations.restarts_s:
            yield Mark("note", f"The unit restarted in {sanitise(source.name)} at {restart_s:.1f} s.")
    for note in result.notes:
        yield Mark("caution", f"{sanitise(note)}.")


def statistic(test: ChiSquare) -> str:
    """Return a chi-square test as text."""
    low, high = test.band
    return (
        f"chi-square {test.value:.1f} with {_freedom(test)}, 95 % band {low:.1f} to {high:.1f}, "
        f"p = {test.p_value:.2g}"
    )


def _freedom(test: ChiSquare) -> str:
    return f"{counted(test.degrees_of_freedom, 'degree')} of freedom"


def scatter_mark(result: LeverArmEstimate) -> Mark:
    """Return the mark of the scatter at rest."""
    test = result.scatter
    if test is None:
        return Mark("note", "Scatter at rest: not tested on its own.")
    low, high = test.band
    if test.value > high:
        return Mark(
            "caution",
            f"Scatter at rest: larger than the noise of the alignments explains, {statistic(test)}. The "
            "uncertainties may be too small by a factor of "
            f"{sqrt(test.value / test.degrees_of_freedom):.2f}.",
        )
    if test.value < low:
        return Mark(
            "note",
            f"Scatter at rest: smaller than expected, {statistic(test)}. The uncertainties are conservative.",
        )
    return Mark(
        "good", f"Scatter at rest: as the noise makes it, {statistic(test)}. It does not test the arms."
    )


def redundancy_mark(result: LeverArmEstimate) -> Mark:
    """Return the mark of the agreement of the rotations."""
    test = result.redundancy
    if not test.degrees_of_freedom:
        return Mark(
            "note",
            "Redundancy: none. Arms determined, not checked: no redundant rotation. A second set of "
            "rotations in the opposite direction checks them.",
        )
    low, high = test.band
    if test.value > high:
        level: Level = "bad" if test.p_value < CONTRADICTION_P else "caution"
        return Mark(level, f"Redundancy: the rotations disagree on the arms, {statistic(test)}.")
    if test.value < low:
        return Mark("note", f"Redundancy: the rotations agree better than expected, {statistic(test)}.")
    return Mark("good", f"Redundancy: the rotations agree on the arms, {statistic(test)}.")


def _turn_mark(result: LeverArmEstimate) -> Mark:
    """Return the mark of the rotation that deviates most from the others."""
    tested = [one for one in result.leave_one_out if one.test is not None]
    if not tested:
        return Mark(
            "note", "No rotation can be compared with the others: without it they do not determine the arms."
        )
    worst = min(tested, key=lambda one: 1.0 if one.test is None else one.test.p_value)
    p = 1.0 if worst.test is None else worst.test.p_value
    shift, sigma = (
        np.abs(x).ravel() if x is not None else np.zeros(9) for x in (worst.shift_m, worst.sigma_m)
    )
    at = int(shift.argmax())
    text = (
        f"Omitting the rotation {sanitise(worst.label)}, which fits worst, changes a component by "
        f"{mm(float(shift[at]), '.4f')} mm, standard uncertainty of that {sigma[at] / MM:.4f} mm; "
        f"p = {p:.2g} for one of {counted(len(tested), 'rotation')}."
    )
    return Mark("caution" if p < TURN_P / len(tested) else "good", text)


def _pulled(identification: IdentificationResult) -> Iterator[Mark]:
    """Yield which errors of the calibration are much larger than their prior uncertainty."""
    for n in identification.result.parameters:
        expected = identification.priors.expected_skew if n.name == "skew_s" else 0.0
        if abs(n.value - expected) > PRIOR_LIMIT * n.prior:
            yield Mark(
                "caution",
                f"The error {sanitise(n.name)} is {abs(n.value - expected) / n.prior:.1f} times its prior "
                "uncertainty; the calibration is worse than assumed: give its accuracy (--prior-sigma, "
                "--skew-sigma-ms).",
            )


def _dither(result: LeverArmEstimate) -> Iterator[Mark]:
    """Yield what dither was found in the increments."""
    for run in result.runs:
        if run.lines:
            lines = ", ".join(
                f"{line.amplitude_rad / ARCSEC:.3g} arcsec at {line.frequency_hz:.0f} Hz about {line.axis}"
                for line in run.lines
            )
            yield Mark(
                "note",
                f"The gyro increments of run {sanitise(run.label)} carry dither: {lines}. H uses the rate "
                f"filter {run.rate_filter}, which leaves an error of {result.dither_error:.2g} sigma.",
            )


def _site(identification: IdentificationResult) -> Iterator[Mark]:
    """Yield where the alignments contradict the site."""
    site = identification.site
    for run in identification.runs:
        read = run.site_readings
        latitude = atan2(read.rate_up, read.rate_level)
        if abs(latitude - site.latitude_rad) > LATITUDE_LIMIT:
            yield Mark(
                "caution",
                f"Run {sanitise(run.label)}: the Earth's rotation is that of latitude "
                f"{latitude / DEG:.2f} deg, the site's is {site.latitude_deg:.2f} deg; check the site and "
                "the gyro biases.",
            )
        if abs(read.force - site.gravity) > GRAVITY_LIMIT:
            yield Mark(
                "caution",
                f"Run {sanitise(run.label)}: the mean specific force is {read.force:.5f} m/s^2, gravity at "
                f"the site {site.gravity:.5f} m/s^2; check the site and the accelerometers' scale factors.",
            )
