"""What candump prints on a screen, and its logs of time differences, as the lines of a candump log.

      can0  150   [8]  01 00 FF FF 02 00 40 00
     (1700000000.000028)  can0  150   [8]  ..             -t a; counted from the first message: -t z
     (2023-11-14 22:13:20.000028)  can0  150   [8]  ..    -t A, read as UTC
     (000.000128)  can0  150   [8]  ..                    -t d: since the message before

Without times all messages have the time 0.
"""

import re
from collections.abc import Iterator
from datetime import datetime
from itertools import chain
from typing import Final

from imudrv.capture_files.recognise import are_differences
from imudrv.capture_files.source import Source

_LINE: Final = re.compile(
    rb" *(?:\((?:(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d)|(\d{1,10}))\.(\d{6,9})\) +)?(\S+) +"
    rb"(?:[RT]X [B-] [E-] +)?([0-9A-F]{3}|[0-9A-F]{8}) +\[ ?(\d\d?)\] *"
    rb"(?:(remote request)|((?:[0-9A-F]{2} ?)*))(?: +'.*'| +ERRORFRAME)?\s*"
)
_LOG_LINE: Final = re.compile(rb"\((\d{1,10})\.(\d{6})\d{0,3}\)(.*\n?)", re.DOTALL)
_AT_ONCE: Final = 4096


def read_screen(source: Source) -> Iterator[bytes]:
    """Yield the text of a candump log; a line that is no message stays as it is.

    Parameters
    ----------
    source : Source
        Open file.
    """
    lines = iter(source)
    head = [line for line, _ in zip(lines, range(_AT_ONCE), strict=False)]
    matches = (_LINE.fullmatch(line) for line in head)
    has_differences = are_differences((m[2], m[3]) for m in matches if m is not None and m[2] is not None)
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
        if has_differences:
            us = total_us = total_us + us
        # with two digits of length candump shows CAN FD
        data = b"R" if remote else (b"#1" if len(length) == 2 else b"") + data.replace(b" ", b"")
        time = b"%d.%06d" % divmod(us, 1_000_000)
        text.append(b"(%b) %b %b#%b\n" % (time, channel, identifier, data))
        if len(text) >= _AT_ONCE:
            yield b"".join(text)
            text.clear()
    yield b"".join(text)


def read_differences(source: Source) -> Iterator[bytes]:
    """Yield a candump log of time differences with times counted from its beginning.

    Parameters
    ----------
    source : Source
        Open file.
    """
    total_us = 0
    for line in source:
        if match := _LOG_LINE.fullmatch(line):
            total_us += int(match[1]) * 1_000_000 + int(match[2])
            line = b"(%d.%06d)%b" % (*divmod(total_us, 1_000_000), match[3])
        yield line


def _time_us(date: bytes | None, seconds: bytes | None, fraction: bytes | None) -> int:
    us = int(fraction[:6]) if fraction else 0
    if date:
        us += int(datetime.fromisoformat(f"{date.decode()}+00:00").timestamp()) * 1_000_000
    elif seconds:
        us += int(seconds) * 1_000_000
    return us
