"""Parts of a URL, and checks common to all ports."""

import os
import re
from pathlib import Path
from typing import Final, NamedTuple
from urllib.parse import parse_qsl

from imudrv.errors import InputError
from imudrv.profiles.schema import Profile

PYSERIAL: Final = ("socket", "rfc2217", "spy", "hwgrep", "alt", "loop", "cp2110")
SCHEMES: Final = tuple(f"{scheme}://" for scheme in ("serial", *PYSERIAL, "can", "replay", "sim"))


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
        """Device file of a serial port, where the system has device files."""
        return Path(self.address) if self.scheme == "serial" and os.name == "posix" else None


def split(text: str) -> Url:
    """Split a URL into its parts.

    Parameters
    ----------
    text : str
        URL, or the name of a serial device: ``/dev/ttyUSB0``, ``COM3``.

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
    if not found:
        if not re.match(r"/|COM\d+$", before):
            known = ", ".join(SCHEMES)
            raise InputError(
                f"{text!r}: expected a URL that begins with {known}, or a path like /dev/ttyUSB0"
            )
        scheme, address = "serial", before
    try:
        pairs = parse_qsl(query, keep_blank_values=True, strict_parsing=True) if query else []
    except ValueError:
        raise InputError(f"{text}: expected options as NAME=VALUE with & between, got {query!r}") from None
    options = dict(pairs)
    if len(options) < len(pairs):
        raise InputError(f"{text}: expected each option once, got one twice")
    return Url(text, scheme.lower(), address, options)


def value(text: str) -> bool | float | str:
    """Return the value of an option: true or false, a number, or the text itself."""
    if text in ("true", "false"):
        return text == "true"
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            continue
    return text


def require_transport(url: Url, profile: Profile, transport: str) -> None:
    """Refuse a profile whose transport is not that of the port.

    Raises
    ------
    InputError
        The message names the URLs that fit the profile.
    """
    if profile.transport != transport:
        fitting = "can://INTERFACE/CHANNEL" if profile.transport == "can" else "serial:///dev/..."
        raise InputError(
            f"{url.text}: expected a port for the {profile.transport} profile {profile.name}, "
            f"like {fitting}, got a {transport} port; change the URL or the profile"
        )
