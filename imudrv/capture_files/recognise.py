"""What a capture file is. The suffix of its name chooses, the content is checked."""

import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import PurePath
from typing import Final, Literal, NamedTuple

from imudrv.errors import InputError


class Kind(NamedTuple):
    """A form in which captures are stored.

    Parameters
    ----------
    name : str
        What it is, for messages.
    transport : {'serial', 'can', ''}
        What it contains; empty for a container of either, and for what cannot be read.
    suffix : str
        Suffix that chooses it; empty if its content does.
    advice : str
        What to do with it if it cannot be read.
    """

    name: str
    transport: Literal["serial", "can", ""]
    suffix: str = ""
    advice: str = ""


WIRE_BYTES: Final = Kind("wire bytes", "serial")
HEX_DUMP: Final = Kind("a hex dump", "serial")
CANDUMP_LOG: Final = Kind("a candump log", "can")
CANDUMP_DIFFERENCES: Final = Kind("a candump log of time differences", "can")
CANDUMP_SCREEN: Final = Kind("a log in the screen format of candump", "can")
ASC: Final = Kind("an ASC log", "can", ".asc")
BLF: Final = Kind("a Vector BLF log", "can", ".blf")
TRC: Final = Kind("a PEAK TRC log", "can", ".trc")
CSV: Final = Kind("a CSV log of python-can", "can", ".csv")
DATABASE: Final = Kind("an SQLite log of python-can", "can", ".db")
MDF: Final = Kind("an MDF 4 log", "can", ".mf4")
GZIP: Final = Kind("a gzip archive", "", ".gz")
ZSTANDARD: Final = Kind("a Zstandard archive", "", ".zst")
RECORDING: Final = Kind("a recording (MCAP)", "", ".mcap")
DATAGRAMS: Final = Kind(
    "increments as I50N datagrams",
    "",
    ".i50n",
    "they are compensated already and hold no pulses; write them as a table with `imudrv export --to csv`",
)

_UNPACK: Final = "unpack it, and give the file inside"
_CONVERT: Final = "it is no CAN log; record the bus with `candump -L`"
_ZIP: Final = Kind("a zip archive (or NumPy .npz)", "", advice=_UNPACK)
_XZ: Final = Kind("an xz archive", "", advice=_UNPACK)
_BZIP2: Final = Kind("a bzip2 archive", "", advice=_UNPACK)
_SEVEN_ZIP: Final = Kind("a 7z archive", "", advice=_UNPACK)
_PCAP: Final = Kind("a packet capture of Wireshark", "", advice=_CONVERT)

_BY_SUFFIX: Final = {
    kind.suffix: kind for kind in (ASC, BLF, TRC, CSV, DATABASE, MDF, GZIP, ZSTANDARD, RECORDING, DATAGRAMS)
}
_BY_MAGIC: Final = (
    (b"\x1f\x8b\x08", GZIP),
    (b"\x28\xb5\x2f\xfd", ZSTANDARD),
    (b"LOGG", BLF),
    (b"SQLite format 3\0", DATABASE),
    (b"MDF     ", MDF),
    (b"UnFinMF ", MDF),
    (b"\x89MCAP0\r\n", RECORDING),
    (b"I50N\x01", DATAGRAMS),
    (b"PK\x03\x04", _ZIP),
    (b"\xfd7zXZ\0", _XZ),
    (b"BZh91AY&SY", _BZIP2),
    (b"7z\xbc\xaf\x27\x1c", _SEVEN_ZIP),
    (b"\xd4\xc3\xb2\xa1", _PCAP),
    (b"\x0a\x0d\x0d\x0a", _PCAP),
)
_BY_LINE: Final = (
    (rb"^\(\d+\.\d+\)[ \t]+\S+[ \t]+[0-9A-Fa-f]{3,8}#", CANDUMP_LOG),
    (rb"^ *(?:\([\d:. -]+\) +)?\S+ +(?:[RT]X [B-] [E-] +)?[0-9A-F]{3,8} +\[\d\d?\] ", CANDUMP_SCREEN),
    (rb"^timestamp,arbitration_id,extended,remote,error,dlc,data\r?$", CSV),
    (rb"^;\$FILEVERSION|^;   Message Number", TRC),
    (
        rb"^date [A-Z]{2,3} |^base +(?:hex|dec)\b|^begin triggerblock|^ *\d+\.\d+ +(?:\d+|CANFD) +\S+ +.x +",
        ASC,
    ),
    (rb"^(?:[0-9A-F]{2} +){3,}[0-9A-F]{2} *\r?$|^[0-9A-F]{32,}\r?$", HEX_DUMP),
    (rb"^[0-9A-F]{4,16}(?::| ) ?(?:[0-9A-F]{2}){1,16} +[0-9A-F]{2}", HEX_DUMP),
)
_TIME: Final = re.compile(rb"^ ?\((\d{1,10})\.(\d{6})\d*\) ", re.MULTILINE)
_EPOCH_FROM_US: Final = 10**14
"""Times from here on, 1973, are those of a clock."""
_MANY_RANGES: Final = 10
"""Two channels in turn go twice over their range, or three times."""
_LOOKED_AT: Final = 1 << 13
"""Number of bytes in which a line of the format has to come."""
_CONTROL: Final = re.compile(rb"[\0-\x08\x0e-\x1a\x1c-\x1f]")


