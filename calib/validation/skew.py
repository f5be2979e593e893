"""Correction of a gyro-accelerometer skew by interpolation."""

from dataclasses import replace
from math import floor

import numpy as np

from calib.validation.trial import TrialSettings
from imudrv.errors import InputError
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import rate_filter
from imudrv.records import Flag, Records
from imudrv.units import NS


class SkewCorrection:
    """Specific force back to the time of the gyros.

    Velocity felt up to `t + skew` is known at the end of each sample; in between a cubic through the four
    samples around tells it (Lagrange). The size effect is that of the gyros' own time and is not moved.
    """

    def __init__(self, setting: TrialSettings, known: Coefficients) -> None:
        layout = setting.layout
        self._interval_ns = layout.interval_ns
        self._bare = Compensator(
            replace(known, r_b=None), layout, rate_filter(setting.rate_filter, layout.interval_ns)
        )
        at = -setting.skew_s / (layout.interval_ns * NS)
        first = floor(at)
        u = at - first
        self._weights = (
            -u * (u - 1.0) * (u - 2.0) / 6.0,
            (u + 1.0) * (u - 1.0) * (u - 2.0) / 2.0,
            -(u + 1.0) * u * (u - 2.0) / 2.0,
            (u + 1.0) * u * (u - 1.0) / 6.0,
        )
        self._offsets = range(first - 1, first + 3)
        self._behind, self._ahead = max(0, 1 - first), max(0, first + 2)
        self._felt = np.zeros((0, 3))  # of samples whose increments are still held back here
        self._waiting: Records | None = None
        self._bare_dv = np.zeros((0, 3))

    def feed(self, pulses: Records, increments: Records) -> Records:
        """Take pulses and their increments; increments with the specific force of their own time."""
        bare = self._bare.feed(pulses)
        if (bare["flags"] & Flag.MISSING_BEFORE).any() or (bare["interval_ns"] != self._interval_ns).any():
            raise InputError(
                "skew: expected samples without gaps, got one; it cannot be put right over a gap"
            )
        self._bare_dv = np.concatenate([self._bare_dv, bare["dv_b"]])
        felt, self._bare_dv = self._bare_dv[: len(increments)], self._bare_dv[len(increments) :]
        effect = felt - increments["dv_b"]
        rows = increments.copy()
        rows["dv_b"] = effect
        rows = rows if self._waiting is None else np.concatenate([self._waiting, rows])
        felt = np.concatenate([self._felt, felt])
        stop = len(rows) - self._ahead
        if stop <= self._behind:
            self._waiting, self._felt = rows, felt
            return rows[:0]
        out = rows[self._behind : stop].copy()
        moved = np.zeros((len(out), 3))
        for weight, offset in zip(self._weights, self._offsets, strict=True):
            moved += weight * felt[self._behind + offset : stop + offset]
        out["dv_b"] = moved - out["dv_b"]
        self._waiting, self._felt = rows[stop - self._behind :].copy(), felt[stop - self._behind :].copy()
        return out
