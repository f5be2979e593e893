"""Alignment and navigation on a real ring-laser unit, from wire bytes on.

The log is of a parked vehicle that people and the engine shake (public PSINS toolbox): X right, Y front, Z
up; quiet from 600 to 960 s. Its first three rows say how the vehicle stood, yaw counter-clockwise from north
and to 0.1 deg, where, and what a pulse is. The accelerometers' counts leap by up to 4 pulses: 4.9 mm/s is
what a velocity here cannot show.
"""

import importlib.util
from itertools import pairwise
from math import cos, hypot, radians, sin, sqrt
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from imudrv import profiles
from imudrv.capture import Capture
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.nav.alignment import Aligned, Alignment
from imudrv.nav.attitude import quaternion_of_matrix
from imudrv.nav.earth import earth_rate_n, normal_gravity
from imudrv.nav.mechanisation import Navigator, Place
from imudrv.records import Records
from imudrv.units import ARCSEC, DEG, DEG_PER_H, UG

TOOLS = Path(__file__).parents[2] / "tools"
_spec = importlib.util.spec_from_file_location("psins_to_wire", TOOLS / "psins_to_wire.py")
assert _spec is not None
assert _spec.loader is not None
psins_to_wire = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(psins_to_wire)

WINDOW = (600, 960)
"""The quiet window, s."""
QUARTERS = tuple(pairwise(range(600, 961, 90)))
GYRO_BIAS, ACCELEROMETER_BIAS = 0.01 * DEG_PER_H, 50.0 * UG
"""1 sigma, the class of such a unit; its calibration is not published."""
RESOLUTION = 4.9e-3  # m/s, see above
EARTH_RADIUS = 6.36e6


class Log(NamedTuple):
    increments: Records
    place: tuple[float, float, float]  # latitude and longitude, rad, height, m
    heading_deg: float  # of the front, from north to east

    def part(self, begin_s: float, end_s: float) -> Records:
        return self.increments[round(begin_s * 100) : round(end_s * 100)]

    def aligned(self, begin_s: float, end_s: float, bias: float = ACCELEROMETER_BIAS) -> Aligned:
        alignment = Alignment(self.place[0], GYRO_BIAS, bias, end_s - begin_s)
        alignment.feed(self.part(begin_s, end_s))
        assert alignment.done
        return alignment.result()

    def navigated(self, begin_s: float, end_s: float, q_nb: ArrayLike) -> Records:
        """A row each second."""
        return Navigator(Place(*self.place), q_nb, every=100).feed(self.part(begin_s, end_s))


