"""After the steps: result, the operator's decision, activation of the certificate, and report."""

from collections.abc import Iterator
from typing import Final

from calib.bench.entries import Decision
from calib.bench.journal import journal_dates
from calib.bench.keys import Keyboard
from calib.bench.kinds import SessionResult, compute
from calib.bench.queue_sink import QueueReader
from calib.bench.rest_results import RestsResult
from calib.bench.result import Result
from calib.bench.screen import OperatorScreen
from calib.bench.session import Session
from calib.bench.simulated_unit import is_rehearsal
from calib.bench.state import JOURNAL, REPORT, RESULT
from calib.bench.web_console import WebConsole
from calib.certificate import check_unit_file, write
from calib.lever_arms.gauge import convert
from calib.messages import Message, english, message
from calib.procedure.events import Rejected, Skipped
from calib.reports.certificate import Particulars
from calib.reports.certificate import document as certificate_document
from calib.reports.html import as_html
from imudrv.errors import InputError
from imudrv.files import atomic, settings_file
from imudrv.files.atomic import atomic_write

_MARKS: Final = {
    "good": message("mark_good"),
    "note": message("mark_note"),
    "caution": message("mark_caution"),
    "bad": message("mark_bad"),
}


def session_result(session: Session) -> SessionResult:
    """Return the result of the recordings; its certificate, if there is one, is written once."""
    result = compute(session)
    if RESULT not in session.files and result.certificate is not None:
        path = session.path(RESULT)
        path.unlink(missing_ok=True)  # of a process that was killed before it recorded the file
        write(path, result.certificate, session.key)
        session.record_file(RESULT)
    return result


def decide_alone(result: SessionResult) -> bool:
    """Return whether the verdicts on a result allow to accept it without an operator."""
    return all(mark != "bad" for mark, _ in result.verdicts)


def ask_operator(
    result: SessionResult,
    unit: str,
    screen: OperatorScreen,
    keys: Keyboard,
    web: WebConsole | None,
    queue: QueueReader,
) -> bool:
    """Ask the operator whether to accept the result.

    Parameters
    ----------
    result : SessionResult
        The result.
    unit : str
        Serial number.
    screen, keys
        The operator's terminal.
    web : WebConsole or None
        The operator's page.
    queue : QueueReader
        Emptied meanwhile; its samples are not needed.

    Returns
    -------
    bool
        The answer.

    Raises
    ------
    ServiceEndedError
        The service has ended before the answer.
    """
    screen.say(message("accept", unit=unit))
    while not screen.is_idle:
        queue.take()
    keys.read()  # keys pressed before the question are no answer to it
    if web is not None:
        web.ask(result)
    while (answer := keys.answer()) is None and (web is None or (answer := web.answer()) is None):
        queue.take()
    if web is not None:
        web.decided()
    return answer


def summarise(result: SessionResult, screen: OperatorScreen) -> None:
    """Print what the operator needs for the decision."""
    screen.print(result.text)
    for mark, text in result.verdicts:
        screen.say(message("mark", mark=_MARKS[mark], text=text))


def activate(session: Session) -> None:
    """Make the result the active certificate, unless it is already.

    Parameters
    ----------
    session : Session
        The session, with a result.

    Raises
    ------
    InputError
        The active certificate is neither the initial one nor the result, or that of another unit.
    """
    active = session.plan.certificate
    digest = atomic.sha256(active.path) if active.path.exists() else None
    if digest == active.sha256:
        check_unit_file(active.path, session.plan.unit)
        settings_file.replace(active.path, atomic.content(session.path(RESULT)))
    elif digest != session.files[RESULT]:
        raise InputError(
            f"{active.path}: expected the certificate that the session began with, it was changed meanwhile; "
            f"it is kept as it is, the result is in {session.folder / RESULT}"
        )


def accepted_result(session: Session) -> tuple[Message, ...]:
    """Return where the active certificate and the report are; empty if no result is accepted."""
    decision = session.stage(Decision)
    if decision is None or not decision.accepted:
        return ()
    return (
        message("active_certificate", path=str(session.plan.certificate.path)),
        message("report", path=str(session.folder / REPORT)),
    )


def write_report(session: Session, result: SessionResult, verified: Message | None = None) -> None:
    """Write the report and record its hash.

    Parameters
    ----------
    session : Session
        The session.
    result : SessionResult
        Its result.
    verified : Message, optional
        Outcome of the verification of arms; None: it is not done yet.
    """
    watermark = "SIMULATED" if is_rehearsal(session.folder) else ""
    if isinstance(result, Result):
        page = _page_of_arms(session, result, verified, watermark)
    elif isinstance(result, RestsResult):
        page = as_html(result.document, watermark=watermark)
    else:
        raise TypeError(f"expected a result of a session, got {type(result).__name__}")
    with atomic_write(session.path(REPORT)) as file:
        file.write(page.encode())
    session.record_file(REPORT)


def _page_of_arms(session: Session, result: Result, verified: Message | None, watermark: str) -> str:
    """Return the calibration certificate of the arms."""
    verified = message("verification_due") if verified is None else verified
    arms, identification = result.identification.arms, result.identification
    plan = session.plan
    dates = journal_dates(session.folder / JOURNAL)
    particulars = Particulars(
        number=f"{plan.unit}-{identification.created:%Y%m%d}-{session.files[RESULT][:8]}",
        bench=session.bench(),
        operator=plan.operator or session.bench().operator,
        procedure=f"{session.procedure().name}, SHA-256 {plan.procedure.sha256[:16]}, {plan.software}",
        measured=" to ".join(dict.fromkeys(dates)),
        attempts=tuple(_deviations(session)),
        verified=verified,
        is_simulated=bool(watermark),
    )
    return as_html(
        certificate_document(identification, (arms, convert(arms, "x")), particulars),
        number=particulars.number,
        watermark=watermark,
    )


def _deviations(session: Session) -> Iterator[tuple[str, str]]:
    """Return rejected attempts and skipped steps, and why."""
    for entry in session.entries:
        if isinstance(entry, Rejected):
            why = "; ".join(map(english, entry.reasons))
            yield f"rejected: {entry.step_id}, attempt {entry.attempt}", why
        elif isinstance(entry, Skipped):
            yield f"skipped: {entry.step_id}", "by the operator"
