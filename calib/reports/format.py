"""Numbers and counts as reports show them."""

from math import floor, log10

import numpy as np

from imudrv.arrays import Array
from imudrv.units import MM


def three_digits(value: float) -> str:
    """Three digits; whole numbers up to a million whole."""
    return f"{value:.0f}" if 1000.0 <= abs(value) < 1e6 else f"{value:#.3g}".rstrip(".")


def decimals(sigma_m: Array) -> int:
    """Places behind the point, mm, that leave two digits of the smallest uncertainty that is not zero."""
    least = float(sigma_m[sigma_m > 1e-9].min(initial=1.0)) / MM
    return int(np.clip(1 - floor(log10(least)), 1, 5))


def counted(n: int, what: str) -> str:
    """Return a count with its noun: '1 rotation', '3 rotations'."""
    return f"{n} {what}{'' if n == 1 else 's'}"
