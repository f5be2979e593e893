"""Simulated units in their first calibration, by hand: raw captures with their truth.

The unit differs from its nominal scales and axes by what a new one does; a person turns it in place, lifts
it, turns it over and sets it down, never quite straight.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from imudrv.calibration import Calibration
from imudrv.files import settings_file
from imudrv.files.settings_file import parse
from imudrv.imu.coefficients import Coefficients
from imudrv.nav.attitude import rotation
from imudrv.records import Records
from imudrv.sim.scenario import Scenario
from imudrv.sim.unit import draw_true_unit, simulate
from imudrv.site import Site
from imudrv.units import ARCSEC, DEG
from imudrv.wire.encode import StreamEncoder
from imudrv.wire.layout import Layout

SITE: Final = Site(latitude_deg=31.2, longitude_deg=121.4, height_m=12.0, gravity_m_s2=9.7946)
K0, SCALE0 = 2000.0, 0.5
"""Nominal scales: pulses per m/s, arcsec per pulse."""

AXES: Final = {"X": 0, "Y": 1, "Z": 2}
FACES: Final = (("+Z", "+X"), ("-Z", "-X"), ("+X", "+Y"), ("-X", "-Y"), ("+Y", "+Z"), ("-Y", "-Z"))


def axis(name: str) -> np.ndarray:
    """Return the unit vector of a body axis such as '-X'."""
    v = np.zeros(3)
    v[AXES[name[1]]] = 1.0 if name[0] == "+" else -1.0
    return v


def pose(up: str, east: str) -> np.ndarray:
    """Return C_nb of a pose."""
    u, e = axis(up), axis(east)
    return np.stack([e, np.cross(u, e), u])


def six_faces_turned() -> list[np.ndarray]:
    """Return the attitudes of the twelve rests of `six-faces-turned`."""
    half = np.diag([-1.0, -1.0, 1.0])
    return [C for up, east in FACES for C in (pose(up, east), half @ pose(up, east))]


def three_loops() -> list[np.ndarray]:
    """Return the attitudes of `three-loops`: four quarter turns about the horizontal X, Y, Z axis."""
    attitudes = []
    for up, east in (("+Z", "+X"), ("+Z", "+Y"), ("+X", "+Z")):
        quarter = rotation(axis(east), np.pi / 2)
        C = pose(up, east)
        for _ in range(5):
            attitudes.append(C)
            C = C @ quarter
    return [C for k, C in enumerate(attitudes) if k != 5]  # the first loop ends where the second begins


@dataclass(frozen=True)
class SimulatedUnit:
    """A scenario of a unit that was never calibrated, and the true one."""

    scenario: Scenario
    truth: Coefficients


def new_unit(
    seed: int,
    layout: Layout,
    attitudes: list[np.ndarray] | None = None,
    *,
    rest_s: float = 60.0,
    scale: float = 0.005,
    pivot_fixed: bool = False,
    gravity_error: float = 0.0,
    set_down: float = 0.004,
    wander: bool = False,
    changes: dict | None = None,
    rests: dict[int, list[dict]] | None = None,
) -> SimulatedUnit:
    """Return a unit and its session by hand.

    Parameters
    ----------
    seed : int
        Of unit, hands and noise.
    layout : Layout
    attitudes : list of ndarray, optional
        Of the rests; default: `six_faces_turned`.
    rest_s : float
    scale : float
        Deviation from the nominal scales, 1 sigma, relative.
    pivot_fixed : bool
        On a table: the origin of b stays where it is.
    gravity_error : float
        True less measured gravity, m/s^2.
    set_down : float
        How far a face leans from level, rad, 1 sigma.
    wander : bool
        Whether the biases wander, 5 ug and 0.005 deg/h with a time constant of 750 s, in steps of 20 s.
    changes : dict, optional
        Of the scenario, by its keys, `unit` added to that here.
    rests : dict of int to list of dict, optional
        Motions in the place of a rest, by its number from 0.
    """
    random = np.random.default_rng(seed)
    attitudes = six_faces_turned() if attitudes is None else attitudes
    calibration = _certificate(random, scale)
    site = SITE.model_copy(update={"gravity_m_s2": SITE.gravity + gravity_error})
    motion: list[dict] = []
    C = np.eye(3)
    for k, wanted in enumerate(attitudes):
        if k or not np.array_equal(wanted, C):
            error = random.normal(0.0, [set_down, set_down, 0.05])
            target = rotation(error, float(np.linalg.norm(error))) @ wanted
            motion += _carry(C, target, random, pivot_fixed)
            C = target
        motion += (rests or {}).get(k, [{"rest": {"duration_s": rest_s}}])
    document = {
        "format": "imu50-scenario",
        "version": 1,
        "seed": seed,
        "site": site.model_dump(exclude_none=True),
        "start": {"pose": "z_up"},
        "motion": motion,
        "unit": {
            "calibration": calibration.model_dump(mode="json"),
            "noise": {"arw_deg_per_sqrt_h": 0.002, "vrw_m_s_per_sqrt_h": 5e-6 * 9.80665 * 60.0},
        },
    }
    for key, value in (changes or {}).items():
        document[key] = {**document.get(key, {}), **value} if isinstance(value, dict) else value
    if wander:
        document["unit"]["bias_steps"] = _wander(random, motion)
    scenario = parse(document, Scenario, "unit")
    return SimulatedUnit(scenario, draw_true_unit(scenario, layout))


def _wander(random: np.random.Generator, motion: list[dict]) -> list[dict]:
    """Return steps of a Gauss-Markov process."""
    length = sum(next(iter(one.values()))["duration_s"] for one in motion)
    kept = np.exp(-20.0 / 750.0)
    sizes = np.repeat([0.005, 5.0], 3)
    at, steps = sizes * random.standard_normal(6), []
    change = at
    for k in range(int(length // 20.0)):
        steps.append(
            {"at_s": 20.0 * k, "gyro_deg_per_h": change[:3].tolist(), "accelerometer_ug": change[3:].tolist()}
        )
        new = kept * at + np.sqrt(1.0 - kept**2) * sizes * random.standard_normal(6)
        change, at = new - at, new
    return steps


def _certificate(random: np.random.Generator, scale: float) -> Calibration:
    """Draw a new unit: scale, 150 arcsec, 1 deg/h, 500 ug, 20 ug/g^2, arms, 0.2 ms."""
    G, A = (np.eye(3) + 150 * ARCSEC * random.standard_normal((3, 3)) for _ in range(2))
    G, A = (m / np.linalg.norm(m, axis=1, keepdims=True) for m in (G, A))
    C_bg = np.linalg.inv(G)
    # b along the gyros: X along gyro X, Y in the plane of X and Y
    q = np.linalg.qr(G.T)[0]
    q = q * np.sign(np.diag(q))
    C_bg, C_ba = q.T @ C_bg, q.T @ np.linalg.inv(A)
    arms = random.normal(0.0, 25.0, (3, 3))
    arms -= arms.mean(axis=0)
    return parse(
        {
            "format": "imu50-calibration",
            "version": 1,
            "serial_number": "50-0017",
            "created": "2026-01-01T00:00:00Z",
            "gyro": {
                "scale_arcsec_per_pulse": (SCALE0 * (1 + scale * random.standard_normal(3))).tolist(),
                "bias_deg_per_h": random.normal(0.0, 1.0, 3).tolist(),
                "C_bg": C_bg.tolist(),
            },
            "accelerometer": {
                "scale_pulse_per_m_s": (K0 * (1 + scale * random.standard_normal(3))).tolist(),
                "bias_ug": random.normal(0.0, 500.0, 3).tolist(),
                "C_ba": C_ba.tolist(),
                "quadratic_ug_per_g2": random.normal(0.0, 20.0, 3).tolist(),
            },
            "size_effect": {
                "r_mm": dict(zip("xyz", arms.round(6).tolist(), strict=True)),
                "gauge": "centroid",
            },
            "skew_ms": float(random.normal(0.0, 0.2)),
        },
        Calibration,
        "unit",
    )


def _carry(C: np.ndarray, target: np.ndarray, random: np.random.Generator, pivot_fixed: bool) -> list[dict]:
    """Return the motions from an attitude to the next."""
    R = target @ C.T
    angle = float(np.arccos(np.clip((np.trace(R) - 1.0) / 2.0, -1.0, 1.0)))
    axis_n = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    if np.linalg.norm(axis_n) < 1e-6:  # half a turn
        axis_n = np.linalg.eigh(0.5 * (R + R.T))[1][:, 2]
    turn = {
        "angle_deg": angle / DEG,
        "duration_s": float(random.uniform(2.5, 4.0)),
        "axis_n": (axis_n / np.linalg.norm(axis_n)).tolist(),
    }
    if pivot_fixed:
        return [{"rotate": turn}]
    turn |= {"wobble_deg": 1.5, "wobble_hz": 1.3}
    sway = {
        "duration_s": 1.5,
        "band_hz": [0.3, 1.5],
        "ramp_s": 0.7,
        "rate_rms_deg_per_s": [4.0, 4.0, 4.0],
        "sway_mm": [20.0, 20.0, 20.0],
    }
    return [{"rock": sway}, {"rotate": turn}, {"rock": sway}]


def pulses_of(unit: SimulatedUnit, layout: Layout) -> Records:
    """Return the pulses of a whole session."""
    return np.concatenate([chunk.pulses for chunk in simulate(unit.scenario, layout)])


def write_session(unit: SimulatedUnit, layout: Layout, folder: Path) -> Path:
    """Write `session.raw`, `site.yaml` and `truth.yaml`; return the capture."""
    encoder = StreamEncoder(layout)
    capture = folder / "session.raw"
    with capture.open("wb") as file:
        for chunk in simulate(unit.scenario, layout):
            file.write(encoder.encode(chunk.pulses).tobytes())
    settings_file.write(folder / "site.yaml", unit.scenario.site)
    truth = unit.scenario.unit.calibration
    if truth is not None:
        settings_file.write(folder / "truth.yaml", truth)
    return capture
