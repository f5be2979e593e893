"""The session's folder: the plan, the journal, and the files that all rests on; safe from kill and power cut.

====================  ===================================================================================
``journal.jsonl``     see `calib.bench.journal`; its first line is the plan
``before.yaml``       the unit's certificate as it was
``working.yaml``      the same without size effect: what the service compensates with
``run-STEP-N.mcap``   recording of the N-th attempt at a step, and ``run-STEP-N.npz`` its velocity and H
``certificate.yaml``  the result, and ``report.html``
====================  ===================================================================================

The SHA-256 of each file is in the journal once it is closed. A step counts as accepted only when its files
are in and its recording has been decoded and found to cover the step's evidence; so whatever happens, what
counts can be computed again from what is there.
"""

import fcntl
import hashlib
import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Final, NamedTuple, Self

import numpy as np

from calib.bench import journal
from calib.bench.evidence import Attempt, Result, identify, require_covered
from calib.bench.journal import Entry, Journal
from calib.identification import PriorCalibration
from calib.procedure.plan import verification
from calib.procedure.schema import VERIFICATION, Procedure, Step
from imudrv import profiles
from imudrv.calibration import Calibration, read_calibration, write_calibration
from imudrv.errors import InputError
from imudrv.files import atomic, settings_file
from imudrv.site import Site

JOURNAL: Final = "journal.jsonl"


INITIAL_CERTIFICATE: Final = "before.yaml"


WORKING_CERTIFICATE: Final = "working.yaml"


RESULT: Final = "certificate.yaml"


REPORT: Final = "report.html"


RESUME_KELVIN: Final = 5.0
"""Most that a temperature may differ from the accepted runs' when a session is resumed."""


LOCK: Final = ".lock"


class EmbeddedFile(NamedTuple):
    """A file that the plan holds, whole.

    Attributes
    ----------
    name : str
        As the user gave it.
    text : str
        Its content.
    """

    name: str
    text: str

    @property
    def sha256(self) -> str:
        """Hash of its content."""
        return hashlib.sha256(self.text.encode()).hexdigest()


class Plan(NamedTuple):
    """What the session is about.

    Attributes
    ----------
    procedure, site, profile : Document
        What is done, where, and what the unit sends.
    certificate : Path
        The unit's active certificate.
    certificate_sha256 : str
        Of what it was at the beginning.
    unit : str
        Its serial number.
    port : str
        Where the unit was connected.
    """

    procedure: EmbeddedFile
    site: EmbeddedFile
    profile: EmbeddedFile
    certificate: Path
    certificate_sha256: str
    unit: str
    port: str


