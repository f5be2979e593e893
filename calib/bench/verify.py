"""Verification of a session: check its files, and recompute the result from the recordings."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calib.bench import journal
from calib.bench.result import decode_covered, identify_session
from calib.bench.state import JOURNAL, LOCK, RESULT, SessionState, require_session
from calib.certificate import PROVENANCE_IDENTIFIED
from imudrv.calibration import Calibration, read_calibration
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.units import MM


class Verified(NamedTuple):
    """Result of a verification.

    Attributes
    ----------
    faults : tuple of str
        Faults, each with its line or file; empty if there are none.
    notes : tuple of str
        What was checked, and remarks.
    """

    faults: tuple[str, ...]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        """Return one line per note and fault."""
        return "\n".join([*self.notes, *(f"fault: {fault}" for fault in self.faults)])


def verify(folder: Path) -> Verified:
    """Check the journal, the hashes, that recordings cover their steps, and that they give the certificate.

    Parameters
    ----------
    folder : Path
        Folder of the session; nothing in it is changed.

    Returns
    -------
    Verified

    Raises
    ------
    InputError
        The folder contains no session.
    """
    require_session(folder)
    try:
        entries, _, partial = journal.read(folder / JOURNAL)
        session = SessionState(folder, entries)
    except InputError as error:
        return Verified((str(error),), ())
    files = session.files
    faults = [f"{folder / JOURNAL}: {partial}"] if partial else []
    faults += faulty_files(session) or uncovered_steps(session)
    notes = [f"{len(entries)} lines and {len(files)} files checked"]
    unknown = sorted({path.name for path in folder.iterdir() if path.is_file()} - {*files, JOURNAL, LOCK})
    notes += [f"{folder / name}: not in the journal, not checked" for name in unknown]
    if not faults and RESULT not in files:
        notes.append("there is no certificate yet")
    elif not faults:
        faults = _certificate_faults(session)
        if not faults:
            notes.append("the recordings give the certificate, digit for digit")
    return Verified(tuple(faults), tuple(notes))


def faulty_files(session: SessionState) -> list[str]:
    """Return the missing and damaged files of a session, one line each."""
    faults = []
    for name, digest in session.files.items():
        path = session.folder / name
        try:
            found = atomic.sha256(path)
        except InputError as error:
            faults.append(str(error))
            continue
        if found != digest:
            faults.append(
                f"{path}: was damaged or changed: expected SHA-256 {digest[:12]}..., got {found[:12]}..."
            )
    return faults


def uncovered_steps(session: SessionState) -> list[str]:
    """Return the accepted steps whose recordings lack samples, one line each."""
    faults = []
    for attempt in session.attempts().values():
        try:
            decode_covered(attempt)
        except InputError as error:
            faults.append(str(error))
    return faults


def _certificate_faults(session: SessionState) -> list[str]:
    path = session.folder / RESULT
    stored = read_calibration(path)
    try:
        again = identify_session(session).certificate
    except InputError as error:
        return [f"{session.folder}: the recordings give no certificate: {error}"]
    if _timeless(again) == _timeless(stored):
        return []
    return [f"{path}: differs from the result of the recordings{_difference(again, stored)}"]


def _timeless(calibration: Calibration) -> dict[str, Any]:
    """Return a certificate without the time and software version of its computation."""
    document = calibration.model_dump(mode="json", exclude={"created"})
    document["provenance"][PROVENANCE_IDENTIFIED].pop("software", None)
    return document


def _difference(again: Calibration, stored: Calibration) -> str:
    if again.size_effect is None or stored.size_effect is None:
        return ""
    mm = float(np.abs(again.size_effect.r_m - stored.size_effect.r_m).max()) / MM
    return f": sensing points by up to {mm:.6f} mm, or other values"
