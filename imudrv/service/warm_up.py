"""Compile and load every stage before the unit is connected."""

from contextlib import closing

import numpy as np

from imudrv.calibration import Calibration, coefficients
from imudrv.chain import Chain
from imudrv.imu.rate_filter import RateFilterName
from imudrv.profiles.schema import Profile
from imudrv.records import MESSAGE, Records
from imudrv.service.clock_watch import ClockWatch
from imudrv.service.latency import Latency, count_latency
from imudrv.service.serve import DescriptorLoop


def warm_up(profile: Profile, calibration: Calibration, rate_filter: RateFilterName, is_direct: bool) -> None:
    """Call all kernels of the service, those of a replacement of the calibration as well, without a sample.

    Parameters
    ----------
    profile, calibration, rate_filter
        Those of the service.
    is_direct : bool
        Whether the kernel of `imudrv.service.serve` is needed.
    """
    chain = Chain(profile, coefficients(calibration), rate_filter)
    nothing: bytes | Records = np.zeros(1, MESSAGE) if profile.layout().can else bytes(1)
    chain.feed(nothing, 0)
    chain.replace_calibration(coefficients(calibration))
    chain.feed(nothing, 0)
    chain.close()
    latency = Latency(0)
    count_latency(0, 0, latency.state)
    if is_direct:
        with closing(DescriptorLoop(chain, latency)) as loop:
            loop.run(-1, 0, ClockWatch(), [], False)
