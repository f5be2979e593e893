"""`calib run`: a session from the command line, with a unit or a rehearsal."""

import os
import time
from collections.abc import Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from datetime import UTC, date, datetime
from pathlib import Path
from signal import SIGINT, SIGTERM
from threading import Thread
from typing import Final

import numpy as np
from rich.console import Console

from calib.bench.completion import accepted_result
from calib.bench.controller import SessionController
from calib.bench.entries import EmbeddedFile
from calib.bench.keys import Keyboard
from calib.bench.queue_sink import QueueSink
from calib.bench.resume import check_files, require_same, resume, steps_message
from calib.bench.screen import OperatorScreen
from calib.bench.session import Session
from calib.bench.simulated_unit import SimulatedUnitProcess, is_rehearsal
from calib.bench.state import JOURNAL, REPORT, REPORTS, RESULT, WORKING_CERTIFICATE
from calib.bench.technician import BENCH, REHEARSED_UNIT, mistakes_of
from calib.bench.web_console import WebConsole
from calib.certificate import lever_arms_of
from calib.inputs import require_six_axes
from calib.messages import Message, language, message, text
from calib.noise.fit import PART
from calib.procedure import plan
from calib.procedure.schema import Procedure
from calib.reports.document import Document
from calib.reports.pdf import renderer, write_pdf
from calib.reports.text import as_text
from calib.reports.truth import calibration_comparison, comparison
from calib.sensors import plan as sensors_plan
from imudrv import profiles
from imudrv.bench import BENCH_FILE, Bench
from imudrv.calibration import Calibration, coefficients, read_calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.files.config_folder import config_file
from imudrv.imu.compensation import require_sensors
from imudrv.service.endpoint import default_folder
from imudrv.service.loop import Service
from imudrv.service.runtime import SignalFlags
from imudrv.service.settings import Settings
from imudrv.signals import SIGHUP
from imudrv.sinks.history import History
from imudrv.site import Site
from imudrv.terminal import INTERRUPTED, NOT_GOOD, OK
from imudrv.units import MM

PROCEDURE: Final = "three-rotations"
"""Default procedure."""


REHEARSAL_PROFILE: Final = "imu50-rs422"
"""Default profile of a rehearsal."""


_LINGER_S: Final = 0.2


_CONNECT_S: Final = 10.0
_POLL_S: Final = 0.01
"""Longest wait for the driver to find a unit that has started, and the interval at which it is asked."""


QUEUE_LIMIT: Final = 1000
"""Samples that may wait for the engine in a rehearsal at full speed."""


@dataclass(frozen=True)
class RunOptions:
    """Options of `calib run`.

    Attributes
    ----------
    folder : Path
        Folder of the session. An existing session is resumed: options that are not given are as it began,
        those that are given must be the same.
    port, profile : str or None
        Port of the unit, and its wire format.
    calibration, site : Path or None
        The unit's active certificate, and the site of the bench. Where the sensors are calibrated, the
        certificate need not exist.
    procedure : str or None
        Name or path; None: `PROCEDURE`.
    hands_free : bool
        Proceed by the sensors alone, without keys.
    accept : bool
        Accept the result without a person, unless a verdict is bad.
    rehearse : bool
        Use a simulated unit and technician, hands free.
    keys : bool
        A person presses the keys of the rehearsal, and the technician does what the screen says.
    web : str or None
        Address of a page for browsers, see `imudrv.web.server.PageServer`; its buttons are keys.
    mistakes : str
        Mistakes of the technician, see `calib.bench.technician.mistakes_of`.
    speed : str
        Speed of the rehearsal: a number, or ``max``.
    pdf : bool
        Write the report as PDF, too.
    bench : Path or None
        Bench file of a new session; None: that of the user's configuration, if there is one.
    operator, unit : str or None
        Who conducts a new session, and the serial number on the unit; asked at a terminal if not given.
    received : date or None
        When the unit of a new session was received.
    redo : sequence of str
        Steps of an existing session to do again.
    plan : bool
        Only show the procedure and its expected accuracy.
    language : str or None
        Language of the operator; None: that of the system.
    """

    folder: Path
    port: str | None = None
    profile: str | None = None
    calibration: Path | None = None
    site: Path | None = None
    procedure: str | None = None
    hands_free: bool = False
    accept: bool = False
    rehearse: bool = False
    keys: bool = False
    web: str | None = None
    mistakes: str = ""
    speed: str = "1"
    pdf: bool = False
    bench: Path | None = None
    operator: str | None = None
    unit: str | None = None
    received: date | None = None
    redo: Sequence[str] = ()
    plan: bool = False
    language: str | None = None

    @property
    def is_rehearsal(self) -> bool:
        """Whether the session has a simulated unit, now or when it began."""
        return self.rehearse or is_rehearsal(self.folder)

    @property
    def has_operator(self) -> bool:
        """Whether an operator presses keys."""
        if self.hands_free:
            return False
        return not self.is_rehearsal or self.keys or self.web is not None

    def say(self, console: Console, what: Message) -> None:
        """Print a message in the language of the operator."""
        console.print(text(what, language(self.language)), markup=False, highlight=False, soft_wrap=True)


