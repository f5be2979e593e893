"""Text of a candump log to CAN messages and back, one line per message.

    (1700000000.123456) can0 150#0001FFFF02004000            classic, id of 3 or 8 hex digits
    (1700000000.123456) can0 158##1000102...                 CAN FD: ``##`` and one digit of flags

An identifier of 8 digits has 29 bits, one of 3 digits 11. An error frame (`candump -e`) has bit 29 of its
identifier set: 20000004.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.errors import InputError
from imudrv.kernels import kernel
from imudrv.records import EXTENDED, MESSAGE, REJECT, Reason, Records
from imudrv.units import NS_PER_S
from imudrv.wire.fields import Bytes

LONGEST_LINE: Final = 256
"""Maximum number of characters of a line without its newline; a longer line is no message."""
MOST_CHANNELS: Final = 16
"""Maximum number of channels distinguished by name, as in candump itself."""

_NEWLINE, _TAB, _RETURN, _SPACE = ord("\n"), ord("\t"), ord("\r"), ord(" ")
_OPEN, _CLOSE, _POINT, _HASH, _ZERO = ord("("), ord(")"), ord("."), ord("#"), ord("0")
_RECEIVED, _TRANSMITTED = ord("R"), ord("T")
_NOT_HEX: Final = 255
_NO_MESSAGE: Final = -1
_IS_ERROR_FRAME: Final = -2
_ERROR_FLAG: Final = 1 << 29
_ID_MASK: Final = _ERROR_FLAG - 1
_LAST_SECOND: Final = (2**63 - 1) // NS_PER_S - 1
_NOT_A_MESSAGE: Final = int(Reason.NOT_A_MESSAGE)
_ERROR_FRAME: Final = int(Reason.ERROR_FRAME)

_NIBBLES = np.full(256, _NOT_HEX, np.uint8)
for _value, _digit in enumerate(b"0123456789ABCDEF"):
    _NIBBLES[_digit] = _NIBBLES[ord(chr(_digit).lower())] = _value
_DIGITS = np.frombuffer(b"0123456789ABCDEF", np.uint8).copy()


class CandumpDecoder:
    """Decoder of candump log text; feed it text as it arrives, in any pieces.

    The messages and rejects are the same for any cut of the text into pieces, and every byte fed is in the
    line of a message, in a blank line, in a reject (its line, whole) or among the `pending` ones. Remote
    frames carry no data and are rejects; error frames are rejects with a reason of their own.

    Only the messages of one channel come out, so that two units in one log are never mixed; `check_channel`
    refuses a log of several channels where none was chosen.

    Parameters
    ----------
    channel : str, optional
        The channel to read; that of the first message if absent.
    """

    def __init__(self, channel: str | None = None) -> None:
        self._line: NDArray[np.uint8] = np.zeros(0, np.uint8)
        self._cut = 0
        self._offset = 0
        self._is_closed = False
        self._channel = channel
        # Row 0 is the channel that is read; a name ends with a zero, a free row has none. The last count is
        # that of the channels for which no row was free.
        self._names = np.zeros((MOST_CHANNELS, LONGEST_LINE + 1), np.uint8)
        self._counts = np.zeros(MOST_CHANNELS + 1, np.int64)
        if channel is not None:
            # A blank is in no channel of a log, and a line has no room for a longer name.
            name = channel.encode(errors="surrogatepass").replace(b"\0", b" ")[:LONGEST_LINE] or b" "
            self._names[0, : len(name)] = list(name)

    @property
    def pending(self) -> int:
        """Number of bytes of the unfinished last line; at most `LONGEST_LINE` + 1 of them are kept."""
        return self._line.size + self._cut

    @property
    def bytes_fed(self) -> int:
        """Number of bytes fed so far."""
        return self._offset + self.pending

    @property
    def channels(self) -> dict[str, int]:
        """Messages of each channel so far; those of the channels beyond `MOST_CHANNELS` are ``others``."""
        names = [bytes(row).rstrip(b"\0").decode("ascii", "backslashreplace") for row in self._names]
        counts = self._counts.tolist()
        return {name: count for name, count in zip([*names, "others"], counts, strict=True) if count}

    def check_channel(self, log: str, option: str) -> None:
        """Refuse a log of several channels where none was chosen, and at its end one without the chosen one.

        Parameters
        ----------
        log : str
            Name of the log, for the message.
        option : str
            How to choose a channel, up to its name, for the message.

        Raises
        ------
        InputError
            The message names the channels of the log so far.
        """
        if not self._is_closed and np.count_nonzero(self._counts) < 2:
            return
        names = sorted(self.channels)
        came = " and ".join(", ".join(names).rsplit(", ", 1))
        if self._channel is None and len(names) > 1:
            raise InputError(
                f"{log}: expected messages of one CAN channel, got those of {came}; "
                f"choose one, as with {option}{names[0]}"
            )
        if self._channel is not None and self._is_closed and names and not self._counts[0]:
            raise InputError(
                f"{log}: expected messages of CAN channel {self._channel!r}, got those of {came}"
            )

    def feed(self, data: bytes | bytearray | memoryview | NDArray[np.uint8]) -> tuple[Records, Records]:
        """Decode text.

        Parameters
        ----------
        data : bytes-like
            Any number of bytes.

        Returns
        -------
        messages : ndarray of MESSAGE
            Of the channel that is read, with the log's own times.
        rejects : ndarray of REJECT
            Lines that are no message.
        """
        text = np.concatenate([self._line, np.frombuffer(data, np.uint8)])
        ends = np.flatnonzero(text == _NEWLINE)
        messages = np.zeros(ends.size, MESSAGE)
        rejects = np.zeros(ends.size, REJECT)
        found, rejected = _scan(text, ends, messages, rejects, self._names, self._counts)
        rejects = rejects[:rejected]
        rejects["offset"] += self._offset
        if ends.size and self._cut:
            # What was cut off belongs to the first line; what was kept of that is too long, hence its reject.
            rejects["length"][0] += self._cut
            rejects["offset"][1:] += self._cut
            self._offset += self._cut
            self._cut = 0
        stop = int(ends[-1]) + 1 if ends.size else 0
        self._offset += stop
        rest = text[stop:]
        self._line = rest[: LONGEST_LINE + 1].copy()
        self._cut += rest.size - self._line.size
        return messages[:found], rejects

    def close(self) -> tuple[Records, Records]:
        """End of the log: a last line without an end is taken as it is.

        Returns
        -------
        messages, rejects
            As from `feed`; at most one of both together.
        """
        messages, rejects = self.feed(b"\n")
        self._is_closed = True
        self._offset -= 1
        rejects["length"] -= 1
        rejects["reason"][rejects["reason"] == Reason.NOT_A_MESSAGE] = Reason.UNFINISHED
        return messages, rejects


@kernel
def _scan(
    text: Bytes,
    ends: NDArray[np.intp],
    messages: Records,
    rejects: Records,
    names: Bytes,
    counts: NDArray[np.int64],
) -> tuple[int, int]:
    """Read every whole line; `ends` are the positions of their newlines.

    Returns
    -------
    tuple of 2 int
        Messages and rejects.
    """
    start = found = rejected = 0
    for i in range(ends.shape[0]):
        end = ends[np.uint64(i)]
        message = messages[found]
        other = _parse(text, start, message, names) if end - start <= LONGEST_LINE else _NO_MESSAGE
        row = _row_of(text, other, names) if other > 0 else other
        if row == 0:
            found += 1
        else:
            message["data"][:] = 0
            if row > 0:
                counts[np.uint64(row)] += 1
            elif text[_skip_blanks(text, start)] != _NEWLINE or end - start > LONGEST_LINE:
                rejects[rejected]["offset"] = start
                rejects[rejected]["length"] = end + 1 - start
                rejects[rejected]["reason"] = _ERROR_FRAME if row == _IS_ERROR_FRAME else _NOT_A_MESSAGE
                rejected += 1
        start = end + 1
    counts[0] += found
    return found, rejected


@kernel
def _parse(text: Bytes, p: int, message: np.void, names: Bytes) -> int:
    """Read the line at `p` into `message`, whose data are zeros; no step passes the newline of the line.

    Returns 0 for a message of the channel that is read, the position of the channel name for a message of
    another channel, `_IS_ERROR_FRAME` for an error frame, and `_NO_MESSAGE` otherwise.
    """
    p = _parse_time(text, p, message)
    if p == _NO_MESSAGE:
        return _NO_MESSAGE
    channel = _skip_blanks(text, p)
    end = _end_of_word(text, channel)
    begin = _skip_blanks(text, end)
    if channel == p or end == channel or begin == end:
        return _NO_MESSAGE
    p = _parse_identifier(text, begin, message)
    if p == _NO_MESSAGE:
        return _NO_MESSAGE
    p = _parse_data(text, p, message)
    if p == _NO_MESSAGE:
        return _NO_MESSAGE
    end_of_data = _skip_blanks(text, p)
    if end_of_data > p and (text[end_of_data] == _RECEIVED or text[end_of_data] == _TRANSMITTED):
        end_of_data = _skip_blanks(text, end_of_data + 1)
    if text[end_of_data] != _NEWLINE:
        return _NO_MESSAGE
    if message["id"] & _ERROR_FLAG:
        return _IS_ERROR_FRAME
    return 0 if _is_name(text, channel, end - channel, names[0]) else channel


@kernel
def _parse_time(text: Bytes, p: int, message: np.void) -> int:
    """Read ``(seconds.fraction)`` at `p`; return the position after it, or `_NO_MESSAGE`."""
    if text[p] != _OPEN:
        return _NO_MESSAGE
    p, seconds, digits = _decimal(text, p + 1)
    if digits < 1 or digits > 10 or seconds > _LAST_SECOND or text[p] != _POINT:
        return _NO_MESSAGE
    p, fraction, digits = _decimal(text, p + 1)
    if digits < 1 or digits > 9 or text[p] != _CLOSE:
        return _NO_MESSAGE
    for _ in range(9 - digits):
        fraction *= 10
    message["t_ns"] = seconds * NS_PER_S + fraction
    return p + 1


@kernel
def _parse_identifier(text: Bytes, begin: int, message: np.void) -> int:
    """Read the identifier at `begin` and its ``#``; return the position after it, or `_NO_MESSAGE`."""
    p = begin
    identifier = np.int64(0)
    while p < begin + 8 and _NIBBLES[text[p]] != _NOT_HEX:
        identifier = identifier << 4 | np.int64(_NIBBLES[text[p]])
        p += 1
    limit = 0x7FF if p - begin == 3 else _ERROR_FLAG | _ID_MASK
    if (p - begin != 3 and p - begin != 8) or identifier > limit or text[p] != _HASH:
        return _NO_MESSAGE
    message["id"] = identifier if p - begin == 3 else identifier | EXTENDED
    return p + 1


