"""Correction of a gyro-accelerometer skew by interpolation."""

from math import floor

import numpy as np

from calib.validation.trial import TrialSettings
from imudrv.calibration import coefficients
from imudrv.errors import InputError
from imudrv.imu.compensation import Compensator
from imudrv.records import Flag, Records
from imudrv.units import NS


class SkewCorrection:
    """Shift the specific force back to the time of the gyros.

    The samples give the velocity up to `t + skew`; in between it is interpolated by a cubic through the four
    nearest samples (Lagrange). The size effect is computed at the time of the gyros and is not shifted.
    """

    def __init__(self, settings: TrialSettings) -> None:
        layout = settings.layout
        self._interval_ns = layout.interval_ns
        bare = coefficients(settings.calibration.without_size_effect())
        self._bare = Compensator(bare, layout, settings.rate_filter)
        at = -settings.skew_s / (layout.interval_ns * NS)
        first = floor(at)
        u = at - first
        self._weights = (
            -u * (u - 1.0) * (u - 2.0) / 6.0,
            (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0,
            -(u + 1.0) * u * (u - 2.0) / 2.0,
            (u + 1.0) * u * (u - 1.0) / 6.0,
        )
        self._offsets = range(first - 1, first + 3)
        self._before, self._after = max(0, 1 - first), max(0, first + 2)
        self._force = np.zeros((0, 3))  # of the samples in _waiting
        self._waiting: Records | None = None
        self._bare_dv = np.zeros((0, 3))

    def feed(self, pulses: Records, increments: Records) -> Records:
        """Take pulses and their increments; return increments with the force at the time of the gyros."""
        bare = self._bare.feed(pulses)
        if (bare["flags"] & Flag.MISSING_BEFORE).any() or (bare["interval_ns"] != self._interval_ns).any():
            raise InputError(
                "skew: expected samples without gaps, got a gap; a skew cannot be corrected over a gap"
            )
        self._bare_dv = np.concatenate([self._bare_dv, bare["dv_b"]])
        force, self._bare_dv = self._bare_dv[: len(increments)], self._bare_dv[len(increments) :]
        effect = force - increments["dv_b"]
        rows = increments.copy()
        rows["dv_b"] = effect
        rows = rows if self._waiting is None else np.concatenate([self._waiting, rows])
        force = np.concatenate([self._force, force])
        stop = len(rows) - self._after
        if stop <= self._before:
            self._waiting, self._force = rows, force
            return rows[:0]
        out = rows[self._before : stop].copy()
        shifted = np.zeros((len(out), 3))
        for weight, offset in zip(self._weights, self._offsets, strict=True):
            shifted += weight * force[self._before + offset : stop + offset]
        out["dv_b"] = shifted - out["dv_b"]
        self._waiting, self._force = rows[stop - self._before :].copy(), force[stop - self._before :].copy()
        return out
