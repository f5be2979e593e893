"""Data decoded with a profile: how much of it is frames, and at what rate."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from imudrv.imu.sequence import SampleCounts, SequenceTracker
from imudrv.profiles.schema import Profile
from imudrv.records import EXTENDED, Reason, Records
from imudrv.wire.decoder import FrameDecoder

FEW: Final = 3
"""A profile fits from this number of good frames on."""
LEAST_SHARE: Final = 0.1
"""A profile fits if its frames are at least this part of the bytes; of noise they are less."""
RATE_TOLERANCE: Final = 0.09
"""Largest relative error of a correct rate over 3 s: a stall of 250 ms changes it by less."""


@dataclass(frozen=True)
class TrafficSummary:
    """Summary of data decoded with a profile, from the first good frame on if there is one.

    Parameters
    ----------
    amount : int
        Number of bytes or messages in all.
    share : float
        Part of the bytes that is in good frames; on CAN, where a controller checks each message, 1.
    syncs : int
        Number of sync patterns; on CAN of messages with the profile's identifiers.
    counts : SampleCounts
        Sample counts.
    rejected : dict of Reason to int
        Number of rejected runs by reason.
    messages : dict of int to int
        On CAN the number of messages for each identifier of the profile.
    set_bits : tuple of str
        Names of the status bits that applied at any time.
    degc : dict of str to float
        Latest temperatures; NaN if none was received.
    """

    amount: int
    share: float
    syncs: int
    counts: SampleCounts
    rejected: dict[Reason, int]
    messages: dict[int, int]
    set_bits: tuple[str, ...]
    degc: dict[str, float]

    @property
    def fits(self) -> bool:
        """Whether the data fits the profile."""
        return self.counts.frames >= FEW and self.share >= LEAST_SHARE

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
    active: dict[int, str] = {}
    for status in np.unique(pulses["status"]).tolist():
        active |= layout.active_bits(status)
    degc = pulses["temperature_degc"][-1].tolist() if pulses.size else []
    if isinstance(data, bytes):
        share = frames.size * sum(m.length for m in profile.messages if m.every == 1) / max(len(data), 1)
        syncs = data.count(bytes.fromhex(profile.messages[0].sync or ""))
        messages = {}
    else:
        messages = {
            m.can_id: int(np.count_nonzero(data["id"] & m.can_mask == m.can_id)) for m in layout.messages
        }
        syncs = sum(messages.values())
        share = 1.0
    return TrafficSummary(
        len(data),
        share,
        syncs,
        tracker.counts,
        rejected,
        messages,
        tuple(active[mask] for mask in sorted(active)),
        dict(zip(layout.temperature_names, degc, strict=False)),
    )


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
        words.append(
            "by id: " + ", ".join(f"{_id_text(number)} {n}" for number, n in traffic.messages.items())
        )
    return "; ".join(words)


def _id_text(identifier: int) -> str:
    return f"{identifier & ~EXTENDED:08X}" if identifier & EXTENDED else f"{identifier:03X}"


def rate(traffic: TrafficSummary, seconds: float) -> float:
    """Return the samples per second by the unit's counter."""
    return traffic.counts.expected / seconds