def kind_of_content(head: bytes) -> Kind | None:
    """Return the kind of a file by its beginning; None if it is no known one, such as wire bytes."""
    for magic, kind in _BY_MAGIC:
        if head.startswith(magic):
            return kind
    if is_text(head):
        for pattern, kind in _BY_LINE:
            if re.search(pattern, head[:_LOOKED_AT], re.MULTILINE | re.IGNORECASE):
                if kind is CANDUMP_LOG and are_differences(_TIME.findall(head)):
                    return CANDUMP_DIFFERENCES
                return kind
    return None


def are_differences(times: Iterable[tuple[bytes, bytes]]) -> bool:
    """Return whether times of candump are those since the message before (``-t d``).

    Differences go up and down over their whole range with each message; times counted from anywhere increase
    but for channels whose messages come in turn.

    Parameters
    ----------
    times : iterable of (bytes, bytes)
        Digits of the seconds and of their fraction, of successive messages.
    """
    us = [int(seconds) * 1_000_000 + int(fraction[:6]) for seconds, fraction in times]
    if not us or us[0] >= _EPOCH_FROM_US:
        return False
    travelled = sum(abs(after - before) for before, after in pairwise(us))
    return travelled > _MANY_RANGES * (max(us) - min(us))


def is_text(head: bytes) -> bool:
    """Return whether the beginning of a file has no byte that is in no text."""
    return _CONTROL.search(head[:_LOOKED_AT]) is None


def recognise(path: PurePath, name: PurePath | None, head: bytes) -> Kind | None:
    """Return the kind of a file, or None if neither its name nor its content is of a known one.

    Parameters
    ----------
    path : PurePath
        The file, for messages.
    name : PurePath or None
        Name whose suffix counts: without ``.gz`` if the content is unpacked; None for a pipe, whose name says
        nothing.
    head : bytes
        Beginning of the content.

    Raises
    ------
    InputError
        Name and content contradict each other, or the file cannot be read; the message says what it is.
    """
    suffix = "" if name is None else name.suffix.lower()
    named, kind = _BY_SUFFIX.get(suffix), kind_of_content(head)
    if kind is None:
        if named is None:
            return None
        raise InputError(
            f"{path}: named {suffix}, but does not begin like {named.name}; rename it if it is something else"
        )
    if kind.advice:
        raise InputError(f"{path}: expected a capture, got {kind.name}; {kind.advice}")
    if name is None or named is kind or (named is None and not kind.suffix):
        return kind
    raise InputError(
        f"{path}: named {suffix or 'without a suffix'}, but is {kind.name}; "
        f"rename it to {name.stem}{kind.suffix or '.log'}"
    )
