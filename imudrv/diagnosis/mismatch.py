"""Why data holds no frame of a profile, and which profile fits instead."""

from collections.abc import Iterable
from dataclasses import dataclass

from imudrv.diagnosis.traffic import TrafficSummary, decode_traffic
from imudrv.profiles.schema import Profile
from imudrv.records import Records
from imudrv.wording import counted


@dataclass(frozen=True)
class Mismatch:
    """Data that does not fit the expected profile.

    Parameters
    ----------
    profile : Profile
        The expected profile.
    traffic : TrafficSummary
        The data, decoded with it.
    fitting : Profile or None
        A profile that fits, if one was found.
    """

    profile: Profile
    traffic: TrafficSummary
    fitting: Profile | None

    @property
    def found(self) -> str:
        """What was found in the data, such as ``sync EB 90 seen 980 times, check never right``."""
        traffic = self.traffic
        frames = traffic.counts.frames
        if traffic.fits:
            return f"{frames} are right, but none continues the counter: {traffic.counts}"
        if self.profile.transport == "can":
            return f"{counted(traffic.syncs, 'message')} with its identifiers, no complete sample"
        message = self.profile.messages[0]
        sync = f"sync {message.sync}"
        if not traffic.syncs:
            return f"{sync} never seen"
        if frames:
            why = f"check right only {frames} x, as by chance"
        else:
            why = "check never right" if message.checks else "no complete frame"
        return f"{sync} seen {counted(traffic.syncs, 'time')}, {why}"

    def __str__(self) -> str:
        """What was found, and which profile it looks like."""
        return f"{self.found}; this looks like {self.fitting.name}" if self.fitting else self.found


def find_mismatch(profile: Profile, data: bytes | Records, candidates: Iterable[Profile]) -> Mismatch:
    """Find out why data does not fit a profile.

    Parameters
    ----------
    profile : Profile
        The expected profile.
    data : bytes or ndarray of MESSAGE
        Piece of received data.
    candidates : iterable of Profile
        Other profiles to try.

    Returns
    -------
    Mismatch
    """
    others = [other for other in candidates if other != profile]
    return Mismatch(profile, decode_traffic(profile, data), best_profile(others, data))


def best_profile(candidates: Iterable[Profile], data: bytes | Records) -> Profile | None:
    """Return the profile that decodes most of the data, or None; see `fitting_profiles`."""
    return next(iter(fitting_profiles(candidates, data)), None)


def fitting_profiles(candidates: Iterable[Profile], data: bytes | Records) -> list[Profile]:
    """Return the profiles that decode most of the data with the fewest losses: one, or several equally good.

    Parameters
    ----------
    candidates : iterable of Profile
        Profiles of the other transport are ignored.
    data : bytes or ndarray of MESSAGE
        Piece of received data.

    Returns
    -------
    list of Profile
        In the order of the candidates; empty if none fits.
    """
    transport = "serial" if isinstance(data, bytes) else "can"
    best = (0, 0)
    found: list[Profile] = []
    for profile in candidates:
        if profile.transport == transport and (traffic := decode_traffic(profile, data)).fits:
            decoded = traffic.counts.frames * sum(m.length for m in profile.messages if m.is_part)
            score = decoded, -traffic.counts.lost - traffic.counts.duplicate
            if score > best:
                best, found = score, []
            if score == best:
                found.append(profile)
    return found
