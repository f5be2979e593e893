"""Playback of a scenario in real time on a line: hardware in the loop.

The deadlines are absolute: data sent at time `t` of the run are written at `begin + t / speed`. Delays do not
accumulate, and overdue data are written at once.
"""

import signal
import threading
import time
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from math import ceil
from typing import Final, NamedTuple

import numpy as np

from imudrv.profiles.schema import Profile
from imudrv.records import Records
from imudrv.signals import handled
from imudrv.sim.capture import WireChunk, wire
from imudrv.sim.links import open_line
from imudrv.sim.links.base import LineOptions
from imudrv.sim.scenario import Scenario, samples
from imudrv.sim.unit import More
from imudrv.units import NS
from imudrv.wire.layout import Layout
from imudrv.wording import counted

AHEAD: Final = 1000
"""Samples simulated at a time, ahead of playback; 4 ms of work, so the first are ready soon."""
MOST: Final = 64
"""Maximum number of overdue frames or messages written at a time."""
FINEST_NS: Final = 500_000
"""Samples closer together than this are written in groups, as a serial converter does, ns."""
_SLICE_NS: Final = 50_000_000


class DueChunk(NamedTuple):
    """Data that are sent together.

    Parameters
    ----------
    data : bytes or ndarray of MESSAGE
        Data; empty if faults removed all of them.
    first_ns, last_ns : int
        Time of the first and of the last frame or message since the start of the run.
    """

    data: bytes | Records
    first_ns: int
    last_ns: int


class PacedPlayback:
    """Output of a simulated unit in order of time, simulated ahead in another thread.

    Parameters
    ----------
    scenario : Scenario
        Scenario to simulate.
    layout : Layout
        Layout of the profile.
    more : callable, optional
        See `imudrv.sim.unit.simulate`.
    """

    def __init__(self, scenario: Scenario, layout: Layout, more: More | None = None) -> None:
        self._chunks = _ahead(wire(scenario, layout, AHEAD, more))
        self._chunk: WireChunk | None = None
        self._row = 0
        self._current()

    def due_ns(self, group: int = 1) -> int | None:
        """Return the time of the next frames or messages.

        Parameters
        ----------
        group : int
            Number of them; fewer at the end of a chunk.

        Returns
        -------
        int or None
            Time of the last of them since the start of the run; None after the end.
        """
        chunk = self._current()
        return None if chunk is None else int(chunk.t_ns[min(self._row + group, chunk.t_ns.size) - 1])

    def take(self, until_ns: int, most: int = MOST) -> DueChunk | None:
        """Return data that are due.

        Parameters
        ----------
        until_ns : int
            Time since the start of the run.
        most : int
            Maximum number of frames or messages.

        Returns
        -------
        DueChunk or None
            None if nothing is due.
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
    """Clock of a run that starts now.

    Parameters
    ----------
    speed : float or None
        Speed relative to real time; None: everything is due at once.
    """

    def __init__(self, speed: float | None) -> None:
        self._speed = speed
        self._begin_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        """Return the time since the start of the run."""
        if self._speed is None:
            return 2**62
        return int((time.monotonic_ns() - self._begin_ns) * self._speed)

    def left_ns(self, t_ns: int) -> int:
        """Return the time left until `t_ns` of the run; negative if that has passed."""
        if self._speed is None:
            return 0
        return self._begin_ns + ceil(t_ns / self._speed) - time.monotonic_ns()

    def wait(self, t_ns: int, longest_s: float) -> None:
        """Sleep until `t_ns` of the run, at most for `longest_s`."""
        left_s = min(self.left_ns(t_ns) * NS, longest_s)
        if left_s > 0.0:
            time.sleep(left_s)


@dataclass
class Played:
    """Summary of a run.

    Parameters
    ----------
    samples : int
        Number of samples of the unit.
    sent, undelivered : int
        Bytes, on CAN messages, that were delivered, and that were not: no reader, or too slow a reader.
    unit : str
        ``bytes`` or ``messages``.
    latest_ns : int or None
        Largest delay of a frame; None if there were no deadlines.
    """

    samples: int
    sent: int
    undelivered: int
    unit: str
    latest_ns: int | None

    def __str__(self) -> str:
        """One-line summary."""
        late = "" if self.latest_ns is None else f"; {self.latest_ns * 1e-6:.2f} ms late at worst"
        samples = counted(self.samples, "sample")
        return f"{samples}, {self.sent} {self.unit}, {self.undelivered} not delivered{late}"


def play(
    scenario: Scenario,
    profile: Profile,
    target: str,
    speed: float | None,
    say: Callable[[str], None],
    link: str | None = None,
    stop: threading.Event | None = None,
    more: More | None = None,
) -> Played:
    """Play a scenario as hardware in the loop, to its end or until `stop` is set.

    A pty or a TCP server waits for its first reader before the run starts. After that the unit sends without
    regard to readers, except at `speed` None, where it waits for them.

    Parameters
    ----------
    scenario : Scenario
        Scenario with its faults; the bytes are those of `imudrv.sim.capture.record`.
    profile : Profile
        Wire format and settings of the line.
    target : str
        ``pty``, a serial port's path or ``serial://PATH?baudrate=N``, ``can://INTERFACE/CHANNEL?...``,
        ``tcp://[HOST]:PORT``.
    speed : float or None
        Speed relative to real time; None: as fast as the reader reads.
    say : callable
        Receives messages for the user, one line each; the first ends with the name of the port.
    link : str, optional
        Stable name for a pty: a symbolic link, renewed after an unplug.
    stop : Event, optional
        Ends the run when set; in the main thread Ctrl-C and SIGTERM set it too.
    more : callable, optional
        Next motion after those of the scenario, see `imudrv.sim.unit.simulate`; it is used two seconds later.

    Returns
    -------
    Played

    Raises
    ------
    InputError
        The target is not valid or cannot be opened, or the port was lost.
    """
    layout = profile.layout()
    stop = stop or threading.Event()
    options = LineOptions(profile.name, speed is None, say, stop)
    latest_ns = last_ns = 0
    with (
        _signals_set(stop),
        closing(PacedPlayback(scenario, layout, more)) as unit,
        # the first samples are simulated before the line is announced
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
        whole = samples(scenario, layout.interval)
        line.finish()
    return Played(
        round(last_ns / layout.interval) if stop.is_set() else whole,
        line.sent,
        line.undelivered,
        "messages" if layout.can else "bytes",
        None if speed is None else latest_ns,
    )


def _ahead(chunks: Iterator[WireChunk]) -> Generator[WireChunk, None, None]:
    """Make the next chunk while this one is used."""
    with ThreadPoolExecutor(1) as worker:
        coming = worker.submit(next, chunks, None)
        while (chunk := coming.result()) is not None:
            coming = worker.submit(next, chunks, None)
            yield chunk


def _signals_set(stop: threading.Event) -> AbstractContextManager[None]:
    """Ctrl-C and SIGTERM end the run."""
    if threading.current_thread() is not threading.main_thread():
        return nullcontext()
    return handled(lambda *_: stop.set(), signal.SIGINT, signal.SIGTERM)
