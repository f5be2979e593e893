"""How much of what a line can carry a profile's samples take."""

from typing import Final

from imudrv.profiles.messages import Message
from imudrv.profiles.schema import Profile, SerialLine
from imudrv.records import EXTENDED
from imudrv.units import NS

_IDLE_BITS: Final = 3
_STUFFING: Final = 1.2


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
        return profile.transmission_ns * NS * rate  # how often other messages come is not known
    if line.data_bitrate is not None:
        return _STUFFING * (profile.transmission_ns * NS + _IDLE_BITS / line.bitrate) * rate
    return sum(_most_bits(m) / m.every for m in profile.messages) * rate / line.bitrate


def _most_bits(message: Message) -> int:
    """Return the bits of a classic CAN message with the idle ones that follow, if most bits are stuffed.

    A bit is stuffed after five equal ones, in the data and in the fields before and after (ISO 11898-1).
    """
    around, stuffed = (64, 54) if message.can_id[0] & EXTENDED else (44, 34)
    return 8 * message.length + around + _IDLE_BITS + (stuffed + 8 * message.length - 1) // 4
