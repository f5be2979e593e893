"""Results of the accepted recordings: lever arms, and the residual velocity after a rotation.

Both are computed from the wire bytes of the recordings, cut to the samples on which the engine accepted the
attempt.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.bench.entries import ResidualVelocity
from calib.bench.state import Attempt, SessionState
from calib.certificate import certificate
from calib.detection.blocks import BLOCK_NS
from calib.estimation.joint import estimate_joint
from calib.estimation.runs import CaptureRuns, NavigationOptions, Priors, Run, navigate_rotations
from calib.identification import (
    CaptureSummary,
    IdentificationResult,
    PriorCalibration,
    Temperature,
    software,
)
from calib.procedure.schema import VERIFICATION, Procedure
from imudrv.calibration import Calibration, coefficients
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.sequence import SampleCounts, SequenceTracker
from imudrv.recording.reader import Recording
from imudrv.records import Records
from imudrv.site import Site
from imudrv.units import NS
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.layout import Layout

RESIDUAL_WINDOW_S: Final = 0.5
"""Averaging window for the velocity before and after a rotation, s."""


_PUBLISHED_PERIOD: Final = 1 << 32
"""Period of the counter of published increments."""


_READS_PER_PIECE: Final = 1000
"""Reads of the port that are decoded together; a live read brings one sample."""


class Result(NamedTuple):
    """Result of the accepted recordings.

    Attributes
    ----------
    findings : IdentificationResult
        The identification.
    certificate : Calibration
        The unit's new certificate.
    """

    findings: IdentificationResult
    certificate: Calibration


class _DecodedRecording(NamedTuple):
    """Decoded evidence of an attempt.

    Attributes
    ----------
    pulses : Records
        Samples of the evidence.
    counter : ndarray of int64
        Their counters, in the service's count.
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
    procedure: Procedure, attempts: Sequence[Attempt], basis: PriorCalibration, site: Site
) -> Result:
    """Identify the lever arms.

    Parameters
    ----------
    procedure : Procedure
        The procedure that was carried out.
    attempts : sequence of Attempt
        The accepted attempts.
    basis : PriorCalibration
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
    priors = Priors()
    known = replace(coefficients(basis.calibration), r_b=None)
    sources = tuple(_summarise(procedure, attempt, known, site, priors) for attempt in attempts)
    findings = IdentificationResult(
        estimate_joint([run for source in sources for run in source.evidence.runs], priors),
        basis,
        site,
        procedure.rotation_limits(procedure.steps[0]),
        priors,
        sources,
        datetime.now(UTC).replace(microsecond=0),
        software(),
    )
    return Result(findings, certificate(findings, findings.arms))


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


def require_covered(attempt: Attempt) -> None:
    """Refuse an attempt whose recording lacks samples.

    Parameters
    ----------
    attempt : Attempt
        An accepted attempt.

    Raises
    ------
    InputError
        Samples are missing, or the recording cannot be read; the message says which and what to do.
    """
    _decode_covered(attempt)


def residual_velocity(
    procedure: Procedure, attempt: Attempt, calibration: Calibration, site: Site
) -> ResidualVelocity:
    """Return the residual velocity after a rotation, without and with compensation.

    Parameters
    ----------
    procedure : Procedure
        Procedure with the attempt's step.
    attempt : Attempt
        An accepted attempt.
    calibration : Calibration
        Certificate with its size effect.
    site : Site
        Site of the bench.

    Returns
    -------
    ResidualVelocity

    Raises
    ------
    InputError
        The recording cannot be read or lacks its rotation.
    """
    known, decoded = coefficients(calibration), _decode_covered(attempt)
    rows = round(RESIDUAL_WINDOW_S / (BLOCK_NS * NS))
    residual = []
    for c in (replace(known, r_b=None), known):
        run = _navigate(procedure, attempt, decoded, c, site, Priors()).runs[0]
        gained = _mean(run, run.after, slice(rows)) - _mean(run, run.before, slice(-rows, None))
        residual.append(float(np.hypot(gained[0], gained[1])))
    return ResidualVelocity(*residual)


def _mean(run: Run, rest: np.ndarray, rows: slice) -> np.ndarray:
    mean: np.ndarray = run.v_n[rest][rows].mean(axis=0)
    return mean


def _summarise(
    procedure: Procedure, attempt: Attempt, known: Coefficients, site: Site, priors: Priors
) -> CaptureSummary:
    with atomic.unchanged(attempt.recording):
        decoded = _decode_covered(attempt)
        digest = atomic.sha256(attempt.recording)
    degc = decoded.pulses["temperature_degc"]
    return CaptureSummary(
        attempt.recording.stem,
        attempt.recording.name,
        digest,
        decoded.layout.name,
        str(decoded.counts),
        tuple(
            Temperature(name, float(t.min()), float(t.max()))
            for name, column in zip(decoded.layout.temperature_names, degc.T, strict=False)
            if (t := column[~np.isnan(column)]).size
        ),
        _navigate(procedure, attempt, decoded, known, site, priors),
    )


def _navigate(
    procedure: Procedure,
    attempt: Attempt,
    decoded: _DecodedRecording,
    known: Coefficients,
    site: Site,
    priors: Priors,
) -> CaptureRuns:
    layout = decoded.layout
    compensator = Compensator(known, layout)
    increments = [compensator.feed(decoded.pulses), compensator.close()]
    evidence = navigate_rotations(
        lambda: increments,
        known.C_ba,
        site,
        attempt.recording.stem,
        NavigationOptions(procedure.rotation_limits(attempt.step), priors, expected=attempt.step.up[1]),
    )
    if len(evidence.runs) != 1:
        reasons = "; ".join(reason for _, reasons in evidence.rejected for reason in reasons) or "no motion"
        raise InputError(
            f"{attempt.recording}: expected the one rotation that was accepted, got {len(evidence.runs)}: "
            f"{reasons}"
        )
    return evidence


def _decode_covered(attempt: Attempt) -> _DecodedRecording:
    """Decode a recording and cut it to the evidence, which must be complete."""
    decoded = _decode(attempt)
    if lacks := _missing(attempt, decoded):
        step, folder = attempt.step.id, attempt.recording.parent
        raise InputError(
            f"{attempt.recording}: step {step}: {lacks}; do this step again: "
            f"calib run --session {folder} --redo {step}"
        )
    return decoded


def _decode(attempt: Attempt) -> _DecodedRecording:
    """Decode a recording and cut it to the evidence that it contains."""
    recording = Recording(attempt.recording)
    layout = recording.profile.layout()
    decoder, tracker = FrameDecoder(layout), SequenceTracker(layout)
    pulses = [tracker.feed(decoder.feed(data)) for data in _wire(recording)]
    pulses.append(tracker.feed(decoder.close()))
    samples = np.concatenate(pulses)
    counter = samples["counter"]
    backward = np.flatnonzero(np.diff(counter) <= 0)  # the unit restarted before the evidence
    begin = int(backward[-1]) + 1 if len(backward) else 0
    counter = counter[begin:]
    if len(counter) and not begin:  # at a restart the service, too, begins with the unit's own number
        counter = counter + _offset(recording, attempt, int(counter[0]), 1 << layout.counter_bits)
    first, stop = np.searchsorted(counter, [attempt.first_counter, attempt.last_counter + 1])
    return _DecodedRecording(
        samples[begin + first : begin + stop], counter[first:stop], layout, tracker.counts
    )


def _offset(recording: Recording, attempt: Attempt, first: int, period: int) -> int:
    """Return the service's count minus the unit's counter, which may have wrapped before the recording."""
    published = next((int(increments["counter"][0]) for increments in recording.increments()), first)
    published += _multiple(attempt.last_counter - published, _PUBLISHED_PERIOD)
    return _multiple(published - first, period)


def _multiple(difference: int, period: int) -> int:
    """Return the multiple of the period that is nearest to a difference."""
    return (2 * difference + period) // (2 * period) * period


def _missing(attempt: Attempt, decoded: _DecodedRecording) -> str:
    """Describe the longest gap in the evidence, unless the line lost these samples.

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


def _wire(recording: Recording) -> Iterator[bytes | Records]:
    """Yield the wire data of a recording in pieces of many reads."""
    arrivals = (arrival.data for arrival in recording.arrivals())
    while pieces := list(islice(arrivals, _READS_PER_PIECE)):
        yield np.concatenate(pieces) if isinstance(pieces[0], np.ndarray) else b"".join(pieces)  # type: ignore[arg-type]
