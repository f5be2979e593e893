"""Limits of a rotation, and the reasons for rejection."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import hypot, inf
from typing import Final

from calib.detection.segments import Rotation
from calib.messages import Message, message
from imudrv.records import Flag
from imudrv.units import STANDARD_GRAVITY, UG, URAD

LEAST_EXTRAPOLATED_DEG_PER_S: Final = 10.0
"""Peak rate below which no error of the arms is extrapolated, deg/s."""


@dataclass(frozen=True)
class RotationLimits:
    """Limits of a rotation of the procedure; degrees and seconds.

    Attributes
    ----------
    angle_deg, angle_tolerance_deg : float
        Angle about the vertical, of either sign.
    least_peak_deg_per_s : float
        Minimum peak rate, for half turns of up to 5.6 s; in a slower rotation, bias and misalignment dominate
        the velocity.
    axis_tilt_deg : float
        Maximum angle between the axis and the vertical.
    rest_before_s, rest_after_s : float
        Minimum rests: for alignment and velocity before, for velocity after: an arrest of 3 s, less what
        belongs to the turns.
    missing : int
        Maximum number of samples missing during the rotation.
    """

    angle_deg: float = 180.0
    angle_tolerance_deg: float = 5.0
    least_peak_deg_per_s: float = 60.0
    axis_tilt_deg: float = 10.0
    rest_before_s: float = 32.0
    rest_after_s: float = 2.8
    missing: int = 0


def rejection_reasons(
    rotation: Rotation, limits: RotationLimits, expected: str | None = None
) -> tuple[Message, ...]:
    """Return why a motion is not a rotation of the procedure.

    Parameters
    ----------
    rotation : Rotation
        A detected motion.
    limits : RotationLimits
        Limits of the procedure.
    expected : {'X', 'Y', 'Z'}, optional
        Body axis that has to be vertical.

    Returns
    -------
    tuple of Message
        Reasons, each with value and limit; empty: the rotation is accepted.
    """
    r, angle_deg, vertical = rotation, abs(rotation.angle_deg), expected or rotation.about
    checks = (
        (r.about != vertical, message("wrong_vertical", about=r.about, expected=vertical)),
        (
            abs(angle_deg - limits.angle_deg) > limits.angle_tolerance_deg,
            message(
                "wrong_angle",
                angle_deg=angle_deg,
                expected_deg=limits.angle_deg,
                tolerance_deg=limits.angle_tolerance_deg,
            ),
        ),
        (
            r.axis_tilt_deg > limits.axis_tilt_deg,
            message("axis_tilted", tilt_deg=r.axis_tilt_deg, limit_deg=limits.axis_tilt_deg),
        ),
        (r.peak_deg_per_s < limits.least_peak_deg_per_s, _too_slow(r, limits)),
        (r.missing > limits.missing, message("samples_lost", missing=r.missing, limit=limits.missing)),
        (r.flags & Flag.SATURATED, message("saturated")),
        (r.flags & Flag.FAULT, message("fault_during_rotation")),
    )
    return (*(reason for failed, reason in checks if failed), *_rest_reasons(r, limits))


def _too_slow(rotation: Rotation, limits: RotationLimits) -> Message:
    peak, limit = rotation.peak_deg_per_s, limits.least_peak_deg_per_s
    if peak < LEAST_EXTRAPOLATED_DEG_PER_S:
        return message("too_slow", peak_deg_per_s=peak, limit_deg_per_s=limit)
    error_mm = expected_error_mm(peak)
    return message("too_slow_with_error", peak_deg_per_s=peak, limit_deg_per_s=limit, error_mm=error_mm)


def _rest_reasons(rotation: Rotation, limits: RotationLimits) -> Iterator[Message]:
    before, after = rotation.before, rotation.after
    if before is None:
        yield message("no_rest_before", limit_s=limits.rest_before_s)
    elif before.duration_s < limits.rest_before_s:
        yield message("short_rest_before", rest_s=before.duration_s, limit_s=limits.rest_before_s)
    if after is None:
        yield message("no_rest_after", limit_s=limits.rest_after_s)
    elif after.duration_s < limits.rest_after_s:
        yield message("short_rest_after", rest_s=after.duration_s, limit_s=limits.rest_after_s)


def expected_error_mm(peak_deg_per_s: float) -> float:
    """Return the 1-sigma error of a lever arm from one velocity per rotation, mm.

    A minimum-jerk half turn takes `T = 180 * 1.875 / peak`; the velocity changes by 8.8 / T m/s per metre of
    lever arm, and by `T hypot(b, g m)` m/s from b = 50 ug of bias and m = 30 urad of gyro misalignment.

    Examples
    --------
    >>> [round(expected_error_mm(peak), 2) for peak in (70.0, 140.0)]  # half the time: a quarter
    [1.51, 0.38]
    """
    if peak_deg_per_s <= 0.0:
        return inf
    T = 180.0 * 1.875 / peak_deg_per_s
    return 1e3 * T * T / 8.8 * hypot(50.0 * UG, 30.0 * URAD * STANDARD_GRAVITY)
