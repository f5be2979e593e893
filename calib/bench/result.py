"""Results of accepted runs: lever arms, and the residual velocity after a rotation.

Both are computed from the wire bytes of the recordings, cut to the samples on which the engine accepted the
attempt.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.bench.entries import AcceptedRest, ResidualVelocity
from calib.bench.state import Attempt, SessionState
from calib.certificate import certificate
from calib.detection.blocks import BLOCK_NS
from calib.detection.sections import split_at_restarts
from calib.estimation.gains import velocity_gain
from calib.estimation.joint import estimate_joint
from calib.estimation.priors import certified_priors
from calib.estimation.runs import CaptureRuns, NavigationOptions, navigate_capture
from calib.identification import (
    CaptureSummary,
    IdentificationResult,
    PriorCalibration,
    temperature_ranges,
)
from calib.messages import Message, english, text
from calib.procedure.plan import verification
from calib.procedure.schema import VERIFICATION, Procedure
from calib.reports.identification import arms_text
from calib.reports.verdict import verdict
from imudrv.calibration import Calibration, coefficients
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.imu.compensation import Compensator
from imudrv.imu.sequence import SampleCounts, SequenceTracker
from imudrv.recording.reader import Recording
from imudrv.records import Records
from imudrv.site import Site
from imudrv.units import MM
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.layout import Layout, SequenceKind

_PUBLISHED_PERIOD: Final = 1 << 32
"""Period of the counter of published increments."""


_LATER: Final = 1000
"""Samples by which the first one of a recording that can be decoded may follow the first one published."""
_ROUNDING: Final = 1e-5
"""Relative: intervals of a sample rate that is a ratio differ by 1 ns of 100 us or more."""


class Result(NamedTuple):
    """Result of the accepted runs, see `calib.bench.kinds.SessionResult`.

    Attributes
    ----------
    identification : IdentificationResult
        The identification.
    certificate : Calibration
        The unit's new certificate.
    """

    identification: IdentificationResult
    certificate: Calibration

    @property
    def verdicts(self) -> tuple[tuple[str, Message], ...]:
        """Marks and reasons."""
        return tuple(verdict(self.identification))

    def text(self, language: str) -> str:
        """Return what the operator needs for the decision."""
        return arms_text(self.identification.arms, partial(text, language=language))

    @property
    def page(self) -> dict[str, Any]:
        """The same for the page: a table, and the three points."""
        arms = self.identification.arms
        rows: list[list[str]] = [["", "X", "Y", "Z"]]
        for axis, r in zip("xyz", (arms.r_b / MM).tolist(), strict=True):
            rows.append([f"r_{axis}", *(f"{value:+.3f}" for value in r)])
        if arms.covariance is not None:
            sigma_mm = np.sqrt(np.diag(arms.covariance)).reshape(3, 3) / MM
            rows[0] += ["u(X)", "u(Y)", "u(Z)"]
            for row, u in zip(rows[1:], sigma_mm.tolist(), strict=True):
                row += [f"{value:.3f}" for value in u]
        return {"table": rows, "gauge": arms.gauge, "r_mm": (arms.r_b / MM).tolist()}


class DecodedRecording(NamedTuple):
    """Decoded samples of an attempt.

    Attributes
    ----------
    pulses : Records
        Pulses.
    counter : ndarray of int64
        Their numbers in the service's count, which is that of the engine's events.
    layout : Layout
        Of the recording.
    counts : SampleCounts
        Loss summary of the whole recording.
    """

    pulses: Records
    counter: NDArray[np.int64]
    layout: Layout
    counts: SampleCounts


def identify_session(session: SessionState) -> Result:
    """Identify the lever arms from the accepted steps of a session; see `identify`."""
    procedure = session.procedure()
    attempts = session.attempts()
    attempts.pop(VERIFICATION, None)
    return identify(procedure, list(attempts.values()), session.initial_calibration(), session.site())


def identify(
    procedure: Procedure, attempts: Sequence[Attempt], prior_calibration: PriorCalibration, site: Site
) -> Result:
    """Identify the lever arms.

    Parameters
    ----------
    procedure : Procedure
        The procedure that was carried out.
    attempts : sequence of Attempt
        The accepted attempts.
    prior_calibration : PriorCalibration
        The certificate before; its size effect is not used.
    site : Site
        Site of the bench.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        A recording cannot be read or lacks its rotation, or `estimate_joint` refuses.
    """
    priors = certified_priors(prior_calibration.calibration)
    bare = prior_calibration.calibration.without_size_effect().without_skew()
    sources = tuple(_summarise(procedure, attempt, bare, site) for attempt in attempts)
    result = estimate_joint([run for source in sources for run in source.rotations.runs], priors)
    limits = procedure.rotation_limits(procedure.runs[0])
    identification = IdentificationResult(result, prior_calibration, site, limits, priors, sources)
    return Result(identification, certificate(identification, identification.arms))


def uncovered(attempt: Attempt) -> str:
    """Describe the samples of an attempt that its recording lacks.

    Parameters
    ----------
    attempt : Attempt
        An attempt whose recording is closed.

    Returns
    -------
    str
        Phrase with the counters; empty if the recording is complete.

    Raises
    ------
    InputError
        The recording cannot be read.
    """
    return _missing(attempt, _decode(attempt))


def uncovered_rests(path: Path, rests: Sequence[AcceptedRest]) -> dict[str, str]:
    """Describe the samples of rests that their recording lacks.

    Parameters
    ----------
    path : Path
        A recording that is closed, or was cut; read once, in a memory that does not depend on its length.
    rests : sequence of AcceptedRest
        Rests accepted while it was written.

    Returns
    -------
    dict of str to str
        Phrases with the counters by step id, of the rests that are not complete in it. Of a unit that does
        not number its samples only their number is known.

    Raises
    ------
    InputError
        The recording cannot be read.
    """
    recording = Recording(path)
    layout = recording.profile.layout()
    is_counted = layout.sequence.kind is SequenceKind.COUNTER
    decoder, tracker = FrameDecoder(layout), SequenceTracker(layout)
    pieces = (
        tracker.feed(decoder.feed_reads(reads.data, reads.ends, reads.times)) for reads in recording.reads()
    )
    total, offset = 0, 0
    covered: dict[int, list[int]] = {}  # samples of each rest between two restarts
    for section, part in split_at_restarts(pieces, layout.counter_step):
        total += len(part)
        if section not in covered:
            covered[section] = [0] * len(rests)
            # at a restart the service, too, begins with the unit's own number
            begins = is_counted and not section
            offset = (
                _offset(recording, rests[-1].last_counter, int(part["counter"][0]), layout) if begins else 0
            )
        number = (part["counter"] + offset) // layout.counter_step
        for k, rest in enumerate(rests):
            first, stop = np.searchsorted(number, [rest.first_counter, rest.last_counter + 1])
            covered[section][k] += int(stop - first)
    found = [max(samples, default=0) for samples in zip(*covered.values(), strict=True)] or [0] * len(rests)
    if not is_counted:
        before = 0
        for k, rest in enumerate(rests):
            before += rest.samples
            found[k] = rest.samples if total >= before else 0
    return {
        rest.step_id: f"its recording does not cover counters {rest.first_counter}..{rest.last_counter}"
        for rest, samples in zip(rests, found, strict=True)
        if samples < rest.samples
    }


def residual_velocity(session: SessionState, calibration: Calibration) -> ResidualVelocity:
    """Return the velocity after the verification rotation, without and with compensation.

    Parameters
    ----------
    session : SessionState
        A session whose verification is accepted.
    calibration : Calibration
        Certificate with its size effect.

    Returns
    -------
    ResidualVelocity

    Raises
    ------
    InputError
        The recording cannot be read or lacks its rotation.
    """
    procedure, attempt = verification(session.procedure()), session.attempts()[VERIFICATION]
    decoded = decode_covered(attempt)
    residual = []
    for used in (calibration.without_size_effect(), calibration):
        run = _navigate(procedure, attempt, decoded, used, session.site()).runs[0]
        V, _ = velocity_gain(run)
        residual.append(float(np.hypot(V[0], V[1])))
    return ResidualVelocity(*residual)


def _summarise(
    procedure: Procedure, attempt: Attempt, calibration: Calibration, site: Site
) -> CaptureSummary:
    with atomic.unchanged(attempt.recording):
        decoded = decode_covered(attempt)
        digest = atomic.sha256(attempt.recording)
    layout, degc = decoded.layout, decoded.pulses["temperature_degc"]
    return CaptureSummary(
        attempt.recording.stem,
        attempt.recording.name,
        digest,
        layout.name,
        decoded.counts,
        temperature_ranges(layout.temperature_names, np.fmin.reduce(degc), np.fmax.reduce(degc)),
        _navigate(procedure, attempt, decoded, calibration, site),
    )


def _navigate(
    procedure: Procedure,
    attempt: Attempt,
    decoded: DecodedRecording,
    calibration: Calibration,
    site: Site,
) -> CaptureRuns:
    limits = procedure.rotation_limits(attempt.step)
    navigated = navigate_capture(
        lambda: [decoded.pulses],
        decoded.layout,
        calibration,
        site,
        attempt.step.id,
        NavigationOptions(limits, expected=attempt.step.up[1]),
    )
    if len(navigated.runs) != 1:
        reasons = "; ".join(english(reason) for _, reasons in navigated.rejected for reason in reasons)
        raise InputError(
            f"{attempt.recording}: expected the one run that was accepted, got {len(navigated.runs)}: "
            f"{reasons or 'no motion'}"
        )
    return navigated


def decode_covered(attempt: Attempt) -> DecodedRecording:
    """Decode a recording and cut it to the samples of the attempt.

    Raises
    ------
    InputError
        Samples are missing, or the recording cannot be read; the message says which and what to do.
    """
    decoded = _decode(attempt)
    if lacks := _missing(attempt, decoded):
        step, folder = attempt.step.id, attempt.recording.parent
        raise InputError(
            f"{attempt.recording}: step {step}: {lacks}; do this step again: "
            f"calib run --session {folder} --redo {step}"
        )
    return decoded


def _decode(attempt: Attempt) -> DecodedRecording:
    """Decode a recording and cut it to those samples of the attempt that it contains."""
    recording = Recording(attempt.recording)
    layout = recording.profile.layout()
    decoder, tracker = FrameDecoder(layout), SequenceTracker(layout)
    pulses = [
        tracker.feed(decoder.feed_reads(reads.data, reads.ends, reads.times)) for reads in recording.reads()
    ]
    pulses.append(tracker.feed(decoder.close()))
    samples = np.concatenate(pulses)
    if layout.sequence.kind is SequenceKind.COUNTER:
        begin, number = _by_counter(recording, attempt, samples["counter"], layout)
    else:
        begin, number = 0, _by_increments(recording, attempt, samples, layout)
    first, stop = np.searchsorted(number, [attempt.first_counter, attempt.last_counter + 1])
    return DecodedRecording(samples[begin + first : begin + stop], number[first:stop], layout, tracker.counts)


def _by_counter(
    recording: Recording, attempt: Attempt, counter: NDArray[np.int64], layout: Layout
) -> tuple[int, NDArray[np.int64]]:
    """Return the first sample after the last restart of the unit, and the service's numbers from there on."""
    step = layout.counter_step
    backward = np.flatnonzero(np.diff(counter) <= 0)  # the unit restarted before the attempt
    begin = int(backward[-1]) + 1 if len(backward) else 0
    counter = counter[begin:]
    if len(counter) and not begin:  # at a restart the service, too, begins with the unit's own number
        counter = counter + _offset(recording, attempt.last_counter, int(counter[0]), layout)
    return begin, counter // step


