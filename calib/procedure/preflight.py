"""Check of a unit at rest: noise, temperatures, gravity and the Earth's rotation, their size, sign and axes.

The pose is known, so both vectors are. Where the readings differ, each single cause is tried, another pose,
one axis reversed, two exchanged; those that explain both readings are named. Causes that explain them equally
well are reported as ambiguous: near the equator the Earth's rotation has no vertical part, and in one pose a
reversed level gyro looks like a unit with the opposite heading.
"""

from collections.abc import Iterator
from itertools import combinations
from math import acos, atan2, sin
from typing import Final

import numpy as np

from calib.axes import axis_name, side
from calib.detection.tracking import MG, RestAverages
from calib.estimation.dither_line import dither_lines
from calib.estimation.low_pass import chosen_filter, weights
from calib.messages import Message, message
from calib.procedure.events import Conditions
from calib.procedure.prompts import fault_message, lean_message, turn_message
from calib.procedure.schema import ProcedureLimits, Step
from imudrv.arrays import Array
from imudrv.calibration import Calibration
from imudrv.nav.earth import EARTH_RATE, earth_rate_n
from imudrv.records import Flag
from imudrv.site import Site
from imudrv.units import ARCSEC, DEG, DEG_PER_H, NS

PREFLIGHT_S: Final = 30.0
"""Length of the rest that is examined, s."""


GRAVITY_TOLERANCE: Final = 0.02
"""Tolerance of the mean specific force, m/s^2: 2 mg, far above the error of a calibrated unit."""


RATE_TOLERANCE: Final = 1.0 * DEG_PER_H
"""Tolerance of the mean rate, rad/s: pulses and a slightly swaying bench, over half a minute."""


MEAN_SQUARE_LIMIT: Final = 5e-5
"""Largest mean square of a filtered rate at rest, 1/s^2: H takes that for the square of a rotation, and with
lever arms of 50 mm a turn of 2.5 s is then off by 6 um/s, a tenth of the noise of a good accelerometer."""


ANOTHER_POSE: Final = 30.0 * DEG
"""Angle of gravity from its axis above which the pose is another one, rad."""


def sensor_faults(
    averages: RestAverages, status: Conditions, limits: ProcedureLimits, calibration: Calibration
) -> tuple[Message, ...]:
    """Return what is wrong with status bits, temperatures and noise at rest.

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
    tuple of Message
        Empty if nothing is.
    """
    reasons = []
    if averages.flags & Flag.FAULT or status.faults:
        reasons.append(fault_message(status.faults))
    if calibration.temperature is not None:
        low, high = calibration.temperature.range_degc
        outside = [
            message("temperature", channel=name, temperature_degc=t, low_degc=low, high_degc=high)
            for name, t in status.temperature_degc.items()
            if t is not None and not low <= t <= high
        ]
        if not outside and averages.flags & Flag.TEMPERATURE_RANGE:
            outside = [message("some_temperature", low_degc=low, high_degc=high)]
        reasons += outside
    rate_noise, force_noise = averages.noise()
    noise, limit = rate_noise / DEG, limits.noise_deg_per_s
    if noise > limit:
        reasons.append(message("gyro_noise", noise_deg_per_s=noise, limit_deg_per_s=limit))
    noise, limit = force_noise / MG, limits.noise_mg
    if noise > limit:
        reasons.append(message("accelerometer_noise", noise_mg=noise, limit_mg=limit))
    return tuple(reasons)


def dither_faults(dtheta_b: Array, interval_ns: int) -> tuple[Message, ...]:
    """Return whether the angle increments at rest carry dither or vibration that spoils the lever arms.

    Parameters
    ----------
    dtheta_b : ndarray, shape (n, 3)
        Angle increments at rest, rad.
    interval_ns : int
        Sample interval.

    Returns
    -------
    tuple of Message
        Empty if the filter of the rates leaves less than `MEAN_SQUARE_LIMIT`.
    """
    name, interval_s = chosen_filter("auto", interval_ns), interval_ns * NS
    taps = weights(name, interval_ns)
    left = np.stack([np.convolve(angle, taps, "valid") for angle in dtheta_b.T]) / interval_s
    square = left.var(axis=1)
    axis = int(square.argmax())
    if square[axis] < MEAN_SQUARE_LIMIT:
        return ()
    rate, limit = float(np.sqrt(square[axis])) / DEG, float(np.sqrt(MEAN_SQUARE_LIMIT)) / DEG
    for line in dither_lines(dtheta_b, interval_s):
        if line.axis == "XYZ"[axis]:
            arcsec, hz = line.amplitude_rad / ARCSEC, line.frequency_hz
            return (
                message(
                    "dither_line",
                    axis=line.axis,
                    amplitude_arcsec=arcsec,
                    frequency_hz=hz,
                    filter=name,
                    rate_deg_per_s=rate,
                    limit_deg_per_s=limit,
                ),
            )
    return (message("dither", axis="XYZ"[axis], rate_deg_per_s=rate, filter=name, limit_deg_per_s=limit),)


