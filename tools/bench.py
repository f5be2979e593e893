#!/usr/bin/env python3
"""How fast the product is, each stage beside what a user would otherwise write.

    tools/bench.py [--samples N] [--repeat N] [--json]

Every stage gets the same minutes of a capture with damage in it, one after the other, in one process on one core.
The machine and its other work change the figures; the ratios are the message.
"""

import argparse
import binascii
import json
import os
import platform
import struct
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Final

import numba
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from imudrv.imu.accounting import Accountant
from imudrv.imu.compensation import Coefficients, Compensator
from imudrv.imu.rate_filter import rate_filter
from imudrv.profiles import load
from imudrv.records import PULSES, Records
from imudrv.sim.faults import StreamFaults
from imudrv.sim.scenario import Faults, StreamRates
from imudrv.units import ARCSEC, DEG_PER_H, UG
from imudrv.wire.encode import StreamEncoder
from imudrv.wire.stream import StreamDecoder

Array = NDArray[np.float64]

LAYOUT: Final = load("imu50-rs422").layout()
TAU: Final = 1e-3
PIECE: Final = 16_384
"""Samples at a time: about a quarter of a minute."""
SLOW_SAMPLES: Final = 65_536
"""Samples for the loop in Python, which would take minutes for all of them."""
DAMAGE: Final = StreamRates(
    bit_flips=0.004, bytes_lost=0.004, bytes_inserted=0.004, false_sync_between=0.004, frame_lost=0.004
)
CALIBRATION: Final = Coefficients(
    gyro_scale=np.array([0.45, 0.76, 0.85]) * ARCSEC,
    gyro_bias=np.array([0.2, -0.3, 0.1]) * DEG_PER_H,
    C_bg=np.eye(3) + 1e-3,
    accelerometer_scale=np.array([2382.0, 1731.0, 1643.0]),
    accelerometer_bias=np.array([80.0, -190.0, 40.0]) * UG,
    C_ba=np.eye(3) - 1e-3,
    r_b=np.array([[0.024, -0.011, -0.009], [-0.023, 0.029, -0.007], [-0.001, -0.018, 0.016]]),
)


@dataclass(frozen=True)
class Measure:
    """One stage: what was measured, in samples a second, beside the other way."""

    stage: str
    other_way: str
    samples: int
    per_second: float
    other_samples: int
    other_per_second: float

    @property
    def ratio(self) -> float:
        """How many times quicker than the other way."""
        return self.per_second / self.other_per_second


def capture(samples: int) -> list[bytes]:
    """Pieces of a damaged capture of a unit that turns and shakes."""
    random = np.random.default_rng(1)
    encoder = StreamEncoder(LAYOUT)
    header = bytes(value for _, value in LAYOUT.messages[0].constants)
    line = StreamFaults(Faults(stream=DAMAGE), header, seed=2)
    pieces = []
    for first in range(0, samples, PIECE):
        pulses = np.zeros(min(PIECE, samples - first), PULSES)
        pulses["counter"] = first + np.arange(len(pulses))
        pulses["gyro"] = random.integers(-2000, 2000, (len(pulses), 3))
        pulses["accelerometer"] = random.integers(-50, 50, (len(pulses), 3))
        pulses["temperature_degc"] = 35.0
        sent, _ = line.apply(encoder.encode(pulses), pulses["counter"] * LAYOUT.interval_ns)
        pieces.append(sent)
    return pieces


class Watch:
    """Adds up the time of the calls made through it."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__[**P, R](self, call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        begin = time.perf_counter()
        result = call(*args, **kwargs)
        self.seconds += time.perf_counter() - begin
        return result
