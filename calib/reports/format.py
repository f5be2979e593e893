"""Format of numbers in reports."""

from math import floor, isnan, log10

import numpy as np

from imudrv.arrays import Array
from imudrv.units import MM


def three_digits(value: float) -> str:
    """Return a number with three significant digits; from 1000 to a million, all digits before the point."""
    return f"{value:.0f}" if 1000.0 <= abs(value) < 1e6 else f"{value:#.3g}".rstrip(".")


def mm(value: float, spec: str = ".2f") -> str:
    """Return a length in mm, or a velocity in mm/s, in a format; nothing for NaN."""
    return "" if isnan(value) else f"{value / MM + 0.0:{spec}}"


def decimals(sigma_m: Array) -> int:
    """Return the number of decimals, in mm, that shows two digits of the smallest nonzero uncertainty."""
    least = float(sigma_m[sigma_m > 1e-9].min(initial=1.0)) / MM
    return int(np.clip(1 - floor(log10(least)), 1, 5))
