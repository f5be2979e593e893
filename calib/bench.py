"""`calib run`: a session from the command line, with a unit or a rehearsal."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from threading import Thread
from typing import Final

from rich.console import Console

from calib import procedure as procedures
from calib.conduct import Conduct, Tap
from calib.console import Keys, Screen
from calib.procedure import Procedure, predicted
from calib.rehearsal import BENCH, technician
from calib.session import JOURNAL, REPORT, WORKING, Document, Session
from imudrv import config, profiles
from imudrv.calibration import write_calibration
from imudrv.console import INTERRUPTED, OK
from imudrv.errors import InputError
from imudrv.service import Service
from imudrv.settings import Settings
from imudrv.sim.live import speed_of
from imudrv.sinks.history import History
from imudrv.site import Site
from imudrv.units import MM

PROCEDURE: Final = "three-rotations"
"""Unless told otherwise."""
REHEARSED: Final = "imu50-rs422"
"""Profile of a rehearsal unless told otherwise."""
SEED: Final = 1
"""Of the rehearsal's unit and technician."""
AHEAD: Final = 1000
"""Samples that may wait for the engine where the unit waits for its reader."""
_PATIENCE_S: Final = 60.0

# The unit ends with whoever started it, however that ends (Linux: PR_SET_PDEATHSIG, SIGKILL), and does not
# begin where that has ended already.
_UNIT: Final = (
    "import ctypes, os, sys; ctypes.CDLL(None).prctl(1, 9); "
    "os.getppid() == int(sys.argv.pop(1)) or sys.exit(); "
    "from imudrv.cli import main; sys.exit(main())"
)


def run(
    *,
    port: str | None = None,
    profile: str | None = None,
    calibration: Path | None = None,
    site: Path | None = None,
    procedure: str | None = None,
    folder: Path | None = None,
    hands_free: bool = False,
    rehearse: bool = False,
    speed: str = "1",
    redo: Sequence[str] = (),
    console: Console,
) -> int:
    """Lead through a session, a new one or one that is there.

    Parameters
    ----------
    port, profile : str or None
        Where the unit is, and what it sends.
    calibration, site : Path or None
        The unit's active certificate, and where it stands.
    procedure : str or None
        Name or path; `PROCEDURE` if it is not given.
    folder : Path or None
        Of the session; a new one by the time if it is not given. A session that is there is resumed: what is
        not given is then as it began, what is given must be the same.
    hands_free : bool
        Go on by the sensors alone.
    rehearse : bool
        With a simulated unit and technician, hands free.
    speed : str
        Of the rehearsal: a number, or ``max``.
    redo : sequence of str
        Steps of a session that is there, to be done again.
    console : Console
        Where it is shown.

    Returns
    -------
    int
        Exit code: 0 at the session's end, 130 when it can be resumed.

    Raises
    ------
    InputError
        Something that is given cannot be, or the session cannot be resumed; says why.
    """
    folder = folder or Path(f"session-{datetime.now(UTC):%Y%m%dT%H%M%SZ}")
    is_there = (folder / JOURNAL).exists()
    keys = Keys()
    rehearsal = Rehearsal(folder, speed) if rehearse or Rehearsal.was(folder) else None
    if rehearsal is None and not hands_free and not keys.there:
        raise InputError("expected a terminal for the operator's keys, got none; use one, or --hands-free")
    if rehearsal is not None and (port or calibration or site):
        raise InputError("--rehearse: expected no --port, --calibration or --site; it has a unit of its own")
    if is_there and rehearse and not Rehearsal.was(folder):
        raise InputError(f"{folder}: expected a rehearsal to go on with, got the session of a unit")
    if redo and not is_there:
        raise InputError(f"--redo: expected a session that is there, with --session, got none in {folder}")
    if is_there:
        session = Session.open(folder)
    else:
        plan = procedures.load_file(procedure or PROCEDURE)
        if rehearsal is not None:
            port, calibration, site = rehearsal.make(plan.model)
            profile = profile or REHEARSED
        if port is None or profile is None or calibration is None or site is None:
            raise InputError("a new session: expected --port, --profile, --calibration and --site")
        place = config.read_file(site, Site)
        worst_mm = float(predicted(plan.model, place.model).differences_sigma.max()) / MM
        expected = f"session {folder}: the differences are expected to 1 sigma of {worst_mm:.3f} mm"
        console.print(expected, markup=False, soft_wrap=True)
        session = Session.create(
            folder,
            procedure=_document(procedure or PROCEDURE, plan.content),
            calibration=calibration,
            site=_document(site, place.content),
            profile=profile,
            port=port,
        )
    try:
        if is_there:
            _require_resumable(session, procedure, calibration, site, profile)
            _resume(session, console, redo, asks=rehearsal is None and not hands_free)
        return _conducted(session, port or session.plan.port, keys, rehearsal, hands_free, console)
    finally:
        session.close()


