"""Align and navigate each run: velocity and its measurement matrices.

A run is one or more turns after one alignment. It is aligned on the rest before its first turn, except the
last seconds of that rest, then navigated from zero velocity through the end of that rest and through all
turns with the rests between and after them: arrest 0 is the rest before the first turn, arrest k the one
after turn k. The dither of the gyro blocks is filtered from the angle increments. A capture is read twice:
the first pass finds the segments, the second aligns and navigates, so that memory holds one chunk and the
rows kept.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.detection.acceptance import RotationLimits
from calib.detection.blocks import BLOCK_NS
from calib.detection.segments import Segments, find_segments
from calib.detection.turns import RejectedRotation, Turn, find_runs
from calib.estimation.low_pass import without_dither
from imudrv.arrays import Array
from imudrv.calibration import Calibration, coefficients
from imudrv.errors import InputError
from imudrv.imu.compensation import Compensator
from imudrv.nav.alignment import ALIGNMENT_S, MIN_ALIGNMENT_S, Aligned, Alignment
from imudrv.nav.mechanisation import Navigator
from imudrv.records import Records
from imudrv.site import Site
from imudrv.units import DEG_PER_H, MM, NS, PPM, STANDARD_GRAVITY, UG, URAD
from imudrv.wire.layout import Layout

BEFORE_S: Final = 10.0
"""Length of the rest before the first turn that is navigated, s."""


AFTER_S: Final = 15.0
"""Maximum length of the rest after the last turn that is navigated, s."""


GUARD_S: Final = 0.1
"""Margin of each rest next to a turn that is not used, s: a turn ends too slowly."""


@dataclass(frozen=True)
class Priors:
    """Prior uncertainty of the unit: 1-sigma of the residual errors of its static calibration.

    Attributes
    ----------
    accelerometer_bias, accelerometer_scale, accelerometer_misalignment : float
        m/s^2, 1, rad, each axis.
    gyro_bias, gyro_scale, gyro_misalignment : float
        rad/s, 1, rad, each axis.
    skew : float
        Delay of the end of the accelerometers' sample after the gyros', s; 0: known to be none.
    quadratic : float
        Quadratic term of an accelerometer, 1/(m/s^2).
    arm : float
        A direction of the lever arms with a larger sigma is unobservable, m: a drawing is as accurate.
    """

    accelerometer_bias: float = 50.0 * UG
    accelerometer_scale: float = 20.0 * PPM
    accelerometer_misalignment: float = 30.0 * URAD
    gyro_bias: float = 0.01 * DEG_PER_H
    gyro_scale: float = 5.0 * PPM
    gyro_misalignment: float = 30.0 * URAD
    skew: float = 0.5e-3
    quadratic: float = 50.0 * UG / STANDARD_GRAVITY**2
    arm: float = 3.0 * MM


@dataclass(frozen=True)
class Run:
    """Turns after one alignment, navigated.

    Attributes
    ----------
    label : str
        Name of the capture, with the number of the run where the capture has several.
    turns : tuple of Turn
        The turns and the rests before and after them.
    aligned : Aligned
        Initial alignment.
    gravity : float
        m/s^2.
    rows : ndarray of MEASUREMENT
        Every 20 ms from the start of navigation; at rest, velocity is measured minus true.
    v_n : ndarray, shape (n, 3)
        Mean velocity over the samples between the row before and each row, m/s: the pulses of a level
        accelerometer, 20 to 100 per second, would alias into single values.
    t_s : ndarray, shape (n,)
        Time of each row from the start of navigation, by the counter.
    arrests : ndarray of bool, shape (turns + 1, n)
        Rows at rest: before the first turn, after the first, after the second, ...
    """

    label: str
    turns: tuple[Turn, ...]
    aligned: Aligned
    gravity: float
    rows: Records
    v_n: Array
    t_s: Array
    arrests: NDArray[np.bool_]

    @property
    def turn_labels(self) -> tuple[str, ...]:
        """Label of each turn: `z-up/1`, `z-up/2`, ...; that of the run if it is the only one."""
        if len(self.turns) == 1:
            return (self.label,)
        return tuple(f"{self.label}/{k + 1}" for k in range(len(self.turns)))

    @property
    def at_rest(self) -> NDArray[np.bool_]:
        """Rows of all arrests, shape (n,)."""
        return np.asarray(self.arrests.any(axis=0), np.bool_)


@dataclass(frozen=True)
class CaptureRuns:
    """Rests, rotations and runs of a capture.

    Attributes
    ----------
    segments : Segments
        All rests and rotations.
    runs : tuple of Run
        The runs, navigated; each has an accepted turn.
    rejected : tuple of RejectedRotation
        The motions that are not accepted, with the reasons.
    """

    segments: Segments
    runs: tuple[Run, ...]
    rejected: tuple[RejectedRotation, ...]


@dataclass(frozen=True)
class NavigationOptions:
    """Selection of rotations, and prior knowledge for their alignment.

    Attributes
    ----------
    limits : RotationLimits
        Limits of an accepted rotation.
    priors : Priors
        For the predicted accuracy of the alignment.
    expected : {'X', 'Y', 'Z'} or None
        Body axis that has to be vertical; None: any.
    """

    limits: RotationLimits = field(default_factory=RotationLimits)
    priors: Priors = field(default_factory=Priors)
    expected: str | None = None


def navigate_rotations(
    read: Callable[[], Iterable[Records]],
    C_ba: ArrayLike,
    site: Site,
    label: str = "",
    options: NavigationOptions | None = None,
) -> CaptureRuns:
    """Find the runs of a capture and navigate them.

    Parameters
    ----------
    read : callable
        Returns the capture's INCREMENTS from the beginning, in pieces, without size-effect compensation;
        called twice.
    C_ba : array_like, shape (3, 3)
        Accelerometer axes to body, of the calibration of the increments.
    site : Site
        Place of the unit.
    label : str
        Name of the capture in messages and reports.
    options : NavigationOptions, optional
        Limits, priors and expected axis.

    Returns
    -------
    CaptureRuns

    Raises
    ------
    InputError
        The capture is too short, or a rest cannot be used for alignment.
    """
    options = options or NavigationOptions()
    segments = find_segments(without_dither(read()))
    found = find_runs(segments.rotations, options.limits, options.expected)
    labels = [label] if len(found.runs) == 1 else [f"{label}#{k + 1}" for k in range(len(found.runs))]
    builders = [
        _RunBuilder(name, turns, segments.interval_s, C_ba, site, options.priors)
        for name, turns in zip(labels, found.runs, strict=True)
    ]
    if builders:
        for piece in without_dither(read()):
            for builder in builders:
                builder.feed(piece)
    return CaptureRuns(segments, tuple(builder.result() for builder in builders), found.rejected)


def navigate_capture(
    read: Callable[[], Iterable[Records]],
    layout: Layout,
    calibration: Calibration,
    site: Site,
    label: str = "",
    options: NavigationOptions | None = None,
) -> CaptureRuns:
    """Compensate the pulses of a capture and navigate its rotations, see `navigate_rotations`.

    Parameters
    ----------
    read : callable
        Returns the capture's PULSES from the beginning, in pieces; called twice.
    layout : Layout
        Layout of the profile.
    calibration : Calibration
        Calibration of the unit. Lever arms are identified from runs without size effect.
    site, label, options
        See `navigate_rotations`.

    Returns
    -------
    CaptureRuns

    Raises
    ------
    InputError
        See `navigate_rotations`.
    """
    known = coefficients(calibration)

    def increments() -> Iterator[Records]:
        compensator = Compensator(known, layout)
        for pulses in read():
            yield compensator.feed(pulses)
        yield compensator.close()

    return navigate_rotations(increments, known.C_ba, site, label, options)


class _RunBuilder:
    """Aligns and navigates one run from the pieces of its capture."""

    def __init__(
        self,
        label: str,
        turns: tuple[Turn, ...],
        interval_s: float,
        C_ba: ArrayLike,
        site: Site,
        priors: Priors,
    ) -> None:
        self._label, self._turns, self._interval_s = label, turns, interval_s
        self._C_ba, self._site = C_ba, site
        first, last = turns[0], turns[-1]
        rest_s = first.before.duration_s
        navigated_s = min(BEFORE_S, rest_s - MIN_ALIGNMENT_S)
        aligned_s = min(ALIGNMENT_S, rest_s - navigated_s)
        self._begin = first.start - round(navigated_s / interval_s)
        self._first = self._begin - round(aligned_s / interval_s)  # counter of the first sample needed
        self._stop = min(last.after.stop, last.stop + round(AFTER_S / interval_s))
        self._alignment = Alignment(site.latitude_rad, priors.gyro_bias, priors.accelerometer_bias, aligned_s)
        self._started: tuple[Aligned, Navigator] | None = None
        self._every = max(1, round(BLOCK_NS * NS / interval_s))
        self._navigated = 0
        self._rows: list[Records] = []
        self._v_n: list[Array] = []

    def feed(self, increments: Records) -> None:
        """Process a piece of the capture."""
        first, begin, stop = np.searchsorted(increments["counter"], [self._first, self._begin, self._stop])
        if first < begin:
            self._alignment.feed(increments[first:begin])
        if begin < stop:
            if self._started is None:
                aligned = self._alignment.result()
                self._started = aligned, Navigator(self._site.place, aligned.q_nb, C_ba=self._C_ba)
            rows = self._started[1].feed(increments[max(first, begin) : stop])
            self._rows.append(rows[-(self._navigated + 1) % self._every :: self._every].copy())
            self._v_n.append(rows["v_n"].copy())
            self._navigated += len(rows)

    def result(self) -> Run:
        """Return the navigated run."""
        if self._started is None:
            raise InputError(
                f"{self._label}: expected the same samples in both passes, got none of this run in the second"
            )
        rows = np.concatenate(self._rows)
        v_n = np.concatenate(self._v_n)[: len(rows) * self._every]
        counter = rows["counter"]
        guard = round(GUARD_S / self._interval_s)
        begins = [self._begin, *(turn.stop + guard for turn in self._turns)]
        ends = [*(turn.start - guard for turn in self._turns), self._stop]
        return Run(
            self._label,
            self._turns,
            self._started[0],
            self._site.gravity,
            rows,
            v_n.reshape(len(rows), self._every, 3).mean(axis=1),
            (counter + 1 - self._begin) * self._interval_s,
            np.array([(begin <= counter) & (counter < end) for begin, end in zip(begins, ends, strict=True)]),
        )
