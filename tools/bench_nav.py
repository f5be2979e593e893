"""Speed from wire bytes to velocity and its measurement matrices, compared with python-ins (pyins).

The capture repeats two simulated half turns, which end as they began; the size effect of the second cancels
that of the first. python-ins gets the same increments, already decoded and compensated, in one array as in
its documentation; it integrates attitude, velocity and position and has no equivalent of H.
"""

import resource
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from imudrv.calibration import coefficients
from imudrv.capture import Capture
from imudrv.files.settings_file import parse
from imudrv.imu.compensation import Compensator
from imudrv.nav.attitude import quaternion_of_matrix
from imudrv.nav.mechanisation import Navigator
from imudrv.profiles import load
from imudrv.records import Records
from imudrv.sim.scenario import NOMINAL, Scenario, samples
from imudrv.sim.unit import simulate
from imudrv.units import NS
from imudrv.wire.encode import StreamEncoder

PROFILE: Final = load("imu50-rs422")
LAYOUT: Final = PROFILE.layout()
SCENARIO: Final = parse(
    {
        "format": "imu50-scenario",
        "version": 1,
        "seed": 1,
        "site": {"latitude_deg": 28.2, "longitude_deg": 113.0, "height_m": 60.0},
        "motion": [
            {"rest": {"duration_s": 5}},
            {"rotate": {"angle_deg": 180, "duration_s": 2.5}},
            {"rest": {"duration_s": 5}},
            {"rotate": {"angle_deg": 180, "duration_s": 2.5}},
            {"rest": {"duration_s": 5}},
        ],
    },
    Scenario,
    "the benchmark's motion",
)
"""20 s."""
REPEATS: Final = 180
"""An hour."""
EVERY: Final = 1000
"""Samples per row of velocity and matrices."""
OTHER_REPEATS: Final = 15
"""Part of the hour that python-ins integrates: it keeps its output, some 400 bytes a sample."""
STAGES: Final = ("capture to velocity, H, B, P, Q", "navigate, with H, B, P, Q", "navigate, without")
OTHER: Final = "python-ins, no H"
KNOWN: Final = coefficients(NOMINAL.without_size_effect())


@dataclass(frozen=True)
class Measure:
    """Speed of a stage and of its alternative, samples a second."""

    stage: str
    samples: int
    per_second: float
    other_way: str
    other_samples: int
    other_per_second: float

    @property
    def ratio(self) -> float:
        """Speed of the stage over that of the alternative."""
        return self.per_second / self.other_per_second


class Hour(NamedTuple):
    """Result of the measurement."""

    measures: list[Measure]
    peak_mb: float  # resident memory after the first pass from capture to matrices