class Rehearsal:
    """A simulated unit in the hands of a simulated technician, in a process of its own, on a pty.

    Parameters
    ----------
    folder : Path
        Of the session.
    speed : str
        Seconds of the rehearsal in a second, or ``max``: as fast as the engine takes it.

    Raises
    ------
    InputError
        Not a speed.
    """

    def __init__(self, folder: Path, speed: str) -> None:
        self._folder = folder / "rehearsal"
        self._speed = speed
        self.waits = speed_of(speed) is None
        self._unit: subprocess.Popen[str] | None = None

    @staticmethod
    def was(folder: Path) -> bool:
        """Whether a session is a rehearsal."""
        return (folder / "rehearsal").is_dir()

    def make(self, procedure: Procedure) -> tuple[str, Path, Path]:
        """Make the unit's papers.

        Parameters
        ----------
        procedure : Procedure
            Of the session.

        Returns
        -------
        str
            Its port.
        Path
            Its certificate, without the arms.
        Path
            Where it stands.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        unit = technician(procedure, seed=SEED).unit.calibration
        assert unit is not None
        certificate, site = self._folder / "unit.yaml", self._folder / "site.yaml"
        write_calibration(certificate, unit.model_copy(update={"size_effect": None}))
        config.write(site, BENCH)
        return str(self._link), certificate, site

    def begin(self, procedure: Procedure, profile: str) -> None:
        """Carry a procedure out from the beginning, with the unit switched on anew.

        Parameters
        ----------
        procedure : Procedure
            The steps that are left.
        profile : str
            What the unit sends.

        Raises
        ------
        InputError
            The unit does not come up.
        """
        self.end()
        scenario = self._folder / "scenario.yaml"
        config.write(scenario, technician(procedure, seed=SEED))
        command = ["sim", str(scenario), "--profile", profile, "--port", "pty", "--link", str(self._link)]
        self._unit = subprocess.Popen(
            [sys.executable, "-c", _UNIT, str(os.getpid()), *command, "--speed", self._speed],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        end = time.monotonic() + _PATIENCE_S
        while not self._link.exists():
            if self._unit.poll() is not None or time.monotonic() > end:
                self.end()
                assert self._unit.stderr is not None
                raise InputError(f"the simulated unit did not come up: {self._unit.stderr.read().strip()}")
            time.sleep(0.02)

    def end(self) -> None:
        """Switch the unit off."""
        if self._unit is not None:
            self._unit.kill()
            self._unit.wait()
        self._link.unlink(missing_ok=True)

    @property
    def _link(self) -> Path:
        return self._folder.resolve() / "port"


def _conducted(
    session: Session,
    port: str,
    keys: Keys,
    rehearsal: Rehearsal | None,
    hands_free: bool,
    console: Console,
) -> int:
    plan = session.plan
    layout = profiles.load(plan.profile.name).layout()
    tap = Tap(AHEAD if rehearsal is not None and rehearsal.waits else None)
    settings = Settings(
        port=port,
        profile=plan.profile.name,
        calibration=str(session.folder / WORKING),
        unit=plan.unit,
        status=str(Path(tempfile.gettempdir()) / f"imu50-calib-{os.getpid()}.sock"),
    )
    service = Service(
        settings,
        lambda text: tap.tell(text.partition(" ")[2]),
        [tap],
        in_real_time=rehearsal is None,
        history=History(),
    )

    def begin(steps: Procedure) -> None:
        if rehearsal is not None:
            rehearsal.begin(steps, plan.profile.name)

    conduct = Conduct(
        session,
        session.procedure(),
        layout,
        service,
        tap,
        Screen(console),
        keys,
        hands_free=hands_free or rehearsal is not None,
        begin=begin,
    )
    worker = Thread(target=conduct.run, name="conduct")
    worker.start()
    try:
        service.run()
    finally:
        tap.close()
        worker.join()
        if rehearsal is not None:
            rehearsal.end()
        if not conduct.outcome:
            console.print(f"accepted so far: {', '.join(session.accepted) or 'no step'}", markup=False)
            console.print(f"go on with: calib run --session {session.folder}", markup=False, soft_wrap=True)
    if conduct.error is not None:
        raise conduct.error
    if not conduct.outcome:
        return INTERRUPTED
    console.print(conduct.outcome, markup=False, highlight=False, soft_wrap=True)
    return OK


def _require_resumable(
    session: Session, procedure: str | None, calibration: Path | None, site: Path | None, profile: str | None
) -> None:
    if session.is_over:
        raise InputError(f"{session.folder}: the session is over, see {REPORT} in it; name another folder")
    session.require_whole()
    session.require_same(
        procedure=_document(procedure, procedures.load_file(procedure).content) if procedure else None,
        calibration=calibration,
        site=_document(site, config.read_file(site, Site).content) if site else None,
        profile=profile or session.plan.profile.name,
    )


def _resume(session: Session, console: Console, redo: Sequence[str], asks: bool) -> None:
    """Say where the session was, ask whether to go on there, and clear up."""
    lines = [session.dropped] if session.dropped else []
    accepted = ", ".join(session.accepted) or "no step yet"
    lines.append(f"session {session.folder} of unit {session.plan.unit}: accepted {accepted}")
    console.print("\n".join(lines), markup=False, soft_wrap=True)
    if asks and console.input("go on there? \\[y/n] ").strip().lower() not in ("y", "yes"):
        raise InputError(f"{session.folder}: left as it is; name another folder for a new session")
    session.redo(redo)
    left = session.enter_leftovers()
    session.append({"event": "resumed", "left": left})


def _document(name: str | Path, content: bytes) -> Document:
    return Document(str(name), content.decode())
