"""Limits of a rotation, and the reasons for rejection."""

from dataclasses import dataclass
from math import hypot, inf
from typing import Final

from calib.detection.segments import Rotation
from imudrv.records import Flag
from imudrv.units import STANDARD_GRAVITY, UG, URAD

LEAST_EXTRAPOLATED_DEG_PER_S: Final = 10.0
"""Peak rate below which no error of the arms is extrapolated, deg/s."""


@dataclass(frozen=True)
class RotationLimits:
    """What a rotation of the procedure has to keep; degrees and seconds.

    Attributes
    ----------
    angle_deg, angle_tolerance_deg : float
        Angle about the vertical, of either sign.
    least_peak_deg_per_s : float
        Slower than this the lever arms drown in what bias and misalignment do meanwhile.
    axis_tilt_deg : float
        Most that the axis may be off the vertical.
    rest_before_s, rest_after_s : float
        Least lengths: to align and to see the velocity before, and to see it after.
    missing : int
        Most samples missing during the rotation.
    """

    angle_deg: float = 180.0
    angle_tolerance_deg: float = 5.0
    least_peak_deg_per_s: float = 70.0
    axis_tilt_deg: float = 10.0
    rest_before_s: float = 32.0
    rest_after_s: float = 5.0
    missing: int = 0


def rejection_reasons(
    rotation: Rotation, limits: RotationLimits, expected: str | None = None
) -> tuple[str, ...]:
    """Why a motion cannot serve as a rotation of the procedure.

    Parameters
    ----------
    rotation : Rotation
        What was found.
    limits : Limits
        What it has to keep.
    expected : {'X', 'Y', 'Z'}, optional
        Body axis that the procedure wants vertical.

    Returns
    -------
    tuple of str
        Reasons, each with its number and its limit; empty: it serves.
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
            f"axis {r.axis_tilt_deg:.1f} deg off the vertical, want {limits.axis_tilt_deg:g} at most"
        )
    if r.peak_deg_per_s < limits.least_peak_deg_per_s:
        error = ""
        if r.peak_deg_per_s >= LEAST_EXTRAPOLATED_DEG_PER_S:
            error = f", expect {expected_error_mm(r.peak_deg_per_s):.1f} mm"
        reasons.append(
            f"peak {r.peak_deg_per_s:.0f} deg/s: slower than {limits.least_peak_deg_per_s:g}{error}"
        )
    if r.missing > limits.missing:
        reasons.append(f"{r.missing} samples missing during the rotation, want {limits.missing} at most")
    for flag, what in ((Flag.SATURATED, "an axis saturated"), (Flag.FAULT, "the unit told a fault")):
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
    """Error of a lever arm that one velocity a rotation gives, 1 sigma, mm.

    Half a turn from rest to rest of least jerk takes `T = 180 * 1.875 / peak`; it gains 8.8 / T m/s a metre,
    while 50 ug of bias and 30 urad of gyro misalignment gain `T hypot(b, g m)` m/s.
    """
    if peak_deg_per_s <= 0.0:
        return inf
    T = 180.0 * 1.875 / peak_deg_per_s
    return 1e3 * T * T / 8.8 * hypot(50.0 * UG, 30.0 * URAD * STANDARD_GRAVITY)
