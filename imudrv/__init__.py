"""Driver of a 50-type ring-laser-gyro IMU: from the bytes of its wire to compensated increments.

In a notebook::

    >>> import imudrv
    >>> capture = imudrv.Capture("z_up.raw", "imu50-rs422")
    >>> increments = imudrv.compensate(capture, calibration="unit.yaml")
    >>> increments["dv_b"].shape
    (1000, 3)
    >>> capture
    <Capture z_up.raw, imu50-rs422, 1000 samples read>

The flow is one way; each stage is a package or module that can be read alone::

    port -> bytes -> FRAME -> PULSES -> INCREMENTS -> out
       ports     wire     imu       imu         sinks

    ports  sources of bytes and CAN messages, by URL: `open_port`
    wire   decodes: `StreamDecoder`, `CandumpDecoder` + `CanAssembler`; encodes for the simulator
    imu    accounts for every sample (`SequenceTracker`), stamps it (`ClockModel`),
           compensates it (`Compensator`)
    sinks  destinations of increments, by URL, and the recorder
    chain, service   the stages in a row, and the one thread that runs them live
    capture, recording  the same from files; capture_files reads these in all their forms
    nav    strapdown mathematics      sim    simulated unit

Data are numpy record arrays (`imudrv.records`), time along the first axis: one row live, millions offline.
Kernels keep their state, so that any cut into pieces gives the same bits.

Frames: b is the unit's body (X right, Y front, Z up), n local level (east, north, up), a and g the sensing
axes of accelerometers and gyros, i inertial. `C_ba` takes components from a to b, so that neighbours cancel:
`f_b = C_ba @ f_a`. Quaternions are Hamilton's, scalar first. Units inside are SI and radians; a name says
any other unit (`bias_deg_per_h`). Times are integer nanoseconds; intervals come from the unit's counter.
Increments come first: `dtheta_b` (rad) and `dv_b` (m/s) cover `interval_ns`, never an assumed interval.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from imudrv import profiles
    from imudrv.calibration import Calibration as Calibration
    from imudrv.calibration import coefficients as coefficients
    from imudrv.calibration import read_calibration as read_calibration
    from imudrv.calibration import write_calibration as write_calibration
    from imudrv.capture import Capture as Capture
    from imudrv.capture import compensate as compensate
    from imudrv.errors import Imu50Error as Imu50Error
    from imudrv.errors import InputError as InputError
    from imudrv.imu.coefficients import Coefficients as Coefficients
    from imudrv.imu.compensation import Compensator as Compensator
    from imudrv.imu.rate_filter import rate_filter as rate_filter
    from imudrv.imu.sequence import SampleCounts as SampleCounts
    from imudrv.imu.sequence import SequenceTracker as SequenceTracker
    from imudrv.nav.mechanisation import Navigator as Navigator
    from imudrv.profiles.schema import Profile as Profile
    from imudrv.receiver import Receiver as Receiver
    from imudrv.receiver import receive as receive
    from imudrv.recording.reader import Recording as Recording
    from imudrv.records import FRAME as FRAME
    from imudrv.records import INCREMENTS as INCREMENTS
    from imudrv.records import PULSES as PULSES
    from imudrv.records import Flag as Flag
    from imudrv.records import Reason as Reason
    from imudrv.records import Source as Source
    from imudrv.site import Site as Site
    from imudrv.wire.datagram import DatagramDecoder as DatagramDecoder
    from imudrv.wire.decoder import CaptureDecoder as CaptureDecoder
    from imudrv.wire.stream import StreamDecoder as StreamDecoder

    load_profile = profiles.load

# Imported at first use, so that a program pays only for what it needs.
_MODULES = {
    "imudrv.calibration": ("Calibration", "coefficients", "read_calibration", "write_calibration"),
    "imudrv.capture": ("Capture", "compensate"),
    "imudrv.errors": ("Imu50Error", "InputError"),
    "imudrv.imu.coefficients": ("Coefficients",),
    "imudrv.imu.compensation": ("Compensator",),
    "imudrv.imu.rate_filter": ("rate_filter",),
    "imudrv.imu.sequence": ("SampleCounts", "SequenceTracker"),
    "imudrv.nav.mechanisation": ("Navigator",),
    "imudrv.profiles": ("load_profile",),
    "imudrv.profiles.schema": ("Profile",),
    "imudrv.receiver": ("Receiver", "receive"),
    "imudrv.recording.reader": ("Recording",),
    "imudrv.records": ("FRAME", "INCREMENTS", "PULSES", "Flag", "Reason", "Source"),
    "imudrv.site": ("Site",),
    "imudrv.wire.datagram": ("DatagramDecoder",),
    "imudrv.wire.decoder": ("CaptureDecoder",),
    "imudrv.wire.stream": ("StreamDecoder",),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'imudrv' has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), "load" if name == "load_profile" else name)


def __dir__() -> list[str]:
    return __all__
