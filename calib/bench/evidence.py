"""What the accepted recordings give: the lever arms, and the velocity that a rotation leaves.

All is made again from the wire bytes of the recordings, cut to the samples that the engine's verdict rests
on.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
from calib.procedure.schema import Procedure, Step
from imudrv.calibration import Calibration, coefficients
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import rate_filter
from imudrv.imu.sequence import SampleCounts, SequenceTracker
from imudrv.recording.reader import Recording
from imudrv.records import Records
from imudrv.site import Site
from imudrv.units import MM, NS
from imudrv.wire.decoder import FrameDecoder
from imudrv.wire.layout import Layout

LEFT_S: Final = 0.5
"""Velocity left by a rotation is the mean over so long after it, less that before it."""


_PUBLISHED_PERIOD: Final = 1 << 32
"""Of the counter of published increments."""


_AT_ONCE: Final = 1000
"""Reads of the port that are decoded together: live each brings one sample."""


class Attempt(NamedTuple):
    """An accepted attempt at a step.

    Attributes
    ----------
    step : Step
        What was done.
    recording : Path
        Its recording.
    first_counter, last_counter : int
        Samples that the verdict rests on, both included, as the service counted them.
    samples : int or None
        How many there were; None: not known, as in sessions of an older version.
    """

    step: Step
    recording: Path
    first_counter: int
    last_counter: int
    samples: int | None = None


class Result(NamedTuple):
    """What the accepted recordings give.

    Attributes
    ----------
    findings : Findings
        The identification.
    certificate : Calibration
        The unit's new one.
    """

    findings: IdentificationResult
    certificate: Calibration


class ResidualVelocity(NamedTuple):
    """Horizontal velocity that a rotation left, m/s.

    Attributes
    ----------
    without, compensated : float
        With the size effect in, and with it compensated.
    """

    without: float
    compensated: float

    def __str__(self) -> str:
        """For people."""
        return (
            f"half a turn leaves {self.without / MM:.1f} mm/s with the size effect in, "
            f"{self.compensated / MM:.1f} mm/s with it compensated"
        )


class _DecodedRecording(NamedTuple):
    """What a recording holds of an attempt."""

    pulses: Records  # of the evidence
    counter: NDArray[np.int64]  # of the pulses, as the service counted them
    layout: Layout
    counts: SampleCounts  # of the whole recording


def identify(
    procedure: Procedure, attempts: Sequence[Attempt], basis: PriorCalibration, site: Site
) -> Result:
    """Find the lever arms.

    Parameters
    ----------
    procedure : Procedure
        That was carried out.
    attempts : sequence of Attempt
        The accepted ones.
    basis : Basis
        The certificate before; its size effect is not used.
    site : Site
        Where the unit stood.

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
    sources = tuple(_source(procedure, attempt, known, site, priors) for attempt in attempts)
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
    """Say which samples of an attempt its recording lacks.

    Parameters
    ----------
    attempt : Attempt
        Its recording is closed.

    Returns
    -------
    str
        In plain words, with the counters; empty: all are there.

    Raises
    ------
    InputError
        The recording cannot be read.
    """
    return _lacks(attempt, _decoded(attempt))


def require_covered(attempt: Attempt) -> None:
    """Refuse an attempt of which the recording lacks samples.

    Parameters
    ----------
    attempt : Attempt
        An accepted one.

    Raises
    ------
    InputError
        It lacks some, or cannot be read; says which and what to do.
    """
    _hear(attempt)


def residual_velocity(
    procedure: Procedure, attempt: Attempt, calibration: Calibration, site: Site
) -> ResidualVelocity:
    """Tell what compensation does for a rotation.

    Parameters
    ----------
    procedure : Procedure
        With the attempt's step.
    attempt : Attempt
        An accepted one.
    calibration : Calibration
        With its size effect.
    site : Site
        Where the unit stands.

    Returns
    -------
    Left

    Raises
    ------
    InputError
        The recording cannot be read or lacks its rotation.
    """
    known, heard = coefficients(calibration), _hear(attempt)
    rows = round(LEFT_S / (BLOCK_NS * NS))
    left = []
    for c in (replace(known, r_b=None), known):
        run = _collected(procedure, attempt, heard, c, site, Priors()).runs[0]
        gained = _mean(run, run.after, slice(rows)) - _mean(run, run.before, slice(-rows, None))
        left.append(float(np.hypot(gained[0], gained[1])))
    return ResidualVelocity(*left)


