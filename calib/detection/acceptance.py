"""Limits of a rotation, and the reasons for rejection."""

from dataclasses import dataclass
from math import hypot, inf
from typing import Final, NamedTuple

from calib.detection.segments import Rest, Rotation
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
        Minimum peak rate; in a slower rotation, bias and misalignment dominate the velocity.
    axis_tilt_deg : float
        Maximum angle between the axis and the vertical.
    rest_before_s, rest_after_s : float
        Minimum rests: for alignment and velocity before, for velocity after.
    missing : int
        Maximum number of samples missing during the rotation.
    """

    angle_deg: float = 180.0
    angle_tolerance_deg: float = 5.0
    least_peak_deg_per_s: float = 70.0
    axis_tilt_deg: float = 10.0
    rest_before_s: float = 32.0
    rest_after_s: float = 5.0
    missing: int = 0


@dataclass(frozen=True)
class AcceptedRotation(Rotation):
    """A rotation within the limits; it has a rest before and after it."""

    before: Rest
    after: Rest


class RejectedRotation(NamedTuple):
    """A motion that is outside the limits, and the reasons."""

    rotation: Rotation
    reasons: tuple[str, ...]


def assess(
    rotation: Rotation, limits: RotationLimits, expected: str | None = None
) -> AcceptedRotation | RejectedRotation:
    """Accept or reject a motion as a rotation of the procedure; see `rejection_reasons`."""
    reasons = rejection_reasons(rotation, limits, expected)
    if reasons or rotation.before is None or rotation.after is None:
        return RejectedRotation(rotation, reasons)
    return AcceptedRotation(**vars(rotation))


def rejection_reasons(
    rotation: Rotation, limits: RotationLimits, expected: str | None = None
) -> tuple[str, ...]:
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
    tuple of str
        Reasons, each with value and limit; empty: the rotation is accepted.
    """
    r, reasons = rotation, []
    if expected is not None and r.about != expected:
        reasons.append(f"about {r.about}, expected {expected}")
    if abs(abs(r.angle_deg) - limits.angle_deg) > limits.angle_tolerance_deg:
        reasons.append(
            f"turned {abs(r.angle_deg):.1f} deg, want {limits.angle_deg:g} +- {limits.angle_tolerance_deg:g}"
        )
    if r.axis_tilt_deg > limits.axis_tilt_deg:
        reasons.append(
            f"axis {r.axis_tilt_deg:.1f} deg off the vertical, want at most {limits.axis_tilt_deg:g}"
        )
    if r.peak_deg_per_s < limits.least_peak_deg_per_s:
        error = ""
        if r.peak_deg_per_s >= LEAST_EXTRAPOLATED_DEG_PER_S:
            error = f", expect {expected_error_mm(r.peak_deg_per_s):.1f} mm"
        reasons.append(
            f"peak {r.peak_deg_per_s:.0f} deg/s: slower than {limits.least_peak_deg_per_s:g}{error}"
        )
    if r.missing > limits.missing:
        reasons.append(f"{r.missing} samples missing during the rotation, want at most {limits.missing}")
    for flag, what in ((Flag.SATURATED, "an axis saturated"), (Flag.FAULT, "the unit reported a fault")):
        if r.flags & flag:
            reasons.append(f"{what} during the rotation")
    for rest, side, least in (
        (r.before, "before", limits.rest_before_s),
        (r.after, "after", limits.rest_after_s),
    ):
        if rest is None:
            reasons.append(f"no rest {side} it, want {least:g} s")
        elif rest.duration_s < least:
            reasons.append(f"rest {side} {rest.duration_s:.1f} s, want {least:g}")
    return tuple(reasons)


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
