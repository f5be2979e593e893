"""Location of the unit: the site file."""

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field as Key

from imudrv.files.model import Model
from imudrv.units import DEG

if TYPE_CHECKING:
    from imudrv.nav.mechanisation import Place


class Site(Model):
    """A location on the Earth; `gravity_m_s2` is absent if it was not measured.

    Examples
    --------
    >>> round(Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0).gravity, 5)
    9.79168
    """

    format: Literal["imu50-site"] = "imu50-site"
    version: Literal[1] = 1
    latitude_deg: Annotated[float, Key(ge=-90, le=90)]
    longitude_deg: Annotated[float, Key(ge=-180, le=180)]
    height_m: Annotated[float, Key(ge=-500, le=9000)]
    gravity_m_s2: Annotated[float, Key(ge=9.7, le=9.9)] | None = None

    @property
    def latitude_rad(self) -> float:
        """Geodetic latitude, rad, north positive."""
        return self.latitude_deg * DEG

    @property
    def longitude_rad(self) -> float:
        """Longitude, rad, east positive."""
        return self.longitude_deg * DEG

    @property
    def gravity(self) -> float:
        """Measured gravity, or else normal gravity, m/s^2."""
        if self.gravity_m_s2 is not None:
            return self.gravity_m_s2
        from imudrv.nav.earth import normal_gravity  # a kernel: a file is checked without any

        return normal_gravity(self.latitude_rad, self.height_m)

    @property
    def place(self) -> "Place":
        """The location as `imudrv.Navigator` takes it."""
        from imudrv.nav.mechanisation import Place

        return Place(self.latitude_rad, self.longitude_rad, self.height_m, self.gravity_m_s2)
