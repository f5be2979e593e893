"""A scenario in real time: what its wire carries goes out when it is due, onto a line that others read.

Paced by absolute deadlines: what is sent at `t` of the run goes out at `begin + t / speed`. Lateness never
adds up, and what has become due meanwhile goes out at once.
"""

import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import dataclass
from math import ceil
from typing import Final, NamedTuple

import numpy as np

from imudrv.errors import InputError
from imudrv.profiles.schema import Profile
from imudrv.records import Records
from imudrv.sim.capture import WireChunk, wire
from imudrv.sim.links import open_line
from imudrv.sim.links.base import LineOptions
from imudrv.sim.scenario import Scenario, samples
from imudrv.units import NS
from imudrv.wire.layout import Layout

AHEAD: Final = 1000
"""Samples made at a time, ahead of time: 4 ms of work, and the first of them are there soon."""
MOST: Final = 64
"""Frames or messages that go out at a time when they are late."""
FINEST_NS: Final = 500_000
"""Samples closer together than this go out in groups, as a converter sends them on."""
_SLICE_NS: Final = 50_000_000


class DueChunk(NamedTuple):
    """Data that are sent together.

    Parameters
    ----------
    data : bytes or ndarray of MESSAGE
        Empty where faults have taken all of it.
    first_ns, last_ns : int
        When its first and its last frame or message are sent, from the beginning of the run.
    """

    data: bytes | Records
    first_ns: int
    last_ns: int


class PacedPlayback:
    """What a simulated unit sends, in the order of time; made ahead in another thread, the first of it now.

    Parameters
    ----------
    scenario : Scenario
        What happens.
    layout : Layout
        Of the profile.
    """

    def __init__(self, scenario: Scenario, layout: Layout) -> None:
        self._chunks = _ahead(wire(scenario, layout, AHEAD))
        self._chunk: WireChunk | None = None
        self._row = 0
        self._current()

    def due_ns(self, group: int = 1) -> int | None:
        """When the next frames or messages are sent.

        Parameters
        ----------
        group : int
            How many of them; fewer at the end of a piece.

        Returns
        -------
        int or None
            When the last of them is sent, from the beginning of the run; None after the end.
        """
        chunk = self._current()
        return None if chunk is None else int(chunk.t_ns[min(self._row + group, chunk.t_ns.size) - 1])

    def take(self, until_ns: int, most: int = MOST) -> DueChunk | None:
        """Take what is due.

        Parameters
        ----------
        until_ns : int
            From the beginning of the run.
        most : int
            Frames or messages.

        Returns
        -------
        DueChunk or None
            None when nothing is due.
        """
        chunk = self._current()
        if chunk is None or chunk.t_ns[self._row] > until_ns:
            return None
        data, t_ns, end, _ = chunk
        begin = self._row
        self._row += int(np.searchsorted(t_ns[begin : begin + most], until_ns, side="right"))
        start, stop = int(end[begin - 1]) if begin else 0, int(end[self._row - 1])
        return DueChunk(data[start:stop], int(t_ns[begin]), int(t_ns[self._row - 1]))

    def close(self) -> None:
        """Stop the simulation."""
        self._chunks.close()

    def _current(self) -> WireChunk | None:
        """Return the chunk of the next frame or message, None after the end."""
        while self._chunk is None or self._row == self._chunk.t_ns.size:
            self._chunk = next(self._chunks, None)
            self._row = 0
            if self._chunk is None:
                return None
        return self._chunk