@pytest.fixture(scope="module")
def log(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Log:
    source, raw = data / "lasergyro.imu", tmp_path_factory.mktemp("real") / "lasergyro.raw"
    lines = [line for line in source.read_text().splitlines() if line and not line.startswith("%")]
    (_, _, yaw, *_), (latitude, longitude, height, _, _, g), scales = (
        [float(word) for word in line.split()] for line in lines[:3]
    )
    psins_to_wire.convert(source, raw)
    capture = Capture(raw, profiles.load(str(psins_to_wire.PROFILE)))
    nothing, level = np.zeros(3), np.eye(3)
    c = Coefficients(
        gyro_scale=np.array(scales[:3]) * ARCSEC,
        gyro_bias=nothing,
        C_bg=level,
        accelerometer_scale=1.0 / (np.array(scales[3:]) * 1e-6 * g),
        accelerometer_bias=nothing,
        C_ba=level,
    )
    compensator = Compensator(c, capture.layout)
    increments = np.concatenate(list(capture.increments(compensator, lambda _: None)))
    return Log(increments, (radians(latitude), radians(longitude), height), -yaw)


def matrix(q_nb: NDArray[np.float64]) -> Rotation:
    return Rotation.from_quat(np.roll(q_nb, -1))


def level_deg(q_nb: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far X and Y point upwards."""
    degrees: NDArray[np.float64] = np.degrees(np.arcsin(matrix(q_nb).as_matrix()[2, :2]))
    return degrees


def test_the_quiet_window_is_at_rest_and_people_are_detected_outside_it(log: Log) -> None:
    assert log.aligned(*WINDOW).motion is None
    assert "moved" in str(log.aligned(960, 1320).motion)


def test_the_force_is_gravity(log: Log) -> None:
    force = np.linalg.norm(log.part(*WINDOW)["dv_b"].sum(axis=0)) / 360.0
    # Real gravity is some 50 mGal, 50 ug, off the normal one, the calibration as much: 3 sigma.
    limit = 3.0 * hypot(50.0 * UG, ACCELEROMETER_BIAS)
    assert force == pytest.approx(normal_gravity(log.place[0], log.place[2]), abs=limit)


def test_the_level_of_each_quarter_is_the_same_to_a_hundredth_of_a_degree(log: Log) -> None:
    levels = [level_deg(log.aligned(*quarter).q_nb) for quarter in QUARTERS]
    # the vehicle itself leans over by 0.006 deg meanwhile (next test)
    assert np.ptp(levels, axis=0).max() < 0.01


def test_what_level_changes_from_quarter_to_quarter_the_gyros_have_felt(log: Log) -> None:
    for before, after in pairwise(QUARTERS):
        # a constant bias of the accelerometers stays the same from quarter to quarter
        first, second = (log.aligned(*quarter, bias=0.0) for quarter in (before, after))
        carried = log.navigated(*after, first.q_nb)["q_nb"][-1]
        apart = (matrix(second.q_nb) * matrix(carried).inv()).as_rotvec()
        drift = GYRO_BIAS * 90.0  # 2.5e-4 deg
        # on the way level drifts, too, by what the first quarter's heading is off
        turned = earth_rate_n(log.place[0])[1] * first.heading_sigma_rad * 90.0
        sigma = np.linalg.norm([first.level_sigma_rad, second.level_sigma_rad, drift, turned])
        assert np.abs(apart[:2]).max() < 3.0 * sigma


def test_heading_is_that_of_the_vehicle_within_its_predicted_sigma(log: Log) -> None:
    aligned = log.aligned(*WINDOW)
    off_deg = aligned.heading_rad / DEG - log.heading_deg
    assert abs(off_deg) < 3.0 * aligned.heading_sigma_rad / DEG
    # 0.01 deg/h / (15.04 deg/h cos 34.2 deg) = 0.046 deg, and noise. The log gives yaw to 0.1 deg: a sigma
    # above it would prove nothing.
    assert 0.046 * DEG < aligned.heading_sigma_rad < 0.1 * DEG


@pytest.mark.parametrize("quarter", QUARTERS)
def test_heading_is_so_in_each_quarter(log: Log, quarter: tuple[int, int]) -> None:
    aligned = log.aligned(*quarter)
    assert abs(aligned.heading_rad / DEG - log.heading_deg) < 3.0 * aligned.heading_sigma_rad / DEG


def test_alignment_and_navigation_of_the_same_window_agree(log: Log) -> None:
    aligned = log.aligned(*WINDOW)
    turns = Rotation.from_rotvec(log.part(*WINDOW)["dtheta_b"])
    while len(turns) > 1:  # a product of all in their order; at rest coning is nothing
        odd = turns[len(turns) // 2 * 2 :]
        pairs = turns[0 : len(turns) // 2 * 2 : 2] * turns[1::2]
        turns = Rotation.concatenate([pairs, odd]) if len(odd) else pairs
    earth = Rotation.from_rotvec(np.array(earth_rate_n(log.place[0])) * 360.0)
    at_begin = (earth * matrix(aligned.q_nb) * turns[0].inv()).as_matrix()
    rows = log.navigated(*WINDOW, quaternion_of_matrix(at_begin))
    # Alignment makes this velocity as small as an attitude can; what is left is the log's resolution, in the
    # velocity and in the start of it.
    assert np.abs(rows["v_n"][:, :2]).max() < 2.0 * RESOLUTION


@pytest.mark.parametrize(
    ("begin_s", "aligned_s", "end_s"), [(600, 780, 960), (690, 780, 960), (780, 870, 960), (600, 960, 1847)]
)
def test_navigation_from_there_on_drifts_as_schuler_and_the_predicted_sigma_allow(
    log: Log, begin_s: int, aligned_s: int, end_s: int
) -> None:
    # A bias of the accelerometers drives no velocity: alignment has met it with a tilt.
    aligned = log.aligned(begin_s, aligned_s, bias=0.0)
    rows = log.navigated(aligned_s, end_s, aligned.q_nb)
    t = np.arange(1, len(rows) + 1)
    gravity = normal_gravity(log.place[0], log.place[2])
    schuler = sqrt(gravity / EARTH_RADIUS)
    # A tilt phi swings velocity by phi sqrt(g R) sin; a drift d, which is what the heading's sigma is of the
    # Earth's rate, by d R (1 - cos) (Titterton and Weston, 2nd ed., chapter 12).
    from_tilt = aligned.level_sigma_rad * gravity / schuler * np.array([sin(schuler * x) for x in t])
    drift = earth_rate_n(log.place[0])[1] * aligned.heading_sigma_rad
    from_drift = drift * EARTH_RADIUS * np.array([1.0 - cos(schuler * x) for x in t])
    bound = 3.0 * np.hypot(from_tilt, from_drift) + RESOLUTION
    assert (np.abs(rows["v_n"][:, :2]) < bound[:, None]).all()


def test_a_quarter_of_an_hour_of_navigation_is_that_of_a_laser_gyro_unit(log: Log) -> None:
    rows = log.navigated(960, 1847, log.aligned(*WINDOW).q_nb)
    latitude, longitude, _ = log.place
    north_m = (rows["latitude_rad"] - latitude) * EARTH_RADIUS
    east_m = (rows["longitude_rad"] - longitude) * EARTH_RADIUS * cos(latitude)
    # A drift d tilts the level by d t, so that the place is off by d g t^3 / 6: 55 m for 0.01 deg/h; 3 sigma.
    assert np.hypot(north_m, east_m).max() < 3.0 * GYRO_BIAS * 9.8 * 887.0**3 / 6.0
