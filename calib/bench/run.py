"""`calib run`: a session from the command line, with a unit or a rehearsal."""

import os
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from threading import Thread
from typing import Final

from rich.console import Console

from calib.bench.controller import SessionController
from calib.bench.keys import Keyboard
from calib.bench.queue_sink import QueueSink
from calib.bench.screen import OperatorScreen
from calib.bench.session import JOURNAL, REPORT, WORKING_CERTIFICATE, EmbeddedFile, Session
from calib.bench.simulated_unit import SimulatedUnitProcess
from calib.procedure.plan import load_file, predicted
from calib.procedure.schema import Procedure
from imudrv import profiles
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.service.loop import Service
from imudrv.service.settings import Settings
from imudrv.sinks.history import History
from imudrv.site import Site
from imudrv.terminal import INTERRUPTED, OK
from imudrv.units import MM

PROCEDURE: Final = "three-rotations"
"""Unless told otherwise."""


REHEARSED: Final = "imu50-rs422"
"""Profile of a rehearsal unless told otherwise."""


AHEAD: Final = 1000
"""Samples that may wait for the engine where the unit waits for its reader."""


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
    keys = Keyboard()
    rehearsal = SimulatedUnitProcess(folder, speed) if rehearse or SimulatedUnitProcess.was(folder) else None
    if rehearsal is None and not hands_free and not keys.there:
        raise InputError("expected a terminal for the operator's keys, got none; use one, or --hands-free")
    if rehearsal is not None and (port or calibration or site):
        raise InputError("--rehearse: expected no --port, --calibration or --site; it has a unit of its own")
    if is_there and rehearse and not SimulatedUnitProcess.was(folder):
        raise InputError(f"{folder}: expected a rehearsal to go on with, got the session of a unit")
    if redo and not is_there:
        raise InputError(f"--redo: expected a session that is there, with --session, got none in {folder}")
    if is_there:
        session = Session.open(folder)
    else:
        wanted = load_file(procedure or PROCEDURE)
        if rehearsal is not None:
            port, calibration, site = rehearsal.make(wanted.model)
            profile = profile or REHEARSED
        if port is None or profile is None or calibration is None or site is None:
            raise InputError("a new session: expected --port, --profile, --calibration and --site")
        place = settings_file.read_file(site, Site)
        worst_mm = float(predicted(wanted.model, place.model).differences_sigma.max()) / MM
        expected = f"session {folder}: the differences are expected to 1 sigma of {worst_mm:.3f} mm"
        console.print(expected, markup=False, soft_wrap=True)
        session = Session.create(
            folder,
            procedure=_document(procedure or PROCEDURE, wanted.content),
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


def _conducted(
    session: Session,
    port: str,
    keys: Keyboard,
    rehearsal: SimulatedUnitProcess | None,
    hands_free: bool,
    console: Console,
) -> int:
    plan = session.plan
    layout = profiles.load(plan.profile.name).layout()
    tap = QueueSink(AHEAD if rehearsal is not None and rehearsal.waits else None)
    settings = Settings(
        port=port,
        profile=plan.profile.name,
        calibration=str(session.folder / WORKING_CERTIFICATE),
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

    conduct = SessionController(
        session,
        session.procedure(),
        layout,
        service,
        tap,
        OperatorScreen(console),
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
        procedure=_document(procedure, load_file(procedure).content) if procedure else None,
        calibration=calibration,
        site=_document(site, settings_file.read_file(site, Site).content) if site else None,
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


def _document(name: str | Path, content: bytes) -> EmbeddedFile:
    return EmbeddedFile(str(name), content.decode())
