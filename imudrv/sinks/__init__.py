"""Outputs of pulses and increments, opened by URL.

base      interface of a sink           backlog   queue of datagrams for one consumer
network   UDP, TCP                      serial    serial line
can       CAN bus                       file      growing file
zenoh     Zenoh
recorder  MCAP recording                history   the latest reads, in memory
"""

from imudrv.errors import InputError
from imudrv.sinks.base import Sink
from imudrv.wire.layout import Layout

SCHEMES = ("udp", "tcp", "serial", "can", "zenoh", "file")


def open_sink(url: str, layout: Layout) -> Sink:
    """Open a sink.

    Parameters
    ----------
    url : str
        ``udp://HOST:PORT``, ``tcp://HOST:PORT``, ``serial://PATH?baudrate=...``,
        ``can://INTERFACE/CHANNEL?profile=...``, ``zenoh://imu50/BENCH/UNIT`` or ``file:NAME.i50n``.
    layout : Layout
        Layout of the unit.

    Returns
    -------
    Sink
        The sink; an absent device or receiver may still appear later.

    Raises
    ------
    InputError
        Faults that a retry does not fix: unknown scheme or setting, address or name that cannot be used.
    """
    # Import only what is used: python-can alone would double the start-up time of a command.
    scheme = url.partition(":")[0]
    if scheme == "udp":
        from imudrv.sinks.network import UdpSink

        return UdpSink(url)
    if scheme == "tcp":
        from imudrv.sinks.network import TcpSink

        return TcpSink(url)
    if scheme == "serial":
        from imudrv.sinks.serial import SerialSink

        return SerialSink(url)
    if scheme == "can":
        from imudrv.sinks.can import CanSink

        return CanSink(url, layout)
    if scheme == "zenoh":
        from imudrv.sinks.zenoh import ZenohSink

        return ZenohSink(url)
    if scheme == "file":
        from imudrv.sinks.file import FileSink

        return FileSink(url)
    raise InputError(f"{url}: expected {', '.join(f'{s}:' for s in SCHEMES)} at the start, got {scheme!r}")
