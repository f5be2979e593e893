"""Compile and load every stage before the unit is connected."""

from contextlib import closing
from typing import Final

import numpy as np

from imudrv.calibration import Calibration, coefficients
from imudrv.chain import Chain
from imudrv.imu.rate_filter import RateFilterName
from imudrv.profiles.schema import Profile
from imudrv.records import PULSES
from imudrv.service.clock_watch import ClockWatch
from imudrv.service.latency import Latency
from imudrv.service.serve import DescriptorLoop
from imudrv.wire.encode import CanEncoder, StreamEncoder

_SAMPLES: Final = 300

_PIECES: Final = 50


def warm_up(profile: Profile, calibration: Calibration, rate_filter: RateFilterName, is_direct: bool) -> None:
    """Send made-up samples through every stage, including a replacement of the calibration.

    Parameters
    ----------
    profile, calibration, rate_filter
        Those of the service.
    is_direct : bool
        Whether the kernel of `imudrv.service.serve` is needed.
    """
    layout = profile.layout()
    pulses = np.zeros(_SAMPLES, PULSES)
    pulses["counter"] = layout.counter_step * np.arange(_SAMPLES)
    pulses["temperature_degc"] = 35.0
    chain = Chain(profile, coefficients(calibration), rate_filter)
    wire = CanEncoder(layout).encode(pulses) if layout.can else StreamEncoder(layout).encode(pulses).tobytes()
    piece = max(1, len(wire) // _PIECES)
    for at in range(0, len(wire), piece):
        chain.feed(wire[at : at + piece], at)
    chain.replace_calibration(coefficients(calibration))
    chain.feed(wire, len(wire))
    chain.close()
    if is_direct:
        with closing(DescriptorLoop(chain, Latency(0))) as loop:
            loop.run(-1, 0, ClockWatch(), [], False)
