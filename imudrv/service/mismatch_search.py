"""Search for the reason why received data holds no frame of the profile, beside the loop."""

from functools import partial

from imudrv import profiles
from imudrv.diagnosis import Mismatch, find_mismatch
from imudrv.ports.base import LineErrors
from imudrv.profiles.schema import Profile
from imudrv.records import Records
from imudrv.service.background import Background


class MismatchSearch:
    """Finds out why data does not fit the profile and which shipped profile does.

    Parameters
    ----------
    profile : Profile
        Profile of the unit.
    """

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._shipped: list[Profile] = []
        self._background = Background[tuple[Mismatch, str]]()
        self.clear()

    def clear(self) -> None:
        """Forget what was found: the data is frames again."""
        self._background.clear()
        self._found: Mismatch | None = None
        self._text = "looking for a profile that fits"

    def poll(self, now_ns: int, undecoded: bytes | Records, errors: LineErrors) -> str:
        """Return what is known, and search again if that is due; does not block.

        Parameters
        ----------
        now_ns : int
            Present time.
        undecoded : bytes or ndarray of MESSAGE
            The latest data.
        errors : LineErrors
            Errors that the driver has counted since the data was good.

        Returns
        -------
        str
            Stays the same until another profile fits.
        """
        result = self._background.poll(now_ns, partial(self._search, undecoded, errors))
        if result is not None and (self._found is None or result[0].fitting != self._found.fitting):
            self._found, self._text = result
        return self._text

    def _search(self, data: bytes | Records, errors: LineErrors) -> tuple[Mismatch, str]:
        if not self._shipped:
            self._shipped = [profiles.load(name) for name in profiles.shipped()]
        found = find_mismatch(self._profile, data, self._shipped)
        return found, _text(found, errors)


def _text(found: Mismatch, errors: LineErrors) -> str:
    if found.fitting is not None:
        advice = f": start with --profile {found.fitting.name}"
    elif errors.framing or errors.parity:
        advice = (
            f"; {errors}: this looks like a wrong baud rate or parity; `imudrv doctor` tries the usual rates"
        )
    elif found.traffic.fits:
        advice = ""
    else:
        advice = (
            "; no shipped profile fits: check baud rate and profile, "
            "or stop this and run `imudrv doctor` on the port"
        )
    return f"{found}{advice}"