def new_folder() -> Path:
    """Return the default folder of a new session, named by the time."""
    return Path(f"session-{datetime.now(UTC):%Y%m%dT%H%M%SZ}")


def run(options: RunOptions, console: Console) -> int:
    """Conduct a new or an existing session, or show what a new one would be.

    Parameters
    ----------
    options : RunOptions
        Options of the command.
    console : Console
        The operator's terminal.

    Returns
    -------
    int
        Exit code: 0 at the session's end; 130 when it can be resumed; 3 when nobody was there to accept the
        result.

    Raises
    ------
    InputError
        An option is invalid, or the session cannot be resumed; the message says why.
    """
    if options.plan:
        console.print(_plan_text(options), markup=False, highlight=False, soft_wrap=True)
        return OK
    with closing(open_or_create(options, console)) as session:
        if options.web is None:
            return conduct(session, options, console)
        with closing(WebConsole(session, options.web, language(options.language))) as web:
            options.say(console, message("web_address", url=web.url))
            code = conduct(session, options, console, web)
            if web.viewers:
                options.say(console, message("web_stays"))
                with suppress(KeyboardInterrupt):
                    while web.viewers:
                        time.sleep(_LINGER_S)
            return code


def open_or_create(options: RunOptions, console: Console) -> Session:
    """Resume the session of the options, or create it; see `run`."""
    exists = (options.folder / JOURNAL).exists()
    _check(options, exists)
    if not exists:
        return _create(options, console)
    session = Session.open(options.folder)
    try:
        _require_resumable(session, options)
        resume(
            session,
            console,
            options.redo,
            language(options.language),
            _ask if options.has_operator and Keyboard().there else None,
        )
    except BaseException:
        session.close()
        raise
    return session


