"""The effect of dither as text."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from calib.certificate import lever_arms_of
from calib.dither.spectrum import AXES, Dither, compensated, gain, sensing_directions, size_effect
from imudrv.arrays import Array
from imudrv.calibration import Calibration
from imudrv.imu.rate_filter import RateFilter
from imudrv.units import ARCSEC, MM, UG


def dither_text(
    calibration: Calibration,
    amplitude_arcsec: ArrayLike,
    frequency_hz: ArrayLike,
    rate_filters: Sequence[RateFilter],
    interval_s: float,
    reaction: float = 0.01,
) -> str:
    """Return the effect of gyro dither on the accelerometers, and on the compensation with each rate filter.

    Parameters
    ----------
    calibration : Calibration
        Calibration with lever arms.
    amplitude_arcsec, frequency_hz : array_like, shape (3,)
        Dither of the blocks x, y, z. Phases are zero; they matter if frequencies are equal.
    rate_filters : sequence of RateFilter
        Rate filters to compare.
    interval_s : float
        Sample interval, s.
    reaction : float, optional
        Angle of the case divided by that of the block.

    Returns
    -------
    str
        Lines.

    Raises
    ------
    InputError
        The calibration has no lever arms.
    """
    arms = lever_arms_of(calibration, f"unit {calibration.serial_number}")
    C_bg, geometry = np.array(calibration.gyro.C_bg), (np.array(calibration.accelerometer.C_ba), arms.r_b)
    amplitude = np.asarray(amplitude_arcsec, np.float64) * ARCSEC
    block = Dither(C_bg.T, amplitude, np.asarray(frequency_hz, np.float64))
    case = replace(block, axes_b=sensing_directions(C_bg), amplitude_rad=reaction * amplitude)

    def lines() -> Iterator[str]:
        sizes = " ".join(f"{np.linalg.norm(r) / MM:.1f}" for r in arms.r_b)
        yield f"unit {calibration.serial_number}: arms of {sizes} mm, gauge {arms.gauge}"
        for j, axis in enumerate(AXES):
            yield (
                f"gyro {axis}: {amplitude[j] / ARCSEC:g} arcsec at {block.frequency_hz[j]:g} Hz, "
                f"{block.rate[j]:.3f} rad/s; the case {reaction * block.rate[j]:.3g} rad/s"
            )
        if np.unique(block.frequency_hz[amplitude > 0.0]).size < np.count_nonzero(amplitude):
            yield "gyros have the same frequency: the mean of all together assumes equal phases"
        yield ""
        yield from _spectrum(
            f"Reaction of the case, {100.0 * reaction:g} %, true motion; on accelerometers x, y, z in ug",
            *(case, geometry, interval_s),
        )
        yield from _spectrum(
            "Dither of the blocks, as if it were motion of the case; on accelerometers x, y, z in ug",
            *(block, geometry, interval_s),
        )
        yield "Error of the mean compensated specific force, ug"
        yield (
            f"  {'':<8} {'lag':>4} {'gain':>8}   {'false, from blocks in increments':^32}   "
            f"{'residual of the true, from case':^32}"
        )
        truth = size_effect(case, *geometry).averaged(interval_s).aliased(interval_s)
        for rate_filter in rate_filters:
            largest = np.abs(gain(rate_filter, block.frequency_hz[amplitude > 0.0], interval_s)).max(
                initial=0.0
            )
            false, corrected = (
                compensated(dither, *geometry, rate_filter, interval_s).aliased(interval_s)
                for dither in (block, case)
            )
            yield (
                f"  {rate_filter.name:<8} {rate_filter.lag:>4} {largest:>8.1e}   "
                f"{_three(-false.mean)}   {_three((truth - corrected).mean)}"
            )

    return "".join(f"{line.rstrip()}\n" for line in lines())


def _spectrum(title: str, dither: Dither, geometry: tuple[Array, Array], interval_s: float) -> Iterator[str]:
    yield title
    for gyro, axis in enumerate(AXES):
        yield f"  {f'mean, gyro {axis} alone':<37} {_three(size_effect(dither.alone(gyro), *geometry).mean)}"
    lines = size_effect(dither, *geometry)
    yield f"  {'mean, all':<37} {_three(lines.mean)}"
    yield f"  {'line':>10} {'alias':>8} {'averaging':>12}     {'amplitude':^32}"
    rate_hz = 1.0 / interval_s
    for name, frequency, amplitude in zip(lines.names, lines.frequency_hz, lines.amplitude, strict=True):
        if frequency and np.any(amplitude > 1e-6 * UG):
            alias = abs(frequency - rate_hz * np.rint(frequency / rate_hz))
            factor = abs(np.sinc(frequency * interval_s))
            where = f"{frequency:>7g} Hz {alias:>5g} Hz {factor:>12.3f}"
            yield f"  {where}     {_three(amplitude)}   {name}"
    yield ""


def _three(force: Array) -> str:
    return " ".join(f"{value if abs(value) > 1e-9 else 0.0:>#10.3g}" for value in force / UG)
