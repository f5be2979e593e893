"""The effect of dither as text."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import ArrayLike

from calib.certificate import lever_arms_of
from calib.dither.spectrum import AXES, Dither, compensated, gain, in_increments, of_case, size_effect
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
    """Tell what a unit's dither does: to its accelerometers, and through the rate filters.

    Parameters
    ----------
    calibration : Calibration
        With lever arms.
    amplitude_arcsec, frequency_hz : array_like, shape (3,)
        Of the blocks x, y, z. Phases are zero; they matter where frequencies are equal.
    rate_filters : sequence of RateFilter
        To be told of.
    interval_s : float
        Sample interval.
    reaction : float, optional
        Of the case: its angle over the block's.

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
    C_bg, geometry = calibration.gyro.C_bg_array, (calibration.accelerometer.C_ba_array, arms.r_b)
    amplitude = np.asarray(amplitude_arcsec, np.float64) * ARCSEC
    block = in_increments(C_bg, amplitude, frequency_hz)
    case = of_case(C_bg, reaction * amplitude, frequency_hz)

    def told() -> Iterator[str]:
        sizes = " ".join(f"{np.linalg.norm(r) / MM:.1f}" for r in arms.r_b)
        yield f"unit {calibration.serial_number}: arms of {sizes} mm, gauge {arms.gauge}"
        for j, axis in enumerate(AXES):
            yield (
                f"gyro {axis}: {amplitude[j] / ARCSEC:g} arcsec at {block.frequency_hz[j]:g} Hz, "
                f"{block.rate[j]:.3f} rad/s; the case {reaction * block.rate[j]:.3g} rad/s"
            )
        if np.unique(block.frequency_hz[amplitude > 0.0]).size < np.count_nonzero(amplitude):
            yield "gyros of one frequency: the means of all together are those of equal phases"
        yield ""
        yield from _spectrum(
            f"The case's reaction, {100.0 * reaction:g} %, true; on accelerometers x, y, z in ug",
            *(case, geometry, interval_s),
        )
        yield from _spectrum(
            "The blocks' dither, were it motion of the case; on accelerometers x, y, z in ug",
            *(block, geometry, interval_s),
        )
        yield "What comes into the mean of the compensated velocity, ug"
        yield (
            f"  {'':<8} {'late':>4} {'passes':>8}   {'block in the increments: false':^32}   "
            f"{'case: left of the true':^32}"
        )
        truth = size_effect(case, *geometry).averaged(interval_s)
        for each in rate_filters:
            passes = np.max(np.abs(gain(each, block.frequency_hz[amplitude > 0.0], interval_s)), initial=0.0)
            false = -compensated(block, *geometry, each, interval_s).seen(interval_s).mean
            left = (truth - compensated(case, *geometry, each, interval_s)).seen(interval_s).mean
            yield f"  {each.name:<8} {each.lag:>4} {passes:>8.1e}   {_three(false)}   {_three(left)}"

    return "".join(f"{line.rstrip()}\n" for line in told())


def _spectrum(title: str, dither: Dither, geometry: tuple[Array, Array], interval_s: float) -> Iterator[str]:
    yield title
    for gyro, axis in enumerate(AXES):
        yield f"  {f'mean, gyro {axis} alone':<37} {_three(size_effect(dither.alone(gyro), *geometry).mean)}"
    lines = size_effect(dither, *geometry)
    yield f"  {'mean, all':<37} {_three(lines.mean)}"
    yield f"  {'line':>10} {'seen at':>8} {'increments':>12}     {'amplitude':^32}"
    rate_hz = 1.0 / interval_s
    for name, frequency, amplitude in zip(lines.names, lines.frequency_hz, lines.amplitude, strict=True):
        if frequency and np.any(amplitude > 1e-6 * UG):
            seen = abs(frequency - rate_hz * np.rint(frequency / rate_hz))
            keep = abs(np.sinc(frequency * interval_s))
            where = f"{frequency:>7g} Hz {seen:>5g} Hz {f'keep {keep:.3f}':>12}"
            yield f"  {where}     {_three(amplitude)}   {name}"
    yield ""


def _three(force: Array) -> str:
    return " ".join(f"{value if abs(value) > 1e-9 else 0.0:>#10.3g}" for value in force / UG)
