"""Signs in wire bytes that the line or the recorder was set wrongly, although the bytes look like data."""

import re
from typing import Final

_FEWEST: Final = 8
"""Number of occurrences from which a sign is no chance."""
_LONG_ENOUGH: Final = 1 << 14
"""Bytes in which the counter of frames of up to 64 bytes passes through all values of a byte."""
_AT_ONCE: Final = 1 << 12
_ODD_RUN: Final = re.compile(rb"(?<!\xff)(?:\xff\xff)*\xff(?!\xff)")
_LONE_LF: Final = re.compile(rb"(?<!\r)\n")
_FLOW_CONTROL: Final = re.compile(rb"[\x11\x13]")


class DamageSigns:
    """Signs of a wrong setting in wire bytes, fed in any pieces.

    Sound bytes disprove each sign within a few frames; from then on nothing is searched.
    """

    def __init__(self) -> None:
        self._is_text_mode = self._is_flow_control = self._is_doubled = True
        self._line_feeds = self._doubled = self._bytes = 0
        self._last = b""  # the end of the bytes before: a CR, or FF of the same parity

    def feed(self, data: bytes) -> None:
        """Examine further bytes."""
        self._bytes += len(data)
        for begin in range(0, len(data), _AT_ONCE):
            if not (self._is_text_mode or self._is_flow_control or self._is_doubled):
                return
            self._examine(self._last + data[begin : begin + _AT_ONCE])

    def _examine(self, data: bytes) -> None:
        if self._is_text_mode:
            self._is_text_mode = _LONE_LF.search(data) is None
            self._line_feeds += data.count(b"\n")
        if self._is_flow_control:
            self._is_flow_control = _FLOW_CONTROL.search(data) is None
        body = data.rstrip(b"\xff")
        if self._is_doubled:
            self._is_doubled = _ODD_RUN.search(body) is None
            self._doubled += body.count(b"\xff\xff")
        run = len(data) - len(body)  # it may continue in the next piece
        self._last = b"\xff" * (2 - run % 2) if run else data[-1:].replace(b"\n", b"")

    @property
    def hints(self) -> list[str]:
        """What the bytes say, and what to do; one sentence a sign."""
        found = []
        if self._is_text_mode and self._line_feeds >= _FEWEST:
            found.append(
                f"all {self._line_feeds} bytes 0A come after a 0D: recorded in text mode, which turns LF "
                "into CR LF; record in binary (raw) mode"
            )
        if self._is_flow_control and self._bytes >= _LONG_ENOUGH:
            found.append(
                f"no byte 11 and no 13 in {self._bytes} bytes: XON/XOFF flow control takes them out; "
                "switch it off (stty -ixon -ixoff)"
            )
        if self._is_doubled and self._doubled >= _FEWEST:
            found.append(
                "every run of bytes FF has an even length: the line driver doubles FF to mark errors "
                "(PARMRK); switch it off (stty -parmrk)"
            )
        return found
