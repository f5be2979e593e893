"""Verdict of an identification: a mark and a message for each test, the overall mark first."""

from collections.abc import Iterator
from math import atan2, sqrt
from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np

from calib.estimation.result import CONTRADICTION_P, ChiSquare, LeverArmEstimate, dither_lines
from calib.identification import IdentificationResult
from calib.messages import Message, message
from calib.reports.document import sanitise
from imudrv.nav.alignment import RestMotion
from imudrv.units import DEG, MM

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
    """A mark, and a message with the reason."""

    level: Level
    text: Message


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


def _overall(result: LeverArmEstimate) -> Message:
    tested = []
    if result.scatter is not None:
        tested.append(message("scatter_at_rest", n=result.scatter.degrees_of_freedom))
    if result.redundancy.degrees_of_freedom:
        tested.append(message("agreement_of_rotations", n=result.redundancy.degrees_of_freedom))
    return message(
        "determined",
        parts=message("nine_components") if result.gauge == "given" else message("six_differences"),
        rotations=result.accepted,
        method=result.method,
        worst_mm=float(result.differences_sigma.max()) / MM,
        tested=tuple(tested) or message("nothing"),
    )


def _marks(identification: IdentificationResult) -> Iterator[Mark]:
    result = identification.result
    for fault in result.faults:
        yield Mark("bad", message("refused", why=fault))
    yield scatter_mark(result)
    yield redundancy_mark(result)
    if result.redundancy.degrees_of_freedom and result.leave_one_out:
        yield _turn_mark(result)
    for n in result.parameters:
        if n.name == "skew_s" and not n.observable:
            yield Mark("note", message("skew_unknown", prior_ms=n.prior * 1e3))
    yield from _pulled(identification)
    yield from _dither(result)
    yield from _site(identification)
    for k, run in enumerate(identification.runs):
        if run.aligned.motion is not None:
            yield Mark("caution", message("run_moved", run=k + 1, motion=rest_motion(run.aligned.motion)))
        for turn, label in zip(run.turns, run.turn_labels, strict=True):
            if not turn.accepted:
                yield Mark("note", message("turn_unused", turn=sanitise(label), reasons=tuple(turn.reasons)))
    for source in identification.sources:
        for restart_s in source.rotations.restarts_s:
            yield Mark("note", message("restarted", capture=sanitise(source.name), at_s=restart_s))
    for note in result.notes:
        yield Mark("caution", note)


def rest_motion(moved: RestMotion) -> Message:
    """Return when and how much a unit moved that should have been at rest."""
    return message("rest_motion", begin_s=moved.begin_s, end_s=moved.end_s, times=moved.rms / moved.limit)


def statistic(test: ChiSquare) -> Message:
    """Return a chi-square test as a message."""
    low, high = test.band
    return message(
        "chi_square", value=test.value, n=test.degrees_of_freedom, low=low, high=high, p=test.p_value
    )


def scatter_mark(result: LeverArmEstimate) -> Mark:
    """Return the mark of the scatter at rest."""
    test = result.scatter
    if test is None:
        return Mark("note", message("scatter_untested"))
    low, high = test.band
    if test.value > high:
        factor = sqrt(test.value / test.degrees_of_freedom)
        return Mark("caution", message("scatter_large", statistic=statistic(test), factor=factor))
    if test.value < low:
        return Mark("note", message("scatter_small", statistic=statistic(test)))
    return Mark("good", message("scatter_good", statistic=statistic(test)))


def redundancy_mark(result: LeverArmEstimate) -> Mark:
    """Return the mark of the agreement of the rotations."""
    test = result.redundancy
    if not test.degrees_of_freedom:
        return Mark("note", message("not_checked"))
    low, high = test.band
    if test.value > high:
        level: Level = "bad" if test.p_value < CONTRADICTION_P else "caution"
        return Mark(level, message("rotations_disagree", statistic=statistic(test)))
    if test.value < low:
        return Mark("note", message("rotations_agree_well", statistic=statistic(test)))
    return Mark("good", message("rotations_agree", statistic=statistic(test)))


def _turn_mark(result: LeverArmEstimate) -> Mark:
    """Return the mark of the rotation that deviates most from the others."""
    tested = [one for one in result.leave_one_out if one.test is not None]
    if not tested:
        return Mark("note", message("not_comparable"))
    worst = min(tested, key=lambda one: 1.0 if one.test is None else one.test.p_value)
    p = 1.0 if worst.test is None else worst.test.p_value
    shift, sigma = (
        np.abs(x).ravel() if x is not None else np.zeros(9) for x in (worst.shift_m, worst.sigma_m)
    )
    at = int(shift.argmax())
    text = message(
        "omitted",
        turn=sanitise(worst.label),
        shift_mm=float(shift[at]) / MM,
        sigma_mm=float(sigma[at]) / MM,
        p=p,
        rotations=len(tested),
    )
    return Mark("caution" if p < TURN_P / len(tested) else "good", text)


def _pulled(identification: IdentificationResult) -> Iterator[Mark]:
    """Yield which errors of the calibration are much larger than their prior uncertainty."""
    for n in identification.result.parameters:
        expected = identification.priors.expected_skew if n.name == "skew_s" else 0.0
        ratio = abs(n.value - expected) / n.prior
        if ratio > PRIOR_LIMIT:
            yield Mark("caution", message("calibration_worse", name=sanitise(n.name), ratio=ratio))


def _dither(result: LeverArmEstimate) -> Iterator[Mark]:
    """Yield what dither was found in the increments."""
    for run in result.runs:
        if run.lines:
            yield Mark(
                "note",
                message(
                    "dither_found",
                    run=sanitise(run.label),
                    lines=dither_lines(run),
                    filter=run.rate_filter,
                    error_sigma=result.dither_error,
                ),
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
                message(
                    "site_latitude",
                    run=sanitise(run.label),
                    found_deg=latitude / DEG,
                    site_deg=site.latitude_deg,
                ),
            )
        if abs(read.force - site.gravity) > GRAVITY_LIMIT:
            yield Mark(
                "caution",
                message(
                    "site_gravity", run=sanitise(run.label), found_m_s2=read.force, site_m_s2=site.gravity
                ),
            )
