"""Hex dumps of wire bytes, as terminal programs, ``xxd`` and ``hexdump -C`` write them.

EB 90 50 26 C0 D4 01 00                             bytes, with or without blanks between them
00000000: eb90 5026 c0d4 0100  ..P&....             address, groups of bytes, text
00000000  eb 90 50 26  c0 d4 01 00  |..P&....|
"""

import re
from collections.abc import Iterator
from typing import Final

from imudrv.capture_files.source import Source

_PLAIN: Final = re.compile(rb"\s*((?:[0-9A-Fa-f]{2}\s*)*)")
_WITH_ADDRESS: Final = re.compile(
    rb"([0-9A-Fa-f]{4,16})(?:: ((?:[0-9A-Fa-f]{2,32} )+) .*|  ((?:[0-9A-Fa-f]{2} {1,2})+) *\|.*|)\s*"
)
_AT_ONCE: Final = 1 << 16


def read_hex_dump(source: Source) -> Iterator[bytes]:
    """Yield the bytes of a hex dump.

    Parameters
    ----------
    source : Source
        Open file.

    Raises
    ------
    ValueError
        A line is no part of a dump, or its address is not the number of bytes before it.
    """
    data, count, width = bytearray(), 0, 0
    for line in source:
        with_address = _WITH_ADDRESS.fullmatch(line)
        plain = _PLAIN.fullmatch(line)
        if with_address and (with_address[2] or with_address[3] or width):
            address = int(with_address[1], 16)
            if address != count:
                raise ValueError(f"expected the address {count:08x}, got {address:08x}; lines are missing")
            width = len(with_address[1])
            found = bytes.fromhex((with_address[2] or with_address[3] or b"").decode())
        elif plain and not width:
            found = bytes.fromhex(plain[1].decode())
        else:
            start = line[:40].decode("ascii", "backslashreplace").rstrip()
            raise ValueError(f"expected bytes in hexadecimal digits, got {start!r}")
        data += found
        count += len(found)
        if len(data) >= _AT_ONCE:
            yield bytes(data)
            data.clear()
    yield bytes(data)
