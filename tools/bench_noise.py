"""Speed and memory of `calib noise`: beside allantools, and over a long record that is made as it is read."""

import resource
import time
from typing import Final

import numpy as np
from bench_nav import Measure

from calib.noise.analysis import CHANNELS
from calib.noise.pyramid import KEEP, Pyramid
from calib.noise.stretches import StretchSplitter
from imudrv.records import PULSES, Flag
from imudrv.units import ARCSEC

SAMPLES: Final = 1_000_000
RATE_HZ: Final = 1000
PIECE: Final = 4096


def against_allantools(rounds: int) -> Measure:
    """Measure one channel, all averaging times, against the overlapping Allan deviation of allantools."""
    import allantools  # a reference for tests, not a dependency

    x = np.random.default_rng(1).normal(size=SAMPLES)
    phase, actions = np.concatenate([[0.0], np.cumsum(x)]), np.full(SAMPLES, KEEP, np.int8)
    ours, theirs = [], []
    for _ in range(1 + rounds):  # the first one compiles
        begin = time.perf_counter()
        pyramid = Pyramid(1)
        pyramid.feed(x[:, None], actions)
        found = pyramid.result()
        middle = time.perf_counter()
        _, deviation, _, _ = allantools.oadev(phase, 1.0, "phase", found.factors.astype(float))
        ours.append(middle - begin)
        theirs.append(time.perf_counter() - middle)
    exact = found.factors < 128
    off = np.sqrt(found.variance[: len(deviation), 0]) / deviation - 1.0
    assert np.abs(off[exact[: len(off)]]).max() < 1e-9
    stage = f"Allan deviation, {len(found.factors)} averaging times"
    speeds = SAMPLES / min(ours[1:]), SAMPLES / min(theirs[1:])
    return Measure(stage, rounds * SAMPLES, speeds[0], "allantools.oadev", rounds * SAMPLES, speeds[1])


def long_record(hours: float) -> dict[str, float]:
    """Pass a record of six channels at 1 kHz through the search for rests and the pyramid.

    Parameters
    ----------
    hours : float
        Its length; it is made piece by piece from a minute of noise.

    Returns
    -------
    dict
        Samples, seconds of the pass alone, and growth of the resident memory, MB.
    """
    rng = np.random.default_rng(1)
    minute = np.zeros(60 * RATE_HZ, PULSES)
    minute["interval_ns"], minute["flags"] = 1_000_000, Flag.VALID
    minute["gyro"] = np.rint(rng.normal(size=(len(minute), 3)))
    minute["accelerometer"] = np.rint(rng.normal(size=(len(minute), 3)) + np.array([0.0, 0.0, 19.6]))
    scales = np.repeat([0.5 * ARCSEC, 1.0 / 2000.0], 3)
    splitter, pyramid = StretchSplitter(1.0 / RATE_HZ, scales, scales), Pyramid(len(CHANNELS))
    total, done, seconds, base = round(hours * 3600 * RATE_HZ), 0, 0.0, 0
    while done < total:
        at = int(rng.integers(0, len(minute) - PIECE))
        piece = minute[at : at + min(PIECE, total - done)].copy()
        piece["elapsed_ns"] = (done + 1 + np.arange(len(piece))) * 1_000_000
        begin = time.perf_counter()
        pyramid.feed(*splitter.feed(piece))
        seconds += time.perf_counter() - begin
        done += len(piece)
        if done >= 60 * RATE_HZ and not base:  # compiled, and all buffers are in use
            base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    pyramid.feed(*splitter.close())
    found = pyramid.result()
    assert found.longest > 0.99 * total
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base
    return {"samples": float(total), "seconds": seconds, "grown_mb": grown / 1024.0}
