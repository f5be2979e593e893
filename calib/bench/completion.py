"""After the steps: result, the operator's decision, activation of the certificate, and report."""

from calib.bench.entries import ResidualVelocity
from calib.bench.keys import Keyboard
from calib.bench.queue_sink import QueueReader
from calib.bench.result import Result, identify_session
from calib.bench.screen import OperatorScreen
from calib.bench.session import Session
from calib.bench.state import REPORT, RESULT
from calib.certificate import check_target, write
from calib.lever_arms.gauge import convert
from calib.reports.identification import arms_text, report_html
from calib.reports.verdict import verdict
from imudrv.calibration import Calibration, read_calibration
from imudrv.errors import InputError
from imudrv.files import atomic, settings_file
from imudrv.files.atomic import atomic_write


def session_result(session: Session) -> Result:
    """Return the result of the recordings; its certificate is written once and then read back."""
    result = identify_session(session)
    path = session.path(RESULT)
    if RESULT in session.files:
        return result._replace(certificate=read_calibration(path))
    path.unlink(missing_ok=True)  # of a process that was killed before it recorded the file
    write(path, result.certificate, session.key)
    session.record_file(RESULT)
    return result


def decide_alone(result: Result) -> bool:
    """Return whether the verdicts on a result allow to accept it without an operator."""
    return all(mark != "bad" for mark, _ in verdict(result.identification))


def ask_operator(unit: str, screen: OperatorScreen, keys: Keyboard, queue: QueueReader) -> bool:
    """Ask the operator whether to accept the result.

    Parameters
    ----------
    unit : str
        Serial number.
    screen, keys
        The operator's terminal.
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
    screen.print(f"Accept it as the certificate of unit {unit}? [y/n]")
    while not screen.is_idle:
        queue.take()
    keys.read()  # keys pressed before the question are no answer to it
    while True:
        queue.take()
        for key in keys.read():
            if key in "yn":
                return key == "y"


def summary(result: Result) -> str:
    """Return the text on which the operator decides."""
    verdicts = [f"{mark}: {text}" for mark, text in verdict(result.identification)]
    return "\n".join([arms_text(result.identification.arms), *verdicts])


def activate(session: Session, certificate: Calibration) -> None:
    """Make the result the active certificate, unless it is already.

    Parameters
    ----------
    session : Session
        The session.
    certificate : Calibration
        Its result.

    Raises
    ------
    InputError
        The active certificate is neither the initial one nor the result, or that of another unit.
    """
    active = session.plan.certificate
    digest = atomic.sha256(active.path)
    if digest == active.sha256:
        check_target(active.path, certificate)
        settings_file.replace(active.path, atomic.content(session.path(RESULT)))
    elif digest != session.files[RESULT]:
        raise InputError(
            f"{active.path}: expected the certificate that the session began with, it was changed meanwhile; "
            f"it is kept as it is, the result is in {session.folder / RESULT}"
        )


def write_report(session: Session, result: Result, residual: ResidualVelocity | None) -> None:
    """Write the report, with the verification after the result, and record its hash."""
    arms = result.identification.arms
    html = report_html(result.identification, (arms, convert(arms, "x")))
    text = "The verification was skipped."
    if residual is not None:
        text = f"One more rotation with the new certificate: {residual}."
    section = f"<section>\n<h2>Verification</h2>\n<p>{text}</p>\n</section>"
    with atomic_write(session.path(REPORT)) as file:
        file.write(html.replace("</section>", f"</section>\n{section}", 1).encode())
    session.record_file(REPORT)
