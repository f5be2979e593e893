"""State of an open line by the data that it delivers: whether they arrive, are frames, and at what rate."""

import sys
from collections import deque
from typing import Final, NamedTuple

import numpy as np

from imudrv.diagnosis.traffic import RATE_TOLERANCE
from imudrv.profiles.schema import Profile
from imudrv.records import MESSAGE, Records
from imudrv.units import NS, NS_PER_S

SILENCE_NS: Final = 4 * NS_PER_S // 10
"""A line without data for this long, plus two samples, is silent."""
UNREADABLE_NS: Final = NS_PER_S
"""Data without samples for this long, plus the longest hold-back of samples, does not fit."""
KEPT: Final = {"serial": 1 << 16, "can": 1 << 12}
"""Most of the latest bytes, or messages, that are kept while nothing is decoded."""
RATE_SPANS_S: Final = (3, 6, 12)
"""Times over which the rate is checked: the longer, the smaller the error that a stall can explain."""
_CHANCE: Final = 100
"""A stream has less than one byte in this number in frames that are right by chance."""


class LineState(NamedTuple):
    """State of the line to the unit.

    Parameters
    ----------
    name : str
        ``connecting``, ``streaming``, ``silent``, ``unreadable``, ``wrong rate``, ``lost`` or ``ended``.
    trouble : str
        What is wrong and what to do; empty if nothing.
    """

    name: str
    trouble: str = ""

    def __str__(self) -> str:
        """One line of text."""
        return f"port {self.name}: {self.trouble}"


class LineWatch:
    """Judges an open line by the data that it delivers; all times from one monotonic clock, ns.

    A silent or unreadable line is streaming again with the next samples, not with the next byte, nor with
    the few frames that noise makes by chance. A wrong rate is reported after three seconds that all deviate
    by more than 9 %, six by 4.5 % or twelve by 2.25 %, in the same direction, and withdrawn after as many
    that do not: a stall, a burst of old frames or a jump of the counter changes neither.

    Parameters
    ----------
    profile : Profile
        Expected profile.
    in_real_time : bool
        Whether the unit sends at its own pace; otherwise its rate is not checked.
    t_ns : int
        Time of opening the line.
    """

    def __init__(self, profile: Profile, in_real_time: bool, t_ns: int) -> None:
        self._profile = profile
        self._in_real_time = in_real_time
        interval_ns = profile.layout().interval_ns
        held = 2 * max(message.every for message in profile.messages)  # on CAN, for their full counter
        self._silence_ns = SILENCE_NS + 2 * interval_ns
        self._unreadable_ns = UNREADABLE_NS + held * interval_ns
        self._state = LineState("streaming")
        self._arrived_ns = t_ns
        self._undecoded = _Undecoded(profile)
        self._counted: tuple[int, int] | None = None
        self._rates: deque[float] = deque(maxlen=RATE_SPANS_S[-1])
        self._rate_span_s = 0  # over which a wrong rate was found

    def arrived(self, data: bytes | Records, samples: int, t_ns: int) -> None:
        """Take note of an arrival.

        Parameters
        ----------
        data : bytes or ndarray of MESSAGE
            What arrived; not empty.
        samples : int
            Number of samples that it completed.
        t_ns : int
            Present time.
        """
        self._arrived_ns = t_ns
        self._undecoded.add(data, samples, t_ns)
        if self._undecoded.fits:
            self._undecoded.clear()
            if self._state.name in ("silent", "unreadable"):
                self._enter(LineState("streaming"))

    def counted(self, expected: int, t_ns: int) -> None:
        """Check the rate; call it about once a second.

        Parameters
        ----------
        expected : int
            Number of samples by the unit's counter, see `imudrv.imu.sequence.SampleCounts`.
        t_ns : int
            Present time.
        """
        if not self._in_real_time or self._state.name in ("silent", "unreadable"):
            return
        if self._counted is not None:
            before, since_ns = self._counted
            self._rates.append((expected - before) / ((t_ns - since_ns) * NS))
        self._counted = expected, t_ns
        if self._rate_span_s:
            if self._deviation(self._rate_span_s) == 0:
                self._state, self._rate_span_s = LineState("streaming"), 0
        elif span_s := next((n for n in RATE_SPANS_S if self._deviation(n)), 0):
            rate = sum(list(self._rates)[-span_s:]) / span_s
            nominal = f"{self._profile.rate_hz:g} samples/s of {self._profile.name}"
            trouble = (
                f"expected {nominal}, the unit counts {rate:.1f}: "
                "set sample_rate_hz in the profile, or the rate in the unit"
            )
            self._state, self._rate_span_s = LineState("wrong rate", trouble), span_s

    def state(self, t_ns: int) -> LineState:
        """Return the state of the line.

        Parameters
        ----------
        t_ns : int
            Present time.

        Returns
        -------
        LineState
            ``streaming``, ``silent``, ``unreadable`` or ``wrong rate``; the text of a trouble stays the same
            while it lasts.
        """
        if t_ns - self._arrived_ns > self._silence_ns:
            self._undecoded.clear()
            self._enter(LineState("silent", f"nothing for {self._silence_ns * NS:.1f} s"))
        elif self._undecoded.span_ns(t_ns) > self._unreadable_ns and self._state.name != "unreadable":
            trouble = f"{self._undecoded.speed(t_ns)} come, no frame of {self._profile.name}"
            self._enter(LineState("unreadable", trouble))
        return self._state

    @property
    def undecoded(self) -> bytes | Records:
        """Latest data since the last samples, at most `KEPT`."""
        return self._undecoded.data

    def _deviation(self, span_s: int) -> int | None:
        """Return 1 or -1 if each rate of the last seconds is too high or too low, 0 if each is right."""
        if len(self._rates) < span_s:
            return None
        nominal = self._profile.rate_hz
        tolerance = RATE_TOLERANCE * RATE_SPANS_S[0] / span_s
        slack = tolerance * nominal + 1.0 / span_s  # the ends may fall between two samples
        errors = [rate - nominal for rate in list(self._rates)[-span_s:]]
        if max(map(abs, errors)) <= slack:
            return 0
        if min(errors) > slack:
            return 1
        return -1 if max(errors) < -slack else None

    def _enter(self, state: LineState) -> None:
        self._state = state
        self._counted = None
        self._rates.clear()
        self._rate_span_s = 0


