"""CAN bus of any interface that python-can knows."""

import time
from typing import Any

import can

from imudrv.errors import InputError
from imudrv.profiles.schema import CanLine
from imudrv.records import EXTENDED, Records
from imudrv.sim.links.base import POLL_S, RETRY_S, TIMEOUT_S, LineOptions, SimulatedLine
from imudrv.url import Url, value


class SimulatedCanBus(SimulatedLine):
    """CAN bus of any interface that python-can knows; it cannot be unplugged.

    Parameters
    ----------
    options : LineOptions
        Options of every line.
    url : Url
        ``can://INTERFACE/CHANNEL?...``; the query holds options of python-can.
    line : CanLine
        Settings of the bus.

    Raises
    ------
    InputError
        The bus cannot be opened.
    """

    def __init__(self, options: LineOptions, url: Url, line: CanLine) -> None:
        super().__init__(options)
        interface, _, channel = url.address.partition("/")
        settings: dict[str, Any] = {"bitrate": line.bitrate, "data_bitrate": line.data_bitrate}
        settings |= {name: value(text) for name, text in url.options.items()}
        try:
            self._bus = can.Bus(
                interface=interface,
                channel=channel,
                ignore_config=True,
                fd=line.data_bitrate is not None,
                **{name: setting for name, setting in settings.items() if setting is not None},
            )
        except (can.CanError, NotImplementedError, OSError, TypeError, ValueError) as error:
            raise InputError(f"{url.text}: cannot be opened as a CAN bus: {error}") from error
        self._say(f"{options.name} plays on {url.text}")

    def send(self, data: bytes | Records) -> None:
        """Send messages."""
        if isinstance(data, bytes):
            return  # nothing is due
        content = data["data"].tobytes()
        width = len(content) // max(1, data.size)
        heads = zip(data["id"].tolist(), data["length"].tolist(), data["fd"].tolist(), strict=True)
        for i, (identifier, length, fd) in enumerate(heads):
            message = can.Message(
                arbitration_id=identifier & ~EXTENDED,
                is_extended_id=bool(identifier & EXTENDED),
                is_fd=bool(fd),
                bitrate_switch=bool(fd),
                data=content[i * width : i * width + length],
            )
            if not self._send(message):
                self.undelivered += data.size - i
                return

    def _send(self, message: can.Message) -> bool:
        since = time.monotonic()
        while True:
            try:
                self._bus.send(message, timeout=POLL_S)
                self.sent += 1
                return True
            except can.CanError:
                # no acknowledgement, or the interface's queue is full
                if self._stop.is_set() or (not self._waits and time.monotonic() - since > TIMEOUT_S):
                    return False
                time.sleep(RETRY_S)

    def close(self) -> None:
        """Close the bus."""
        self._bus.shutdown()