@kernel
def _parse_data(text: Bytes, p: int, message: np.void) -> int:
    """Read the data at `p`, for CAN FD after ``#`` and flags; return their end, or `_NO_MESSAGE`."""
    longest = 8
    message["fd"] = 0
    if text[p] == _HASH:
        if _NIBBLES[text[p + 1]] == _NOT_HEX:
            return _NO_MESSAGE
        message["fd"] = 1
        longest = 64
        p += 2
    length = 0
    while length < longest:
        high = _NIBBLES[text[np.uint64(p)]]
        if high == _NOT_HEX:
            break
        low = _NIBBLES[text[np.uint64(p + 1)]]
        if low == _NOT_HEX:
            return _NO_MESSAGE
        message["data"][np.uint64(length)] = high << 4 | low
        length += 1
        p += 2
    message["length"] = length
    return p


@kernel
def _row_of(text: Bytes, begin: int, names: Bytes) -> int:
    """Return the row of the channel whose name is at `begin`; a new channel gets the first free row."""
    length = _end_of_word(text, begin) - begin
    for row in range(MOST_CHANNELS):
        if names[row, 0] == 0:
            for k in range(length):
                names[row, k] = text[begin + k]
            return row
        if _is_name(text, begin, length, names[row]):
            return row
    return MOST_CHANNELS


