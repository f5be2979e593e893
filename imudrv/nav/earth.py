"""The Earth of WGS-84: normal gravity, rotation, radii of curvature.

Source: NIMA TR8350.2, Department of Defense World Geodetic System 1984, third edition, 2000, tables 3.1 to
3.4 and equations 4-1 to 4-3.
"""

from math import cos, sin, sqrt
from typing import Final

from imudrv.kernels import kernel
from imudrv.vectors import Vector

EARTH_RATE: Final = 7.292115e-5
"""Rotation rate of the Earth, rad/s."""
SEMI_MAJOR_AXIS: Final = 6378137.0
"""Semi-major axis of the ellipsoid, m."""
FLATTENING: Final = 1.0 / 298.257223563
"""Flattening of the ellipsoid."""
ECCENTRICITY_SQUARED: Final = FLATTENING * (2.0 - FLATTENING)
"""First eccentricity of the ellipsoid, squared."""
GRAVITY_EQUATOR: Final = 9.7803253359
"""Normal gravity on the ellipsoid at the equator, m/s^2."""
GRAVITY_K: Final = 0.00193185265241
"""Somigliana's constant `k` of the normal gravity formula."""
GRAVITY_M: Final = 0.00344978650684
"""`m`: centrifugal over gravitational acceleration at the equator, `omega^2 a^2 b / GM`."""


@kernel
def normal_gravity(latitude_rad: float, height_m: float) -> float:
    """Return normal gravity: Somigliana's formula (4-1), with the second-order height term (4-3).

    Parameters
    ----------
    latitude_rad : float
        Geodetic latitude, rad.
    height_m : float
        Height above the ellipsoid, m; the series holds to 0.01 ug up to 10 km.

    Returns
    -------
    float
        m/s^2, downwards along the ellipsoid's normal. Real gravity differs by up to some 50 mGal.
    """
    s2 = sin(latitude_rad) ** 2
    on_ellipsoid = GRAVITY_EQUATOR * (1.0 + GRAVITY_K * s2) / sqrt(1.0 - ECCENTRICITY_SQUARED * s2)
    h = height_m / SEMI_MAJOR_AXIS
    return on_ellipsoid * (
        1.0 - 2.0 * (1.0 + FLATTENING + GRAVITY_M - 2.0 * FLATTENING * s2) * h + 3.0 * h * h
    )


@kernel
def earth_rate_n(latitude_rad: float) -> Vector:
    """Return the rotation of the Earth relative to inertial space, in local level axes.

    Parameters
    ----------
    latitude_rad : float
        Geodetic latitude, rad.

    Returns
    -------
    tuple of 3 float
        East, north, up, rad/s.
    """
    return 0.0, EARTH_RATE * cos(latitude_rad), EARTH_RATE * sin(latitude_rad)


@kernel
def radii(latitude_rad: float) -> tuple[float, float]:
    """Return the radii of curvature of the ellipsoid.

    Parameters
    ----------
    latitude_rad : float
        Geodetic latitude, rad.

    Returns
    -------
    tuple of 2 float
        Radius of the meridian (north-south) and of the prime vertical (east-west), m.
    """
    x = 1.0 - ECCENTRICITY_SQUARED * sin(latitude_rad) ** 2
    prime_vertical = SEMI_MAJOR_AXIS / sqrt(x)
    return prime_vertical * (1.0 - ECCENTRICITY_SQUARED) / x, prime_vertical
