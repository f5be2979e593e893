"""Target: URLs of ports."""

import contextlib
from typing import Final

from numpy.random import Generator

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.ports import check_url
from imudrv.url import PORTS, speed_of, split

from .properties import Cuts, Setup
from .random_input import mutated, pick, small_number
from .units import CAN, SERIAL

WORDS: Final = (
    *("://", ":", "/", "//", "?", "&", "=", "%", "%00", "\0", "\n", "\x1b[31m", "#", "@", "[", "]", "[::1]"),
    *(
        "/dev/none",
        "/tmp",
        "socketcan",
        "virtual",
        "slcan",
        "udp_multicast",
        "can0",
        "host:1",
        "host:99999",
        ".",
    ),
    *(
        "baudrate",
        "parity",
        "bytesize",
        "stopbits",
        "speed",
        "channel",
        "bitrate",
        "data_bitrate",
        "fd",
        "port",
    ),
    *(
        "=1",
        "=max",
        "=nan",
        "=1e999",
        "=-1",
        "=true",
        "=none",
        "=0x10",
        "=" + "9" * 5000,
        "&x=1",
        "\udcff",
        "é",
    ),
    *("x" * 300, "rocking", "static", "none.yaml", "239.74.163.2", "é" * 200, "bus", "interface", "filename"),
)
PROFILES: Final = tuple(profiles.load(name) for name in (SERIAL[0], CAN[0], CAN[1]))


def make_url(rng: Generator) -> tuple[Setup, bytes]:
    """Return a URL of known parts in any order, or damaged."""
    text = pick(rng, (*PORTS, *PORTS, "usb", "", "/dev/none")) + pick(rng, ("://", "://", "://", ":", ""))
    text += "".join(pick(rng, WORDS) for _ in range(small_number(rng, 9)))
    data = text.encode("utf-8", "surrogateescape")
    return None, mutated(rng, data, [b"://", b"?", b"%"]) if rng.integers(3) == 0 else data


def check_port_url(_: Setup, data: bytes, __: Cuts) -> None:
    """Check that a URL is refused with its text, or can be opened."""
    text = data.decode("utf-8", "surrogateescape")
    for profile in PROFILES:
        with contextlib.suppress(InputError):
            check_url(text, profile)
    with contextlib.suppress(InputError):
        speed_of(split(text).options.get("speed", ""))
