"""Conversion factors and constants; everything inside is in SI and radians.

Multiply by a factor to convert to SI (``30.0 * ARCSEC`` is in rad), divide to convert from SI.

>>> from imudrv.units import ARCSEC, URAD
>>> round(0.5 * ARCSEC / URAD, 3)  # half a second of arc in microradians
2.424
"""

from math import pi
from typing import Final

DEG: Final = pi / 180.0
"""One degree, rad."""
ARCSEC: Final = DEG / 3600.0
"""One second of arc, rad."""
DEG_PER_H: Final = DEG / 3600.0
"""One degree per hour, rad/s."""
DEG_PER_SQRT_H: Final = DEG / 60.0
"""One degree per square root of an hour (angle random walk), rad/sqrt(s)."""
STANDARD_GRAVITY: Final = 9.80665
"""Standard gravity, m/s^2 (3rd CGPM, 1901)."""
UG: Final = 1e-6 * STANDARD_GRAVITY
"""One micro-g, m/s^2."""
MGAL: Final = 1e-5
"""One milligal, m/s^2."""
MM: Final = 1e-3
"""One millimetre, m."""
URAD: Final = 1e-6
"""One microradian, rad."""
PPM: Final = 1e-6
"""One part per million."""
MS: Final = 1e-3
"""One millisecond, s."""
NS: Final = 1e-9
"""One nanosecond, s."""
NS_PER_S: Final = 1_000_000_000
"""Nanoseconds in a second."""