def _mean(run: Run, rest: np.ndarray, rows: slice) -> np.ndarray:
    mean: np.ndarray = run.v_n[rest][rows].mean(axis=0)
    return mean


def _source(
    procedure: Procedure, attempt: Attempt, known: Coefficients, site: Site, priors: Priors
) -> CaptureSummary:
    with atomic.unchanged(attempt.recording):
        heard = _hear(attempt)
        digest = atomic.sha256(attempt.recording)
    degc = heard.pulses["temperature_degc"]
    return CaptureSummary(
        attempt.recording.stem,
        attempt.recording.name,
        digest,
        heard.layout.name,
        str(heard.counts),
        tuple(
            Temperature(name, float(t.min()), float(t.max()))
            for name, column in zip(heard.layout.temperature_names, degc.T, strict=False)
            if (t := column[~np.isnan(column)]).size
        ),
        _collected(procedure, attempt, heard, known, site, priors),
    )


def _collected(
    procedure: Procedure,
    attempt: Attempt,
    heard: _DecodedRecording,
    known: Coefficients,
    site: Site,
    priors: Priors,
) -> CaptureRuns:
    layout = heard.layout
    compensator = Compensator(known, layout, rate_filter("causal", layout.interval_ns))
    increments = [compensator.feed(heard.pulses), compensator.close()]
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


def _hear(attempt: Attempt) -> _DecodedRecording:
    """Decode a recording and cut it to the evidence, all of which has to be there."""
    heard = _decoded(attempt)
    if lacks := _lacks(attempt, heard):
        step, folder = attempt.step.id, attempt.recording.parent
        raise InputError(
            f"{attempt.recording}: step {step}: {lacks}; do this step again: "
            f"calib run --session {folder} --redo {step}"
        )
    return heard


def _decoded(attempt: Attempt) -> _DecodedRecording:
    """Decode a recording and cut it to what there is of the evidence."""
    recording = Recording(attempt.recording)
    layout = recording.profile.layout()
    decoder, tracker = FrameDecoder(layout), SequenceTracker(layout)
    pulses = [tracker.feed(decoder.feed(data)) for data in _wire(recording)]
    pulses.append(tracker.feed(decoder.close()))
    heard = np.concatenate(pulses)
    counter = heard["counter"]
    backward = np.flatnonzero(np.diff(counter) <= 0)  # the unit restarted before the evidence
    begin = int(backward[-1]) + 1 if len(backward) else 0
    counter = counter[begin:]
    if len(counter) and not begin:  # at a restart the service, too, begins with the unit's own number
        counter = counter + _offset(recording, attempt, int(counter[0]), 1 << layout.counter_bits)
    first, stop = np.searchsorted(counter, [attempt.first_counter, attempt.last_counter + 1])
    return _DecodedRecording(heard[begin + first : begin + stop], counter[first:stop], layout, tracker.counts)


def _offset(recording: Recording, attempt: Attempt, first: int, period: int) -> int:
    """What to add to the unit's counter, which may have wrapped before the recording, for the service's."""
    published = next((int(increments["counter"][0]) for increments in recording.increments()), first)
    published += _multiple(attempt.last_counter - published, _PUBLISHED_PERIOD)
    return _multiple(published - first, period)


def _multiple(difference: int, period: int) -> int:
    """Multiple of the period that is nearest to a difference."""
    return (2 * difference + period) // (2 * period) * period


def _lacks(attempt: Attempt, heard: _DecodedRecording) -> str:
    """Name the longest gap in the evidence, unless the line lost these samples.

    Where their number is not known, gaps of up to a block of 20 ms are taken for losses of the line: the
    engine accepts no longer ones.
    """
    edges = np.concatenate([[attempt.first_counter - 1], heard.counter, [attempt.last_counter + 1]])
    gaps = np.diff(edges) - 1
    longest = int(gaps.argmax())
    if attempt.samples is None:
        is_whole = gaps[longest] <= BLOCK_NS // heard.layout.interval_ns
    else:
        is_whole = len(heard.counter) == attempt.samples
    if is_whole:
        return ""
    return f"its recording does not cover counters {edges[longest] + 1}..{edges[longest + 1] - 1}"


def _wire(recording: Recording) -> Iterator[bytes | Records]:
    """The wire of a recording in larger pieces."""
    arrivals = (arrival.data for arrival in recording.arrivals())
    while pieces := list(islice(arrivals, _AT_ONCE)):
        yield np.concatenate(pieces) if isinstance(pieces[0], np.ndarray) else b"".join(pieces)  # type: ignore[arg-type]
