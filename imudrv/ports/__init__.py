"""Ports, opened by URL: where wire bytes and CAN messages come from.

=====================================================  ====================================================
``serial:///dev/ttyUSB0``, ``/dev/ttyUSB0``            serial line, settings from the profile
``serial:///dev/serial/by-id/usb-FTDI_...``            by its stable name, the same in any USB socket
``...?baudrate=460800&parity=even``                    other settings: ``baudrate``, ``bytesize`` 5-8,
                                                       ``parity`` none, even, odd, mark, space,
                                                       ``stopbits`` 1, 2
``socket://HOST:PORT``                                 TCP server, such as a serial-to-Ethernet adapter
``rfc2217://HOST:PORT``, ``spy:///dev/ttyUSB0``,       other URLs of pyserial, with its options
``hwgrep://0403:6001``, ``loop://``, ``alt://``        and the settings of a line
``can://INTERFACE/CHANNEL``                            any interface of python-can, profile's bit rates
``can://socketcan/can0``                               Linux kernel; its bit rate is set by ``ip link``
``can://slcan//dev/ttyACM0?tty_baudrate=3000000``      adapter on a serial port; ``sleep_after_open=0``
                                                       saves 2 s where it does not restart at opening
``can://udp_multicast/239.74.163.2?port=43113``        between programs; needs the package msgpack
``can://virtual/NAME``                                 inside one program
``...?bitrate=500000&data_bitrate=2000000&fd=true``    other settings; the rest goes to python-can
``replay://FILE``                                      raw capture, candump log, ``.mcap`` recording
``replay://FILE?speed=10``, ``?speed=max``             at ten times the speed; as fast as it can be read
``replay://FILE?channel=can0``                         one channel of a candump log with several
``sim://SCENARIO.yaml``, ``sim://rocking?speed=max``   simulated unit; a file, or a shipped scenario's name
=====================================================  ====================================================

Values in a query are percent-decoded; an address is taken literally, up to the first ``?``.
"""

from collections.abc import Callable
from functools import partial

from imudrv.ports.base import Port, PortEndedError, PortLostError
from imudrv.profiles.schema import Profile
from imudrv.records import Arrival
from imudrv.url import split

__all__ = ["Arrival", "Port", "PortEndedError", "PortLostError", "check_url", "open_port"]


def open_port(url: str, profile: Profile) -> Port:
    """Open a port.

    Parameters
    ----------
    url : str
        See the table of this module.
    profile : Profile
        Profile of the unit: line settings, identifiers, layout of a capture.

    Returns
    -------
    Port
        The open port.

    Raises
    ------
    InputError
        The URL is not valid, or not with this profile; a retry does not help.
    PortLostError
        The device is absent, in use or not permitted at the moment.
    """
    return _opener(url, profile)()


def check_url(url: str, profile: Profile) -> None:
    """Check a URL without opening a device.

    Parameters
    ----------
    url, profile
        As for `open_port`.

    Raises
    ------
    InputError
        As `open_port` would raise it, as far as it is known without the device.
    """
    opener = _opener(url, profile)
    if split(url).scheme == "sim":  # no device: opening it is the check
        opener().close()


def _opener(url: str, profile: Profile) -> Callable[[], Port]:
    """Check a URL and return what opens it; libraries are loaded only where needed."""
    parts = split(url)
    if parts.scheme == "sim":
        from imudrv.ports.simulated import open_simulated

        return partial(open_simulated, parts, profile)
    if parts.scheme == "replay":
        from imudrv.ports import replay

        return replay.prepare(parts, profile)
    if parts.scheme == "can":
        from imudrv.ports import can

        return can.prepare(parts, profile)
    from imudrv.ports import serial

    return serial.prepare(parts, profile)
