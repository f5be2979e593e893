"""The kernels that the programs call, in parts: each function calls some of them with next to no data.

Run by the processes that `imudrv.compilation` starts. All profiles share these kernels: what distinguishes
them is in arrays. A part that needs another one's kernels finds those compiled.
"""

import os
import signal
import sys
from contextlib import suppress
from importlib import import_module
from typing import Any, Final

import numpy as np
from numba.core import event

from imudrv import kernel_cache, profiles, system
from imudrv.calibration import coefficients
from imudrv.compilation import COMPILING, DONE, PARTS
from imudrv.imu.clock import ClockModel
from imudrv.imu.compensation import Compensator
from imudrv.imu.sequence import SequenceTracker
from imudrv.nav.alignment import Alignment
from imudrv.nav.attitude import quaternion_at, quaternion_of_vector, rotation, rows_of
from imudrv.nav.mechanisation import Navigator, Place
from imudrv.recording.format import unpack_messages
from imudrv.recording.reads import Gatherer
from imudrv.records import FRAME, INCREMENTS, MESSAGE, PULSES, Source
from imudrv.service.warm_up import warm_up
from imudrv.sim.capture import wire
from imudrv.sim.scenario import Scenario, nominal
from imudrv.wire.can import CanAssembler
from imudrv.wire.candump import CandumpDecoder, format_candump
from imudrv.wire.datagram import encode
from imudrv.wire.encode import CanEncoder, StreamEncoder
from imudrv.wire.stream import StreamDecoder

_events: Any = event  # has no type hints

_BYTES: Final = profiles.load("imu50-rs422")
_MESSAGES: Final = profiles.load("imu50-can")
_LEVEL: Final = (1.0, 0.0, 0.0, 0.0)
_SCENARIO: Final = {
    "format": "imu50-scenario",
    "version": 1,
    "seed": 0,
    "site": {"latitude_deg": 0.0, "longitude_deg": 0.0, "height_m": 0.0},
    "motion": (
        {"vibrate": {"duration_s": 0.1, "ramp_s": 0.01, "band_hz": (20.0, 300.0), "g_rms": (0.0, 0.0, 1.0)}},
        {"rest": {"duration_s": 0.1}},
    ),
}


def frames() -> None:
    """Frames from bytes."""
    StreamDecoder(_BYTES.layout()).feed(b"\0")


def samples() -> None:
    """Samples from frames."""
    SequenceTracker(_BYTES.layout()).feed(np.zeros(1, FRAME))


def compensation() -> None:
    """Increments from samples, and their datagrams."""
    layout = _BYTES.layout()
    compensator = Compensator(coefficients(nominal(layout)), layout)
    encode(compensator.feed(np.zeros(1, PULSES)), Source.SIMULATOR)
    compensator.close()


def messages() -> None:
    """Frames from CAN messages."""
    CanAssembler(_MESSAGES.layout()).feed(np.zeros(1, MESSAGE))


def simulation() -> None:
    """A simulated unit, with and without a size effect."""
    scenario = Scenario.model_validate(_SCENARIO)
    calibration = nominal(_BYTES.layout()).without_size_effect()
    unit = scenario.unit.model_copy(update={"calibration": calibration})
    for one in (scenario, scenario.model_copy(update={"unit": unit})):
        for _ in wire(one, _BYTES.layout()):
            pass


def clock() -> None:
    """Times of samples."""
    model = ClockModel(_BYTES.layout().interval_ns, _BYTES.transmission_ns)
    model.feed(np.zeros(1, PULSES))
    model.stamp(np.zeros(1, INCREMENTS))


def encoding() -> None:
    """Bytes and CAN messages of samples."""
    StreamEncoder(_BYTES.layout()).encode(np.zeros(1, PULSES))
    CanEncoder(_MESSAGES.layout()).encode(np.zeros(1, PULSES))


def navigation() -> None:
    """Alignment and navigation."""
    increments = np.zeros(1, INCREMENTS)
    increments["interval_ns"] = _BYTES.layout().interval_ns
    Alignment(0.0, 0.0, 0.0).feed(increments)
    rows_of(quaternion_at(np.array(_LEVEL)))
    rows_of(quaternion_of_vector((0.0, 0.0, 0.0)))
    rotation((0.0, 0.0, 1.0), 0.0)
    for C_ba in (None, np.eye(3)):
        Navigator(Place(0.0, 0.0, 0.0), _LEVEL, C_ba=C_ba).feed(increments)


def live_bytes() -> None:
    """All stages in one, for bytes, and the loop that serves a descriptor."""
    warm_up(_BYTES, nominal(_BYTES.layout()), "causal", system.IS_AVAILABLE)


def live_messages() -> None:
    """All stages in one, for CAN messages."""
    warm_up(_MESSAGES, nominal(_MESSAGES.layout()), "causal", system.IS_AVAILABLE)


def logs() -> None:
    """Text of candump, both ways."""
    CandumpDecoder().feed(format_candump(np.zeros(1, MESSAGE)))


def recordings() -> None:
    """Reads of a recording."""
    Gatherer().gather(b"\0")
    unpack_messages(np.zeros(1, np.uint8), np.ones(1, np.int64))


def bench() -> None:
    """Detection of rests and rotations, and motions; their package is the layer above this one."""
    parts = import_module("calib.kernel_parts")
    parts.detection()
    parts.sensors()


def allan_deviations() -> None:
    """Noise of a rest, likewise."""
    import_module("calib.kernel_parts").noise()


class _Reporter(_events.Listener):  # type: ignore[misc]
    def on_start(self, event: Any) -> None:
        _report(COMPILING)

    def on_end(self, event: Any) -> None:
        pass


def _report(what: bytes) -> None:
    os.write(1, what)


def main() -> None:
    """Do the parts whose numbers come on stdin, shared with other processes, until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    if hasattr(os, "sched_setscheduler"):  # of a service in real time only the service is
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    _events.register("numba:compile", _Reporter())
    while number := os.read(0, 1):
        getattr(sys.modules[__name__], PARTS[number[0]])()
        if kernel_cache.refused:
            return
        _report(DONE)