@kernel
def _is_name(text: Bytes, begin: int, length: int, name: Bytes) -> bool:
    """Return whether the word at `begin` is a name, which ends with a zero."""
    for k in range(length):
        if text[np.uint64(begin + k)] != name[np.uint64(k)]:
            return False
    return bool(name[length] == 0)


@kernel
def _end_of_word(text: Bytes, p: int) -> int:
    while text[np.uint64(p)] > _SPACE:
        p += 1
    return p


class _Decimal(NamedTuple):
    end: int
    value: int  # right for up to 18 digits
    digits: int


@kernel
def _decimal(text: Bytes, p: int) -> _Decimal:
    """Read the digits at `p`."""
    begin = p
    value = 0
    while _ZERO <= text[p] <= _ZERO + 9:
        value = value * 10 + int(text[p] - _ZERO)
        p += 1
    return _Decimal(p, value, p - begin)


@kernel
def _skip_blanks(text: Bytes, p: int) -> int:
    """Return where the spaces, tabs and carriage returns at `p` end."""
    while text[p] == _SPACE or text[p] == _TAB or text[p] == _RETURN:
        p += 1
    return p


def format_candump(messages: Records, channel: str = "can0") -> bytes:
    """Write messages as candump log text; the time is cut to whole microseconds.

    Parameters
    ----------
    messages : ndarray of MESSAGE, shape (n,)
        The messages.
    channel : str
        Name of the interface.

    Returns
    -------
    bytes
        One line per message: ``(seconds.micro) channel ID#DATA``, for CAN FD ``ID##1DATA``.

    Raises
    ------
    InputError
        A time before 1970, or a channel's name that no log can hold.
    """
    name = np.frombuffer(channel.encode(), np.uint8)
    if not 1 <= name.size <= 16 or not np.all((name > _SPACE) & (name < 127)):
        raise InputError(f"channel: expected 1 to 16 printable characters without blanks, got {channel!r}")
    if messages.size == 0:
        return b""
    if messages["t_ns"].min() < 0:
        raise InputError(
            f"message {int(messages['t_ns'].argmin())}: expected a time from 1970 on, "
            f"got {int(messages['t_ns'].min())} ns; a candump log cannot hold it"
        )
    around_data = len("(1700000000.123456)  12345678##1\n") + name.size
    text = np.empty(messages.size * (around_data + 2 * int(messages["length"].max())), np.uint8)
    return text[: _write(messages, name, text)].tobytes()