def conduct(session: Session, options: RunOptions, console: Console, web: WebConsole | None = None) -> int:
    """Conduct an open session: the service runs in this thread, the controller in another; see `run`."""
    begun_with = session.plan
    simulated = None
    if options.is_rehearsal:
        simulated = SimulatedUnitProcess(
            session.folder, options.speed, options.mistakes, is_live=options.has_operator
        )
    queue = QueueSink(QUEUE_LIMIT if simulated is not None and simulated.waits else None)
    profile = session.profile()
    layout = profiles.load(profile).layout()
    settings = Settings(
        port=options.port or (begun_with.port if simulated is None else simulated.port),
        profile=profile,
        calibration=str(session.folder / WORKING_CERTIFICATE),
        unit=begun_with.unit,
        status=str(default_folder() / f"imu50-calib-{os.getpid()}.sock"),
    )
    signals = SignalFlags()
    service = Service(
        settings,
        lambda text: queue.put_message(text.partition(" ")[2]),
        [queue],
        in_real_time=simulated is None,
        history=History(counter_step=layout.counter_step),
        signals=signals,
    )

    def begin(steps: Procedure) -> None:
        if simulated is not None:
            simulated.begin(steps, profile)
            deadline_s = time.monotonic() + _CONNECT_S
            while service.port_state.trouble and time.monotonic() < deadline_s and not queue.is_closed:
                time.sleep(_POLL_S)  # a rehearsal does not begin with a cable to be checked

    controller = SessionController(
        session,
        layout,
        service,
        queue,
        OperatorScreen(console, language(options.language)),
        Keyboard(),
        hands_free=not options.has_operator,
        accepts=options.accept or (options.is_rehearsal and not options.has_operator),
        begin=begin,
        watch=(lambda _: None) if simulated is None else simulated.watch,
        web=web,
    )
    worker = Thread(target=controller.run, name="controller")
    # From here on: an interrupt while compiled code is loaded could be lost or leave a lock behind.
    with signals.caught(SIGINT, SIGTERM, SIGHUP):
        worker.start()
        try:
            service.run()
        finally:
            queue.close()
            worker.join()
            if simulated is not None:
                simulated.end()
            if not controller.outcome:
                _show_end(_unfinished(session), options, console, web)
    if controller.error is not None:
        raise controller.error
    if not controller.outcome:
        return NOT_GOOD if controller.is_undecided else INTERRUPTED
    _show_end(controller.outcome, options, console, web)
    for name in REPORTS.values():
        if options.pdf and name in session.files:
            report = session.folder / name
            write_pdf(report, report.with_suffix(".pdf"))
            options.say(console, message("report", path=str(report.with_suffix(".pdf"))))
    result = session.folder / RESULT
    if simulated is not None and RESULT in session.files:
        against = _against_truth(
            session, read_calibration(result), simulated.truth(layout, session.procedure().kind)
        )
        console.print(as_text(against), markup=False, highlight=False, soft_wrap=True)
    return OK


def _unfinished(session: Session) -> tuple[Message, ...]:
    steps = message("accepted_steps", steps=steps_message(session))
    return (*accepted_result(session), steps, message("resume_with", folder=str(session.folder)))


def _show_end(
    lines: Sequence[Message], options: RunOptions, console: Console, web: WebConsole | None
) -> None:
    for line in lines:
        options.say(console, line)
    if web is not None:
        web.end(lines)


def _against_truth(session: Session, found: Calibration, true: Calibration) -> Document:
    """Return the comparison of a result with the simulated unit."""
    name = "the simulated unit"
    if session.procedure().runs:
        return comparison(lever_arms_of(found, RESULT), lever_arms_of(true, name), name)
    return calibration_comparison(found, true, name)


def _ask() -> bool:
    with Keyboard() as keys:
        return keys.wait_for_answer()


def _check(options: RunOptions, exists: bool) -> None:
    """Refuse options that do not fit together."""
    folder = options.folder
    if options.has_operator and options.web is None and not Keyboard().there:
        raise InputError("expected a terminal for the operator's keys, got none; use one, or --hands-free")
    if options.is_rehearsal and (options.port or options.calibration or options.site):
        raise InputError("--rehearse: expected no --port, --calibration or --site; it has a unit of its own")
    if (options.keys or options.mistakes) and not options.is_rehearsal:
        raise InputError("--keys, --mistakes: expected with --rehearse")
    if options.mistakes:
        mistakes_of(options.mistakes, plan.load(options.procedure or PROCEDURE), np.random.default_rng())
    if exists and options.rehearse and not is_rehearsal(folder):
        raise InputError(f"{folder}: --rehearse: expected a rehearsal to resume, got the session of a unit")
    if options.pdf:
        renderer()
    if options.redo and not exists:
        raise InputError(f"--redo: expected an existing session, with --session, got none in {folder}")


def _plan_text(options: RunOptions) -> str:
    """Return the plan of a new session."""
    if options.site is None and not options.rehearse:
        raise InputError("--plan: expected --site, for the latitude, or --rehearse")
    site = BENCH if options.site is None else settings_file.read(options.site, Site)
    procedure = plan.load(options.procedure or PROCEDURE)
    if procedure.kind == "arms":
        return plan.text(procedure, site)
    text = sensors_plan.text(procedure, site)
    if procedure.kind == "noise":
        longest_s = max(rest.rest_s for rest in procedure.rests) / PART
        text += f"\naveraging times up to {longest_s:g} s, if the rest is not disturbed"
    return text


