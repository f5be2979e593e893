"""Real serial port."""

import time
from contextlib import suppress
from typing import Any

import serial

from imudrv.errors import InputError
from imudrv.posix import require_posix
from imudrv.sim.links.base import RETRY_S, TIMEOUT_S, FileLine, LineOptions


class SimulatedSerialPort(FileLine):
    """Real serial port.

    Parameters
    ----------
    options : LineOptions
        Options of every line.
    path : str
        Path of the device.
    settings : dict
        Settings of the line for pyserial.

    Raises
    ------
    InputError
        The port cannot be opened.
    """

    def __init__(self, options: LineOptions, path: str, settings: dict[str, Any]) -> None:
        super().__init__(options)
        require_posix(path, "use tcp://127.0.0.1:PORT instead")
        self._path = path
        self._settings = settings
        self._port: serial.Serial | None = None
        self.plug()
        self._say(f"{options.name}, {settings['baudrate']} baud, plays on {path}")

    def plug(self) -> None:
        """Open the port."""
        try:
            self._port = serial.Serial(self._path, **self._settings, exclusive=True)
        except (OSError, ValueError) as error:
            raise InputError(f"{self._path}: cannot be opened as a serial port: {error}") from error
        self._fd = self._port.fileno()

    def finish(self) -> None:
        """Wait until the driver has transmitted everything."""
        deadline = time.monotonic() + TIMEOUT_S
        with suppress(OSError):  # the device may have just disappeared
            while self._port is not None and self._port.out_waiting and time.monotonic() < deadline:
                time.sleep(RETRY_S)

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
        self._port = None
        self._fd = -1
