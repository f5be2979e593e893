"""Evidence: for every rotation that serves, velocity and its matrices over rest, rotation and rest.

Each rotation is a run of its own: aligned on the rest before it but for its last seconds, then navigated from
zero velocity through the end of that rest, the rotation, and the rest after, with the dither of the gyro
blocks filtered from the angle increments. A capture is read twice: the first pass finds the segments, the
second aligns and navigates as the increments come by, so that memory stays that of a chunk and of the rows
kept.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.detection.acceptance import RotationLimits, rejection_reasons
from calib.detection.blocks import BLOCK_NS
from calib.detection.segments import Rotation, Segments, find_segments
from calib.estimation.low_pass import without_dither
from imudrv.arrays import Array
from imudrv.nav.alignment import ALIGNMENT_S, MIN_ALIGNMENT_S, Aligned, Alignment
from imudrv.nav.earth import normal_gravity
from imudrv.nav.mechanisation import MEASUREMENT, Navigator
from imudrv.records import Records
from imudrv.site import Site
from imudrv.units import DEG_PER_H, MM, NS, PPM, STANDARD_GRAVITY, UG, URAD

BEFORE_S: Final = 10.0
"""Rest that is navigated before the rotation, s."""


AFTER_S: Final = 15.0
"""Most of the rest after it that is navigated, s."""


GUARD_S: Final = 0.1
"""So near to the rotation rest is not used: its very ends are too slow to be told from rest, s."""


@dataclass(frozen=True)
class Priors:
    """What is known of the unit before: 1-sigma of what its static calibration leaves.

    Attributes
    ----------
    accelerometer_bias, accelerometer_scale, accelerometer_misalignment : float
        m/s^2, 1, rad, each axis.
    gyro_bias, gyro_scale, gyro_misalignment : float
        rad/s, 1, rad, each axis.
    skew : float
        By how much the accelerometers' sample may end later than the gyros', s; 0: known to be none.
    quadratic : float
        Quadratic term of an accelerometer, 1/(m/s^2).
    arm : float
        What the data tell no better than this counts as not seen, m: a drawing does as well.
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
    """One rotation, navigated.

    Attributes
    ----------
    label : str
        Capture and number of the rotation in it.
    rotation : Rotation
        As found, with the rests beside it.
    aligned : Aligned
        The alignment it starts from.
    gravity : float
        m/s^2.
    rows : ndarray of MEASUREMENT
        Every 20 ms from the start of navigation; velocity is measured minus true at rest.
    v_n : ndarray, shape (n, 3)
        Mean velocity over the samples from the row before to each row, m/s: pulses of a level accelerometer,
        20 to 100 a second, beat with single values.
    t_s : ndarray, shape (n,)
        Time of each row from the start of navigation, by the counter.
    before, after : ndarray of bool, shape (n,)
        Rows at rest before and after the rotation.
    """

    label: str
    rotation: Rotation
    aligned: Aligned
    gravity: float
    rows: Records
    v_n: Array
    t_s: Array
    before: NDArray[np.bool_]
    after: NDArray[np.bool_]


@dataclass(frozen=True)
class CaptureRuns:
    """What a capture gives.

    Attributes
    ----------
    segments : Segments
        All that was found.
    runs : tuple of Run
        The rotations that serve.
    rejected : tuple of (Rotation, tuple of str)
        The other motions, with the reasons.
    """

    segments: Segments
    runs: tuple[Run, ...]
    rejected: tuple[tuple[Rotation, tuple[str, ...]], ...]


