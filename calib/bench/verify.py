"""Verification of a session or a certificate: hashes, signatures, and the result, computed again.

Hashes detect accidents. Only a signature of a key that is trusted detects forgery.
"""

import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from calib.bench import journal
from calib.bench.entries import AcceptedRest, Decision
from calib.bench.journal import Contents
from calib.bench.kinds import compute
from calib.bench.recordings import uncovered_steps
from calib.bench.result import decode_covered
from calib.bench.state import (
    INITIAL_CERTIFICATE,
    JOURNAL,
    LOCK,
    PROFILE,
    RESULT,
    WEB_TOKEN,
    WORKING_CERTIFICATE,
    SessionState,
    require_session,
)
from calib.bench.working import working_certificate
from calib.certificate import PROVENANCE_IDENTIFIED
from calib.messages import english
from calib.noise.documents import PROVENANCE_NOISE
from calib.signing.certificates import signature_fault
from calib.signing.keys import bench_key
from calib.signing.signatures import fingerprint, is_valid
from imudrv.calibration import (
    PROVENANCE_SENSORS,
    Calibration,
    Signature,
    read_calibration,
    read_calibration_file,
)
from imudrv.errors import InputError
from imudrv.files import atomic
from imudrv.recording.reader import Recording
from imudrv.units import MM
from imudrv.wording import counted


class Verified(NamedTuple):
    """Result of a verification.

    Attributes
    ----------
    faults : tuple of str
        Faults, each with its line or file; empty if there are none.
    notes : tuple of str
        What was checked, by whom it is signed, and remarks.
    unfinished : tuple of str
        Why the session is unfinished; empty if it is at its end.
    untrusted : tuple of str
        What is not signed by a trusted key; empty if no trusted keys were given.
    """

    faults: tuple[str, ...]
    notes: tuple[str, ...]
    unfinished: tuple[str, ...] = ()
    untrusted: tuple[str, ...] = ()

    def __str__(self) -> str:
        """Return one line per note, fault and so on."""
        return "\n".join(
            [
                *self.notes,
                *(f"fault: {fault}" for fault in self.faults),
                *(f"unfinished: {reason}" for reason in self.unfinished),
                *(f"not trusted: {reason}" for reason in self.untrusted),
            ]
        )


def verify(path: Path, trusted: Mapping[str, str] | None = None) -> Verified:
    """Verify a session or a certificate; nothing is changed.

    Parameters
    ----------
    path : Path
        Folder of a session: journal, hashes, signatures, that plan, certificates and recordings belong to one
        unit, that recordings cover their steps, and that they give the certificate. Or a certificate: its
        signature.
    trusted : mapping of str to str, optional
        Names of trusted keys by public key. If given, session and certificate must be signed by one of them;
        otherwise only the bench's own key has a name.

    Returns
    -------
    Verified

    Raises
    ------
    InputError
        There is neither a session nor a certificate; or a signature cannot be checked, because the package
        cryptography is not installed.
    """
    is_file = os.path.isfile(path)  # False also for a name that the system cannot have
    return _verify_certificate(path, trusted) if is_file else _verify_session(path, trusted)


def faulty_files(session: SessionState, names: Collection[str]) -> list[str]:
    """Return the missing and damaged files of some in the journal of a session, one line each."""
    faults = []
    for name, digest in session.files.items():
        if name not in names:
            continue
        try:
            path = session.path(name)
            found = atomic.sha256(path)
        except InputError as error:
            faults.append(str(error))
            continue
        if found != digest:
            faults.append(
                f"{path}: was damaged or changed: expected SHA-256 {digest[:12]}..., got {found[:12]}..."
            )
    return faults


def _verify_certificate(path: Path, trusted: Mapping[str, str] | None) -> Verified:
    file = read_calibration_file(path)
    if fault := signature_fault(file, str(path)):
        return Verified((fault,), ())
    note, untrusted = _signer(str(path), file.model.signature, trusted)
    return Verified((), (note,), (), untrusted)


def _verify_session(folder: Path, trusted: Mapping[str, str] | None) -> Verified:
    require_session(folder)
    try:
        contents = journal.read(folder / JOURNAL)
        session = SessionState(folder, contents.entries)
    except InputError as error:
        return Verified((str(error),), ())
    files = session.files
    faults = _signature_faults(folder, contents) + faulty_files(session, files)
    if not faults:
        faults = [*_disagreements(session), *_uncovered_steps(session)]
    notes = [f"{counted(len(contents.entries), 'line')} and {counted(len(files), 'file')} checked"]
    unknown = {path.name for path in folder.iterdir() if path.is_file()} - {
        *files,
        JOURNAL,
        LOCK,
        PROFILE,
        WEB_TOKEN,
    }
    shown = (name if name.isprintable() else ascii(name) for name in sorted(unknown))
    notes += [f"{folder / name}: not in the journal, not checked" for name in shown]
    signed = {JOURNAL: contents.signature}
    if not faults and RESULT not in files:
        decision = session.stage(Decision)
        needs_none = not session.procedure().runs and decision is not None and not decision.accepted
        if session.is_over and not needs_none:
            faults = [f"{folder / RESULT}: expected in the journal of a session at its end, it is not there"]
        notes.append("there is no certificate yet")
    elif not faults:
        faults = _certificate_faults(session)
        signed[RESULT] = read_calibration(session.path(RESULT)).signature
        if not faults:
            notes.append("the recordings give the certificate, digit for digit")
    untrusted: list[str] = []
    if not faults:
        for name, signature in signed.items():
            note, reasons = _signer(str(folder / name), signature, trusted)
            notes.append(note)
            untrusted += reasons
    return Verified(tuple(faults), tuple(notes), tuple(_unfinished(session, contents)), tuple(untrusted))