def nav(rounds: int) -> Hour:
    """Measure the processing from a capture to H, and navigation alone.

    Parameters
    ----------
    rounds : int
        Number of rounds; the best counts.

    Returns
    -------
    Hour
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hour.raw"
        q_nb = _write(path)
        count = path.stat().st_size // LAYOUT.messages[0].length
        _process(path, q_nb)
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6
        pieces = _period(path)
        other = PythonIns(np.concatenate(pieces), q_nb)
        # alternately, so that other load of the machine affects all
        seconds = [
            (
                _process(path, q_nb),
                _navigate(pieces, q_nb, matrices=True),
                _navigate(pieces, q_nb, matrices=False),
                other.integrate(),
            )
            for _ in range(rounds)
        ]
    *ours, theirs = np.min(seconds, axis=0).tolist()
    return Hour(
        [
            Measure(stage, count * rounds, count / best, OTHER, other.count * rounds, other.count / theirs)
            for stage, best in zip(STAGES, ours, strict=True)
        ],
        peak_mb,
    )


def _write(path: Path) -> NDArray[np.float64]:
    """Write an hour of wire bytes; return the attitude at its start."""
    chunks = list(simulate(SCENARIO, LAYOUT))
    pulses = np.concatenate([chunk.pulses for chunk in chunks])
    first = pulses["counter"].copy()
    encoder = StreamEncoder(LAYOUT)
    with path.open("wb") as file:
        for k in range(REPEATS):
            pulses["counter"] = first + k * len(pulses)
            file.write(encoder.encode(pulses).tobytes())
    return quaternion_of_matrix(chunks[0].truth["C_nb"][0])


def _compensator() -> Compensator:
    return Compensator(KNOWN, LAYOUT)


def _navigator(q_nb: NDArray[np.float64], *, matrices: bool) -> Navigator:
    return Navigator(SCENARIO.site.place, q_nb, C_ba=KNOWN.C_ba if matrices else None, every=EVERY)


def _process(path: Path, q_nb: NDArray[np.float64]) -> float:
    """Return the seconds from the capture to the matrices, piece by piece."""
    navigator = _navigator(q_nb, matrices=True)
    begin = time.perf_counter()
    for increments in Capture(path, PROFILE).increments(_compensator(), lambda _: None):
        navigator.feed(increments)
    return time.perf_counter() - begin


def _period(path: Path) -> list[Records]:
    """Return the increments of the first two half turns, in the pieces of the capture."""
    pieces, wanted = [], samples(SCENARIO, LAYOUT.interval)
    for increments in Capture(path, PROFILE).increments(_compensator(), lambda _: None):
        pieces.append(increments[:wanted])
        wanted -= len(pieces[-1])
        if wanted == 0:
            break
    return pieces


def _navigate(pieces: list[Records], q_nb: NDArray[np.float64], *, matrices: bool) -> float:
    """Return the seconds of navigation over the hour."""
    navigator = _navigator(q_nb, matrices=matrices)
    begin = time.perf_counter()
    for _ in range(REPEATS):
        for increments in pieces:
            navigator.feed(increments)
    return time.perf_counter() - begin


class PythonIns:
    """python-ins on the same increments; both must give the same velocity.

    Parameters
    ----------
    period : ndarray of INCREMENTS
        Repeated `OTHER_REPEATS` times.
    q_nb : ndarray, shape (4,)
        Attitude at the start, scalar first.

    Attributes
    ----------
    count : int
        Number of samples integrated.
    """

    def __init__(self, period: Records, q_nb: NDArray[np.float64]) -> None:
        import pandas as pd
        from pyins import strapdown, util

        increments = np.tile(period, OTHER_REPEATS)
        # front, right, down
        rows = np.hstack([increments[name][:, [1, 0, 2]] * [1, 1, -1] for name in ("dtheta_b", "dv_b")])
        t_s = np.arange(1, len(rows) + 1) * (LAYOUT.interval_ns * NS)
        site = SCENARIO.site
        C_nb = Rotation.from_quat(np.roll(q_nb, -1)).as_matrix()
        swap = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # east, north, up and north, east, down
        heading, pitch, roll = Rotation.from_matrix(swap @ C_nb @ swap).as_euler("ZYX", degrees=True)
        position = {"lat": site.latitude_deg, "lon": site.longitude_deg, "alt": site.height_m}
        rest = {"VN": 0.0, "VE": 0.0, "VD": 0.0, "roll": roll, "pitch": pitch, "heading": heading}
        self._strapdown = strapdown
        self._imu = pd.DataFrame(rows, index=t_s, columns=util.GYRO_COLS + util.ACCEL_COLS)
        self._start = pd.Series({**position, **rest}, name=t_s[0])
        self.count = len(rows)

        other = self._integrated(len(period)).iloc[-1]  # compiles it, too
        navigator = _navigator(q_nb, matrices=False)
        navigator.feed(period[1:])
        v_n = navigator.latest["v_n"][0]
        # python-ins has the rotation within a sample to second order only: an error of (2.4e-3)^2 / 6 of g
        assert np.allclose([other.VE, other.VN], v_n[:2], rtol=0.0, atol=1e-4), (other, v_n)

    def integrate(self) -> float:
        """Return the seconds of an integration."""
        begin = time.perf_counter()
        self._integrated(self.count)
        return time.perf_counter() - begin

    def _integrated(self, count: int):  # type: ignore[no-untyped-def]
        increments = self._strapdown.compute_increments_from_imu(self._imu[:count], "increment")
        return self._strapdown.Integrator(self._start).integrate(increments)
