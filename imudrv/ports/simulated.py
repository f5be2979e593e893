"""Simulated unit inside this process: ``sim://SCENARIO.yaml?speed=1|10|max``."""

import time
from typing import Final

import numpy as np

from imudrv.errors import InputError
from imudrv.hostclock import now_ns
from imudrv.ports.base import Port, PortEndedError, PortLostError
from imudrv.profiles.schema import Profile
from imudrv.records import MESSAGE, Arrival, Records, Source
from imudrv.sim.live import AHEAD, MOST, Pace, PacedPlayback
from imudrv.sim.scenario import Scenario, load
from imudrv.url import Url, speed_of

_NOTHING: Final = np.zeros(0, MESSAGE)


def open_simulated(url: Url, profile: Profile) -> Port:
    """Open a simulated unit and start its run.

    Parameters
    ----------
    url : Url
        ``sim://NAME`` of a shipped scenario or ``sim://PATH`` of a file; ``?speed=`` 1 (the default),
        any other number, or max.
    profile : Profile
        Profile of the unit.

    Returns
    -------
    Port

    Raises
    ------
    InputError
        The scenario does not exist or is not valid, or an option is unknown.
    """
    if unknown := url.options.keys() - {"speed"}:
        raise InputError(f"{url.text}: expected no option but speed, got {', '.join(unknown)}")
    return SimulatedPort(url.text, load(url.address), profile, speed_of(url.options.get("speed", "1")))


class SimulatedPort(Port):
    """Simulated unit; an unplug of the scenario is a silence.

    At a finite speed data arrive when they are due, stamped by the host clock. At full speed they arrive as
    fast as they are read, stamped with the time of the run.

    Parameters
    ----------
    url : str
        As the user gave it.
    scenario : Scenario
        Scenario to simulate.
    profile : Profile
        Profile of the unit.
    speed : float or None
        Speed relative to real time; None: as fast as it is read.
    """

    def __init__(self, url: str, scenario: Scenario, profile: Profile, speed: float | None) -> None:
        super().__init__(url, Source.SIMULATOR)
        self._playback: PacedPlayback | None = PacedPlayback(scenario, profile.layout())
        self._is_paced = speed is not None
        self._most = AHEAD if self._is_paced else MOST
        self._pace = Pace(speed)
        self._begin_ns = now_ns()
        self._nothing: bytes | Records = _NOTHING if profile.transport == "can" else b""

    def read(self, timeout_s: float) -> Arrival:
        """See `Port.read`."""
        if self._playback is None:
            raise PortLostError(f"{self.url}: the port is closed")
        deadline = time.monotonic() + timeout_s
        while (due_ns := self._playback.due_ns()) is not None:
            self._pace.wait(due_ns, max(0.0, deadline - time.monotonic()))
            due = self._playback.take(self._pace.now_ns(), self._most)
            if due is not None and len(due.data):
                return self._stamped(due.data, due.last_ns)
            if self._is_paced and time.monotonic() >= deadline:
                return Arrival(now_ns(), self._nothing)
        raise PortEndedError(f"{self.url}: the scenario is over")

    def _stamped(self, data: bytes | Records, run_ns: int) -> Arrival:
        t_ns = now_ns() if self._is_paced else self._begin_ns + run_ns
        if isinstance(data, bytes):
            return Arrival(t_ns, data)
        messages = data.copy()
        if self._is_paced:
            messages["t_ns"] = t_ns
        else:
            messages["t_ns"] += self._begin_ns
        return Arrival(t_ns, messages)

    def close(self) -> None:
        """See `Port.close`."""
        if self._playback is not None:
            self._playback.close()
            self._playback = None
