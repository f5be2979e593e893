"""Lines that a simulated unit sends on. What a line cannot deliver is counted.

A line is a `pty`, a real port (`serial`), a `tcp` server or a `can` bus; `base` holds what they share.
"""

from urllib.parse import parse_qsl, urlsplit

from imudrv.errors import InputError
from imudrv.profiles.schema import CanLine, Profile
from imudrv.sim.links.base import LineOptions, SimulatedLine
from imudrv.sim.links.can import SimulatedCanBus
from imudrv.sim.links.pty import SimulatedPty
from imudrv.sim.links.serial import SimulatedSerialPort
from imudrv.sim.links.tcp import SimulatedTcpServer


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
    url = urlsplit(target)
    if link is not None and target != "pty":
        raise InputError(f"link {link}: expected only with the port pty, got {target}")
    if (url.scheme == "can") != isinstance(line, CanLine):
        kinds = "can://INTERFACE/CHANNEL" if isinstance(line, CanLine) else "pty, a serial port or tcp://"
        raise InputError(f"port {target}: expected {kinds} for the profile {profile.name}")
    if isinstance(line, CanLine):
        return SimulatedCanBus(options, url, line)
    if target == "pty":
        return SimulatedPty(options, link)
    try:
        if url.scheme == "tcp":
            return SimulatedTcpServer(options, url.hostname or "127.0.0.1", url.port or 0)
        if url.scheme in ("serial", ""):
            query = dict(parse_qsl(url.query, strict_parsing=bool(url.query)))
            baudrate = int(query.pop("baudrate", line.baudrate))
            if url.path and not url.netloc and not query:
                settings = line.model_copy(update={"baudrate": baudrate})
                return SimulatedSerialPort(options, url.path, settings)
    except ValueError as error:
        raise InputError(f"port {target}: {error}") from error
    raise InputError(
        f"port {target}: expected pty, a serial port's path, serial:///PATH?baudrate=N, "
        "tcp://HOST:PORT or can://INTERFACE/CHANNEL"
    )
