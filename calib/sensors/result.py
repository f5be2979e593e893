"""Result of a calibration of the sensors; certificate, report and JSON are functions of it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from calib.axes import axis_name
from calib.messages import Message, english
from calib.sensors import observability
from calib.sensors.adjustment import Adjustment, Free
from calib.sensors.evidence import Evidence
from calib.sensors.faces import Faces
from calib.sensors.parameters import (
    BETA,
    BETA_T,
    COLUMNS,
    M,
    NominalScales,
    Number,
    Parameters,
    R,
    W,
    numbers,
    numbers_jacobian,
)
from imudrv.arrays import Array
from imudrv.calibration import Calibration
from imudrv.site import Site

Mark = Literal["good", "note", "caution", "bad"]
MARKS: tuple[Mark, ...] = ("good", "note", "caution", "bad")


class Judgement(NamedTuple):
    """One sentence of the verdict."""

    mark: Mark
    what: Message

    @property
    def text(self) -> str:
        """The sentence in English."""
        return english(self.what)


class CaptureInput(NamedTuple):
    """A capture that was read."""

    name: str
    sha256: str
    counts: str  # samples and losses, in one line


@dataclass(frozen=True)
class Estimate:
    """A number of the certificate with its uncertainty.

    Attributes
    ----------
    path : str
        In the file.
    value : float
        In the unit of the file; that of the start where the number is not observable.
    sigma : float
    observable : bool
    start : float
        Value that the adjustment started from.
    """

    path: str
    value: float
    sigma: float
    observable: bool
    start: float

    @property
    def is_shown(self) -> bool:
        """Whether it is a number of its own: not fixed by the gauge or by a length of 1."""
        if ".C_" not in self.path:
            return True
        return self.path[-5] != self.path[-2] and self.sigma > LEAST_AXIS_SIGMA


LEAST_AXIS_SIGMA = 1e-12
"""Below it an element of an axes matrix is fixed by the gauge."""


@dataclass(frozen=True)
class SensorsInput:
    """Inputs of a calibration of the sensors.

    Attributes
    ----------
    serial_number, profile, procedure : str
        The unit, its wire format, and what was planned; '' where nothing was.
    site : Site
    captures : tuple of CaptureInput
    start : Calibration or None
    frame : {'gyro', 'faces'}
    free : Free
    nominal : NominalScales
    """

    serial_number: str
    profile: str
    procedure: str
    site: Site
    captures: tuple[CaptureInput, ...]
    start: Calibration | None
    frame: Literal["gyro", "faces"]
    free: Free
    nominal: NominalScales


@dataclass(frozen=True)
class SensorsResult:
    """Result of a calibration of the sensors.

    Attributes
    ----------
    inputs : SensorsInput
    evidence : Evidence
    start : Parameters
        Where the adjustment started.
    adjustment : Adjustment or None
        None where there was none, or it did not converge; the verdict says why.
    faces : Faces or None
    poses : tuple of str
        Pose of each rest.
    verdict : tuple of Judgement
    reference_degc : float
        Temperature that the numbers are at; NaN: none was measured.
    gravity_sigma : float
        m/s^2.
    missing : tuple of str
        Motions that would show what is not observable.
    leave_one_out : tuple of float
        For each rest the factor by which the sigma of a number grows at most without it.
    """

    inputs: SensorsInput
    evidence: Evidence
    start: Parameters
    adjustment: Adjustment | None
    faces: Faces | None
    poses: tuple[str, ...]
    verdict: tuple[Judgement, ...]
    reference_degc: float
    gravity_sigma: float
    missing: tuple[str, ...] = ()
    leave_one_out: tuple[float, ...] = ()
    created: datetime = field(default_factory=lambda: datetime.now(UTC).replace(microsecond=0))

    def __repr__(self) -> str:
        return f"<SensorsResult: unit {self.inputs.serial_number}, {self.mark}: {self.verdict[-1].text}>"

    @property
    def mark(self) -> Mark:
        """The worst mark of the verdict."""
        return max((one.mark for one in self.verdict), key=MARKS.index)

    @cached_property
    def _in_frame(self) -> tuple[Parameters, Array]:
        """Parameters and their covariance in the body axes that were asked for."""
        if self.adjustment is None:
            return self.start, np.zeros((COLUMNS, COLUMNS))
        return in_frame(self.adjustment, self.faces)

    @cached_property
    def estimates(self) -> tuple[Estimate, ...]:
        """The numbers that were free."""
        if self.adjustment is None:
            return ()
        p, P = self._in_frame
        nominal, free = self.inputs.nominal, self.inputs.free
        # The faces define axes, and are uncertain themselves: what is observable does not depend on them.
        observable = free_numbers(self.adjustment.p, self.start, self.adjustment.covariance, nominal, free)[3]
        return tuple(
            Estimate(number.path, number.value if shown else start.value, sigma, shown, start.value)
            for number, start, sigma, shown in zip(
                *free_numbers(p, self.start, P, nominal, free)[:3], observable, strict=True
            )
        )

    @cached_property
    def covariance(self) -> Array:
        """Covariance of `estimates`, in the units of the file."""
        p, P = self._in_frame
        J = numbers_jacobian(p, self.inputs.nominal)
        kept = _free_rows(numbers(p, self.inputs.nominal), self.inputs.free)
        C: Array = J[kept] @ P @ J[kept].T
        return C

    @property
    def not_observable(self) -> tuple[str, ...]:
        """Paths of the numbers that are not observable."""
        return tuple(one.path for one in self.estimates if not one.observable)

    @property
    def parameters(self) -> Parameters:
        """The parameters in the frame that was asked for."""
        return self._in_frame[0]


def in_frame(adjustment: Adjustment, faces: Faces | None) -> tuple[Parameters, Array]:
    """Return parameters and covariance, in the axes along the gyros or along the faces.

    The change is exact, and brings the uncertainty of the turn with it.
    """
    if faces is None:
        return adjustment.p, adjustment.covariance
    C = faces.C
    T = np.eye(COLUMNS)
    T[W, W] = np.kron(C, np.eye(3))
    T[M, M] = np.kron(C, np.eye(3))
    T[BETA, BETA] = T[BETA_T, BETA_T] = C
    T[R, R] = np.kron(np.eye(3), C)
    p = adjustment.p.rotated(C)
    by_turn = np.zeros((COLUMNS, 3))
    for k in range(3):
        cross = -np.cross(np.eye(3)[k], np.eye(3)).T  # C changes by -theta x
        by_turn[W, k], by_turn[M, k] = (cross @ p.W).ravel(), (cross @ p.M).ravel()
        by_turn[BETA, k], by_turn[BETA_T, k] = cross @ p.beta, cross @ p.slopes.beta
        by_turn[R, k] = (p.r_b @ cross.T).ravel()
    P = T @ adjustment.covariance @ T.T + by_turn @ faces.theta_covariance @ by_turn.T
    return p, P


def _free_rows(all_numbers: Sequence[Number], free: Free) -> list[int]:
    """Return the rows of the numbers that were estimated."""
    left = []
    if not free.temperature:
        left.append("temperature")
    if not free.quadratic:
        left += ["accelerometer.quadratic", "accelerometer.asymmetry"]
    if not free.skew:
        left.append("skew_ms")
    return (
        [k for k, one in enumerate(all_numbers) if not one.path.startswith(tuple(left))]
        if left
        else [*range(len(all_numbers))]
    )


def free_numbers(
    p: Parameters, start: Parameters, P: Array, nominal: NominalScales, free: Free
) -> tuple[list[Number], list[Number], list[float], list[bool]]:
    """Return the numbers that were estimated: value, start, sigma, and whether observable."""
    every, at_start = numbers(p, nominal), numbers(start, nominal)
    kept = _free_rows(every, free)
    J = numbers_jacobian(p, nominal)[kept]
    C = J @ P @ J.T
    chosen = [every[k] for k in kept]
    sigma = np.sqrt(np.maximum(np.diag(C), 0.0))
    return chosen, [at_start[k] for k in kept], sigma.tolist(), observability.observable(chosen, C)


def pose_of(C_nb: Array) -> str:
    """Return the axis that is up in an attitude, such as +Z."""
    return axis_name(C_nb.T @ np.array([0.0, 0.0, 1.0]))
