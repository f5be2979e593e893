"""The demonstration: the turns of the bench procedure on a simulated unit, from wire bytes to velocity."""

from collections.abc import Callable
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from imudrv import profiles
from imudrv.calibration import Calibration, coefficients
from imudrv.imu.accounting import Account, Accountant
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import rate_filter
from imudrv.nav.alignment import DURATION_S, Aligned, Alignment
from imudrv.nav.mechanisation import Navigator
from imudrv.records import Records
from imudrv.sim import scenario as scenarios
from imudrv.sim.capture import record
from imudrv.sim.scenario import Scenario, StreamRates
from imudrv.units import ARCSEC, DEG, DEG_PER_H, NS, UG
from imudrv.wire.decoder import CaptureDecoder
from imudrv.wire.layout import Layout

PROFILE: Final = "imu50-rs422-acc"
RUNS: Final = ("z-up", "x-up", "y-up")
LINE: Final = StreamRates(bit_flips=1e-3, bytes_lost=5e-4, false_sync_between=5e-4)
"""What the demonstration's line does to a frame: bad, as with a loose connector."""
STILL_S: Final = 2.0
"""Rest that is navigated before the turn, s."""
TOLD_S: Final = (0.1, 0.6)
"""When after the turn velocity is told: at rest again, and before residual biases have made much of it."""


class Left(NamedTuple):
    """Horizontal velocity in error after the turn, m/s."""

    uncompensated: float
    compensated: float


def demo(say: Callable[[str], None]) -> None:
    """Simulate, decode, compensate and navigate the three turns; tell what came out.

    The unit has errors that its calibration does not know; the sensing points of its accelerometers it knows.

    Parameters
    ----------
    say : callable
        Told each line.
    """
    layout = profiles.load(PROFILE).layout()
    say(
        f"Three half turns of a simulated unit, {layout.name} at {1e9 / layout.interval_ns:.0f} Hz, bad line."
    )
    for name in RUNS:
        scenario = scenarios.load(name)
        scenario = scenario.model_copy(update={"faults": scenario.faults.model_copy(update={"stream": LINE})})
        pulses, account, size = _driven(scenario, layout)
        say("")
        say(f"{name}, {size / 1e6:.1f} MB from the wire")
        say(f"  {account}")
        calibration = scenario.unit.calibration or scenarios.NOMINAL
        aligned, left = _velocities(pulses, calibration, scenario, layout)
        say(
            f"  aligned in {aligned.duration_s:.0f} s, predicted sigma: heading"
            f" {aligned.heading_sigma_rad / DEG:.3f} deg, level {aligned.level_sigma_rad / ARCSEC:.1f} arcsec"
        )
        say(
            f"  horizontal velocity left by half a turn: {left.uncompensated * 1e3:.1f} mm/s with the size"
            f" effect in, {left.compensated * 1e3:.1f} mm/s with it compensated"
        )


def _driven(scenario: Scenario, layout: Layout) -> tuple[Records, Account, int]:
    """Pulses of a run as the driver saw them, the books on them, and the bytes of the wire."""
    decoder, accountant = CaptureDecoder(layout), Accountant(layout)
    pieces, size = [], 0
    for data, _ in record(scenario, layout):
        size += len(data)
        pieces.append(accountant.feed(decoder.feed(data)))
    pieces.append(accountant.feed(decoder.close()))
    return np.concatenate(pieces), accountant.account, size


def _velocities(
    pulses: Records, calibration: Calibration, scenario: Scenario, layout: Layout
) -> tuple[Aligned, Left]:
    """Align and navigate the same pulses twice."""
    site, residuals = scenario.site, scenario.unit.residuals
    known = coefficients(calibration)
    turned_at_s = scenario.motion[0].motion.duration_s + scenario.motion[1].motion.duration_s
    left = []
    for c in (replace(known, r_b=None), known):
        compensator = Compensator(c, layout, rate_filter("causal", layout.interval_ns))
        increments = np.concatenate([compensator.feed(pulses), compensator.close()])
        alignment = Alignment(
            site.latitude_rad,
            residuals.gyro_bias_deg_per_h * DEG_PER_H,
            residuals.accelerometer_bias_ug * UG,
            duration_s=DURATION_S - STILL_S,
        )
        rest = alignment.feed(increments)
        aligned = alignment.result()
        navigator = Navigator(
            site.latitude_rad, site.longitude_rad, site.height_m, site.gravity_m_s2, aligned.q_nb
        )
        told = navigator.feed(rest)
        since_turn_s = told["t_ns"] * NS - turned_at_s
        v_n = told["v_n"][(TOLD_S[0] < since_turn_s) & (since_turn_s < TOLD_S[1])].mean(axis=0)
        left.append(float(np.hypot(v_n[0], v_n[1])))
    return aligned, Left(*left)
