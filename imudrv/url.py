"""URLs of ports, outputs and simulated lines: parts, options, settings of a serial line."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple
from urllib.parse import parse_qsl, urlsplit

from imudrv.errors import InputError
from imudrv.files import settings_file, yaml_text
from imudrv.profiles.schema import SerialLine

PYSERIAL: Final = ("socket", "rfc2217", "spy", "hwgrep", "alt", "loop", "cp2110")
PORTS: Final = ("serial", *PYSERIAL, "can", "replay", "sim")
"""Schemes of ports."""
_WINDOWS_PORT: Final = re.compile(r"COM\d+", re.IGNORECASE)
SLOWEST: Final = 1e-3
FASTEST: Final = 1e6


class Url(NamedTuple):
    """Parts of a URL.

    Parameters
    ----------
    text : str
        URL as the user gave it.
    scheme : str
        Lower-case scheme; ``serial`` for the name of a device.
    address : str
        Literal text between scheme and query.
    options : dict of str to str
        Options of the query.
    """

    text: str
    scheme: str
    address: str
    options: dict[str, str]

    @property
    def device(self) -> Path | None:
        """Device file of a serial port."""
        return Path(self.address) if self.scheme == "serial" else None


def split(text: str, schemes: Sequence[str] = PORTS) -> Url:
    """Split a URL into its parts.

    Parameters
    ----------
    text : str
        URL, or the name of a serial device: ``/dev/ttyUSB0``, on Windows ``COM3``.
    schemes : sequence of str
        Schemes that are possible.

    Returns
    -------
    Url

    Raises
    ------
    InputError
        The text is neither, or an option occurs twice or has no value.
    """
    before, _, query = text.partition("?")
    scheme, found, address = before.partition("://")
    if not found and (before.startswith("/") or _WINDOWS_PORT.fullmatch(before)):
        scheme, address = "serial", before
    if scheme.lower() not in schemes:
        known = ", ".join(f"{scheme}://" for scheme in schemes)
        path = " or a path like /dev/ttyUSB0," if "serial" in schemes else ""
        raise InputError(f"{text}: expected a URL that begins with {known},{path} got {before!r}")
    if not query.isprintable():
        raise InputError(f"{text}: expected options of printable text, got {query!r}")
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
    except ValueError:
        raise InputError(f"{text}: expected options as NAME=VALUE with & between, got {query!r}") from None
    options = dict(pairs)
    if len(options) < len(pairs):
        raise InputError(f"{text}: expected each option once, got one twice")
    return Url(text, scheme.lower(), address, options)


def value(text: str) -> bool | float | str | None:
    """Return the value of an option: true or false, a number, or the text itself, as in a settings file."""
    return yaml_text.scalar(text)


def host_and_port(url: Url, default_host: str | None = None) -> tuple[str, int]:
    """Return host and port of an address.

    Raises
    ------
    InputError
        The address is something else, the host is missing and has no default, or there are options.
    """
    try:
        parts = urlsplit(f"//{url.address}")
        host, port = parts.hostname or default_host, parts.port
    except ValueError:
        host = port = None
    if host is None or port is None or parts.path:
        raise InputError(f"{url.text}: expected {url.scheme}://HOST:PORT, got {url.address!r} as the address")
    if url.options:
        raise InputError(f"{url.text}: expected no options for {url.scheme}://, got {', '.join(url.options)}")
    return host, port


def device_path(url: Url) -> str:
    """Return the path of a serial device, on Windows its name.

    Raises
    ------
    InputError
        The path is not absolute.
    """
    if not url.address.startswith("/") and not _WINDOWS_PORT.fullmatch(url.address):
        raise InputError(
            f"{url.text}: expected the path of a device like serial:///dev/ttyUSB0 (three slashes), "
            f"got {url.address!r}"
        )
    return url.address


def serial_settings(url: Url, line: SerialLine) -> dict[str, Any]:
    """Return the settings of a serial line for pyserial: those of `line`, replaced by the options of a URL.

    Raises
    ------
    InputError
        An option is unknown or has a wrong value.
    """
    asked = {name: value(text) for name, text in url.options.items()}
    settings = settings_file.parse({**line.model_dump(), **asked}, SerialLine, url.text).model_dump()
    return {**settings, "parity": settings["parity"][0].upper()}


def speed_of(text: str) -> float | None:
    """Return the speed that a text means: ``1``, ``0.5``, ``10``; ``max`` is None.

    Parameters
    ----------
    text : str
        The text.

    Returns
    -------
    float or None

    Raises
    ------
    InputError
        The text is neither ``max`` nor a number from 0.001 to a million.
    """
    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not SLOWEST <= speed <= FASTEST:
        raise InputError(f"speed: expected max or a number from {SLOWEST:g} to {FASTEST:g}, got {text!r}")
    return speed
