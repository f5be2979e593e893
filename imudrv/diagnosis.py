"""Diagnosis of a line by the data that it delivers, without I/O.

For a piece of data: whether a profile fits, how well, and which would fit better. For a stream: whether data
arrives, whether it contains samples, and at what rate.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from imudrv.imu.sequence import SampleCounts, SequenceTracker
from imudrv.profiles.schema import Profile, SerialLine
from imudrv.records import EXTENDED, Reason, Records
from imudrv.units import NS, NS_PER_S
from imudrv.wire.decoder import FrameDecoder

FEW: Final = 3
"""A profile fits from this number of good frames; noise gives fewer."""
SILENCE_NS: Final = 4 * NS_PER_S // 10
"""A line without data for this long, plus two samples, is silent."""
UNREADABLE_NS: Final = NS_PER_S
"""Data without a sample for this long, plus the longest hold-back of samples, does not fit."""
RATE_TOLERANCE: Final = 0.09
"""Largest relative error of a correct rate: a stall of 250 ms changes a rate over 3 s by less."""
_RATE_SECONDS: Final = 3
_IDLE_BITS: Final = 3
_STUFFING: Final = 1.2


@dataclass(frozen=True)
class TrafficSummary:
    """Summary of data decoded with a profile, from the first good frame on if there is one.

    Parameters
    ----------
    amount : int
        Number of bytes or messages in all.
    syncs : int
        Number of sync patterns; on CAN of messages with the profile's identifiers.
    counts : SampleCounts
        Sample counts.
    rejected : dict of Reason to int
        Number of rejected runs by reason.
    messages : dict of int to int
        On CAN the number of messages for each identifier of the profile, with `EXTENDED` if it has 29 bits.
    set_bits : tuple of str
        Names of the status bits that were set at any time.
    degc : dict of str to float
        Latest temperatures; NaN if none was received.
    """

    amount: int
    syncs: int
    counts: SampleCounts
    rejected: dict[Reason, int]
    messages: dict[int, int]
    set_bits: tuple[str, ...]
    degc: dict[str, float]

    @property
    def fits(self) -> bool:
        """Whether the data fits the profile."""
        return self.counts.frames >= FEW

    @property
    def is_clean(self) -> bool:
        """Whether less than one sample in a hundred was lost or came twice."""
        faulty = self.counts.lost + self.counts.duplicate
        return faulty * 100 < self.counts.expected


def decode_traffic(profile: Profile, data: bytes | Records) -> TrafficSummary:
    """Decode data with a profile.

    Parameters
    ----------
    profile : Profile
        A serial profile for bytes, a CAN profile for messages.
    data : bytes or ndarray of MESSAGE
        Piece of received data; it may begin anywhere.

    Returns
    -------
    TrafficSummary
    """
    layout = profile.layout()
    decoder = FrameDecoder(layout)
    frames = decoder.feed(data)
    if isinstance(data, bytes) and frames.size:
        # the bytes before are the end of a frame that began earlier
        decoder = FrameDecoder(layout)
        frames = decoder.feed(data[frames["offset"][0] :])
    rejected = {reason: entry.runs for reason, entry in decoder.rejected.items()}
    if layout.can:
        frames = np.concatenate([frames, decoder.close()])  # held until their full counter arrives
    tracker = SequenceTracker(layout)
    pulses = tracker.feed(frames)
    status = int(np.bitwise_or.reduce(pulses["status"])) if pulses.size else 0
    degc = pulses["temperature_degc"][-1].tolist() if pulses.size else []
    if isinstance(data, bytes):
        syncs = data.count(bytes.fromhex(profile.messages[0].sync or ""))
        messages = {}
    else:
        messages = {m.can_id: int(np.count_nonzero(data["id"] & m.can_mask == m.can_id)) for m in layout.messages}
        syncs = sum(messages.values())
    return TrafficSummary(
        len(data),
        syncs,
        tracker.counts,
        rejected,
        messages,
        tuple(name for bit, name in layout.status_names if status >> bit & 1),
        dict(zip(layout.temperature_names, degc, strict=False)),
    )


def best_profile(candidates: Iterable[Profile], data: bytes | Records) -> Profile | None:
    """Return the profile that decodes most of the data.

    Parameters
    ----------
    candidates : iterable of Profile
        Profiles of the other transport are ignored.
    data : bytes or ndarray of MESSAGE
        Piece of received data.

    Returns
    -------
    Profile or None
        None if none fits.
    """
    transport = "serial" if isinstance(data, bytes) else "can"
    found: tuple[int, Profile] | None = None
    for profile in candidates:
        if profile.transport == transport and (traffic := decode_traffic(profile, data)).fits:
            decoded = traffic.counts.frames * sum(m.length for m in profile.messages if m.every == 1)
            if found is None or decoded > found[0]:
                found = decoded, profile
    return found[1] if found else None


class LineState(NamedTuple):
    """State of the line to the unit.

    Parameters
    ----------
    name : str
        ``connecting``, ``streaming``, ``silent``, ``unreadable``, ``lost`` or ``ended``.
    trouble : str
        What is wrong and what to do; empty if nothing.
    """

    name: str
    trouble: str = ""

    def __str__(self) -> str:
        """One line of text."""
        return self.trouble if self.name == "streaming" else f"port {self.name}: {self.trouble}"


class LineWatch:
    """Judges an open line by the data that it delivers; all times from one monotonic clock, ns.

    A silent or unreadable line is streaming again with the next sample, not with the next byte. A wrong rate
    is reported after three seconds that all deviate in the same direction, and withdrawn after three that
    are all right: a stall, a burst of old frames or a jump of the counter changes neither.

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
        self._undecoded = 0  # bytes or messages since the last sample; arrival of the first of them:
        self._undecoded_ns = t_ns
        self._counted: tuple[int, int] | None = None
        self._rates: deque[float] = deque(maxlen=_RATE_SECONDS)

    def arrived(self, amount: int, samples: int, t_ns: int) -> None:
        """Take note of an arrival.

        Parameters
        ----------
        amount : int
            Number of bytes or messages; at least one.
        samples : int
            Number of samples that they completed.
        t_ns : int
            Present time.
        """
        self._arrived_ns = t_ns
        if samples:
            self._undecoded = 0
            if self._state.name != "streaming":
                self._enter(LineState("streaming"))
            return
        if not self._undecoded:
            self._undecoded_ns = t_ns
        self._undecoded += amount

    def counted(self, expected: int, t_ns: int) -> None:
        """Check the rate; call it about once a second.

        Parameters
        ----------
        expected : int
            Number of samples by the unit's counter, see `imudrv.imu.sequence.SampleCounts`.
        t_ns : int
            Present time.
        """
        if not self._in_real_time or self._state.name != "streaming":
            return
        if self._counted is not None:
            before, since_ns = self._counted
            self._rates.append((expected - before) / ((t_ns - since_ns) * NS))
        self._counted = expected, t_ns
        if len(self._rates) < _RATE_SECONDS:
            return
        nominal = self._profile.rate_hz
        slack = RATE_TOLERANCE * nominal + 1.0 / _RATE_SECONDS  # the ends may fall between two samples
        least, most = nominal - slack, nominal + slack
        if least <= min(self._rates) and max(self._rates) <= most:
            self._state = LineState("streaming")
        elif not self._state.trouble and (max(self._rates) < least or min(self._rates) > most):
            rate = sum(self._rates) / _RATE_SECONDS
            trouble = (
                f"expected {nominal:g} samples/s of {self._profile.name}, the unit counts {rate:.1f}: "
                "set sample_rate_hz in the profile, or the rate in the unit"
            )
            self._state = LineState("streaming", trouble)

    def state(self, t_ns: int) -> LineState:
        """Return the state of the line.

        Parameters
        ----------
        t_ns : int
            Present time.

        Returns
        -------
        LineState
            ``streaming``, ``silent`` or ``unreadable``; the text of a trouble stays the same while it lasts.
        """
        if t_ns - self._arrived_ns > self._silence_ns:
            self._undecoded = 0
            self._enter(LineState("silent", f"nothing for {self._silence_ns * NS:.1f} s"))
        elif self._undecoded and self._state.name != "unreadable":
            span_ns = t_ns - self._undecoded_ns
            if span_ns > self._unreadable_ns:
                what = "bytes" if self._profile.transport == "serial" else "messages"
                trouble = (
                    f"{self._undecoded} {what} in {span_ns * NS:.1f} s, and no frame of {self._profile.name} "
                    "in them: check the profile and the line settings, or stop this and "
                    "run `imudrv doctor` on the port"
                )
                self._enter(LineState("unreadable", trouble))
        return self._state

    def _enter(self, state: LineState) -> None:
        self._state = state
        self._counted = None
        self._rates.clear()


