"""Folder of a session: plan, journal and recordings; safe against a kill or power cut.

====================  ===================================================================================
``journal.jsonl``     see `calib.bench.journal`; its first line is the plan
``before.yaml``       the unit's certificate at the beginning
``working.yaml``      the same without size effect and skew: the service compensates with it
``run-STEP-N.mcap``   recording of the N-th attempt at a step, and ``run-STEP-N.npz`` its velocity and H
``certificate.yaml``  the result, and ``report.html``
====================  ===================================================================================

The SHA-256 of each file is written to the journal once the file is closed. A step is accepted only when its
files are recorded there and its recording has been decoded and found to cover the attempt. The
result can therefore always be computed again from the files.
"""

import fcntl
import hashlib
import os
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Self

from calib.bench import journal
from calib.bench.entries import CertificateFile, Decision, EmbeddedFile, Entry, FileRecorded, Plan
from calib.bench.journal import Journal
from calib.bench.state import (
    INITIAL_CERTIFICATE,
    JOURNAL,
    LOCK,
    WORKING_CERTIFICATE,
    SessionState,
    require_session,
)
from calib.procedure.events import Redone
from calib.procedure.schema import VERIFICATION
from imudrv import profiles
from imudrv.calibration import Calibration, read_calibration, read_calibration_file, write_calibration
from imudrv.errors import InputError
from imudrv.files.atomic import sync_folder


class Session(SessionState):
    """A session, open to one process at a time; see `create` and `open`.

    Attributes
    ----------
    folder : Path
        Its folder.
    plan : Plan
        First entry of its journal.
    dropped : str
        Message about a partial line that was dropped from the journal; empty if there was none.
    """

    def __init__(self, folder: Path, lock: int) -> None:
        self._lock = lock
        self._journal = Journal(folder / JOURNAL)
        super().__init__(folder, self._journal.entries)
        self.dropped = self._journal.dropped
        for name in (INITIAL_CERTIFICATE, WORKING_CERTIFICATE):
            if name not in self.files:
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
    ) -> Self:
        """Create a session in a new folder.

        Parameters
        ----------
        folder : Path
            A folder without a session; created if it does not exist.
        procedure, site : EmbeddedFile
            Already checked.
        calibration : Path
            The unit's certificate; the session keeps a copy.
        profile : str
            Name or path of the profile.
        port : str
            Port of the unit.

        Returns
        -------
        Session

        Raises
        ------
        InputError
            The folder contains a session, or the folder or the certificate cannot be used.
        """
        before = read_calibration_file(calibration)
        plan = Plan(
            format="imu50-session",
            version=1,
            software=f"imu50 {version('imu50')}",
            unit=before.model.serial_number,
            port=port,
            certificate=CertificateFile(calibration.resolve(), before.sha256),
            procedure=procedure,
            site=site,
            profile=EmbeddedFile.of(profile, profiles.content(profile)),
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
            (folder / INITIAL_CERTIFICATE).write_bytes(before.content)
            working = before.model.without_size_effect().without_skew()  # both are estimated
            write_calibration(folder / WORKING_CERTIFICATE, working)
            journal.begin(folder / JOURNAL, plan)
            return cls(folder, lock)
        except BaseException:
            os.close(lock)
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
            The folder contains no session, another process has it open, or the journal is damaged; the
            message gives the line.
        """
        folder = Path(folder)
        require_session(folder)
        lock = _locked(folder)
        try:
            return cls(folder, lock)
        except BaseException:
            os.close(lock)
            raise

    def append(self, entry: Entry) -> None:
        """Append an entry to the journal; see `Journal.append`."""
        self._journal.append(entry)

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

    def next_attempt(self, step_id: str) -> int:
        """Return the number of the next attempt at a step; interrupted attempts count."""
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

    def close(self) -> None:
        """Close the journal and release the lock."""
        self._journal.close()
        os.close(self._lock)


def _locked(folder: Path) -> int:
    """Take the folder's lock, which ends with the process."""
    lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise InputError(f"{folder}: another process has this session open; end it first") from None
    return lock
