"""State of a session, as its journal determines it."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

from calib.bench.entries import (
    AcceptedRest,
    AcceptedStep,
    Decision,
    EmbeddedFile,
    Entry,
    FileRecorded,
    Plan,
    SessionEnded,
    Signed,
)
from calib.identification import PriorCalibration
from calib.procedure.events import Entered, Finished, Redone, Rested
from calib.procedure.plan import verification
from calib.procedure.schema import VERIFICATION, Procedure, Run
from imudrv.bench import Bench
from imudrv.calibration import read_calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.files.model import M
from imudrv.profiles.schema import Profile
from imudrv.site import Site

JOURNAL: Final = "journal.jsonl"


INITIAL_CERTIFICATE: Final = "before.yaml"


WORKING_CERTIFICATE: Final = "working.yaml"


RESULT: Final = "certificate.yaml"


REPORT: Final = "report.html"


REPORTS: Final = {"en": REPORT, "zh_CN": "report.zh_CN.html"}
"""The report in each language of `calib.messages`."""


PROFILE: Final = "profile.yaml"


RECORDING_SUFFIX: Final = ".mcap"


LOCK: Final = ".lock"


WEB_TOKEN: Final = ".web-token"
"""Secret part of the address of the session's page."""


Stage = TypeVar("Stage", Finished, Decision, SessionEnded)


class Attempt(NamedTuple):
    """An accepted attempt at a step.

    Attributes
    ----------
    step : Run
        The step.
    recording : Path
        Its recording.
    first_counter, last_counter : int
        First and last sample of the attempt, in the service's count.
    samples : int or None
        Number of samples of the attempt; None if unknown, as in sessions of an older version.
    """

    step: Run
    recording: Path
    first_counter: int
    last_counter: int
    samples: int | None = None


