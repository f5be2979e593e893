"""Out: where pulses and increments go; each way by its URL.

base      what every sink keeps to      backlog   datagrams that wait for a consumer
network   UDP, TCP      serial, can     ports and buses      file    a growing file
recorder  everything, into an MCAP      spool     the thread that writes a file
files     tables of a whole capture
"""

from imudrv.errors import InputError
from imudrv.sinks.base import Sink
from imudrv.wire.layout import Layout

SCHEMES = ("udp", "tcp", "serial", "can", "file")


def open_sink(url: str, layout: Layout) -> Sink:
    """Open a way out.

    Parameters
    ----------
    url : str
        ``udp://HOST:PORT``, ``tcp://HOST:PORT``, ``serial://PATH?baudrate=...``,
        ``can://INTERFACE/CHANNEL?profile=...`` or ``file:NAME.i50n``.
    layout : Layout
        Of the unit.

    Returns
    -------
    Sink
        Open, or on its way there: what is absent now may come later.

    Raises
    ------
    InputError
        What no waiting will mend: a URL of no known kind, a setting that does not exist, an address or name
        that cannot be had.
    """
    # Only what is used is loaded: python-can alone would double the time that a command takes to start.
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
    if scheme == "file":
        from imudrv.sinks.file import FileSink

        return FileSink(url)
    raise InputError(f"{url}: expected {', '.join(f'{s}:' for s in SCHEMES)} in front, got {scheme!r}")
