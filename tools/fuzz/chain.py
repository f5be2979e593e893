"""Target: the processing chain from a capture to compensated increments."""

import functools
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.random import Generator

from imudrv.calibration import Calibration, coefficients
from imudrv.files import settings_file
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import NAMES
from imudrv.imu.sequence import SequenceTracker
from imudrv.records import Records
from imudrv.sim import scenario
from imudrv.wire.candump import format_candump
from imudrv.wire.decoder import CaptureDecoder

from .properties import Cuts, Setup, whole_as_pieces
from .random_input import mutated, pick, small_number
from .units import SHIPPED, transmit

CALIBRATION: Final = scenario.NOMINAL.model_dump(mode="json", exclude_none=True) | {
    "temperature": {
        "reference_degc": 35,
        "range_degc": [10, 60],
        "gyro_bias_deg_per_h_per_k": [0.01, -0.02, 0.03],
        "gyro_scale_ppm_per_k": [2, -3, 4],
        "accelerometer_bias_ug_per_k": [10, -20, 15],
        "accelerometer_scale_ppm_per_k": [20, -30, 10],
    },
    "provenance": {"runs": ["a", "b"], "sigma": {"x": 0.1}},
}
COEFFICIENTS: Final = coefficients(settings_file.parse(CALIBRATION, Calibration, "a unit"))


def make_chain(rng: Generator) -> tuple[Setup, bytes]:
    """Return a mutated capture of a shipped profile."""
    name = pick(rng, tuple(SHIPPED))
    sent, more = (transmit(rng, SHIPPED[name], n) for n in (small_number(rng), 3))
    if SHIPPED[name].can:
        sent, more = format_candump(sent), format_candump(more)
    tokens = [more, more[: len(more) // 2], more[:4], b"\n", rng.bytes(50)]
    return [name, pick(rng, NAMES), bool(rng.integers(4))], mutated(rng, sent, tokens)


def check_chain(setup: Setup, data: bytes, cuts: Cuts) -> None:
    """Check that counts add up at any moment, and increments are finite, ordered and the same in pieces."""
    name, filter_name, size_effect = setup
    layout = SHIPPED[name]
    numbers = COEFFICIENTS if size_effect else replace(COEFFICIENTS, r_b=None)
    outcomes: list[Any] = []

    def run(parts: list[bytes]) -> list[Records]:
        decoder, tracker = CaptureDecoder(layout), SequenceTracker(layout)
        compensator, out = Compensator(numbers, layout, filter_name), []
        for feed in (*(functools.partial(decoder.feed, part) for part in parts), decoder.close):
            out.append(compensator.feed(tracker.feed(feed())))
            assert tracker.counts.closes, f"{tracker.counts} does not add up"
        outcomes.append((tracker.counts, decoder.rejected))
        return [np.concatenate([*out, compensator.close()])]

    (increments,) = whole_as_pieces(run, data, cuts)
    assert outcomes[0] == outcomes[1], f"whole: {outcomes[0]}, in pieces: {outcomes[1]}"
    counts, rejected = outcomes[0]
    assert len(increments) == counts.good
    assert np.all(np.diff(increments["t_ns"]) > 0), "time goes backwards"
    require_finite(increments)
    if not layout.can:
        lost = sum(entry.length for entry in rejected.values())
        assert layout.messages[0].length * counts.frames + lost == len(data)


def require_finite(increments: Records) -> None:
    """Check for infinity and NaN."""
    for name in ("dtheta_b", "dv_b"):
        assert np.isfinite(increments[name]).all(), f"{name} is not finite"