def line_load(profile: Profile) -> float:
    """Return the fraction of the line's capacity that the samples take; on CAN with worst-case bit stuffing.

    Parameters
    ----------
    profile : Profile
        Profile with its line settings and rate.

    Returns
    -------
    float
        More than 1: the line is too slow.
    """
    line, rate = profile.line, profile.rate_hz
    if isinstance(line, SerialLine):
        return profile.transmission_ns * NS * rate
    if line.data_bitrate is not None:
        return _STUFFING * (profile.transmission_ns * NS + _IDLE_BITS / line.bitrate) * rate
    # ISO 11898-1: a bit is stuffed after five equal ones, in 34 bits of overhead and in the data
    bits = (8 * m.length + 44 + _IDLE_BITS + (34 + 8 * m.length - 1) // 4 for m in profile.messages)
    shares = (b / m.every for b, m in zip(bits, profile.messages, strict=True))
    return sum(shares) * rate / line.bitrate


def explain(profile: Profile, traffic: TrafficSummary, seconds: float) -> str:
    """Describe received data in one line.

    Parameters
    ----------
    profile : Profile
        Profile with which it was decoded.
    traffic : TrafficSummary
        The data.
    seconds : float
        Time from the first arrival to the last, s.

    Returns
    -------
    str
    """
    what = "bytes" if profile.transport == "serial" else "messages"
    words = [f"{traffic.amount / seconds:.0f} {what}/s, {traffic.counts.frames} good frames"]
    if traffic.counts.frames:
        words.append(f"{rate(traffic, seconds):.0f} samples/s by the counter, {traffic.counts.lost} lost")
    for reason, count in sorted(traffic.rejected.items()):
        words.append(f"{count} x {reason.name.lower().replace('_', ' ')}")
    if traffic.messages:
        words.append("by id: " + ", ".join(f"{_id_text(id)} {n}" for id, n in traffic.messages.items()))
    return "; ".join(words)


def _id_text(identifier: int) -> str:
    return f"{identifier & ~EXTENDED:08X}" if identifier & EXTENDED else f"{identifier:03X}"


def rate(traffic: TrafficSummary, seconds: float) -> float:
    """Return the samples per second by the unit's counter."""
    return traffic.counts.expected / seconds
