from math import pi, radians, sqrt

import numpy as np
import pytest

from imudrv.nav import earth
from imudrv.units import UG

GM = 3.986004418e14  # m^3/s^2, NIMA TR8350.2, table 3.1


@pytest.mark.parametrize(
    ("latitude_deg", "gravity"),
    [(0.0, 9.7803253359), (90.0, 9.8321849378), (-90.0, 9.8321849378)],  # NIMA TR8350.2, table 3.4
)
def test_gravity_on_the_ellipsoid_is_the_published_one(latitude_deg: float, gravity: float) -> None:
    # the table has eleven digits
    assert earth.normal_gravity(radians(latitude_deg), 0.0) == pytest.approx(gravity, abs=1e-10)


def test_constants_belong_to_one_ellipsoid() -> None:
    a, b = earth.SEMI_MAJOR_AXIS, earth.SEMI_MAJOR_AXIS * (1.0 - earth.FLATTENING)
    # twelve digits are published
    assert earth.EARTH_RATE**2 * a * a * b / GM == pytest.approx(earth.GRAVITY_M, rel=1e-11)
    k = b * 9.8321849378 / (a * earth.GRAVITY_EQUATOR) - 1.0
    assert k == pytest.approx(earth.GRAVITY_K, rel=1e-7)  # a difference of eleven-digit numbers


def test_gravity_falls_with_height_as_the_field_of_an_ellipsoid_does() -> None:
    # On the equator gravity is attraction less centrifugal; the attraction with the oblateness term J2.
    r, j2 = earth.SEMI_MAJOR_AXIS + 3000.0, 1.082629821e-3
    a = earth.SEMI_MAJOR_AXIS
    exact = GM / r**2 * (1.0 + 1.5 * j2 * (a / r) ** 2) - earth.EARTH_RATE**2 * r
    on_ellipsoid = GM / a**2 * (1.0 + 1.5 * j2) - earth.EARTH_RATE**2 * a
    fall = earth.normal_gravity(0.0, 3000.0) - earth.normal_gravity(0.0, 0.0)
    # J4 (2e-6 of gravity, its change 2e-6 * 6 h / a) and the series' third order stay below 0.1 ug
    assert fall == pytest.approx(exact - on_ellipsoid, abs=0.1 * UG)


@pytest.mark.parametrize("latitude", [-pi / 2, -0.3, 0.0, 0.5, pi / 2])
def test_earth_rate_points_along_the_axis(latitude: float) -> None:
    east, north, up = earth.earth_rate_n(latitude)
    assert east == 0.0
    assert sqrt(north**2 + up**2) == pytest.approx(7.292115e-5, rel=1e-15)
    assert np.arctan2(up, north) == pytest.approx(latitude, abs=1e-15)
