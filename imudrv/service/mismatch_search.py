"""Search for the reason why received data holds no frame of the profile, beside the loop."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Final

from imudrv import profiles
from imudrv.diagnosis import Mismatch, find_mismatch
from imudrv.ports.base import LineErrors
from imudrv.ports.holders import holders
from imudrv.profiles.schema import Profile
from imudrv.records import Records
from imudrv.units import NS_PER_S

PERIOD_NS: Final = 10 * NS_PER_S
"""Time between two searches while nothing is decoded."""


class MismatchSearch:
    """Finds out, in a thread, why data does not fit the profile and which shipped profile does.

    Parameters
    ----------
    profile : Profile
        Profile of the unit.
    device : Path or None
        Device file of the port, if it has one.
    """

    def __init__(self, profile: Profile, device: Path | None) -> None:
        self._profile, self._device = profile, device
        self._shipped: list[Profile] = []
        self._pool = ThreadPoolExecutor(1, "mismatch")
        self.clear()

    def clear(self) -> None:
        """Forget what was found: the data is frames again."""
        self._running: Future[tuple[Mismatch, str]] | None = None
        self._next_ns = 0
        self._found: Mismatch | None = None
        self._text = "looking for a profile that fits"

    def poll(self, now_ns: int, undecoded: Callable[[], bytes | Records], errors: LineErrors) -> str:
        """Return what is known, and search again if that is due; does not block.

        Parameters
        ----------
        now_ns : int
            Present time.
        undecoded : callable
            Returns the latest data.
        errors : LineErrors
            Errors that the driver has counted since the data was good.

        Returns
        -------
        str
            Stays the same until another profile fits.
        """
        if self._running is None and now_ns >= self._next_ns:
            self._next_ns = now_ns + PERIOD_NS
            self._running = self._pool.submit(self._search, undecoded(), errors)
        if self._running is not None and self._running.done():
            found, text = self._running.result()
            self._running = None
            if self._found is None or found.fitting != self._found.fitting:
                self._found, self._text = found, text
        return self._text

    def _search(self, data: bytes | Records, errors: LineErrors) -> tuple[Mismatch, str]:
        if not self._shipped:
            self._shipped = [profiles.load(name) for name in profiles.shipped()]
        found = find_mismatch(self._profile, data, self._shipped)
        users = holders(self._device.resolve())[0] if self._device is not None else []
        return found, _text(found, errors, users)


def _text(found: Mismatch, errors: LineErrors, users: list[str]) -> str:
    text = str(found)
    if found.fitting is not None:
        text += f": start with --profile {found.fitting.name}"
    elif errors.framing or errors.parity:
        text += (
            f"; {errors}: this looks like a wrong baud rate or parity; `imudrv doctor` tries the usual rates"
        )
    elif not found.traffic.fits:
        text += (
            "; no shipped profile fits: check baud rate and profile, "
            "or stop this and run `imudrv doctor` on the port"
        )
    return text + (f"; the port is also open in {', '.join(users)}" if users else "")