def _unfinished(session: SessionState, contents: Contents) -> Iterator[str]:
    """Yield why a session is unfinished."""
    if contents.partial is not None:
        yield f"{session.folder / JOURNAL}: {contents.partial}"
    if not session.is_over:
        steps = ", ".join(session.accepted) or "none"
        yield f"accepted steps: {steps}; resume with: calib run --session {session.folder}"


def _signature_faults(folder: Path, contents: Contents) -> list[str]:
    return [
        f"{folder / JOURNAL}: line {number}: expected the signature of the lines before it by the key "
        f"{fingerprint(signature.public_key)}, got one that does not match; a line was changed later"
        for number, signature, data in contents.signatures
        if not is_valid(signature, data)
    ]


def _signer(
    name: str, signature: Signature | None, trusted: Mapping[str, str] | None
) -> tuple[str, tuple[str, ...]]:
    """Return who has signed a file, and, if that is not a trusted key, why not."""
    if signature is None:
        is_trusted, signer = False, "unsigned"
    else:
        names = _own_key() if trusted is None else trusted
        is_trusted = signature.public_key in names
        owner = names.get(signature.public_key, "an unknown key")
        signer = f"signed by {owner} ({fingerprint(signature.public_key)})"
    if trusted is None or is_trusted:
        return f"{name}: {signer}", ()
    return f"{name}: {signer}", (f"{name}: expected the signature of a trusted key, it is {signer}",)


def _own_key() -> dict[str, str]:
    key = bench_key()
    return {} if key is None else {key.public_key: key.name}


def _disagreements(session: SessionState) -> Iterator[str]:
    """Yield where certificates and recordings are not those of the plan."""
    plan, working = session.plan, session.path(WORKING_CERTIFICATE)
    try:
        before = None
        if plan.certificate.sha256 is not None:
            file = read_calibration_file(session.path(INITIAL_CERTIFICATE), plan.unit)
            before = file.model
            if file.sha256 != plan.certificate.sha256:
                yield (
                    f"{session.folder / INITIAL_CERTIFICATE}: expected the certificate of the plan, SHA-256 "
                    f"{plan.certificate.sha256[:12]}..., got {file.sha256[:12]}..."
                )
        kind, profile = session.procedure().kind, session.profile_model()
        if read_calibration(working) != working_certificate(kind, before, profile, plan.unit):
            yield f"{working}: expected {INITIAL_CERTIFICATE} without size effect, got other values"
        if RESULT in session.files:
            result = read_calibration_file(session.path(RESULT), plan.unit)
            if fault := signature_fault(result, str(session.path(RESULT))):
                yield fault
        attempts = [attempt.recording for attempt in session.attempts().values()]
        for recording in attempts or session.recordings():
            yield from _foreign(session, Recording(recording))
    except InputError as error:
        yield str(error)


def _foreign(session: SessionState, recording: Recording) -> Iterator[str]:
    """Yield what a recording has from another unit or session."""
    plan = session.plan
    unit, calibration = recording.origin.get("unit", ""), recording.calibration_text
    if unit != plan.unit:
        yield f"{recording.path}: expected a recording of unit {plan.unit!r}, got one of {unit!r}"
    if recording.profile_text != plan.profile.text:
        yield f"{recording.path}: expected the profile of the plan, {plan.profile.name}, got another one"
    if calibration is not None and calibration.encode() != atomic.content(session.path(WORKING_CERTIFICATE)):
        yield f"{recording.path}: expected the calibration {WORKING_CERTIFICATE}, got another one"


def _uncovered_steps(session: SessionState) -> list[str]:
    """Return the accepted steps whose recordings lack samples, one line each."""
    faults = []
    for attempt in session.attempts().values():
        try:
            decode_covered(attempt)
        except InputError as error:
            faults.append(str(error))
    recordings = {a.recording for a in session.accepted.values() if isinstance(a, AcceptedRest)}
    for name in sorted(recordings):
        faults += [
            f"{session.folder / name}: step {step}: {english(why)}"
            for step, why in uncovered_steps(session, name)
        ]
    return faults


def _certificate_faults(session: SessionState) -> list[str]:
    path = session.path(RESULT)
    stored = read_calibration(path)
    try:
        again = compute(session).certificate
    except InputError as error:
        return [f"{session.folder}: the recordings give no certificate: {error}"]
    if again is None:
        return [f"{session.folder}: the recordings give no certificate"]
    if _timeless(again) == _timeless(stored):
        return []
    return [f"{path}: differs from the result of the recordings{_difference(again, stored)}"]


def _timeless(calibration: Calibration) -> dict[str, Any]:
    """Return a certificate without the time and software version of its computation."""
    document = calibration.model_dump(mode="json", exclude={"created"})
    for part in (PROVENANCE_IDENTIFIED, PROVENANCE_SENSORS, PROVENANCE_NOISE):
        how = (document["provenance"] or {}).get(part)
        if isinstance(how, dict):
            how.pop("software", None)
    return document


def _difference(again: Calibration, stored: Calibration) -> str:
    if again.size_effect is None or stored.size_effect is None:
        return ""
    mm = float(np.abs(again.size_effect.r_m - stored.size_effect.r_m).max()) / MM
    return f": sensing points by up to {mm:.6f} mm, or other values"