class _Undecoded:
    """Data that arrived since the last samples; of them the latest are kept."""

    def __init__(self, profile: Profile) -> None:
        self._is_serial = profile.transport == "serial"
        self._kept = KEPT[profile.transport]
        length = sum(message.length for message in profile.messages if message.is_part)
        # The controller checks CAN messages: none is right by chance.
        self._most_per_sample = _CHANCE * length if self._is_serial else sys.maxsize
        self._pieces: deque[tuple[bytes | Records, int]] = deque()
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self._pieces.clear()
        self._amount = self._samples = 0  # of the pieces
        self._total = self._since_ns = 0

    def add(self, data: bytes | Records, samples: int, t_ns: int) -> None:
        """Take note of an arrival and of the number of samples that it completed."""
        if not self._total:
            self._since_ns = t_ns
        self._total += len(data)
        data = data[-self._kept :]
        self._pieces.append((data, samples))
        self._amount += len(data)
        self._samples += samples
        while self._amount > self._kept:
            old, old_samples = self._pieces.popleft()
            self._amount -= len(old)
            self._samples -= old_samples

    @property
    def fits(self) -> bool:
        """Whether the latest data contains more samples than noise."""
        return self._samples * self._most_per_sample >= self._amount

    @property
    def data(self) -> bytes | Records:
        """The latest data."""
        pieces = [piece for piece, _ in self._pieces]
        if self._is_serial:
            return b"".join(piece for piece in pieces if isinstance(piece, bytes))
        return np.concatenate([np.zeros(0, MESSAGE), *pieces])

    def span_ns(self, t_ns: int) -> int:
        """Return the time since the first arrival; 0 if nothing has arrived."""
        return t_ns - self._since_ns if self._total else 0

    def speed(self, t_ns: int) -> str:
        """Return the amount that arrives in a second, with its unit."""
        rate = self._total / (self.span_ns(t_ns) * NS)
        if not self._is_serial:
            return f"{rate:.0f} messages/s"
        return f"{rate * 1e-3:.3g} kB/s" if rate >= 1e3 else f"{rate:.0f} B/s"
