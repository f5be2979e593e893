"""What a stretch of a line's data says: does a profile fit, how well, and which would fit better. No I/O."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np

from imudrv.imu.accounting import Account, Accountant
from imudrv.profiles import Profile, SerialLine
from imudrv.records import Reason, Records
from imudrv.units import NS
from imudrv.wire.decoder import FrameDecoder

FEW: Final = 3
"""Good frames by chance are fewer than this."""
_IDLE_BITS: Final = 3
_STUFFING: Final = 1.2


@dataclass(frozen=True)
class Heard:
    """What arrived, as a profile reads it; it begins with the first good frame, if there is one.

    Parameters
    ----------
    amount : int
        Bytes or messages, of all.
    syncs : int
        How often the bytes came that a frame begins with; on CAN messages with the profile's identifiers.
    account : Account
        Where the samples went.
    rejected : dict of Reason to int
        Number of runs that are no frame.
    messages : dict of int to int
        On CAN how many of each identifier of the profile.
    set_bits : tuple of str
        Names of the status bits that were set at any time.
    degc : dict of str to float
        The last temperatures, NaN where none came.
    """

    amount: int
    syncs: int
    account: Account
    rejected: dict[Reason, int]
    messages: dict[int, int]
    set_bits: tuple[str, ...]
    degc: dict[str, float]

    @property
    def fits(self) -> bool:
        """The profile is that of the data."""
        return self.account.frames >= FEW

    @property
    def is_clean(self) -> bool:
        """Less than one sample in a hundred was lost or came twice."""
        spoilt = self.account.lost + self.account.duplicate
        return spoilt * 100 < self.account.expected


def hear(profile: Profile, data: bytes | Records) -> Heard:
    """Read data as a profile says.

    Parameters
    ----------
    profile : Profile
        Of a serial unit for bytes, of a CAN unit for messages.
    data : bytes or ndarray of MESSAGE
        A stretch of what arrived, beginning anywhere.

    Returns
    -------
    Heard
    """
    layout = profile.layout()
    decoder = FrameDecoder(layout)
    frames = decoder.feed(data)
    if isinstance(data, bytes) and frames.size:
        # what lies before is the end of a frame that had begun earlier
        decoder = FrameDecoder(layout)
        frames = decoder.feed(data[frames["offset"][0] :])
    rejected = {reason: entry.runs for reason, entry in decoder.rejected.items()}
    if layout.can:
        frames = np.concatenate([frames, decoder.close()])  # held until their full counter comes
    accountant = Accountant(layout)
    pulses = accountant.feed(frames)
    status = int(np.bitwise_or.reduce(pulses["status"])) if pulses.size else 0
    degc = pulses["temperature_degc"][-1].tolist() if pulses.size else []
    if isinstance(data, bytes):
        syncs = data.count(bytes.fromhex(profile.messages[0].sync or ""))
        messages = {}
    else:
        messages = {m.id or 0: int(np.count_nonzero(data["id"] == m.id)) for m in profile.messages}
        syncs = sum(messages.values())
    return Heard(
        len(data),
        syncs,
        accountant.account,
        rejected,
        messages,
        tuple(name for bit, name in layout.status_names if status >> bit & 1),
        dict(zip(layout.temperature_names, degc, strict=False)),
    )


def best(candidates: Iterable[Profile], data: bytes | Records) -> Profile | None:
    """The profile that reads most of the data.

    Parameters
    ----------
    candidates : iterable of Profile
        Those of the other transport are left out.
    data : bytes or ndarray of MESSAGE
        A stretch of what arrived.

    Returns
    -------
    Profile or None
        None where none fits.
    """
    transport = "serial" if isinstance(data, bytes) else "can"
    found: tuple[int, Profile] | None = None
    for profile in candidates:
        if profile.transport == transport and (heard := hear(profile, data)).fits:
            read = heard.account.frames * sum(m.length for m in profile.messages if m.every == 1)
            if found is None or read > found[0]:
                found = read, profile
    return found[1] if found else None


def line_load(profile: Profile) -> float:
    """Fraction of the line that a profile's samples take; on CAN with the bits that stuffing adds at worst.

    Parameters
    ----------
    profile : Profile
        Its line settings and rate.

    Returns
    -------
    float
        More than 1: they do not fit.
    """
    line, rate = profile.line, profile.sample_rate_hz
    if isinstance(line, SerialLine):
        return profile.transmission_ns * NS * rate
    if line.data_bitrate is not None:
        return _STUFFING * (profile.transmission_ns * NS + _IDLE_BITS / line.bitrate) * rate
    # ISO 11898-1: after five equal bits one is stuffed, in the 34 bits and the data that are stuffed at all
    bits = (8 * m.length + 44 + _IDLE_BITS + (34 + 8 * m.length - 1) // 4 for m in profile.messages)
    shares = (b / m.every for b, m in zip(bits, profile.messages, strict=True))
    return sum(shares) * rate / line.bitrate


def explain(profile: Profile, heard: Heard, seconds: float) -> str:
    """What arrived, in a line for people.

    Parameters
    ----------
    profile : Profile
        As which it was read.
    heard : Heard
        What was found.
    seconds : float
        How long it took.

    Returns
    -------
    str
    """
    what = "bytes" if profile.transport == "serial" else "messages"
    words = [f"{heard.amount / seconds:.0f} {what}/s, {heard.account.frames} good frames"]
    if heard.account.frames:
        words.append(f"{rate(heard, seconds):.0f} samples/s by the counter, {heard.account.lost} lost")
    for reason, count in sorted(heard.rejected.items()):
        words.append(f"{count} x {reason.name.lower().replace('_', ' ')}")
    if heard.messages:
        words.append("by id: " + ", ".join(f"{number:03X} {n}" for number, n in heard.messages.items()))
    return "; ".join(words)


def rate(heard: Heard, seconds: float) -> float:
    """Samples a second that the unit counted."""
    return heard.account.expected / seconds
