"""Folder of a session: plan, journal and recordings; safe against a kill or power cut.

====================  ===================================================================================
``journal.jsonl``     see `calib.bench.journal`; its first line is the plan
``before.yaml``       the unit's certificate at the beginning, if there was one
``working.yaml``      the same without size effect and skew: the service compensates with it
``profile.yaml``      the plan's profile for the service, unless it is a shipped one
``run-STEP-N.mcap``   recording of the N-th attempt at a step, and ``run-STEP-N.npz`` its velocity and H
``run-N.mcap``        of the sensors and the noise: all from the first rest to the last; one more after each
                      time that the session is resumed
``certificate.yaml``  the result, and ``report.html``
====================  ===================================================================================

The SHA-256 of each file is written to the journal once the file is closed. A run is accepted only when its
files are recorded there and its recording has been decoded and found to cover the attempt. A rest is accepted
while its recording goes on; once that is closed, or found after a kill, a rest that it does not cover is
asked for again. The result can therefore always be computed again from the files. A bench with a key signs
the certificate and the end of the journal.
"""

import hashlib
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Self

from calib.bench import journal
from calib.bench.entries import (
    CertificateFile,
    Decision,
    EmbeddedFile,
    Entry,
    FileRecorded,
    Plan,
    SessionEnded,
)
from calib.bench.journal import Journal
from calib.bench.state import (
    INITIAL_CERTIFICATE,
    JOURNAL,
    LOCK,
    PROFILE,
    WORKING_CERTIFICATE,
    SessionState,
    require_session,
)
from calib.bench.working import working_certificate
from calib.procedure.events import Redone
from calib.procedure.schema import VERIFICATION, Procedure
from calib.signing.keys import BenchKey, bench_key
from imudrv import profiles
from imudrv.calibration import Calibration, read_calibration, read_calibration_file, write_calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.files.atomic import atomic_write, sync_folder
from imudrv.files.lock import FileLock


