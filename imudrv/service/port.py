"""Supervision of the port: open it, open it again after a loss, watch what the line brings."""

import time
from collections.abc import Callable
from typing import Final

from imudrv.diagnosis import LineState, LineWatch
from imudrv.ports import Port, PortEndedError, PortLostError, check_url, open_port
from imudrv.ports.base import LineErrors
from imudrv.ports.holders import holders
from imudrv.profiles.schema import Profile
from imudrv.records import Arrival, Records, Source
from imudrv.service.background import Background
from imudrv.service.events import EventLog
from imudrv.service.mismatch_search import MismatchSearch
from imudrv.service.status import PortStatus
from imudrv.units import NS_PER_S
from imudrv.url import split

BACK_OFF_S: Final = (0.1, 0.2, 0.4, 0.8)
"""Delays before further attempts to open a port that is absent or brings nothing; the last is repeated."""

_IS_BACK: Final = "port is back"
_SOURCES: Final = {"sim": Source.SIMULATOR, "replay": Source.REPLAY}


class PortSupervisor:
    """A port that is opened again whenever it is lost.

    Parameters
    ----------
    url : str
        As for `imudrv.ports.open_port`.
    profile : Profile
        Profile of the unit.
    in_real_time : bool
        Whether hardware at this port sends at its own pace; otherwise its rate is not checked.
    events : EventLog
        Receives losses and recoveries.
    clock : callable
        Returns the host time, ns.

    Attributes
    ----------
    state : LineState
        State of the line to the unit.
    source : Source
        Kind of device behind the port.

    Raises
    ------
    InputError
        The URL is wrong, or does not fit the profile.
    """

    def __init__(
        self, url: str, profile: Profile, in_real_time: bool, events: EventLog, clock: Callable[[], int]
    ) -> None:
        check_url(url, profile)
        self._url, self._profile = url, profile
        self._events, self._clock = events, clock
        self.source = _SOURCES.get(url.partition(":")[0], Source.HARDWARE)
        self._in_real_time = in_real_time and self.source is Source.HARDWARE
        self.state = LineState("connecting")
        self._port: Port | None = None
        self._watch = LineWatch(profile, self._in_real_time, clock())
        self._search = MismatchSearch(profile)
        self._device = split(url).device
        self._user_search = Background[list[str]]()
        self._users: list[str] = []
        self._errors = LineErrors()  # counted by the driver while the data was good
        self._reconnects = 0
        self._attempts, self._next_attempt_ns = 0, 0  # since the last data
        self._has_data = False  # since it was opened
        self._fruitless = ""  # why it was lost, if that was before any data came

    @property
    def status(self) -> PortStatus:
        """Current status of the port."""
        return PortStatus(self._url, *self.state, self._users, self._reconnects, self.source.name.lower())

    def read(self, timeout_s: float) -> Arrival | None:
        """Wait for data.

        Parameters
        ----------
        timeout_s : float
            Longest wait.

        Returns
        -------
        Arrival or None
            None if nothing has arrived or the port is not open.

        Raises
        ------
        PortEndedError
            The replay or the simulation is complete.
        """
        port = self._port or self._connect()
        if port is None:
            time.sleep(timeout_s)
            return None
        try:
            arrival = port.read(timeout_s)
        except PortLostError as lost:
            self._lose(lost)
            return None
        except PortEndedError:
            self.state = LineState("ended")
            raise
        return arrival if len(arrival.data) else None

    def failed(self, error: int) -> None:
        """Take note of an error that a reader of the descriptor has received, see `Port.fault`."""
        if self._port is not None:
            self._lose(self._port.fault(error))

    def _lose(self, lost: PortLostError) -> None:
        self.close()
        self.state = LineState("lost", str(lost))
        if str(lost) != self._fruitless:
            self._events.failure(str(self.state))
        self._fruitless = "" if self._has_data else str(lost)
        if self._fruitless:
            self._wait()

    @property
    def descriptor(self) -> int | None:
        """Descriptor of the open port, see `Port.descriptor`."""
        return None if self._port is None else self._port.descriptor

    def decoded(self, data: bytes | Records, samples: int) -> None:
        """Take note of data and of the number of samples that they completed."""
        if not self._has_data:
            self._has_data, self._attempts = True, 0
            if self._fruitless:
                self._fruitless = ""
                self._events.event(_IS_BACK)
        self._watch.arrived(data, samples, self._clock())

    def check_rate(self, expected: int, lost: int, now_ns: int) -> None:
        """Check the rate, and after losses which other programs have the port open; call it once a second.

        Parameters
        ----------
        expected : int
            Number of samples by the unit's counter.
        lost : int
            Number of samples lost since the last call.
        now_ns : int
            Present time.
        """
        if self._port is None:
            return
        self._watch.counted(expected, now_ns)
        if self.state.name == "streaming":
            self._errors = self._port.line_errors()
        if lost or self._users or self.state.name == "unreadable":
            self._check_users(now_ns)

    def _check_users(self, now_ns: int) -> None:
        if self._device is None:
            return
        before, device = self._users, self._device
        self._users = self._user_search.poll(now_ns, lambda: holders(device.resolve())[0]) or []
        if self._users and self._users != before:
            self._events.failure(
                f"port also open in {', '.join(self._users)}: each program receives only a part of the data"
            )

    def check_line(self, now_ns: int) -> None:
        """Report a line that has become silent, unreadable or good again, or whose rate is wrong."""
        if self._port is None:
            return
        before, state = self.state, self._watch.state(now_ns)
        if state.name == "unreadable":
            errors = self._port.line_errors().since(self._errors)
            reason = self._search.poll(now_ns, self._watch.undecoded, errors)
            state = state._replace(trouble=f"{state.trouble}: {reason}")
        elif before.name == "unreadable":
            self._search.clear()
        self.state = state
        if state == before:
            return
        if state.trouble:
            self._events.failure(str(state))
        elif before.name == "wrong rate":
            self._events.event("the rate is right again")
        else:
            self._events.event("the unit is back")

    def close(self) -> None:
        """Close the port if it is open."""
        if self._port is not None:
            self._port.close()
            self._port = None

    def _connect(self) -> Port | None:
        if self._clock() < self._next_attempt_ns:
            return None
        try:
            self._port = open_port(self._url, self._profile)
        except PortLostError as lost:
            self._wait()
            self._fruitless = ""
            if str(lost) != self.state.trouble:
                self._events.failure(f"port not available: {lost}")
            self.state = self.state._replace(trouble=str(lost))
            return None
        self._has_data = False
        if self.state.name == "lost":
            self._reconnects += 1
            if not self._fruitless:
                self._events.event(_IS_BACK)
        self.state = LineState("streaming")
        self._watch = LineWatch(self._profile, self._in_real_time, self._clock())
        self._search.clear()
        self._user_search.clear()
        self._users = []
        self._errors = self._port.line_errors()
        return self._port

    def _wait(self) -> None:
        """Put off the next attempt."""
        delay_s = BACK_OFF_S[min(self._attempts, len(BACK_OFF_S) - 1)]
        self._attempts += 1
        self._next_attempt_ns = self._clock() + round(delay_s * NS_PER_S)