@kernel
def _write(messages: Records, name: Bytes, text: Bytes) -> int:
    """Write the lines of all messages to `text`; return their length in bytes."""
    p = 0
    for i in range(messages.shape[0]):
        message = messages[np.uint64(i)]
        p = _put(text, p, _OPEN)
        p = _put_decimal(text, p, message["t_ns"] // NS_PER_S, 10)
        p = _put(text, p, _POINT)
        p = _put_decimal(text, p, message["t_ns"] % NS_PER_S // 1000, 6)
        p = _put(text, p, _CLOSE)
        p = _put(text, p, _SPACE)
        for k in range(name.shape[0]):
            p = _put(text, p, name[k])
        p = _put(text, p, _SPACE)
        p = _put_hex(text, p, message["id"] & _ID_MASK, 3 if message["id"] <= 0x7FF else 8)
        p = _put(text, p, _HASH)
        if message["fd"]:
            p = _put(text, p, _HASH)
            p = _put(text, p, _ZERO + 1)
        for k in range(message["length"]):
            p = _put_hex(text, p, message["data"][np.uint64(k)], 2)
        p = _put(text, p, _NEWLINE)
    return p


@kernel
def _put(text: Bytes, p: int, character: int) -> int:
    """Write a character; return the position after it."""
    text[np.uint64(p)] = character
    return p + 1


@kernel
def _put_decimal(text: Bytes, p: int, value: int, digits: int) -> int:
    """Write the last `digits` decimal digits of a value; return the position after them."""
    for k in range(digits):
        text[np.uint64(p + digits - 1 - k)] = _ZERO + value % 10
        value //= 10
    return p + digits


@kernel
def _put_hex(text: Bytes, p: int, value: int, digits: int) -> int:
    """Write the last `digits` hexadecimal digits of a value; return the position after them."""
    for k in range(digits):
        text[np.uint64(p + digits - 1 - k)] = _DIGITS[value >> 4 * k & 15]
    return p + digits
