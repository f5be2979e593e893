"""What candump prints on a screen, as the lines of a candump log.

      can0  150   [8]  01 00 FF FF 02 00 40 00
     (1700000000.000028)  can0  150   [8]  ..             -t a; counted from the first message: -t z
     (2023-11-14 22:13:20.000028)  can0  150   [8]  ..    -t A, read as UTC
     (000.000128)  can0  150   [8]  ..                    -t d: since the message before

Without times all messages have the time 0. The text does not say whether small times count from the first
message or from the message before; a time that decreases decides.
"""

import re
from collections.abc import Iterable, Iterator
from datetime import datetime
from itertools import chain, pairwise
from typing import Final

from imudrv.capture_files.source import Source

_LINE: Final = re.compile(
    rb" *(?:\((?:(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)|(\d{1,10}))\.(\d{6,9})\) +)?(\S+) +"
    rb"(?:[RT]X [B-] [E-] +)?([0-9A-F]{3}|[0-9A-F]{8}) +\[ ?(\d\d?)\] *"
    rb"(?:(remote request)|((?:[0-9A-F]{2} ?)*))(?: +'.*'| +ERRORFRAME)?\s*"
)
_AT_ONCE: Final = 4096
_EPOCH_FROM_S: Final = 10**8
"""Smaller times count from the first message or the one before."""


def read_screen(source: Source) -> Iterator[bytes]:
    """Yield the text of a candump log; a line that is no message stays as it is.

    Parameters
    ----------
    source : Source
        Open file.
    """
    lines = iter(source)
    head = [line for line, _ in zip(lines, range(_AT_ONCE), strict=False)]
    are_differences = _are_differences(head)
    text, total_us = [], 0
    for line in chain(head, lines):
        match = _LINE.fullmatch(line)
        if match is None:
            text.append(line)
            continue
        date, seconds, fraction, channel, identifier, length, remote, data = match.groups()
        try:
            us = _time_us(date, seconds, fraction)
        except ValueError:  # no such date
            text.append(line)
            continue
        if are_differences:
            us = total_us = total_us + us
        # with two digits of length candump shows CAN FD
        data = b"R" if remote else (b"#1" if len(length) == 2 else b"") + data.replace(b" ", b"")
        time = b"%d.%06d" % divmod(us, 1_000_000)
        text.append(b"(%b) %b %b#%b\n" % (time, channel, identifier, data))
        if len(text) >= _AT_ONCE:
            yield b"".join(text)
            text.clear()
    yield b"".join(text)


def _time_us(date: bytes | None, seconds: bytes | None, fraction: bytes | None) -> int:
    us = int(fraction[:6]) if fraction else 0
    if date:
        us += int(datetime.fromisoformat(f"{date.decode()}+00:00").timestamp()) * 1_000_000
    elif seconds:
        us += int(seconds) * 1_000_000
    return us


def _are_differences(lines: Iterable[bytes]) -> bool:
    """Return whether the times are those since the message before (``-t d``)."""
    matches = (_LINE.fullmatch(line) for line in lines)
    times = [int(m[2] + m[3][:6]) for m in matches if m is not None and m[2] is not None]
    if not times or max(times) >= _EPOCH_FROM_S * 1_000_000:
        return False
    return any(after < before for before, after in pairwise(times))