class Session(SessionState):
    """A session, open to one process at a time; see `create` and `open`.

    Attributes
    ----------
    folder : Path
        Its folder.
    plan : Plan
        First entry of its journal.
    key : BenchKey or None
        Key of the bench, which signs the result; None if it has none.
    dropped : str
        Message about a partial line that was dropped from the journal; empty if there was none.
    """

    def __init__(self, folder: Path, lock: FileLock, key: BenchKey | None) -> None:
        self._lock, self.key = lock, key
        self._journal = Journal(folder / JOURNAL)
        super().__init__(folder, self._journal.entries)
        self.dropped = self._journal.dropped
        for name in (INITIAL_CERTIFICATE, WORKING_CERTIFICATE):
            is_there = name != INITIAL_CERTIFICATE or self.plan.certificate.sha256 is not None
            if is_there and name not in self.files:
                self.record_file(name)

    @classmethod
    def create(
        cls,
        folder: Path,
        *,
        procedure: EmbeddedFile,
        calibration: Path,
        site: EmbeddedFile,
        profile: str,
        port: str,
        bench: EmbeddedFile | None = None,
        operator: str = "",
        received: str = "",
        unit: str | None = None,
    ) -> Self:
        """Create a session in a new folder.

        Parameters
        ----------
        folder : Path
            A folder without a session; created if it does not exist.
        procedure, site : EmbeddedFile
            Already checked.
        calibration : Path
            The unit's certificate; the session keeps a copy. It need not exist where the sensors are
            calibrated: an accepted result is written there.
        profile : str
            Name or path of the profile.
        port : str
            Port of the unit.
        bench : EmbeddedFile, optional
            Who calibrates, where and with what; already checked.
        operator : str
            Who conducts the session.
        received : str
            Date on which the unit was received.
        unit : str, optional
            Serial number; required without a certificate.

        Returns
        -------
        Session

        Raises
        ------
        InputError
            The folder contains a session; or the folder, the certificate or the bench's key cannot be used.
        """
        key = bench_key()
        kind = settings_file.parse_text(procedure.text.encode(), Procedure, procedure.name).kind
        before = read_calibration_file(calibration) if calibration.exists() or kind == "arms" else None
        serial = unit if before is None else before.model.serial_number
        if serial is None:
            raise InputError(f"expected the unit's serial number (--unit): there is no {calibration} yet")
        working = working_certificate(
            kind, None if before is None else before.model, profiles.load(profile), serial
        )
        plan = Plan(
            format="imu50-session",
            version=1,
            software=f"imu50 {version('imu50')}",
            unit=serial,
            port=port,
            certificate=CertificateFile(calibration.resolve(), None if before is None else before.sha256),
            procedure=procedure,
            site=site,
            profile=EmbeddedFile.of(profile, profiles.content(profile)),
            bench=bench,
            operator=operator,
            received=received,
            host=platform.node()[:64],
        )
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = _locked(folder)
        except OSError as error:
            raise InputError(f"{folder}: cannot be created or written: {error.strerror or error}") from error
        try:
            if (folder / JOURNAL).exists():
                raise InputError(
                    f"{folder}: expected a new folder, it contains a session; resume it, or name another"
                )
            if before is not None:
                (folder / INITIAL_CERTIFICATE).write_bytes(before.content)
            write_calibration(folder / WORKING_CERTIFICATE, working)
            journal.begin(folder / JOURNAL, plan)
            return cls(folder, lock, key)
        except BaseException:
            lock.release()
            raise

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Self:
        """Open an existing session.

        Parameters
        ----------
        folder : path-like
            Its folder.

        Returns
        -------
        Session

        Raises
        ------
        InputError
            The folder contains no session, another process has it open, the journal is damaged (the message
            gives the line), or the bench's key cannot be used.
        """
        folder, key = Path(folder), bench_key()
        require_session(folder)
        lock = _locked(folder)
        try:
            return cls(folder, lock, key)
        except BaseException:
            lock.release()
            raise

    def append(self, entry: Entry) -> None:
        """Append an entry to the journal; see `Journal.append`."""
        self._journal.append(entry)

    def end(self, entry: Decision | SessionEnded) -> None:
        """Append the last entry, and the signature of the journal if the bench has a key."""
        self._journal.append(entry, self.key)

    def record_file(self, name: str, *, left: bool = False) -> None:
        """Write the hash of a complete file to the journal.

        Parameters
        ----------
        name : str
            Name of the file in the folder.
        left : bool
            The file belongs to an interrupted attempt.

        Raises
        ------
        InputError
            The file cannot be read, or the journal not written.
        """
        path = self.folder / name
        try:
            with path.open("rb") as file:
                os.fsync(file.fileno())
                digest = hashlib.file_digest(file, "sha256").hexdigest()
                size = file.tell()
            sync_folder(self.folder)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
        self.append(FileRecorded(name, size, digest, left))

    def record_leftovers(self) -> tuple[str, ...]:
        """Record the files of an attempt that a kill or power cut ended, and return their names."""
        left = sorted(path.name for path in self.folder.glob("run-*") if path.name not in self.files)
        for name in left:
            self.record_file(name, left=True)
        return tuple(left)

    def next_recording(self) -> str:
        """Return the name of the next recording of a session of rests."""
        numbers = (path.stem.removeprefix("run-") for path in self.folder.glob("run-*"))
        return f"run-{max((int(n) for n in numbers if n.isdecimal()), default=0) + 1}"

    def next_attempt(self, step_id: str) -> int:
        """Return the number of the next attempt at a step; interrupted attempts count."""
        if not self.procedure().runs:
            return self.last_attempt(step_id) + 1
        numbers = [path.stem.removeprefix(f"run-{step_id}-") for path in self.folder.glob(f"run-{step_id}-*")]
        return max((int(number) for number in numbers if number.isdecimal()), default=0) + 1

    def redo(self, step_ids: Sequence[str]) -> None:
        """Withdraw steps, and the result, so that the steps are done again; all files are kept.

        Parameters
        ----------
        step_ids : sequence of str
            Steps of the procedure; only the verification once the result is accepted.

        Raises
        ------
        InputError
            A step does not exist; the message lists the steps, and none is withdrawn.
        """
        if self.stage(Decision) is None:
            known, hint = [step.id for step in self.procedure().steps], ""
        else:
            known, hint = [VERIFICATION], "; the result is accepted, begin another session for other steps"
        for name in step_ids:
            if name not in known:
                raise InputError(f"--redo: expected one of {', '.join(known)}, got {name!r}{hint}")
        for name in step_ids:
            self.append(Redone(name, self.next_attempt(name), -1))

    def calibration(self) -> Calibration:
        """Return the certificate with which the service compensates."""
        return read_calibration(self.folder / WORKING_CERTIFICATE)

    def profile(self) -> str:
        """Return the profile with which the service decodes: a shipped one by its name, else the plan's text.

        A path that somebody wrote into the journal is not opened.

        Raises
        ------
        InputError
            The text cannot be written to its file in the folder.
        """
        profile = self.plan.profile
        if profile.name in profiles.shipped():
            return profile.name
        path = self.path(PROFILE)
        with atomic_write(path) as file:
            file.write(profile.text.encode())
        return str(path)

    def close(self) -> None:
        """Close the journal and release the lock."""
        self._journal.close()
        self._lock.release()


def _locked(folder: Path) -> FileLock:
    """Take the folder's lock, which ends with the process."""
    try:
        return FileLock(folder / LOCK)
    except BlockingIOError:
        raise InputError(f"{folder}: another process has this session open; end it first") from None
    except OSError as error:
        raise InputError(f"{folder / LOCK}: cannot be opened: {error.strerror or error}") from error
