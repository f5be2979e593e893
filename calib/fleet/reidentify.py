"""Identify the sessions of a tree again, on several cores or computers, and compare with what was certified.

After a change of the software or of its priors, this says for which units the result would be another one.
The sessions are not changed.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib.bench import journal
from calib.bench.result import identify_session
from calib.bench.state import JOURNAL, RESULT, SessionState
from calib.certificate import lever_arms_of
from calib.fleet.spread import spread
from calib.lever_arms.gauge import convert
from imudrv.calibration import read_calibration
from imudrv.errors import InputError
from imudrv.units import MM


class Reidentified(NamedTuple):
    """A session that was identified again.

    Attributes
    ----------
    folder : Path
        The session.
    unit : str
        Serial number; empty if the session cannot be read.
    shift_mm : float
        Largest change of a lever arm, gauge x; NaN if there is none.
    sigmas : float
        The largest change in units of the certified sigma; NaN if there is none.
    r_mm : tuple of float
        The lever arms, gauge x, all nine; empty if there are none.
    fault : str
        Why there is no comparison; empty if there is one.
    """

    folder: Path
    unit: str = ""
    shift_mm: float = float("nan")
    sigmas: float = float("nan")
    r_mm: tuple[float, ...] = ()
    fault: str = ""

    def __str__(self) -> str:
        """One-line summary."""
        if self.fault:
            return f"{self.folder}: {self.fault}"
        if self.shift_mm == 0.0:
            return f"{self.folder}: unit {self.unit}: the same, digit for digit"
        return f"{self.folder}: unit {self.unit}: differs by {self.shift_mm:.6f} mm, {self.sigmas:.2f} sigma"


def sessions(paths: Sequence[Path]) -> list[Path]:
    """Return the sessions in folders, at any depth.

    Raises
    ------
    InputError
        A path is no folder, or there is no session.
    """
    for path in paths:
        if not path.is_dir():
            raise InputError(f"{path}: expected a folder with sessions, there is none; check the path")
    found = sorted({file.parent for path in paths for file in path.rglob(JOURNAL)})
    if not found:
        raise InputError(f"{', '.join(map(str, paths))}: expected sessions, found no {JOURNAL}")
    return found


def reidentify(folder: Path) -> Reidentified:
    """Identify a session again and compare with its certificate."""
    unit = ""
    try:
        session = SessionState(folder, journal.read(folder / JOURNAL).entries)
        unit = session.plan.unit
        if not session.procedure().runs:
            return Reidentified(folder, unit, fault="not a session of the lever arms")
        if RESULT not in session.files:
            return Reidentified(folder, unit, fault="no certificate")
        before = convert(lever_arms_of(read_calibration(session.path(RESULT)), RESULT), "x")
        now = convert(lever_arms_of(identify_session(session).certificate, RESULT), "x")
    except InputError as error:
        return Reidentified(folder, unit, fault=str(error))
    shift = np.abs(now.r_b - before.r_b).ravel()
    sigmas = float("nan")
    if before.covariance is not None:
        sigma = np.sqrt(np.diag(before.covariance))
        sigmas = float((shift[sigma > 0.0] / sigma[sigma > 0.0]).max(initial=0.0))
    return Reidentified(folder, unit, float(shift.max()) / MM, sigmas, tuple((now.r_b / MM).ravel().tolist()))


def reidentify_all(
    folders: Sequence[Path], workers: int = 1, scheduler: str | None = None
) -> Iterator[Reidentified]:
    """Identify sessions again, and yield them in the order in which they are given.

    Parameters
    ----------
    folders : sequence of Path
        Sessions; with a scheduler, paths that its workers can read.
    workers, scheduler
        See `spread`, also for what it raises.

    Yields
    ------
    Reidentified
    """
    absolute = [folder.resolve() for folder in folders]
    done = spread(reidentify, absolute, workers, scheduler)
    for folder, one in zip(folders, done, strict=True):
        yield one._replace(folder=folder)
