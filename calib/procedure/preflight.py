"""What a unit at rest shows of itself: gravity and the Earth's rotation, their size, sign and axes.

The pose is known, so both vectors are. Where the readings differ, each single cause is tried, another pose,
one axis reversed, two exchanged; those that explain both readings are named. Readings that several explain
are said not to be told apart: near the equator the Earth's rotation has no vertical part, and in one pose a
reversed level gyro looks like a unit that stands the other way round.
"""

from itertools import combinations
from math import acos, atan2, sin
from typing import Final

import numpy as np

from calib.axes import axis_name, side
from calib.detection.tracking import MG, RestAverages
from calib.procedure.events import Conditions
from calib.procedure.prompts import turn_instruction
from calib.procedure.schema import ProcedureLimits, Step
from imudrv.arrays import Array
from imudrv.calibration import Calibration
from imudrv.nav.earth import EARTH_RATE, earth_rate_n
from imudrv.records import Flag
from imudrv.site import Site
from imudrv.units import DEG, DEG_PER_H

GRAVITY_TOLERANCE: Final = 0.02
"""Of the mean specific force, m/s^2: 2 mg, far above what a calibrated unit shows."""


PREFLIGHT_S: Final = 30.0
"""Length of the rest that is examined, s."""


RATE_TOLERANCE: Final = 1.0 * DEG_PER_H
"""Of the mean rate, rad/s: what pulses and a bench that sways a little leave of half a minute."""


ANOTHER_POSE: Final = 30.0 * DEG
"""Gravity so far off its axis is not a lean any more, rad."""


def axis_faults(averages: RestAverages, step: Step, limits: ProcedureLimits, site: Site) -> tuple[str, ...]:
    """Why the mean readings at rest are not those of a sound unit in the pose of a step.

    Parameters
    ----------
    averages : RestAverages
        Of 30 s or more.
    step : Step
        Its pose.
    limits : Limits
        Heading and tilt that it may have.
    site : Site
        Location of the unit.

    Returns
    -------
    tuple of str
        Each with what was read, what was expected, and what explains it; empty: all is well.
    """
    f_b, omega_b, gravity = averages.force, averages.rate, site.gravity
    pose = _Pose(step, limits, gravity, site.latitude_rad)
    reasons = []
    size = float(np.linalg.norm(f_b))
    if abs(size - gravity) > GRAVITY_TOLERANCE:
        reasons.append(
            f"gravity reads {size:.3f} m/s^2 where {gravity:.3f} +- {GRAVITY_TOLERANCE:g} is expected: "
            "check the accelerometers' scale factors and biases, and the site"
        )
    rate = float(np.linalg.norm(omega_b))
    if abs(rate - EARTH_RATE) > RATE_TOLERANCE:
        reasons.append(
            f"the Earth's rotation reads {rate / DEG_PER_H:.1f} deg/h where {EARTH_RATE / DEG_PER_H:.1f} +- "
            f"{RATE_TOLERANCE / DEG_PER_H:g} is expected: check the gyros' scale factors and biases"
        )
    if size < 0.5 * gravity or rate < 0.5 * EARTH_RATE or reasons:
        return tuple(reasons)
    if not pose.fits(f_b, omega_b):
        reasons.append(f"{pose.differences(f_b, omega_b)}: {pose.causes(f_b, omega_b)}")
    elif (lean := pose.lean(f_b)) > limits.tilt_deg * DEG:
        reasons.append(
            f"the {side(step.up)} side leans {lean / DEG:.1f} deg, want {limits.tilt_deg:g} at most"
        )
    return tuple(reasons)


def sensor_faults(
    averages: RestAverages, status: Conditions, limits: ProcedureLimits, calibration: Calibration
) -> tuple[str, ...]:
    """Return what noise, status bits and temperatures at rest have against the unit.

    Parameters
    ----------
    averages : RestAverages
        Of 30 s or more.
    status : Conditions
        Reported by the unit.
    limits : ProcedureLimits
        Largest noise.
    calibration : Calibration
        Its temperature range.

    Returns
    -------
    tuple of str
        Empty if there is nothing.
    """
    reasons = []
    if averages.flags & Flag.FAULT or status.faults:
        reasons.append(f"the unit tells a fault: {', '.join(status.faults) or 'which, is not known'}")
    if calibration.temperature is not None:
        low, high = calibration.temperature.range_degc
        holds = f"the certificate holds from {low:g} to {high:g}: wait until it is there"
        outside = [
            f"{name} at {t:.1f} degC, {holds}"
            for name, t in status.temperature_degc.items()
            if t is not None and not low <= t <= high
        ]
        if not outside and averages.flags & Flag.TEMPERATURE_RANGE:
            outside = [f"a temperature is off, {holds}"]
        reasons += outside
    rate_noise, force_noise = averages.noise()
    for what, noise, most, name in (
        ("gyro", rate_noise / DEG, limits.noise_deg_per_s, "deg/s"),
        ("accelerometer", force_noise / MG, limits.noise_mg, "mg"),
    ):
        if noise > most:
            reasons.append(
                f"{what} noise {noise:.3g} {name} rms at rest, want {most:g} at most: look for what "
                "shakes the bench"
            )
    return tuple(reasons)


