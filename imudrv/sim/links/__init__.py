"""Lines that a simulated unit sends on. What a line cannot deliver is counted.

A line is a `pty`, a real port (`serial`), a `tcp` server or a `can` bus; `base` holds what they share.
"""

from imudrv.errors import InputError
from imudrv.loopback import LOOPBACK
from imudrv.profiles.schema import CanLine, Profile
from imudrv.sim.links.base import LineOptions, SimulatedLine
from imudrv.sim.links.can import SimulatedCanBus
from imudrv.sim.links.pty import SimulatedPty
from imudrv.sim.links.serial import SimulatedSerialPort
from imudrv.sim.links.tcp import SimulatedTcpServer
from imudrv.url import device_path, host_and_port, serial_settings, split


def open_line(target: str, profile: Profile, options: LineOptions, link: str | None) -> SimulatedLine:
    """Open the line that a target names.

    Parameters
    ----------
    target, link
        As for `imudrv.sim.live.play`.
    profile : Profile
        Settings of the line.
    options : LineOptions
        Options of every line.

    Returns
    -------
    SimulatedLine

    Raises
    ------
    InputError
        The target is not valid, does not fit the profile, or cannot be opened.
    """
    line = profile.line
    is_can = isinstance(line, CanLine)
    if link is not None and target != "pty":
        raise InputError(f"link {link}: expected only with the port pty, got {target}")
    if target.startswith("can:") != is_can:
        kinds = "can://INTERFACE/CHANNEL" if is_can else "pty, a serial port or tcp://"
        raise InputError(f"port {target}: expected {kinds} for the profile {profile.name}")
    if target == "pty":
        return SimulatedPty(options, link)
    if isinstance(line, CanLine):
        return SimulatedCanBus(options, split(target, ("can",)), line)
    url = split(target, ("serial", "tcp"))
    if url.scheme == "tcp":
        return SimulatedTcpServer(options, *host_and_port(url, LOOPBACK))
    return SimulatedSerialPort(options, device_path(url), serial_settings(url, line))
