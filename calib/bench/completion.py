"""After the steps: result, the operator's decision, activation of the certificate, and report."""

from collections.abc import Iterator

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
from calib.bench.state import JOURNAL, REPORTS, RESULT
from calib.bench.web_console import WebConsole
from calib.certificate import check_unit_file, write
from calib.lever_arms.gauge import convert
from calib.messages import Message, message, text
from calib.procedure.events import Rejected, Skipped
from calib.reports.certificate import Particulars
from calib.reports.certificate import documents as certificate_documents
from calib.reports.document import MARK_NAMES
from calib.reports.html import as_html
from imudrv.errors import InputError
from imudrv.files import atomic, settings_file
from imudrv.files.atomic import atomic_write


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
    screen.print(result.text(screen.language))
    for mark, why in result.verdicts:
        screen.say(message("mark", mark=MARK_NAMES[mark], text=why))


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
    report = message("report", path=str(session.folder / REPORTS["en"]))
    if session.procedure().kind == "arms":  # in each language
        report = message("report_written", folder=str(session.folder))
    return message("active_certificate", path=str(session.plan.certificate.path)), report


def write_report(session: Session, result: SessionResult, verified: Message | None = None) -> None:
    """Write the report, that of arms in each language, and record the hashes.

    Parameters
    ----------
    session : Session
        The session.
    result : SessionResult
        Its result.
    verified : Message, optional
        Outcome of the verification of arms; None: it is not done yet.
    """
    if isinstance(result, Result):
        pages = _pages_of_arms(session, result, verified)
    elif isinstance(result, RestsResult):
        pages = {"en": as_html(result.document, watermark=_watermark(session, "en"))}
    else:
        raise TypeError(f"expected a result of a session, got {type(result).__name__}")
    for language, page in pages.items():
        name = REPORTS[language]
        with atomic_write(session.path(name)) as file:
            file.write(page.encode())
        session.record_file(name)


def _pages_of_arms(session: Session, result: Result, verified: Message | None) -> dict[str, str]:
    """Return the calibration certificate of the arms, by language."""
    verified = message("verification_due") if verified is None else verified
    arms, identification = result.identification.arms, result.identification
    plan = session.plan
    particulars = Particulars(
        number=f"{plan.unit}-{identification.created:%Y%m%d}-{session.files[RESULT][:8]}",
        bench=session.bench(),
        operator=plan.operator or session.bench().operator,
        received=plan.received,
        procedure=message(
            "procedure_edition",
            name=session.procedure().name,
            edition=plan.procedure.sha256[:16],
            software=plan.software,
        ),
        measured=journal_dates(session.folder / JOURNAL),
        attempts=tuple(_deviations(session)),
        verified=verified,
    )
    documents = certificate_documents(identification, (arms, convert(arms, "x")), particulars)
    return {
        language: as_html(
            document,
            number=particulars.number,
            watermark=_watermark(session, language),
            language=language,
        )
        for language, document in documents.items()
    }


def _watermark(session: Session, language: str) -> str:
    return text(message("certificate_simulated"), language) if is_rehearsal(session.folder) else ""


def _deviations(session: Session) -> Iterator[tuple[Message, Message]]:
    """Return rejected attempts and skipped steps, and why."""
    for entry in session.entries:
        if isinstance(entry, Rejected):
            why = message("reasons", reasons=tuple(entry.reasons))
            yield message("attempt_rejected", step=entry.step_id, attempt=entry.attempt), why
        elif isinstance(entry, Skipped):
            yield message("step_skipped", step=entry.step_id), message("by_the_operator")
