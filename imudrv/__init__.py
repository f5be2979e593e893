"""Driver of a 50-type ring-laser-gyro IMU: from the bytes of its wire to compensated increments.

The flow, one way; every stage is a package or module that can be read alone::

    port -> bytes -> FRAME -> PULSES -> INCREMENTS -> out
       ports     wire     imu       imu         sinks

    ports  where bytes and CAN messages come from, by URL: `open_port`
    wire   decodes: `StreamDecoder`, `CandumpDecoder` + `CanAssembler`; encodes for the simulator
    imu    accounts for every sample (`SequenceTracker`), stamps it (`ClockModel`),
           compensates it (`Compensator`)
    sinks  where increments go, by URL, and the recorder
    pipeline, service    the stages in a row, and the one thread that runs them live
    captures, recording  the same from files
    nav    strapdown mathematics      sim    the unit that is not there

What flows are numpy record arrays (`imudrv.records`), time along the first axis: one row live, millions
offline. Kernels keep their state, so that any cut into pieces gives the same bits.

Frames: b is the unit's body (X right, Y front, Z up), n local level (east, north, up), a and g the sensing
axes of accelerometers and gyros, i inertial. `C_ba` takes components from a to b, so that neighbours cancel:
`f_b = C_ba @ f_a`. Quaternions are Hamilton's, scalar first. Units inside are SI and radians; another unit
stands in the name (`bias_deg_per_h`). Times are integer nanoseconds; intervals come from the unit's counter.
Increments come first: `dtheta_b` (rad) and `dv_b` (m/s) cover `interval_ns`, never an assumed interval.
"""

from imudrv.calibration import Calibration, coefficients, read_calibration, write_calibration
from imudrv.capture import Capture
from imudrv.errors import Imu50Error, InputError
from imudrv.imu.coefficients import Coefficients
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import rate_filter
from imudrv.imu.sequence import SampleCounts, SequenceTracker
from imudrv.profiles import load as load_profile
from imudrv.profiles.schema import Profile
from imudrv.receive import Receiver, receive
from imudrv.recording.reader import Recording
from imudrv.records import FRAME, INCREMENTS, PULSES, Flag, Reason, Source
from imudrv.site import Site
from imudrv.wire.datagram import DatagramDecoder
from imudrv.wire.decoder import CaptureDecoder
from imudrv.wire.stream import StreamDecoder

__all__ = [
    "FRAME",
    "INCREMENTS",
    "PULSES",
    "Calibration",
    "Capture",
    "CaptureDecoder",
    "Coefficients",
    "Compensator",
    "DatagramDecoder",
    "Flag",
    "Imu50Error",
    "InputError",
    "Profile",
    "Reason",
    "Receiver",
    "Recording",
    "SampleCounts",
    "SequenceTracker",
    "Site",
    "Source",
    "StreamDecoder",
    "coefficients",
    "load_profile",
    "rate_filter",
    "read_calibration",
    "receive",
    "write_calibration",
]