class Pace:
    """Time of the run against the clock, beginning now.

    Parameters
    ----------
    speed : float or None
        Seconds of the run in a second; None: everything is due.
    """

    def __init__(self, speed: float | None) -> None:
        self._speed = speed
        self._begin_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Time of the run."""
        if self._speed is None:
            return 2**62
        return int((time.monotonic_ns() - self._begin_ns) * self._speed)

    def left_ns(self, t_ns: int) -> int:
        """How long it is until `t_ns` of the run; negative: how late it is."""
        if self._speed is None:
            return 0
        return self._begin_ns + ceil(t_ns / self._speed) - time.monotonic_ns()

    def wait(self, t_ns: int, longest_s: float) -> None:
        """Sleep until `t_ns` of the run, for `longest_s` at the most."""
        left_s = min(self.left_ns(t_ns) * NS, longest_s)
        if left_s > 0.0:
            time.sleep(left_s)


@dataclass
class Played:
    """How a run went.

    Parameters
    ----------
    samples : int
        That the unit made.
    sent, undelivered : int
        Bytes, on CAN messages, that the line took, and that it could not take: nobody there, or too slow.
    unit : str
        Which of both.
    latest_ns : int or None
        How late a frame went out at worst; None where there were no deadlines.
    """

    samples: int
    sent: int
    undelivered: int
    unit: str
    latest_ns: int | None

    def __str__(self) -> str:
        """One line for people."""
        late = "" if self.latest_ns is None else f"; {self.latest_ns * 1e-6:.2f} ms late at worst"
        return f"{self.samples} samples, {self.sent} {self.unit}, {self.undelivered} not delivered{late}"


def play(
    scenario: Scenario,
    profile: Profile,
    target: str,
    speed: float | None,
    say: Callable[[str], None],
    link: str | None = None,
    stop: threading.Event | None = None,
) -> Played:
    """Play a scenario as hardware in the loop, to its end or until it is told to stop.

    A pty or a TCP server waits for its first reader before the run begins; from then on the unit goes on
    whoever listens, except at `speed` None, where it waits for its reader.

    Parameters
    ----------
    scenario : Scenario
        What happens, faults included: the bytes are those of `imudrv.sim.capture.record`.
    profile : Profile
        The wire format and the line's settings.
    target : str
        ``pty``, a serial port's path or ``serial://PATH?baudrate=N``, ``can://INTERFACE/CHANNEL?...``,
        ``tcp://[HOST]:PORT``.
    speed : float or None
        Seconds of the run in a second; None: as fast as the reader takes it.
    say : callable
        Told what a person wants to know, a line at a time; the last word of the first is where to listen.
    link : str, optional
        Stable name for a pty: a symbolic link, made again after an unplug.
    stop : Event, optional
        Set it to end the run. In the main thread Ctrl-C and SIGTERM set it too.

    Returns
    -------
    Played

    Raises
    ------
    InputError
        A target that makes no sense or cannot be opened, or a port that went away.
    """
    layout = profile.layout()
    stop = stop or threading.Event()
    options = LineOptions(profile.name, speed is None, say, stop)
    latest_ns = last_ns = 0
    with (
        _signals_set(stop),
        closing(PacedPlayback(scenario, layout)) as unit,
        # the first samples are there before anybody hears of the line
        closing(open_line(target, profile, options, link)) as line,
    ):
        line.wait_for_reader()
        events = [
            (round(at_s / NS), act)
            for unplug in scenario.faults.unplugs
            for at_s, act in ((unplug.at_s, line.unplug), (unplug.at_s + unplug.duration_s, line.plug))
        ]
        group = 1 if speed is None else max(1, round(FINEST_NS * speed / layout.interval_ns))
        pace = Pace(speed)
        while not stop.is_set() and (first_ns := unit.due_ns()) is not None:
            event_ns = events[0][0] if events else 2**62
            if event_ns < first_ns:
                if pace.left_ns(event_ns) > 0:
                    pace.wait(event_ns, _SLICE_NS * NS)
                else:
                    events.pop(0)[1]()
                continue
            pace.wait(min(unit.due_ns(group) or 0, event_ns), _SLICE_NS * NS)
            due = unit.take(min(pace.now_ns(), event_ns))
            line.send(due.data if due else b"")
            if due:
                last_ns = due.last_ns
                latest_ns = max(latest_ns, -pace.left_ns(due.first_ns))
        whole = samples(scenario, layout.interval_ns)
        line.finish()
    return Played(
        last_ns // layout.interval_ns if stop.is_set() else whole,
        line.sent,
        line.undelivered,
        "messages" if layout.can else "bytes",
        None if speed is None else latest_ns,
    )


def speed_of(text: str) -> float | None:
    """Read a speed: ``1``, ``0.5``, ``10``; ``max`` is None.

    Parameters
    ----------
    text : str
        What the user gave.

    Returns
    -------
    float or None

    Raises
    ------
    InputError
        Something else.
    """
    if text == "max":
        return None
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0.001 <= speed <= 1000.0:
        raise InputError(f"speed: expected max or a number from 0.001 to 1000, got {text!r}")
    return speed


def _ahead(chunks: Iterator[WireChunk]) -> Generator[WireChunk, None, None]:
    """Make the next chunk while this one is used."""
    with ThreadPoolExecutor(1) as worker:
        coming = worker.submit(next, chunks, None)
        while (chunk := coming.result()) is not None:
            coming = worker.submit(next, chunks, None)
            yield chunk


@contextmanager
def _signals_set(stop: threading.Event) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the run."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        for number in before:
            signal.signal(number, lambda *_: stop.set())
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
