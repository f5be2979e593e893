"""Replay of a raw capture, a candump log or a recording.

At a given speed each chunk is returned when it is due, by deadlines relative to the first one; a chunk is one
millisecond of real time, or one read of a recording. With ``max`` the file is read as fast as possible, in
large chunks.

A chunk has the time of its end. A log and a recording contain times; in a raw capture, which does not, the
time is the sample interval times the number of frames up to there, from 0 on. So every replay at a given
speed returns the same chunks with the same times, and a message or a read of a recording has the same time at
any speed.
"""

import math
import time
from collections.abc import Callable, Generator
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from imudrv.errors import InputError
from imudrv.files.inputs import open_file
from imudrv.hostclock import now_ns
from imudrv.ports.base import Port, PortEndedError, PortLostError
from imudrv.profiles.schema import Profile
from imudrv.records import MESSAGE, Arrival, Records, Source
from imudrv.units import NS
from imudrv.url import Url, speed_of
from imudrv.wire.candump import CandumpDecoder
from imudrv.wire.layout import Layout
from imudrv.wording import counted

_CHUNK_BYTES: Final = 1 << 16
_STEP_NS: Final = 1_000_000

Pieces = Generator[Arrival, None, None]


def prepare(url: Url, profile: Profile) -> Callable[[], Port]:
    """Check a ``replay://`` URL.

    Parameters
    ----------
    url : Url
        ``replay://FILE``; option ``channel`` selects one channel of a candump log with several.
    profile : Profile
        Profile of the data; a CAN profile reads candump logs, other profiles raw captures.

    Returns
    -------
    callable
        Opens the port; raises `InputError` if the file has another format.

    Raises
    ------
    InputError
        The URL is not valid, or the file does not exist or is empty.
    """
    path, layout = Path(url.address), profile.layout()
    is_log = layout.can and path.suffix != ".mcap"
    if "channel" in url.options and not is_log:
        kind = "a recording" if path.suffix == ".mcap" else f"a capture of {layout.name}"
        raise InputError(f"{url.text}: channel: expected a candump log, got {kind}; leave the option out")
    options = ("speed", "channel") if is_log else ("speed",)
    if unknown := [name for name in url.options if name not in options]:
        raise InputError(
            f"{url.text}: expected no option but {' and '.join(options)}, got {', '.join(unknown)}"
        )
    speed = speed_of(url.options.get("speed", "1"))
    with open_file(path) as file:
        if not file.read(1):
            raise InputError(f"{url.text}: expected a file to replay, got an empty one")
    return partial(_open, url.text, path, layout, speed, url.options.get("channel"))


class ReplayPort(Port):
    """Replay of a file, in real time or faster.

    Parameters
    ----------
    url : str
        As the user gave it.
    pieces : generator of Arrival
        Chunks in the order of the file; closed by `close`.
    speed : float or None
        Factor on the recorded speed; None: as fast as possible.
    nothing : bytes or ndarray of MESSAGE
        Data of a read when nothing was due.
    """

    def __init__(self, url: str, pieces: Pieces, speed: float | None, nothing: bytes | Records) -> None:
        super().__init__(url, Source.REPLAY)
        self._pieces = pieces
        self._speed = speed
        self._nothing = nothing
        self._piece = next(pieces, None)
        self._first_ns = self._piece.t_ns if self._piece else 0
        self._begin_ns: int | None = None
        self._closed = False

    def read(self, timeout_s: float) -> Arrival:
        """See `Port.read`; the first read starts the clock."""
        if self._closed:
            raise PortLostError(f"{self.url}: the port is closed")
        if self._piece is None:
            self._piece = self._following()
        if self._speed is not None and not self._is_due(self._piece, timeout_s, self._speed):
            return Arrival(self._reached_ns(self._speed), self._nothing)
        piece, self._piece = self._piece, None
        return piece

    def close(self) -> None:
        """See `Port.close`."""
        self._closed = True
        self._pieces.close()

    def _following(self) -> Arrival:
        try:
            return next(self._pieces)
        except StopIteration:
            raise PortEndedError(f"{self.url}: the end of the file") from None
        except OSError as error:
            raise InputError(f"{self.url}: cannot continue to read: {error.strerror or error}") from error

    def _is_due(self, piece: Arrival, timeout_s: float, speed: float) -> bool:
        """Wait for the chunk, at most for the timeout; return whether it is due."""
        left_s = (piece.t_ns - self._reached_ns(speed)) * NS / speed
        if left_s > 0:
            time.sleep(min(left_s, timeout_s))
        return left_s <= timeout_s

    def _reached_ns(self, speed: float) -> int:
        """Return the recorded time that the replay has reached."""
        now = now_ns()
        if self._begin_ns is None:
            self._begin_ns = now
        return self._first_ns + int((now - self._begin_ns) * speed)


def _open(url: str, path: Path, layout: Layout, speed: float | None, channel: str | None) -> Port:
    step_ns = None if speed is None else max(1, int(speed * _STEP_NS))
    nothing: bytes | Records = np.zeros(0, MESSAGE) if layout.can else b""
    if path.suffix == ".mcap":
        pieces = _recording(path, layout)
    elif layout.can:
        pieces = _log(path, layout, step_ns, channel)
    else:
        pieces = _capture(path, layout, step_ns)
    return ReplayPort(url, pieces, speed, nothing)


def _capture(path: Path, layout: Layout, step_ns: int | None) -> Pieces:
    length = layout.messages[0].length
    frames = max(1, _CHUNK_BYTES // length if step_ns is None else step_ns // layout.interval_ns)
    end = 0
    with path.open("rb") as file:
        while data := file.read(frames * length):
            end += len(data)
            yield Arrival(math.ceil(end / length) * layout.interval_ns, data)


def _log(path: Path, layout: Layout, step_ns: int | None, channel: str | None) -> Pieces:
    decoder = CandumpDecoder(channel)
    found = 0
    with path.open("rb") as file:
        text = b"\n"
        while text:
            text = file.read(_CHUNK_BYTES)
            messages, _ = decoder.feed(text) if text else decoder.close()
            decoder.check_channel(str(path), "?channel=")
            found += messages.size
            cuts = () if step_ns is None else np.flatnonzero(np.diff(messages["t_ns"] // step_ns)) + 1
            for piece in np.split(messages, cuts):
                if piece.size:
                    yield Arrival(int(piece["t_ns"][-1]), piece)
    if not found:
        raise InputError(
            f"{path}: expected a candump log for the CAN profile {layout.name}, "
            f"got {counted(decoder.bytes_fed, 'byte')} without one message"
        )


def _recording(path: Path, layout: Layout) -> Pieces:
    from imudrv.recording.reader import Recording

    yield from Recording(path).arrivals(layout)