def _offset(recording: Recording, last: int, first: int, layout: Layout) -> int:
    """Return what to add to the unit's counter, of which `first` is the first; `last` is in the service's."""
    step = layout.counter_step
    published = next((int(rows["counter"][0]) for rows in recording.increments()), first // step)
    published += _multiple(last - published, _PUBLISHED_PERIOD)
    # The counter may have wrapped before the recording.
    return _multiple(step * published - first, 1 << layout.sequence.bits)


def _by_increments(
    recording: Recording, attempt: Attempt, samples: Records, layout: Layout
) -> NDArray[np.int64]:
    """Return the service's numbers of samples that the unit does not number: those of equal increments."""
    published, calibration = list(recording.increments()), recording.calibration
    if not len(samples) or not published or calibration is None:
        return np.zeros(0, np.int64)
    theirs = np.concatenate(published)
    compensator = Compensator(coefficients(calibration), layout)
    own = np.concatenate([compensator.feed(samples), compensator.close()])
    for later in range(min(_LATER, len(theirs))):
        n = min(len(own), len(theirs) - later)
        rows = theirs[later : later + n]
        if all(np.allclose(own[name][:n], rows[name], _ROUNDING, 0.0) for name in ("dtheta_b", "dv_b")):
            number = rows["counter"]
            return number + _multiple(attempt.last_counter - int(number[-1]), _PUBLISHED_PERIOD)
    return np.zeros(0, np.int64)


def _multiple(difference: int, period: int) -> int:
    """Return the multiple of the period that is nearest to a difference."""
    return (2 * difference + period) // (2 * period) * period


def _missing(attempt: Attempt, decoded: DecodedRecording) -> str:
    """Describe the longest gap in the attempt, unless the line lost these samples.

    If the number of samples is unknown, gaps of up to a block of 20 ms are attributed to the line: the engine
    accepts no longer ones.
    """
    edges = np.concatenate([[attempt.first_counter - 1], decoded.counter, [attempt.last_counter + 1]])
    gaps = np.diff(edges) - 1
    longest = int(gaps.argmax())
    if attempt.samples is None:
        is_whole = gaps[longest] <= BLOCK_NS // decoded.layout.interval_ns
    else:
        is_whole = len(decoded.counter) == attempt.samples
    if is_whole:
        return ""
    return f"its recording does not cover counters {edges[longest] + 1}..{edges[longest + 1] - 1}"
