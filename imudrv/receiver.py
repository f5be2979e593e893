"""Receive the samples of a running driver in another program.

with imudrv.receive("udp://:5005") as receiver:
    for increments in receiver:
        position += ...
print(receiver.counts)
"""

import select
import socket
from contextlib import AbstractContextManager
from fractions import Fraction
from types import TracebackType
from typing import Final, Self

import numpy as np
import serial

from imudrv.errors import InputError
from imudrv.imu.sequence import SampleCounts, SequenceTracker
from imudrv.loopback import LOOPBACK
from imudrv.ports.base import PortLostError
from imudrv.ports.serial import explain, receiver_of
from imudrv.posix import require_posix
from imudrv.profiles.schema import SerialLine
from imudrv.records import FRAME, Records
from imudrv.sinks.serial import BAUDRATE
from imudrv.streams import Subscription
from imudrv.url import Url, device_path, host_and_port, serial_settings, split
from imudrv.wire.datagram import DatagramDecoder
from imudrv.wire.layout import Layout, Sequence, SequenceKind

_AT_ONCE: Final = 1 << 16
_QUEUE: Final = 1 << 22  # the system's default holds a quarter of a second of single samples
_CONNECT_S: Final = 5.0
_COUNTED: Final = Layout(
    name="I50N",
    can=False,
    fd=False,
    interval=Fraction(1),
    sequence=Sequence(SequenceKind.COUNTER, 32),
    messages=(),
)


class Ordering:
    """Datagrams of one unit to its samples, each once and in the order of the counter.

    Attributes
    ----------
    rejected_bytes : int
        Number of bytes that belong to no valid datagram.
    """

    def __init__(self) -> None:
        self.rejected_bytes = 0
        self._decoder = DatagramDecoder()
        self._tracker = SequenceTracker(_COUNTED)

    @property
    def counts(self) -> SampleCounts:
        """Sample counts so far."""
        return self._tracker.counts

    def feed(self, data: bytes) -> Records:
        """Return the samples in `data` that are new and in order."""
        received = self._decoder.feed(data)
        self.rejected_bytes += int(received.rejects["length"].sum())
        frames = np.zeros(len(received.increments), FRAME)
        frames["counter"] = received.increments["counter"]
        frames["t_ns"] = np.arange(len(frames))  # index, returned as the arrival time of the good ones
        in_order: Records = received.increments[self._tracker.feed(frames)["arrival_ns"]]
        return in_order


class Receiver(AbstractContextManager["Receiver"]):
    """Iterator over arrays of one or more samples as they arrive; made by `receive`.

    Each sample comes once and in the order of the counter: one that the network duplicates or delays is
    counted and dropped. The iteration ends when the sender closes the connection or nothing arrives for
    `timeout_s`. It is a context manager that closes the connection.

    Parameters
    ----------
    url : str
        See `receive`.
    timeout_s : float or None
        Longest wait, s; None: no limit.
    """

    def __init__(self, url: str, timeout_s: float | None) -> None:
        self._timeout_s = timeout_s
        self._ordering = Ordering()
        self._ordering.feed(b"")  # compiles the kernels before samples arrive
        parts = split(url, ("udp", "tcp", "serial", "zenoh"))
        self._is_packets = parts.scheme == "udp"
        self._device = _open(parts)
        self._receive = (
            self._device.recv if isinstance(self._device, Subscription) else receiver_of(self._device)
        )
        self._is_open = True

    @property
    def counts(self) -> SampleCounts:
        """Sample counts so far."""
        return self._ordering.counts

    @property
    def rejected_bytes(self) -> int:
        """Number of received bytes that belong to no valid datagram."""
        return self._ordering.rejected_bytes

    @property
    def is_open(self) -> bool:
        """Whether more may come."""
        return self._is_open

    def __iter__(self) -> Self:
        return self

    def __next__(self) -> Records:
        """Wait for samples.

        Returns
        -------
        ndarray of INCREMENTS
            One or more: `counter`, `t_ns`, `interval_ns`, `dtheta_b`, `dv_b`, `flags`.
        """
        while self._is_open and select.select([self._device.fileno()], (), (), self._timeout_s)[0]:
            try:
                data = self._receive(_AT_ONCE)
            except OSError:
                data = b""
                self.close()
            if not data and not self._is_packets:
                self.close()
            if len(increments := self._ordering.feed(data)):
                return increments
        raise StopIteration

    def close(self) -> None:
        """Close the connection; the iteration ends."""
        self._is_open = False
        self._device.close()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def receive(url: str, timeout_s: float | None = None) -> Receiver:
    """Receive the samples that `imudrv run --out` sends.

    Parameters
    ----------
    url : str
        ``udp://[HOST]:PORT`` listens, on the loopback unless another HOST of this machine is given;
        ``tcp://HOST:PORT`` connects; ``serial:///dev/ttyUSB0?baudrate=921600`` opens a line;
        ``zenoh://imu50/BENCH/UNIT?config=FILE`` subscribes to a unit.
    timeout_s : float, optional
        Longest wait for samples, s, after which the iteration ends; by default there is no limit.

    Returns
    -------
    Receiver
        Iterator over the samples.

    Raises
    ------
    InputError
        The URL is wrong.
    PortLostError
        It cannot be opened now: no driver listens there, the port is in use, the line does not exist.
    """
    return Receiver(url, timeout_s)


def _open(url: Url) -> socket.socket | serial.Serial | Subscription:
    if url.scheme == "zenoh":
        return Subscription(url)
    if url.scheme == "serial":
        return _open_line(url)
    host, port = host_and_port(url, LOOPBACK)
    try:
        if url.scheme == "tcp":
            return socket.create_connection((host, port), _CONNECT_S)
        return _listen(host, port)
    except OSError as error:
        doing = "connect; is the driver running?" if url.scheme == "tcp" else "listen"
        raise PortLostError(f"{url.text}: cannot {doing} ({error.strerror or error})") from error


def _listen(host: str, port: int) -> socket.socket:
    family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
    listener = socket.socket(family, kind)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _QUEUE)
        listener.bind(address)
    except OSError:
        listener.close()
        raise
    return listener


def _open_line(url: Url) -> serial.Serial:
    require_posix(url.text, "receive from udp:// or tcp:// instead")
    path, settings = device_path(url), serial_settings(url, SerialLine(baudrate=BAUDRATE))
    try:
        return serial.Serial(path, **settings, timeout=0, exclusive=True)
    except ValueError as error:
        raise InputError(f"{url.text}: {error}") from error
    except serial.SerialException as error:
        raise PortLostError(f"{url.text}: {explain(path, error)}") from error