class Session:
    """A session, open to one process at a time; see `create` and `open`.

    Attributes
    ----------
    folder : Path
        Its folder.
    plan : Plan
        What it is about.
    dropped : str
        What a power cut left of a line and was dropped; empty if nothing was.
    """

    def __init__(self, folder: Path, lock: int) -> None:
        self.folder = folder
        self._lock = lock
        self._journal = Journal(folder / JOURNAL)
        self.plan = plan_of(self._journal.entries[0], folder)
        self.dropped = self._journal.dropped
        for name in (INITIAL_CERTIFICATE, WORKING_CERTIFICATE):
            if name not in self.files:
                self.enter(name)

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
        """Begin a session in a new folder.

        Parameters
        ----------
        folder : Path
            There must be no session in it.
        procedure, site : Document
            Checked already.
        calibration : Path
            The unit's certificate; a copy is kept.
        profile : str
            Name or path.
        port : str
            Where the unit is.

        Returns
        -------
        Session

        Raises
        ------
        InputError
            There is a session, or the folder or the certificate cannot be used.
        """
        before = read_calibration(calibration)
        content = calibration.read_bytes()
        plan: Entry = {
            "event": "plan",
            "format": "imu50-session",
            "version": 1,
            "software": f"imu50 {version('imu50')}",
            "unit": before.serial_number,
            "port": port,
            "certificate": {
                "path": str(calibration.resolve()),
                "sha256": hashlib.sha256(content).hexdigest(),
            },
        }
        documents = {
            "procedure": procedure,
            "site": site,
            "profile": EmbeddedFile(profile, profiles.content(profile).decode()),
        }
        for name, document in documents.items():
            plan[name] = {**document._asdict(), "sha256": document.sha256}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = _locked(folder)
        except OSError as error:
            raise InputError(f"{folder}: cannot be made or written to: {error.strerror or error}") from error
        try:
            if (folder / JOURNAL).exists():
                raise InputError(
                    f"{folder}: expected a new folder, there is a session in it; resume it, or name another"
                )
            (folder / INITIAL_CERTIFICATE).write_bytes(content)
            write_calibration(folder / WORKING_CERTIFICATE, before.model_copy(update={"size_effect": None}))
            journal.begin(folder / JOURNAL, plan)
            return cls(folder, lock)
        except BaseException:
            os.close(lock)
            raise

    @classmethod
    def open(cls, folder: str | os.PathLike[str]) -> Self:
        """Open a session that is there.

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
            There is none, another process has it open, or the journal is damaged: the line is named.
        """
        folder = Path(folder)
        require_session(folder)
        lock = _locked(folder)
        try:
            return cls(folder, lock)
        except BaseException:
            os.close(lock)
            raise

    @property
    def entries(self) -> Sequence[Entry]:
        """All lines of the journal."""
        return self._journal.entries

    @property
    def files(self) -> dict[str, str]:
        """Names of the files in the journal, and their SHA-256."""
        return files_of(self.entries)

    @property
    def accepted(self) -> dict[str, Entry]:
        """Steps that need not be asked again, and the lines that accepted them."""
        return _accepted(self.entries)

    def entry(self, event: str) -> Entry | None:
        """The line of a stage that has been reached and still holds.

        Parameters
        ----------
        event : str
            ``finished``, ``decision`` or ``end``.

        Returns
        -------
        dict or None
            None also after a step of the procedure was withdrawn, see `redo`.
        """
        for entry in reversed(self.entries):
            if _withdraws(entry):
                return None
            if entry["event"] == event:
                return entry
        return None

    @property
    def is_over(self) -> bool:
        """Whether it has come to its end, or its result was turned down."""
        last = self.entries[-1]
        return last["event"] == "end" or (last["event"] == "decision" and not last["accepted"])

    def append(self, entry: Entry) -> None:
        """Append a line to the journal; it is on the disk when this returns.

        Parameters
        ----------
        entry : dict
            Of what JSON knows; `event` says what happened.

        Raises
        ------
        InputError
            It cannot be written.
        """
        self._journal.append(entry)

    def enter(self, name: str, **about: object) -> None:
        """Enter a file that is complete, with its hash.

        Parameters
        ----------
        name : str
            In the folder.
        **about
            What else the line tells.

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
            _sync_folder(self.folder)
        except OSError as error:
            raise InputError(f"{path}: cannot be read: {error.strerror or error}") from error
        self.append({"event": "file", "name": name, "bytes": size, "sha256_of_file": digest, **about})

    def attempt(self, step_id: str) -> int:
        """Number of the next attempt at a step; one that a kill has ended counts."""
        numbers = [path.stem.removeprefix(f"run-{step_id}-") for path in self.folder.glob(f"run-{step_id}-*")]
        return max((int(number) for number in numbers if number.isdecimal()), default=0) + 1

    def redo(self, step_ids: Sequence[str]) -> None:
        """Withdraw steps, and what was concluded from them, so that they are asked again; files are kept.

        Parameters
        ----------
        step_ids : sequence of str
            Steps of the procedure; once the result is accepted only the verification.

        Raises
        ------
        InputError
            There is no such step; the steps are listed, and none is withdrawn.
        """
        if self.entry("decision") is None:
            known, hint = [step.id for step in self.procedure().steps], ""
        else:
            known, hint = [VERIFICATION], "; the result is accepted, for other steps begin another session"
        for name in step_ids:
            if name not in known:
                raise InputError(f"--redo: expected one of {', '.join(known)}, got {name!r}{hint}")
        for name in step_ids:
            self.append({"event": "redone", "step_id": name, "attempt": self.attempt(name), "counter": -1})

    def enter_leftovers(self) -> list[str]:
        """Enter what an attempt left that a kill or power cut has ended.

        Returns
        -------
        list of str
            The names.
        """
        left = sorted(path.name for path in self.folder.glob("run-*") if path.name not in self.files)
        for name in left:
            self.enter(name, left=True)
        return left

    def require_whole(self) -> None:
        """Make sure that its files are what they were.

        Raises
        ------
        InputError
            One is damaged or gone.
        """
        if wrong := faulty_files(self.folder, self.files):
            raise InputError("\n  ".join([f"{self.folder}: cannot be resumed:", *wrong]))

    def require_same(
        self,
        *,
        procedure: EmbeddedFile | None = None,
        calibration: Path | None = None,
        site: EmbeddedFile | None = None,
        profile: str | None = None,
    ) -> None:
        """Refuse to resume with anything else than the session began with.

        Parameters
        ----------
        procedure, calibration, site, profile
            What is given now; None: not given, so that the session's own holds.

        Raises
        ------
        InputError
            It differs; all that differs is told.
        """
        plan, differ = self.plan, []
        active = calibration or plan.certificate
        now = read_calibration(active)
        if now.serial_number != plan.unit:
            differ.append(f"unit: expected {plan.unit!r}, got {now.serial_number!r} ({active})")
        elif (digest := atomic.sha256(active)) not in (plan.certificate_sha256, self.files.get(RESULT)):
            differ.append(
                f"certificate: expected the one that it began with ({plan.certificate_sha256[:12]}), "
                f"got another of the same unit ({active}, {digest[:12]})"
            )
        given = {"procedure": procedure, "site": site}
        if profile is not None:
            given["profile"] = EmbeddedFile(profile, profiles.content(profile).decode())
        for name, document in given.items():
            began: EmbeddedFile = getattr(plan, name)
            if document is not None and document.sha256 != began.sha256:
                differ.append(
                    f"{name}: expected {began.name} as it was, got {document.name} with other contents"
                )
        if differ:
            raise InputError(
                "\n  ".join(
                    [
                        f"{self.folder}: cannot be resumed:",
                        *differ,
                        "give what it began with, or begin another session",
                    ]
                )
            )

    def require_temperature(self, degc: Mapping[str, float | None]) -> None:
        """Refuse to resume at another temperature than that of the accepted runs.

        Parameters
        ----------
        degc : mapping
            Channel to degrees Celsius now; None: not known.

        Raises
        ------
        InputError
            One is further off than `RESUME_KELVIN`.
        """
        for name, now in degc.items():
            then = [entry["temperature_degc"].get(name) for entry in self.accepted.values()]
            known = [t for t in then if t is not None]
            if now is None or not known:
                continue
            mean = float(np.mean(known))
            if abs(now - mean) > RESUME_KELVIN:
                raise InputError(
                    f"{self.folder}: cannot be resumed now: {name}: expected {mean:.1f} degC within "
                    f"{RESUME_KELVIN:g} K, as in the accepted runs, got {now:.1f}; let the unit come to that "
                    "temperature, or begin another session"
                )

    def calibration(self) -> Calibration:
        """The certificate that the service works with."""
        return read_calibration(self.folder / WORKING_CERTIFICATE)

    def site(self) -> Site:
        """Where the unit stands."""
        return _site(self.plan)

    def procedure(self) -> Procedure:
        """What is done."""
        return _procedure(self.plan)

    def identify(self) -> Result:
        """Find the lever arms from the recordings of the steps; see `calib.bench.evidence.identify`."""
        return identified(self.folder, self.plan, self.entries)

    def attempt_at(self, step: Step) -> Attempt:
        """The accepted attempt at a step."""
        return _attempt(self.folder, step, self.accepted[step.id])

    def close(self) -> None:
        """Let go of it."""
        self._journal.close()
        os.close(self._lock)


def _accepted(entries: Sequence[Entry]) -> dict[str, Entry]:
    accepted: dict[str, Entry] = {}
    for entry in entries:
        if entry["event"] == "accepted":
            accepted[entry["step_id"]] = entry
        elif entry["event"] == "redone":
            accepted.pop(entry["step_id"], None)
    return accepted


def files_of(entries: Sequence[Entry]) -> dict[str, str]:
    """Names and hashes of the files that count."""
    files: dict[str, str] = {}
    for entry in entries:
        if entry["event"] == "file":
            files[entry["name"]] = entry["sha256_of_file"]
        elif _withdraws(entry):
            files.pop(RESULT, None)
    return files


def _withdraws(entry: Entry) -> bool:
    """Whether a line voids what was concluded from the steps before it."""
    return bool(entry["event"] == "redone" and entry["step_id"] != VERIFICATION)


def uncovered_steps(folder: Path, plan: Plan, entries: Sequence[Entry]) -> list[str]:
    """Accepted steps whose recordings lack a part of the evidence, a line each."""
    accepted = _accepted(entries)
    if not accepted:
        return []
    procedure, wrong = _procedure(plan), []
    for step in (*procedure.steps, *verification(procedure).steps):
        if step.id in accepted:
            try:
                require_covered(_attempt(folder, step, accepted[step.id]))
            except InputError as error:
                wrong.append(str(error))
    return wrong


def faulty_files(folder: Path, files: Mapping[str, str]) -> list[str]:
    """What is wrong with the files, a line each."""
    wrong = []
    for name, digest in files.items():
        try:
            found = atomic.sha256(folder / name)
        except InputError as error:
            wrong.append(str(error))
            continue
        if found != digest:
            wrong.append(
                f"{folder / name}: was damaged or changed: "
                f"expected SHA-256 {digest[:12]}..., got {found[:12]}..."
            )
    return wrong


def plan_of(entry: Entry, folder: Path) -> Plan:
    """Return the plan in the first line of a journal."""
    if entry.get("format") != "imu50-session" or entry.get("version") != 1:
        raise InputError(f"{folder / JOURNAL}: line 1: expected the plan of an imu50-session, version 1")
    documents = {
        name: EmbeddedFile(entry[name]["name"], entry[name]["text"])
        for name in ("procedure", "site", "profile")
    }
    return Plan(
        **documents,
        certificate=Path(entry["certificate"]["path"]),
        certificate_sha256=entry["certificate"]["sha256"],
        unit=entry["unit"],
        port=entry["port"],
    )


def identified(folder: Path, plan: Plan, entries: Sequence[Entry]) -> Result:
    """Estimate the lever arms from the accepted recordings."""
    procedure = _procedure(plan)
    accepted = _accepted(entries)
    basis = PriorCalibration(
        read_calibration(folder / INITIAL_CERTIFICATE), plan.certificate.name, plan.certificate_sha256
    )
    attempts = [_attempt(folder, step, accepted[step.id]) for step in procedure.steps if step.id in accepted]
    return identify(procedure, attempts, basis, _site(plan))


def _attempt(folder: Path, step: Step, entry: Entry) -> Attempt:
    return Attempt(
        step,
        folder / entry["recording"],
        entry["first_counter"],
        entry["last_counter"],
        entry.get("samples"),
    )


def _procedure(plan: Plan) -> Procedure:
    return settings_file.parse_text(plan.procedure.text.encode(), Procedure, plan.procedure.name)


def _site(plan: Plan) -> Site:
    return settings_file.parse_text(plan.site.text.encode(), Site, plan.site.name)


def require_session(folder: Path) -> None:
    """Raise `InputError` unless the folder holds a session."""
    if not (folder / JOURNAL).exists():
        raise InputError(f"{folder}: expected a session, got no {JOURNAL} in it")


def _locked(folder: Path) -> int:
    """Take the folder's lock, which ends with the process."""
    lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise InputError(
            f"{folder}: expected a session that nobody else works on, another process has it open"
        ) from None
    return lock


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