def _create(options: RunOptions, console: Console) -> Session:
    """Create a session, and print the expected accuracy of its procedure."""
    folder, name = options.folder, options.procedure or PROCEDURE
    procedure = plan.load_file(name)
    port, calibration, site, profile = options.port, options.calibration, options.site, options.profile
    if options.is_rehearsal:
        profile = profile or REHEARSAL_PROFILE
    incomplete = InputError("a new session: expected --port, --profile, --calibration and --site")
    if profile is None:
        raise incomplete
    layout = require_six_axes(profiles.load(profile).layout())
    if options.is_rehearsal:
        port, calibration, site = SimulatedUnitProcess(folder, options.speed).make(
            layout, procedure.model.kind
        )
    if port is None or calibration is None or site is None:
        raise incomplete
    before = read_calibration(calibration) if calibration.exists() or procedure.model.runs else None
    if before is not None:
        require_sensors(coefficients(before), layout)
    place = settings_file.read_file(site, Site)
    bench_path = _bench_path(options)
    bench = None if bench_path is None else settings_file.read_file(bench_path, Bench)
    known = before.serial_number if before else REHEARSED_UNIT if options.is_rehearsal else None
    unit, operator = _unit_and_operator(options, console, known, bench)
    options.say(console, _expected(procedure.model, place.model, folder))
    return Session.create(
        folder,
        procedure=EmbeddedFile.of(name, procedure.content),
        calibration=calibration,
        site=EmbeddedFile.of(site, place.content),
        profile=profile,
        port=port,
        bench=None if bench is None else EmbeddedFile.of(str(bench_path), bench.content),
        operator=operator,
        received=options.received.isoformat() if options.received else "",
        unit=unit,
    )


def _expected(procedure: Procedure, site: Site, folder: Path) -> Message:
    """Return how long a session takes, and its expected accuracy."""
    minutes, steps = plan.duration_s(procedure) / 60.0, len(procedure.steps)
    if not procedure.runs:
        return message("expected_rests", folder=str(folder), minutes=minutes, rests=steps)
    worst_mm = float(plan.predicted(procedure, site).differences_sigma.max()) / MM
    return message("expected", folder=str(folder), minutes=minutes, worst_mm=worst_mm)


def _bench_path(options: RunOptions) -> Path | None:
    """Return the bench file, if there is one."""
    if options.bench is not None:
        return options.bench
    default = config_file(BENCH_FILE)
    return default if default is not None and default.is_file() else None


def _unit_and_operator(
    options: RunOptions, console: Console, unit: str | None, bench: settings_file.SettingsFile[Bench] | None
) -> tuple[str | None, str]:
    """Return unit and operator; refuse another unit than the certificate's; ask for what is not given."""
    asks = options.has_operator and not options.is_rehearsal and Keyboard().there
    serial, operator = options.unit, options.operator
    if serial is None and asks:
        options.say(console, message("ask_unit"))
        serial = console.input().strip()  # a scanner types, too
    if serial is not None and unit is not None and serial != unit:
        raise InputError(f"expected unit {unit!r} of the certificate, got {serial!r}; connect that unit")
    if operator is None and asks:
        options.say(console, message("ask_operator"))
        operator = console.input().strip()
    return unit or serial, operator or ("" if bench is None else bench.model.operator)


def _require_resumable(session: Session, options: RunOptions) -> None:
    """Refuse a session that is over, damaged, or began with other files."""
    if session.is_over:
        raise InputError(f"{session.folder}: the session is over, see {REPORT} in it; name another folder")
    check_files(session)
    procedure, site = options.procedure, options.site
    require_same(
        session,
        procedure=EmbeddedFile.of(procedure, plan.load_file(procedure).content) if procedure else None,
        calibration=options.calibration,
        site=EmbeddedFile.of(site, settings_file.read_file(site, Site).content) if site else None,
        profile=options.profile or session.profile(),
    )
