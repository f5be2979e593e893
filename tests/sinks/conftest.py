from collections.abc import Callable

import numpy as np
import pytest
from realtime import until

from imudrv.records import INCREMENTS, PULSES, Source
from imudrv.sinks.base import Batch
from imudrv.wire.datagram import encode

BatchMaker = Callable[[int, int], Batch]
Waiter = Callable[[Callable[[], object]], None]


@pytest.fixture
def batch() -> BatchMaker:
    """Maker of a batch: its first counter and its number of samples."""

    def make(first: int, count: int) -> Batch:
        increments = np.zeros(count, INCREMENTS)
        increments["counter"] = np.arange(first, first + count)
        increments["t_ns"] = 1_700_000_000_000_000_000 + increments["counter"] * 1_000_000
        increments["interval_ns"] = 1_000_000
        increments["dtheta_b"] = increments["counter"][:, None] * 1e-9 + [1e-6, -2e-6, 3e-6]
        increments["dv_b"] = [0.0, 1e-3, 9.8e-3]
        increments["flags"] = 1
        pulses = np.zeros(count, PULSES)
        pulses["counter"] = increments["counter"]
        pulses["interval_ns"] = 1_000_000
        pulses["gyro"] = pulses["counter"][:, None] % 7 - [0, 1, 2]
        pulses["accelerometer"] = [0, 1, 20]
        pulses["temperature_degc"] = [35.12, 34.95, 35.01, 34.88, np.nan, np.nan]
        return Batch(pulses, increments, encode(increments, Source.SIMULATOR))

    return make


@pytest.fixture
def wait_for() -> Waiter:
    """Wait until something is so."""
    return until
