"""Datagrams to a serial line."""

import errno
import os
import time
from contextlib import suppress
from threading import Thread
from typing import Final

import serial

from imudrv.ports.serial import explain
from imudrv.posix import require_posix, termios
from imudrv.profiles.schema import SerialLine
from imudrv.sinks.backlog import Backlog
from imudrv.sinks.base import HOUSEKEEPING_NS, Batch, Outlet, Sink, SinkState, Written
from imudrv.url import device_path, serial_settings, split
from imudrv.wire.datagram import SIZE

BAUDRATE: Final = 921_600
_PIECE: Final = 64
_RETRY_S: Final = 1.0
_CLOSE_S: Final = 1.0


class SerialSink(Sink):
    """Serial port; if absent or unplugged, it is opened as soon as it appears.

    Opening may take milliseconds, hence a thread does it.

    Parameters
    ----------
    url : str
        ``serial:///dev/ttyUSB1?baudrate=921600``, 8N1 unless ``bytesize``, ``parity`` or
        ``stopbits`` is given.

    Raises
    ------
    InputError
        The path is missing, or a setting is not valid.
    """

    patience_ns = HOUSEKEEPING_NS

    def __init__(self, url: str) -> None:
        super().__init__(url)
        require_posix(url, "send to udp:// or tcp:// instead")
        parts = split(url)
        self._path, self._settings = device_path(parts), serial_settings(parts, SerialLine(baudrate=BAUDRATE))
        self._backlog = Backlog(_PIECE)
        self._port: serial.Serial | None = None
        self._trouble = "not open yet"
        self._opening: Thread | None = None
        self._retry_at = 0.0
        self.poll()

    def publish(self, batch: Batch) -> None:
        """Send a batch."""
        if self._port is None:
            self._backlog.dropped += len(batch.datagrams) // SIZE
            return
        try:
            self._backlog.put(batch.datagrams, self._write)
        except OSError as error:
            self._lose(error)

    def outlets(self) -> list[Outlet]:
        """See `Sink.outlets`."""
        port = self._port
        is_free = port is not None and not self._backlog.queued
        return [Outlet(port.fileno(), _PIECE * SIZE, is_socket=False)] if port and is_free else []

    def written(self, batch: Batch, outlets: list[Written]) -> None:
        """See `Sink.written`."""
        if not outlets:
            self.publish(batch)
            return
        size, _, error = outlets[0]
        self._backlog.written(batch.datagrams, size)
        if error not in (0, errno.EAGAIN):
            self._lose(OSError(error, os.strerror(error)))

    def poll(self) -> None:
        """Send what is queued; open the port again if it is lost."""
        if self._port is not None:
            try:
                self._backlog.flush(self._write)
            except OSError as error:
                self._lose(error)
        elif time.monotonic() >= self._retry_at and (self._opening is None or not self._opening.is_alive()):
            self._retry_at = time.monotonic() + _RETRY_S
            self._opening = Thread(target=self._open, daemon=True)
            self._opening.start()

    @property
    def state(self) -> SinkState:
        """Current state."""
        counts = self._backlog
        is_open = self._port is not None
        words = "ok" if is_open else self._trouble
        return SinkState(self.url, words, is_open, counts.sent, counts.dropped, counts.queued)

    def close(self) -> None:
        """Send what is queued for at most a second, and close."""
        deadline = time.monotonic() + _CLOSE_S
        if self._opening is not None:
            self._opening.join(_CLOSE_S)
        while self._port is not None and self._backlog.queued and time.monotonic() < deadline:
            self.poll()
            time.sleep(0.005)
        self._backlog.abandon()
        self._close_port()

    def _open(self) -> None:
        try:
            self._port = serial.Serial(
                self._path, **self._settings, timeout=0, write_timeout=0, exclusive=True
            )
        except OSError as error:
            self._trouble = explain(self._path, error)
        except ValueError as error:  # baud rate not supported
            self._trouble = str(error)

    def _write(self, data: bytes) -> int:
        # The write of pyserial would spin while the port is blocked.
        return 0 if self._port is None else os.write(self._port.fileno(), data)

    def _lose(self, error: OSError) -> None:
        self._trouble = f"lost: {error.strerror or error}"
        self._retry_at = time.monotonic() + _RETRY_S
        self._backlog.abandon()
        self._close_port()

    def _close_port(self) -> None:
        port, self._port = self._port, None
        if port is None:
            return
        with suppress(OSError, termios.error):
            termios.tcflush(port.fileno(), termios.TCOFLUSH)  # otherwise closing may wait for a blocked line
        port.close()