class SessionState:
    """Plan, accepted steps, files and stage of a session.

    Parameters
    ----------
    folder : Path
        Folder of the session.
    entries : sequence of Entry
        Entries of its journal; when the journal grows, so does the state.

    Attributes
    ----------
    plan : Plan
        First entry of the journal.

    Raises
    ------
    InputError
        The journal does not begin with a plan, or a file in the plan has faults.
    """

    def __init__(self, folder: Path, entries: Sequence[Entry]) -> None:
        plan = entries[0]
        if not isinstance(plan, Plan):
            raise InputError(f"{folder / JOURNAL}: line 1: expected the plan of an imu50-session")
        self.folder, self.entries, self.plan = folder, entries, plan
        self._procedure = self._parse("procedure", plan.procedure, Procedure)
        self._site = self._parse("site", plan.site, Site)
        self._profile = self._parse("profile", plan.profile, Profile)
        self._bench = Bench() if plan.bench is None else self._parse("bench", plan.bench, Bench)

    @property
    def files(self) -> dict[str, str]:
        """Names of the files in the journal, with their SHA-256."""
        files: dict[str, str] = {}
        for entry in self.entries:
            if isinstance(entry, FileRecorded):
                files[entry.name] = entry.sha256_of_file
            elif _withdraws_result(entry):
                files.pop(RESULT, None)
        return files

    @property
    def reports(self) -> dict[str, str] | None:
        """Name of the report for each language, the English one where there is no other; None: no report."""
        files = self.files
        if REPORT not in files:
            return None
        return {language: name if name in files else REPORT for language, name in REPORTS.items()}

    @property
    def accepted(self) -> dict[str, AcceptedStep | AcceptedRest]:
        """Accepted steps by their id."""
        accepted: dict[str, AcceptedStep | AcceptedRest] = {}
        for entry in self.entries:
            if isinstance(entry, AcceptedStep | AcceptedRest):
                accepted[entry.step_id] = entry
            elif isinstance(entry, Redone):
                accepted.pop(entry.step_id, None)
        return accepted

    def stage(self, kind: type[Stage]) -> Stage | None:
        """Return the entry of a stage that was reached, None if it was not or no longer counts.

        Parameters
        ----------
        kind : type
            `Finished`, `Decision` or `SessionEnded`. None of them counts once a step of the procedure is
            withdrawn.
        """
        for entry in reversed(self.entries):
            if _withdraws_result(entry):
                return None
            if isinstance(entry, kind):
                return entry
        return None

    @property
    def is_over(self) -> bool:
        """Whether the session is complete, or its result was rejected."""
        last = self.entries[-2 if isinstance(self.entries[-1], Signed) else -1]
        return isinstance(last, SessionEnded) or (isinstance(last, Decision) and not last.accepted)

    def site(self) -> Site:
        """Return the site of the session."""
        return self._site

    def procedure(self) -> Procedure:
        """Return the procedure of the session."""
        return self._procedure

    def profile_model(self) -> Profile:
        """Return the wire format of the unit."""
        return self._profile

    def bench(self) -> Bench:
        """Return who calibrates, where and with what."""
        return self._bench

    def path(self, name: str) -> Path:
        """Return the path of a file of the session.

        Parameters
        ----------
        name : str
            Name in the folder; the journal contains no paths.

        Raises
        ------
        InputError
            It is a symbolic link, which could lead out of the folder.
        """
        path = self.folder / name
        if os.path.islink(path):
            raise InputError(
                f"{path}: expected a file in the session's folder, got a symbolic link; copy the file into it"
            )
        return path

    def initial_calibration(self) -> PriorCalibration:
        """Return the certificate with which the session began.

        Raises
        ------
        InputError
            It began without one.
        """
        certificate = self.plan.certificate
        if certificate.sha256 is None:
            raise InputError(
                f"{self.folder}: expected the certificate before it, the session began without one"
            )
        return PriorCalibration(
            read_calibration(self.path(INITIAL_CERTIFICATE)), certificate.path.name, certificate.sha256
        )

    def attempts(self) -> dict[str, Attempt]:
        """Return the accepted runs by step id, in the order of the procedure, the verification last."""
        procedure, accepted = self.procedure(), self.accepted
        if not procedure.runs:
            return {}
        return {
            step.id: Attempt(step, self.path(a.recording), a.first_counter, a.last_counter, a.samples)
            for step in (*procedure.runs, *verification(procedure).runs)
            if isinstance(a := accepted.get(step.id), AcceptedStep)
        }

    @property
    def rested_s(self) -> dict[str, float]:
        """Time at rest of a long rest so far, by step id; nothing once the step is withdrawn."""
        rested: dict[str, float] = {}
        for entry in self.entries:
            if isinstance(entry, Rested):
                rested[entry.step_id] = entry.rest_s
            elif isinstance(entry, Redone):
                rested.pop(entry.step_id, None)
        return rested

    def last_attempt(self, step_id: str) -> int:
        """Return the number of the last attempt at a step in the journal, 0 without one."""
        return max(
            (
                entry.attempt
                for entry in self.entries
                if isinstance(entry, Entered) and entry.step_id == step_id
            ),
            default=0,
        )

    def recordings(self) -> list[Path]:
        """Return the recordings of a session of rests, in time; those that contain no rest are left out."""
        found, has_rest = [], False
        for entry in self.entries:
            has_rest = has_rest or isinstance(entry, AcceptedRest | Rested)
            if isinstance(entry, FileRecorded) and entry.name.endswith(RECORDING_SUFFIX):
                if has_rest:
                    found.append(self.path(entry.name))
                has_rest = False
        return found

    def _parse(self, key: str, file: EmbeddedFile, model: type[M]) -> M:
        return settings_file.parse_text(
            file.text.encode(), model, f"{self.folder / JOURNAL}: line 1: {key}.text ({file.name})"
        )


def require_session(folder: Path) -> None:
    """Raise `InputError` unless the folder contains a session."""
    if not os.path.exists(folder / JOURNAL):  # False also for a name that the system cannot have
        raise InputError(f"{folder}: expected a session, got no {JOURNAL} in it")


def _withdraws_result(entry: Entry) -> bool:
    """Whether an entry withdraws the result: a step of the procedure is done again."""
    return isinstance(entry, Redone) and entry.step_id != VERIFICATION
