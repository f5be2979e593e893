"""Align and navigate each run: velocity and its measurement matrices.

A run is one or more turns after one alignment. It is aligned on the rest before its first turn, except the
last seconds of that rest, then navigated from zero velocity through the end of that rest and through all
turns with the rests between and after them: arrest 0 is the rest before the first turn, arrest k the one
after turn k. A capture is read twice: the first pass finds the segments, the second keeps the samples of each
run until it ends, and navigates them.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation as Attitude

from calib.detection.acceptance import RotationLimits
from calib.detection.blocks import BLOCK_NS
from calib.detection.sections import find_sections, joined, split_at_restarts
from calib.detection.segments import Segments
from calib.detection.turns import RejectedRotation, Turn, find_runs
from calib.estimation.dither_line import DitherLine, dither_lines
from calib.estimation.low_pass import FilterChoice, chosen_filter, low_passed, weights, without_dither
from calib.estimation.priors import Priors
from calib.estimation.pulses import without_quantisation
from calib.estimation.readings import Readings, RestSamples, beyond_pulses, level_channels, read_rests
from calib.estimation.rigid_motion import rigid_motion
from calib.estimation.walk import WalkEstimate, random_walk
from imudrv.arrays import Array
from imudrv.calibration import Calibration, coefficients
from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import RateFilterName
from imudrv.nav.alignment import ALIGNMENT_S, MIN_ALIGNMENT_S, Aligned, Alignment, RestReadings
from imudrv.nav.mechanisation import MEASUREMENT, Navigator
from imudrv.records import INCREMENTS, Records
from imudrv.site import Site
from imudrv.units import NS
from imudrv.wire.layout import Layout, Sensor, Values

BEFORE_S: Final = 10.0
"""Length of the rest before the first turn that is navigated, s."""


AFTER_S: Final = 15.0
"""Maximum length of the rest after the last turn that is navigated, s."""


GUARD_S: Final = 0.1
"""Margin of each rest next to a turn that H and means of velocity leave out, s: a turn ends too slowly."""


SETTLING_S: Final = 2.0
"""Beginning of an alignment that the noise is not taken from, s: what was put down is still settling."""


FEW: Final = 5
"""Degrees of freedom below which a random walk is not taken from the level accelerometers alone."""


_AT_ONCE: Final = 8192
"""Samples that are navigated at once; a row of H takes 500 bytes."""


class Pulses(NamedTuple):
    """Pulses of the sensors."""

    gyro: Array  # (3,), angle of one pulse, rad; 0: not quantised
    accelerometer: Array  # (3,), velocity of one pulse, m/s
    G: Array  # (3, 3), body axes to gyro axes


NO_PULSES: Final = Pulses(np.zeros(3), np.zeros(3), np.eye(3))


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
    C_ba : ndarray, shape (3, 3)
        Accelerometer axes to body.
    rows : ndarray of MEASUREMENT
        Every 20 ms from the start of navigation; at rest, velocity is measured minus true.
    v_n : ndarray, shape (n, 3)
        Mean velocity over the samples between the row before and each row, m/s: the pulses of a level
        accelerometer, 20 to 100 per second, would alias into single values.
    t_s : ndarray, shape (n,)
        Time of each row from the start of navigation, by the counter.
    arrests : ndarray of bool, shape (turns + 1, n)
        Rows at rest: before the first turn, after the first, after the second, ...
    readings : Readings
        Velocities at rest for the estimate.
    site_readings : RestReadings
        Mean readings of the alignment, to be compared with the site's.
    angle_walk, velocity_walk : WalkEstimate
        Random walks of the gyros, and of the level accelerometers, during the alignment.
    lines : tuple of DitherLine
        Dither in the angle increments during the alignment.
    rate_filter : str
        Filter of the rates of H.
    """

    label: str
    turns: tuple[Turn, ...]
    aligned: Aligned
    gravity: float
    C_ba: Array
    rows: Records
    v_n: Array
    t_s: Array
    arrests: NDArray[np.bool_]
    readings: Readings
    site_readings: RestReadings
    angle_walk: WalkEstimate
    velocity_walk: WalkEstimate
    lines: tuple[DitherLine, ...]
    rate_filter: RateFilterName

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
    restarts_s : tuple of float
        Times from the beginning at which the unit restarted.
    """

    segments: Segments
    runs: tuple[Run, ...]
    rejected: tuple[RejectedRotation, ...]
    restarts_s: tuple[float, ...]


@dataclass(frozen=True)
class NavigationOptions:
    """Selection of rotations, and how they are aligned and navigated.

    Attributes
    ----------
    limits : RotationLimits
        Limits of an accepted rotation.
    priors : Priors
        For the predicted accuracy of the alignment.
    expected : {'X', 'Y', 'Z'} or None
        Body axis that has to be vertical; None: any.
    rate_filter : {'auto', 'causal', 'centred', 'dither'}
        Filter of the rates of H; `auto`: `dither` wherever the sample rate allows it.
    """

    limits: RotationLimits = field(default_factory=RotationLimits)
    priors: Priors = field(default_factory=Priors)
    expected: str | None = None
    rate_filter: FilterChoice = "auto"


def navigate_rotations(
    read: Callable[[], Iterable[Records]],
    C_ba: ArrayLike,
    site: Site,
    label: str = "",
    options: NavigationOptions | None = None,
    pulses: Pulses | None = None,
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
        Limits, priors, expected axis and rate filter.
    pulses : Pulses, optional
        Pulses of the sensors; None: the increments are not quantised.

    Returns
    -------
    CaptureRuns

    Raises
    ------
    InputError
        The capture is too short, or a rest cannot be used for alignment.
    """
    options = options or NavigationOptions()
    sections = find_sections(read(), without_dither)
    found = [find_runs(section.rotations, options.limits, options.expected) for section in sections]
    detected = [(k, turns) for k, one in enumerate(found) for turns in one.runs]
    labels = [label] if len(detected) == 1 else [f"{label}#{k + 1}" for k in range(len(detected))]
    setup = _Setup(np.asarray(C_ba, np.float64), pulses or NO_PULSES, site, options)
    builders = [
        _RunBuilder(name, section, turns, sections[section].interval_s, setup)
        for name, (section, turns) in zip(labels, detected, strict=True)
    ]
    if builders:
        for section, piece in split_at_restarts(read()):
            for builder in builders:
                builder.feed(section, piece)
    return CaptureRuns(
        joined(sections),
        tuple(builder.result() for builder in builders),
        tuple(rejected for one in found for rejected in one.rejected),
        tuple(np.cumsum([section.duration_s for section in sections[:-1]]).tolist()),
    )


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

    return navigate_rotations(increments, known.C_ba, site, label, options, _pulses(known, layout))


