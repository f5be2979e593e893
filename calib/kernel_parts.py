"""The kernels that this package calls beside those of navigation; see `imudrv.kernel_parts`."""

import numpy as np

from calib.detection.blocks import Block, BlockSums
from calib.detection.tracking import AttitudeTracker, RestAverages, RotationTracker, StillnessDetector
from calib.noise.pyramid import Pyramid
from calib.noise.stretches import StretchSplitter
from calib.sensors.motion import SAMPLE, integrate
from calib.sensors.parameters import Parameters
from imudrv.records import INCREMENTS, PULSES
from imudrv.sim.path import minimum_jerk


def detection() -> None:
    """Detection of rests and rotations, during the procedure and in a capture."""
    increments = np.zeros(1, INCREMENTS)
    BlockSums(0, 20).feed(increments)
    block = Block(increments, 0, 0.02, (0.0, 0.0, 1e-6), (0.0, 0.0, 9.8), 0, 0, False, False)
    up = np.array([0.0, 0.0, 1.0])
    attitude, turned = AttitudeTracker(0.0), RotationTracker()
    for tracker in (attitude, turned, RestAverages(), StillnessDetector(1.0, 1.0)):
        tracker.feed(block)
    attitude.q_nb = (1.0, 0.0, 0.0, 0.0)
    attitude.feed(block)
    attitude.lean(up)
    attitude.azimuth(up)
    _ = turned.axis_tilt


def noise() -> None:
    """Allan deviations of a rest."""
    splitter, pyramid = StretchSplitter(1.0, np.ones(6), np.ones(6)), Pyramid(6)
    splitter.feed(np.ones(1, PULSES))
    pyramid.feed(*splitter.close())
    pyramid.end_stretch()


def sensors() -> None:
    """Motions between rests."""
    samples = np.zeros(3, SAMPLE)
    samples["T"] = 1e-3
    still = np.zeros(3), np.zeros(3)
    integrate(samples, Parameters(9.8, np.zeros(2)), still, still)
    minimum_jerk(0.5)
