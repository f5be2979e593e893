"""A calibration is replaced between two samples; any pieces give the same bits."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from imudrv.chain import Chain
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.rate_filter import RateFilterName, rate_filter
from imudrv.profiles import load
from imudrv.records import PULSES, Flag, Records
from imudrv.units import ARCSEC
from imudrv.wire.encode import StreamEncoder

PROFILE = load("imu50-rs422")
TAU_NS = 1_000_000
BARE = Coefficients(
    gyro_scale=np.full(3, 0.5 * ARCSEC),
    gyro_bias=np.zeros(3),
    C_bg=np.eye(3),
    accelerometer_scale=np.full(3, 2000.0),
    accelerometer_bias=np.zeros(3),
    C_ba=np.eye(3),
)
ARMS = replace(BARE, r_b=np.array([[0.02, 0.0, -0.01], [0.01, 0.03, 0.0], [0.0, -0.02, 0.01]]))
LONGER = replace(ARMS, r_b=2.0 * ARMS.r_b if ARMS.r_b is not None else None)
SAMPLES = 400


def wire() -> list[bytes]:
    """Frames of a unit that turns to and fro."""
    pulses = np.zeros(SAMPLES, PULSES)
    pulses["counter"] = np.arange(SAMPLES)
    turn = np.sin(np.arange(SAMPLES) / 30.0)[:, None]
    pulses["gyro"] = np.rint(turn * [300.0, -200.0, 100.0])
    pulses["accelerometer"] = [0, 0, 20]
    return [row.tobytes() for row in StreamEncoder(PROFILE.layout()).encode(pulses)]


def through(chain: Chain, frames: list[bytes], first: int = 0) -> list[Records]:
    return [
        chain.feed(frame, (first + k + 1) * TAU_NS + 400_000).increments for k, frame in enumerate(frames)
    ]


@pytest.mark.parametrize("name", ["causal", "centred", "dither"])
@pytest.mark.parametrize(("old", "new"), [(ARMS, LONGER), (BARE, ARMS), (ARMS, BARE)])
def test_a_calibration_is_replaced_without_a_sample_lost_doubled_or_left_uncompensated(
    name: RateFilterName, old: Coefficients, new: Coefficients
) -> None:
    frames = wire()
    rates = rate_filter(name, TAU_NS)
    chain = Chain(PROFILE, old, name)
    before = through(chain, frames[:200])
    chain.replace_calibration(new)
    after = through(chain, frames[200:], 200)
    got = np.concatenate([*before, *after, chain.close().increments])

    assert got["counter"].tolist() == list(range(SAMPLES))
    alone = [
        np.concatenate([*through(p, frames), p.close().increments])
        for p in (Chain(PROFILE, old, name), Chain(PROFILE, new, name))
    ]
    same = [np.all(got["dv_b"] == a["dv_b"], axis=1) for a in alone]
    switched = int(np.argmin(same[0]))
    assert 200 - rates.lag <= switched <= 200 + len(rates.taps) + 1
    if new.r_b is None:
        # What the old one still held back goes without its size effect, and says so.
        switched += int(np.argmax(same[1][switched:]))
    assert np.all(same[1][switched:])
    if old.r_b is not None and new.r_b is not None:
        assert np.all(got["flags"][len(rates.taps) : -rates.lag or None] & Flag.SIZE_EFFECT)


def test_any_pieces_give_the_same_bits() -> None:
    data = b"".join(wire())
    rng = np.random.default_rng(3)
    results = []
    for cuts in ([0, len(data)], [0, *np.sort(rng.integers(0, len(data), 90)).tolist(), len(data)]):
        chain = Chain(PROFILE, ARMS, "dither")
        parts = [chain.feed(data[a:b], 0).increments for a, b in pairwise(cuts)]
        results.append(np.concatenate([*parts, chain.close().increments]))
    for name in ("counter", "dtheta_b", "dv_b", "interval_ns"):
        np.testing.assert_array_equal(results[0][name], results[1][name])
