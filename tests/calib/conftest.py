"""Ideal increments of a unit that rests and turns on a bench, with white noise; and recordings of samples."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation as Attitude

from imudrv import profiles
from imudrv.nav.earth import earth_rate_n, normal_gravity
from imudrv.records import INCREMENTS, PULSES, Arrival, Flag, Records, Source
from imudrv.sinks.base import Batch
from imudrv.sinks.recorder import Recorder
from imudrv.site import Site
from imudrv.units import DEG, NS
from imudrv.wire.datagram import encode
from imudrv.wire.encode import StreamEncoder

Array = NDArray[np.float64]

SITE = Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0)
POSES = {  # C_nb
    "+Z": np.eye(3),
    "+X": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    "+Y": np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
    "-Z": np.diag([1.0, -1.0, -1.0]),
}


class Step(NamedTuple):
    """A turn by the quintic of least jerk about an axis fixed on the bench; 0 deg: a rest."""

    duration_s: float
    angle_deg: float = 0.0
    axis_n: tuple[float, float, float] = (0.0, 0.0, 1.0)


Bench = Callable[..., Records]


def increments(
    *steps: Step,
    up: str = "+Z",
    arw: float = 6e-7,
    vrw: float = 5e-5,
    interval_ns: int = 2_000_000,
    seed: int = 1,
    tilt: ArrayLike = (2e-3, -1e-3, 0.0),
) -> Records:
    """Increments of the steps, one behind the other; random walks of angle and velocity, SI."""
    tau = interval_ns * NS
    rng = np.random.default_rng(seed)
    omega_ie, gravity = earth_rate_n(SITE.latitude_rad), normal_gravity(SITE.latitude_rad, SITE.height_m)
    C_nb = Attitude.from_rotvec(np.asarray(tilt)) * Attitude.from_matrix(POSES[up])
    dtheta, dv = [], []
    for duration_s, angle_deg, axis_n in steps:
        n = round(duration_s / tau)
        u = np.arange(n + 1) / n
        angle = angle_deg * DEG * u**3 * (10.0 - 15.0 * u + 6.0 * u * u)
        axis = np.asarray(axis_n) / np.linalg.norm(axis_n)
        attitudes = Attitude.from_rotvec(np.outer(angle, axis)) * C_nb
        middle = Attitude.from_rotvec(np.outer(0.5 * (angle[1:] + angle[:-1]), axis)) * C_nb
        turned = middle.inv().apply(np.outer(np.diff(angle), axis) + np.multiply(omega_ie, tau))
        dtheta.append(turned)
        dv.append(middle.inv().apply([0.0, 0.0, gravity * tau]))
        C_nb = attitudes[-1]
    n = sum(map(len, dtheta))
    out = np.zeros(n, INCREMENTS)
    out["counter"] = 1000 + np.arange(n)
    out["interval_ns"], out["flags"] = interval_ns, Flag.VALID
    out["t_ns"] = (np.arange(n) + 1) * interval_ns
    out["dtheta_b"] = np.concatenate(dtheta) + arw * tau**0.5 * rng.standard_normal((n, 3))
    out["dv_b"] = np.concatenate(dv) + vrw * tau**0.5 * rng.standard_normal((n, 3))
    return out


@pytest.fixture(scope="session")
def bench() -> Bench:
    """Makes increments; see `increments`."""
    return increments


@pytest.fixture(scope="session")
def step() -> type[Step]:
    """A step of the bench."""
    return Step


@pytest.fixture(scope="session")
def site() -> Site:
    """Site of the bench."""
    return SITE


READ = 500
"""Samples of a read."""


def record(
    path: Path,
    counters: Iterable[int],
    profile: str = "imu50-rs422",
    unit: str = "nominal",
    calibration: bytes | None = None,
) -> Path:
    """Make a recording of samples at rest; counters as the service counts them."""
    layout = profiles.load(profile).layout()
    counter = np.array(list(counters))
    recorder = Recorder(
        path,
        layout=layout,
        profile=profiles.content(profile),
        calibration=calibration,
        source=Source.SIMULATOR,
        port="nowhere",
        unit=unit,
    )
    encoder = StreamEncoder(layout)
    for at in range(0, len(counter), READ):
        pulses = np.zeros(len(counter[at : at + READ]), PULSES)
        increments = np.zeros(len(pulses), INCREMENTS)
        increments["counter"] = counter[at : at + READ]
        pulses["counter"] = increments["counter"] % (1 << layout.sequence.bits)
        pulses["temperature_degc"] = 35.0
        recorder.arrived(Arrival(at, encoder.encode(pulses).tobytes()).block)
        recorder.publish(Batch(pulses, increments, encode(increments, Source.SIMULATOR)))
    recorder.close()
    return path


@pytest.fixture(scope="session")
def recorded() -> Callable[..., Path]:
    """Makes recordings; see `record`."""
    return record