def axis_faults(
    averages: RestAverages, step: Step, limits: ProcedureLimits, site: Site
) -> tuple[Message, ...]:
    """Return why the mean readings at rest are not those of a sound unit in the pose of a step.

    Parameters
    ----------
    averages : RestAverages
        Of 30 s or more.
    step : Step
        Its pose.
    limits : ProcedureLimits
        Largest deviations of heading and tilt.
    site : Site
        Location of the unit.

    Returns
    -------
    tuple of Message
        Each with the reading, the expected one, and what explains it; empty if all agree.
    """
    f_b, omega_b, gravity = averages.force, averages.rate, site.gravity
    pose = _Pose(step, limits, gravity, site.latitude_rad)
    reasons = []
    size = float(np.linalg.norm(f_b))
    if abs(size - gravity) > GRAVITY_TOLERANCE:
        reasons.append(
            message("gravity", measured_m_s2=size, expected_m_s2=gravity, tolerance_m_s2=GRAVITY_TOLERANCE)
        )
    rate = float(np.linalg.norm(omega_b))
    if abs(rate - EARTH_RATE) > RATE_TOLERANCE:
        reasons.append(
            message(
                "earth_rate",
                measured_deg_per_h=rate / DEG_PER_H,
                expected_deg_per_h=EARTH_RATE / DEG_PER_H,
                tolerance_deg_per_h=RATE_TOLERANCE / DEG_PER_H,
            )
        )
    if size < 0.5 * gravity or rate < 0.5 * EARTH_RATE or reasons:
        return tuple(reasons)
    if not pose.fits(f_b, omega_b):
        readings, cause = pose.differences(f_b, omega_b), pose.cause(f_b, omega_b)
        reasons.append(message("axis_fault", readings=readings, cause=cause))
    elif (lean := pose.lean(f_b)) > limits.tilt_deg * DEG:
        reasons.append(lean_message(lean, step, limits))
    return tuple(reasons)


class _Pose:
    """Expected readings of a pose, and the deviations from them."""

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
        """Error of the vertical part of the rate, rad/s; the same in every pose."""
        return float(f_b @ omega_b / np.linalg.norm(f_b)) - self._vertical

    def clockwise(self, f_b: Array, omega_b: Array) -> float:
        """Clockwise deviation from the heading of the pose, seen from above, rad, -pi to pi."""
        up = f_b / np.linalg.norm(f_b)
        east = np.cross(omega_b, up)
        return -atan2(float(self._east_b @ np.cross(up, east)), float(self._east_b @ east))

    def fits(self, f_b: Array, omega_b: Array) -> bool:
        return (
            self.lean(f_b) < ANOTHER_POSE
            and abs(self.vertical_off(f_b, omega_b)) <= RATE_TOLERANCE
            and abs(self.clockwise(f_b, omega_b)) <= self._heading_limit
        )

    def differences(self, f_b: Array, omega_b: Array) -> tuple[Message, ...]:
        """Return the readings that are not as expected."""
        found = []
        expected = self._gravity * self._up_b
        for k, axis in enumerate("XYZ"):
            if abs(f_b[k] - expected[k]) > 0.5 * self._gravity:
                read, wanted = float(f_b[k]), float(expected[k])
                found.append(
                    message("accelerometer_reads", axis=axis, measured_m_s2=read, expected_m_s2=wanted)
                )
        upright = self.lean(f_b) < ANOTHER_POSE
        if upright and abs(self.vertical_off(f_b, omega_b)) > RATE_TOLERANCE:
            found.append(self._gyro(int(np.argmax(np.abs(self._up_b))), omega_b))
        elif upright and abs(self.clockwise(f_b, omega_b)) > self._heading_limit:
            off = np.abs(omega_b - self._omega_b)
            found += [self._gyro(k, omega_b) for k in range(3) if off[k] > 0.5 * off.max()]
        return tuple(found)

    def _gyro(self, k: int, omega_b: Array) -> Message:
        read, wanted = float(omega_b[k]) / DEG_PER_H, float(self._omega_b[k]) / DEG_PER_H
        return message("gyro_reads", axis="XYZ"[k], measured_deg_per_h=read, expected_deg_per_h=wanted)

    def cause(self, f_b: Array, omega_b: Array) -> Message:
        """Return the single causes that explain the readings."""
        found = []
        if abs(self.vertical_off(f_b, omega_b)) <= RATE_TOLERANCE:
            up = axis_name(f_b)
            if up != self._step.up:
                found.append(message("other_side", side=side(up)))
            else:
                found.append(message("other_heading", turn=turn_message(self.clockwise(f_b, omega_b))))
        found += [accelerometer for P, accelerometer, _ in _MISTAKES if self.fits(P @ f_b, omega_b)]
        found += [gyro for P, _, gyro in _MISTAKES if self.fits(f_b, P @ omega_b)]
        if not found:
            return message("unexplained")
        return message("ambiguous", causes=tuple(found)) if len(found) > 1 else found[0]


def _mistakes() -> Iterator[tuple[Array, Message, Message]]:
    """Yield what each mistake does to a vector, and its message for accelerometers and for gyros."""
    for k, axis in enumerate("XYZ"):
        P = np.eye(3)
        P[k, k] = -1.0
        yield P, message("accelerometer_reversed", axis=axis), message("gyro_reversed", axis=axis)
    for i, j in combinations(range(3), 2):
        P, first, second = np.eye(3), "XYZ"[i], "XYZ"[j]
        P[[i, j]] = P[[j, i]]
        accelerometers = message("accelerometers_exchanged", first=first, second=second)
        yield P, accelerometers, message("gyros_exchanged", first=first, second=second)


_MISTAKES: Final = tuple(_mistakes())