def _pulses(known: Coefficients, layout: Layout) -> Pulses:
    """Return the pulses, or counts, of a unit after the calibration; 0 where a count is a rate."""
    gyro, accelerometer = (np.array(sensor.per_count) * _is_quantised(sensor) for sensor in layout.sensors)
    return Pulses(
        gyro * known.gyro_scale,
        accelerometer / known.accelerometer_scale,
        np.asarray(np.linalg.inv(known.C_bg), np.float64),
    )


def _is_quantised(sensor: Sensor) -> bool:
    """Whether increments are whole counts whose fraction is carried into the next one."""
    is_float = any(axis is not None and axis.is_float for axis in sensor.axes)
    return sensor.in_pulses or not (is_float or sensor.values is Values.RATE)


@dataclass(frozen=True)
class _Setup:
    """What all runs of a capture have in common."""

    C_ba: Array
    pulses: Pulses
    site: Site
    options: NavigationOptions


class _RunBuilder:
    """Keeps the samples of one run, then aligns and navigates it."""

    def __init__(
        self, label: str, section: int, turns: tuple[Turn, ...], interval_s: float, setup: _Setup
    ) -> None:
        self._label, self._section, self._turns = label, section, turns
        self._interval_s, self._setup = interval_s, setup
        first, last = turns[0], turns[-1]
        rest_s = first.before.duration_s
        navigated_s = min(BEFORE_S, rest_s - MIN_ALIGNMENT_S)
        aligned_s = min(ALIGNMENT_S, rest_s - navigated_s)
        self._begin = first.start - round(navigated_s / interval_s)
        self._first = self._begin - round(aligned_s / interval_s)  # counter of the first sample needed
        self._stop = min(last.after.stop, last.stop + round(AFTER_S / interval_s))
        priors = setup.options.priors
        self._alignment = Alignment(
            setup.site.latitude_rad, priors.gyro_bias, priors.accelerometer_bias, aligned_s
        )
        interval_ns = round(interval_s / NS)
        self._filter = chosen_filter(setup.options.rate_filter, interval_ns)
        self._taps = weights(self._filter, interval_ns)
        self._pieces: list[Records] = []
        self._run: Run | None = None

    def feed(self, section: int, increments: Records) -> None:
        """Take a piece of the capture; the pieces of a section are in order."""
        if section != self._section or self._run is not None:
            return
        margin = len(self._taps) // 2
        counter = increments["counter"]
        begin, end = np.searchsorted(counter, [self._first - margin, self._stop + margin])
        self._pieces.append(increments[begin:end].copy())
        if end < len(counter):
            self._run = self._navigated()

    def result(self) -> Run:
        """Return the navigated run."""
        return self._navigated() if self._run is None else self._run

    def _navigated(self) -> Run:
        raw = np.concatenate([np.zeros(0, INCREMENTS), *self._pieces])
        self._pieces.clear()
        smooth = low_passed(raw, self._taps)
        first, begin, stop = np.searchsorted(raw["counter"], [self._first, self._begin, self._stop])
        if first == begin or begin == stop:
            raise InputError(
                f"{self._label}: expected the same samples in both passes, got none of this run in the second"
            )
        self._alignment.feed(smooth[first:begin])
        aligned = self._alignment.result()
        setup = self._setup
        navigator = Navigator(setup.site.place, aligned.q_nb, C_ba=setup.C_ba)
        samples, A = smooth[begin:stop], np.asarray(np.linalg.inv(setup.C_ba), np.float64)
        dv_a = samples["dv_b"] @ A.T
        every = max(1, round(BLOCK_NS * NS / self._interval_s))
        rows, v_n, q_nb = _navigated(navigator, samples, every)
        v_n += self._correction(samples, dv_a, q_nb, A)
        rows["v_n"] = v_n[every - 1 :: every]
        counter, guard = rows["counter"], round(GUARD_S / self._interval_s)
        begins = [self._begin, *(turn.stop + guard for turn in self._turns)]
        ends = [*(turn.start - guard for turn in self._turns), self._stop]
        rests = self._rests(samples["counter"], v_n, dv_a, rows)
        still = raw[first + round(SETTLING_S / self._interval_s) : begin]
        lines = dither_lines(still["dtheta_b"], self._interval_s)
        # dither hides the pulses
        gyro = smooth[begin - len(still) : begin] if lines else still
        gyro_pulse = np.zeros(3) if lines else setup.pulses.gyro
        time = self._time(still["counter"])
        velocity_walk = self._velocity_walk(time, still["dv_b"] @ A.T, A @ self._turns[0].before.up_b)
        return Run(
            self._label,
            self._turns,
            aligned,
            setup.site.gravity,
            setup.C_ba,
            rows,
            v_n[: len(rows) * every].reshape(len(rows), every, 3).mean(axis=1),
            self._time(counter),
            np.array([(begin <= counter) & (counter < end) for begin, end in zip(begins, ends, strict=True)]),
            read_rests(rests, A, setup.pulses.accelerometer, velocity_walk.root),
            self._alignment.readings(),
            random_walk(time, gyro["dtheta_b"] @ setup.pulses.G.T, gyro_pulse, range(3)),
            velocity_walk,
            lines,
            self._filter,
        )

    def _correction(self, samples: Records, dv_a: Array, q_nb: Array, A: Array) -> Array:
        """Return what the velocity is to be corrected by for the fractions of pulses, m/s, in n.

        Where the case vibrates by more than they are, they change in every sample, and their mean is right.
        """
        pulse = self._setup.pulses.accelerometer
        t_s, C_nb = self._time(samples["counter"]), _matrices(q_nb)
        corrected = np.zeros_like(dv_a)
        before = slice(self._turns[0].start - self._begin)
        shaken = beyond_pulses(t_s[before], dv_a[before], pulse)
        for i in np.flatnonzero((pulse > 0.0) & (shaken < pulse**2 / 12.0)):
            motion = rigid_motion(t_s, C_nb, samples["dtheta_b"], A[i], self._setup.site.gravity)
            corrected[:, i] = without_quantisation(t_s, dv_a[:, i], float(pulse[i]), motion) - dv_a[:, i]
        middle = 0.5 * (C_nb + np.concatenate([C_nb[:1], C_nb[:-1]])) @ self._setup.C_ba
        return np.asarray(np.cumsum(np.einsum("nij,nj->ni", middle, corrected), axis=0), np.float64)

    def _velocity_walk(self, t_s: Array, dv_a: Array, up_a: Array) -> WalkEstimate:
        """Return the random walk of the level accelerometers; of all, if those send too few pulses."""
        pulse = self._setup.pulses.accelerometer
        level = random_walk(t_s, dv_a, pulse, level_channels(up_a))
        return level if level.degrees_of_freedom > FEW else random_walk(t_s, dv_a, pulse, range(3))

    def _time(self, counter: NDArray[np.int64]) -> Array:
        """Return the time of the end of samples from the start of navigation, s."""
        return np.asarray((counter + 1 - self._begin) * self._interval_s, np.float64)

    def _rests(
        self, counter: NDArray[np.int64], v_n: Array, dv_a: Array, rows: Records
    ) -> Sequence[RestSamples]:
        edges = [self._begin, *(edge for turn in self._turns for edge in (turn.start, turn.stop)), self._stop]
        at = np.searchsorted(counter, edges)
        rests = []
        for begin, end in zip(at[::2], at[1::2], strict=True):
            middle = rows[np.searchsorted(rows["counter"], counter[(begin + end) // 2])]
            C_nb = _matrices(middle["q_nb"])
            rests.append(RestSamples(self._time(counter[begin:end]), v_n[begin:end], dv_a[begin:end], C_nb))
        return rests


def _navigated(navigator: Navigator, samples: Records, every: int) -> tuple[Records, Array, Array]:
    """Return every n-th row of MEASUREMENT, and velocity and attitude of all samples."""
    kept, velocities, attitudes = [np.zeros(0, MEASUREMENT)], [np.zeros((0, 3))], [np.zeros((0, 4))]
    size = max(1, _AT_ONCE // every) * every
    for at in range(0, len(samples), size):
        rows = navigator.feed(samples[at : at + size])
        kept.append(rows[every - 1 :: every].copy())
        velocities.append(rows["v_n"].copy())
        attitudes.append(rows["q_nb"].copy())
    return np.concatenate(kept), np.concatenate(velocities), np.concatenate(attitudes)


def _matrices(q_nb: Array) -> Array:
    """Return attitudes as matrices."""
    return np.asarray(Attitude.from_quat(np.roll(q_nb, -1, axis=-1)).as_matrix(), np.float64)