class _Pose:
    """What a pose should read, and how far off readings are."""

    def __init__(self, step: Step, limits: ProcedureLimits, gravity: float, latitude_rad: float) -> None:
        self._step, self._heading_limit, self._gravity = step, limits.heading_deg * DEG, gravity
        C_bn = step.C_bn
        self._east_b, self._up_b = C_bn[:, 0], C_bn[:, 2]
        self._vertical = EARTH_RATE * sin(latitude_rad)
        self._omega_b = C_bn @ earth_rate_n(latitude_rad)

    def lean(self, f_b: Array) -> float:
        """Angle between gravity and the pose's upper axis, rad."""
        return acos(float(np.clip(f_b @ self._up_b / np.linalg.norm(f_b), -1.0, 1.0)))

    def vertical_off(self, f_b: Array, omega_b: Array) -> float:
        """Vertical part of the rate less what it should be, rad/s; the same in every pose."""
        return float(f_b @ omega_b / np.linalg.norm(f_b)) - self._vertical

    def clockwise(self, f_b: Array, omega_b: Array) -> float:
        """How far the pose is turned clockwise, seen from above, rad, -pi to pi."""
        up = f_b / np.linalg.norm(f_b)
        east = np.cross(omega_b, up)
        return -atan2(float(self._east_b @ np.cross(up, east)), float(self._east_b @ east))

    def fits(self, f_b: Array, omega_b: Array) -> bool:
        return (
            self.lean(f_b) < ANOTHER_POSE
            and abs(self.vertical_off(f_b, omega_b)) <= RATE_TOLERANCE
            and abs(self.clockwise(f_b, omega_b)) <= self._heading_limit
        )

    def differences(self, f_b: Array, omega_b: Array) -> str:
        """Say the readings that are not as expected."""
        found = []
        expected = self._gravity * self._up_b
        for k, axis in enumerate("XYZ"):
            if abs(f_b[k] - expected[k]) > 0.5 * self._gravity:
                found.append(
                    f"accelerometer {axis} reads {f_b[k]:+.2f} where {expected[k]:+.2f} m/s^2 is expected"
                )
        upright = self.lean(f_b) < ANOTHER_POSE
        if upright and abs(self.vertical_off(f_b, omega_b)) > RATE_TOLERANCE:
            k = int(np.argmax(np.abs(self._up_b)))
            found.append(_gyro(k, omega_b, self._omega_b))
        elif upright and abs(self.clockwise(f_b, omega_b)) > self._heading_limit:
            off = np.abs(omega_b - self._omega_b)
            found += [_gyro(k, omega_b, self._omega_b) for k in range(3) if off[k] > 0.5 * off.max()]
        return ", ".join(found)

    def causes(self, f_b: Array, omega_b: Array) -> str:
        """Name the single causes that explain the readings."""
        found = []
        if abs(self.vertical_off(f_b, omega_b)) <= RATE_TOLERANCE:
            up = axis_name(f_b)
            turned = self.clockwise(f_b, omega_b)
            if up != self._step.up:
                found.append(f"the unit stands with its {side(up)} side up")
            else:
                found.append(f"the unit is to be turned {turn_instruction(turned)}")
        found += [name.format("accelerometer") for name, P in _MISTAKES if self.fits(P @ f_b, omega_b)]
        found += [name.format("gyro") for name, P in _MISTAKES if self.fits(f_b, P @ omega_b)]
        if not found:
            return (
                "neither another pose nor one reversed axis nor two exchanged explain it; check C_ba and C_bg"
            )
        return " or ".join(found) + ("; this cannot be told apart here" if len(found) > 1 else "")


def _gyro(k: int, omega_b: Array, expected: Array) -> str:
    read, want = omega_b[k] / DEG_PER_H, expected[k] / DEG_PER_H
    return f"gyro {'XYZ'[k]} reads {read:+.1f} where {want:+.1f} deg/h is expected"


def _mistakes() -> list[tuple[str, Array]]:
    reversed_axes = [
        (f"{{}} {a} is reversed", np.diag(np.where(np.arange(3) == k, -1.0, 1.0)))
        for k, a in enumerate("XYZ")
    ]
    exchanged = []
    for i, j in combinations(range(3), 2):
        P = np.eye(3)
        P[[i, j]] = P[[j, i]]
        exchanged.append((f"{{}}s {'XYZ'[i]} and {'XYZ'[j]} are exchanged", P))
    return reversed_axes + exchanged


_MISTAKES: Final = _mistakes()