def navigate_rotations(
    read: Callable[[], Iterable[Records]],
    C_ba: ArrayLike,
    site: Site,
    *,
    label: str = "",
    limits: RotationLimits | None = None,
    priors: Priors | None = None,
    expected: str | None = None,
) -> CaptureRuns:
    """Find the rotations of a capture and navigate them.

    Parameters
    ----------
    read : callable
        Gives the capture's INCREMENTS from the beginning, piece by piece, without size-effect compensation;
        called twice.
    C_ba : array_like, shape (3, 3)
        Accelerometer axes to body, of the calibration that made the increments.
    site : Site
        Where the unit stands.
    label : str
        How messages and reports call the capture.
    limits : Limits, optional
        What a rotation has to keep.
    priors : Priors, optional
        For the predicted accuracy of the alignment.
    expected : {'X', 'Y', 'Z'}, optional
        Body axis that the procedure wants vertical.

    Returns
    -------
    Evidence

    Raises
    ------
    InputError
        The capture is too short, or a rest cannot be aligned on.
    """
    limits, priors = limits or RotationLimits(), priors or Priors()
    segments = find_segments(without_dither(read()))
    verdicts = [(rotation, rejection_reasons(rotation, limits, expected)) for rotation in segments.rotations]
    good = [rotation for rotation, reasons in verdicts if not reasons]
    open_runs = [
        _RunBuilder(f"{label}#{k + 1}", rotation, segments.interval_s, C_ba, site, priors)
        for k, rotation in enumerate(good)
    ]
    if open_runs:
        for piece in without_dither(read()):
            for run in open_runs:
                run.feed(piece)
    return CaptureRuns(
        segments,
        tuple(run.result() for run in open_runs),
        tuple((rotation, reasons) for rotation, reasons in verdicts if reasons),
    )


class _RunBuilder:
    """One rotation on its way: takes what concerns it from the pieces that come by."""

    def __init__(
        self,
        label: str,
        rotation: Rotation,
        interval_s: float,
        C_ba: ArrayLike,
        site: Site,
        priors: Priors,
    ) -> None:
        assert rotation.before is not None
        assert rotation.after is not None
        self._label, self._rotation, self._interval_s = label, rotation, interval_s
        self._C_ba, self._site = C_ba, site
        rest_s = rotation.before.duration_s
        navigated_s = min(BEFORE_S, rest_s - MIN_ALIGNMENT_S)
        aligned_s = min(ALIGNMENT_S, rest_s - navigated_s)
        self._begin = rotation.start - round(navigated_s / interval_s)
        self._next = self._begin - round(aligned_s / interval_s)  # counter of the first sample wanted
        self._stop = min(rotation.after.stop, rotation.stop + round(AFTER_S / interval_s))
        self._alignment = Alignment(site.latitude_rad, priors.gyro_bias, priors.accelerometer_bias, aligned_s)
        self._aligned: Aligned | None = None
        self._navigator: Navigator | None = None
        self._every = max(1, round(BLOCK_NS * NS / interval_s))
        self._navigated = 0
        self._rows: list[Records] = []
        self._v_n: list[Array] = []

    def feed(self, increments: Records) -> None:
        """Take a piece of the capture."""
        first, begin, stop = np.searchsorted(increments["counter"], [self._next, self._begin, self._stop])
        if first < begin:
            self._alignment.feed(increments[first:begin])
        if begin < stop:
            if self._navigator is None:
                self._aligned = self._alignment.result()
                self._navigator = self._navigation(self._aligned)
            rows = self._navigator.feed(increments[max(first, begin) : stop])
            self._rows.append(rows[-(self._navigated + 1) % self._every :: self._every].copy())
            self._v_n.append(rows["v_n"].copy())
            self._navigated += len(rows)

    def _navigation(self, aligned: Aligned) -> Navigator:
        site = self._site
        return Navigator(
            site.latitude_rad,
            site.longitude_rad,
            site.height_m,
            site.gravity_m_s2,
            aligned.q_nb,
            C_ba=self._C_ba,
        )

    def result(self) -> Run:
        """What has come by."""
        assert self._aligned is not None
        rows = np.concatenate(self._rows) if self._rows else np.zeros(0, MEASUREMENT)
        v_n = np.concatenate(self._v_n)[: len(rows) * self._every]
        counter = rows["counter"]
        guard = round(GUARD_S / self._interval_s)
        return Run(
            self._label,
            self._rotation,
            self._aligned,
            self._site.gravity_m_s2 or normal_gravity(self._site.latitude_rad, self._site.height_m),
            rows,
            v_n.reshape(len(rows), self._every, 3).mean(axis=1),
            (counter + 1 - self._begin) * self._interval_s,
            before=counter < self._rotation.start - guard,
            after=counter >= self._rotation.stop + guard,
        )
