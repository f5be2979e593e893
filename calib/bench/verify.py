"""Check a session's evidence, and recompute its result from the recordings."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib.bench import journal
from calib.bench.journal import Entry
from calib.bench.session import (
    JOURNAL,
    LOCK,
    RESULT,
    faulty_files,
    files_of,
    identified,
    plan_of,
    require_session,
    uncovered_steps,
)
from calib.certificate import PROVENANCE_IDENTIFIED
from imudrv.calibration import Calibration, read_calibration
from imudrv.errors import InputError
from imudrv.units import MM


class Verified(NamedTuple):
    """How a session stands up to being checked.

    Attributes
    ----------
    faults : tuple of str
        What is wrong, each with its line or file; empty: all is well.
    notes : tuple of str
        What was checked, and what a reader should know.
    """

    faults: tuple[str, ...]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        """A line each."""
        return "\n".join([*(f"fault: {fault}" for fault in self.faults), *self.notes])


def verify(folder: Path) -> Verified:
    """Check a session: journal, hashes, that recordings cover their steps, that they give the certificate.

    Parameters
    ----------
    folder : Path
        Of the session; nothing in it is changed.

    Returns
    -------
    Verified

    Raises
    ------
    InputError
        There is no session.
    """
    require_session(folder)
    try:
        entries, _, torn = journal.read(folder / JOURNAL)
        plan = plan_of(entries[0], folder)
    except InputError as error:
        return Verified((str(error),), ())
    files = files_of(entries)
    faults = [f"{folder / JOURNAL}: {torn}"] if torn else []
    faults += faulty_files(folder, files) or uncovered_steps(folder, plan, entries)
    notes = [f"{len(entries)} lines and {len(files)} files checked"]
    unknown = sorted({path.name for path in folder.iterdir() if path.is_file()} - {*files, JOURNAL, LOCK})
    notes += [f"{folder / name}: not in the journal, not checked" for name in unknown]
    if faults:
        return Verified(tuple(faults), tuple(notes))
    if RESULT not in files:
        return Verified((), (*notes, "there is no certificate yet"))
    stored = read_calibration(folder / RESULT)
    try:
        again = identified(folder, plan, entries).certificate
    except InputError as error:
        return Verified((f"{folder}: the recordings give no certificate: {error}",), tuple(notes))
    if _timeless(again) != _timeless(stored):
        return Verified(
            (f"{folder / RESULT}: expected what the recordings give{_apart(again, stored)}",), tuple(notes)
        )
    return Verified((), (*notes, "the recordings give the certificate, digit for digit"))


def _timeless(calibration: Calibration) -> Entry:
    """A certificate without when, and by which version, it was computed."""
    document = calibration.model_dump(mode="json", exclude={"created"})
    document["provenance"][PROVENANCE_IDENTIFIED].pop("software", None)
    return document


def _apart(again: Calibration, stored: Calibration) -> str:
    if again.size_effect is None or stored.size_effect is None:
        return ""
    mm = float(np.abs(again.size_effect.r_m - stored.size_effect.r_m).max()) / MM
    return f", got sensing points up to {mm:.6f} mm off, or other figures"
