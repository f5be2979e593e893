"""Gateway: pulses to a CAN bus, in any CAN profile."""

import time
from contextlib import closing, suppress
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Final

import can
import numpy as np

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.ports.base import PortLostError
from imudrv.ports.can import prepare
from imudrv.records import EXTENDED, PULSES, Records
from imudrv.sinks.base import Batch, Sink, SinkState
from imudrv.url import split
from imudrv.wire.encode import CanEncoder
from imudrv.wire.layout import Layout

LIMIT: Final = 4096
"""Maximum number of queued samples."""
_RETRY_S: Final = 1.0
_SEND_S: Final = 0.1
_CLOSE_S: Final = 1.0


class CanSink(Sink):
    """Gateway to a CAN bus.

    Samples that the profile cannot represent are dropped and counted: those whose pulses exceed a field, and
    those of several intervals unless the profile has running totals. Temperatures are matched by sensor; one
    that the unit does not have is sent as zero counts. Drivers may block, hence a thread sends.

    Parameters
    ----------
    url : str
        ``can://INTERFACE/CHANNEL?profile=imu50-can``; other options go to python-can, and bit rates come
        from the profile unless given.
    layout : Layout
        Layout of the unit.

    Raises
    ------
    InputError
        Unknown interface or profile, or a profile with another sample rate or other numbers than the unit's.
    """

    def __init__(self, url: str, layout: Layout) -> None:
        super().__init__(url)
        parts = split(url)
        if "profile" not in parts.options:
            raise InputError(f"{url}: expected the outgoing profile, got none; add ?profile=imu50-can")
        profile = profiles.load(parts.options.pop("profile"))
        self._open = prepare(parts, profile)
        self._layout = profile.layout()
        if self._layout.interval != layout.interval:
            raise InputError(
                f"{url}: expected a profile of {float(1e9 / layout.interval):g} samples/s like the unit, "
                f"got {profile.name} with {profile.rate_hz:g}; choose another profile"
            )
        _require_same_numbers(url, self._layout, layout)
        self._steps = layout.counter_step, self._layout.counter_step
        self._temperatures = _related(layout.temperature_names, self._layout.temperature_names)
        CanEncoder(self._layout).encode(np.zeros(1, PULSES))  # compile before samples arrive
        self._encoder = CanEncoder(self._layout)
        self._queue: SimpleQueue[Records | None] = SimpleQueue()
        self._put = self._evicted = 0  # counted by the loop
        self._sent = self._given_up = 0  # counted by the thread
        self._trouble = "not open yet"
        self._is_closing = False
        self._thread = Thread(target=self._run, name="CAN sink", daemon=True)
        self._thread.start()

    def publish(self, batch: Batch) -> None:
        """Send a batch."""
        self._put += batch.pulses.size
        self._queue.put(batch.pulses)
        with suppress(Empty):
            while self._queued > LIMIT:
                oldest = self._queue.get_nowait()
                self._evicted += 0 if oldest is None else oldest.size

    @property
    def state(self) -> SinkState:
        """Current state."""
        words = self._trouble or "ok"
        dropped = self._evicted + self._given_up
        return SinkState(self.url, words, not self._trouble, self._sent, dropped, self._queued)

    def close(self) -> None:
        """Send what is queued for at most a second, and close."""
        self._queue.put(None)
        self._thread.join(_CLOSE_S)
        self._is_closing = True
        self._thread.join(_CLOSE_S)
        self._evicted += self._queued

    @property
    def _queued(self) -> int:
        return self._put - self._evicted - self._sent - self._given_up

    def _run(self) -> None:
        is_on = True
        while is_on and not self._is_closing:
            try:
                with closing(self._open()) as port:
                    self._trouble = ""
                    self._serve(port.bus)
                    return
            except PortLostError as error:
                self._trouble = str(error).removeprefix(f"{self.url}: ")
            except Exception as error:  # a driver may raise anything
                self._trouble = str(error) or type(error).__name__
            is_on = self._idle(_RETRY_S)

    def _serve(self, bus: can.BusABC) -> None:
        """Send until the end of the queue."""
        while (pulses := self._queue.get()) is not None and not self._is_closing:
            done = 0
            try:
                for row in range(pulses.size):
                    is_sent = self._send(bus, pulses[row : row + 1])
                    self._sent += is_sent
                    self._given_up += not is_sent
                    done += 1
            except BaseException:
                self._given_up += pulses.size - done
                raise

    def _idle(self, seconds: float) -> bool:
        """Drop samples while there is no bus; return whether the queue continues."""
        until = time.monotonic() + seconds
        with suppress(Empty):
            while (left := until - time.monotonic()) > 0:
                pulses = self._queue.get(timeout=left)
                if pulses is None:
                    return False
                self._given_up += pulses.size
        return True

    def _send(self, bus: can.BusABC, pulses: Records) -> bool:
        """Send one sample; return whether the profile can represent it."""
        is_long = pulses["interval_ns"][0] > self._layout.interval_ns + 1  # 1 ns: a rate that is a ratio
        if is_long and not self._layout.totals:
            return False
        try:
            messages = self._encoder.encode(self._renamed(pulses))
        except InputError:
            return False
        for message in messages:
            identifier, length = int(message["id"]), int(message["length"])
            bus.send(
                can.Message(
                    arbitration_id=identifier & ~EXTENDED,
                    is_extended_id=bool(identifier & EXTENDED),
                    is_fd=self._layout.fd,
                    bitrate_switch=self._layout.fd,
                    data=message["data"][:length].tobytes(),
                ),
                timeout=_SEND_S,
            )
        return True

    def _renamed(self, pulses: Records) -> Records:
        """Count, and put temperatures into the channels, as the outgoing profile does."""
        renamed = pulses.copy()
        own, outgoing = self._steps
        renamed["counter"] = pulses["counter"] // own * outgoing
        for channel, sources in enumerate(self._temperatures):
            degc = pulses["temperature_degc"][:, sources].mean(axis=1) if sources else np.nan
            renamed["temperature_degc"][:, channel] = degc
        return renamed


def _require_same_numbers(url: str, outgoing: Layout, layout: Layout) -> None:
    """Refuse a profile that cannot carry what the unit sends."""
    for name, sends, carries in (
        ("gyro", layout.gyro, outgoing.gyro),
        ("accelerometer", layout.accelerometer, outgoing.accelerometer),
    ):
        if any(theirs and not own for theirs, own in zip(carries.axes, sends.axes, strict=True)):
            raise InputError(
                f"{url}: {name}: expected a profile for the axes that {layout.name} has, got {outgoing.name} "
                "with more; choose another profile"
            )
        if any(carries.axes) and sends.in_pulses != carries.in_pulses:
            own, theirs = (
                "pulses" if one.in_pulses else "other units than pulses" for one in (sends, carries)
            )
            raise InputError(
                f"{url}: {name}: expected a profile for {own}, as {layout.name} sends them, got "
                f"{outgoing.name} for {theirs}: samples go out uncalibrated, and without the calibration one "
                "cannot be made from the other; choose another profile"
            )


def _related(have: tuple[str, ...], want: tuple[str, ...]) -> list[list[int]]:
    """Return the channels that measure each wanted sensor; ``accelerometer`` is measured by all three."""
    return [
        [k for k, name in enumerate(have) if name.startswith(sensor) or sensor.startswith(name)]
        for sensor in want
    ]
