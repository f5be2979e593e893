"""Conditions for resuming a session, and the operator's consent."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Console

from calib.bench.entries import AcceptedStep, EmbeddedFile, Plan, Resumed
from calib.bench.recordings import uncovered_steps
from calib.bench.session import Session
from calib.bench.state import REPORTS, RESULT
from calib.bench.verify import faulty_files
from calib.messages import Message, message, text
from calib.procedure.events import Redone
from imudrv import profiles
from imudrv.calibration import read_calibration_file
from imudrv.errors import InputError

RESUME_KELVIN: Final = 5.0
"""Largest difference of a temperature from its mean over the accepted runs when a session is resumed, K."""


def check_files(session: Session) -> None:
    """Raise `InputError` if a file of the session is missing or damaged."""
    others = session.files.keys() - set(REPORTS.values())  # a report is written anew
    if faults := faulty_files(session, others):
        raise InputError("\n  ".join([f"{session.folder}: cannot be resumed:", *faults]))


def require_same(
    session: Session,
    *,
    procedure: EmbeddedFile | None = None,
    calibration: Path | None = None,
    site: EmbeddedFile | None = None,
    profile: str | None = None,
) -> None:
    """Refuse to resume a session with other files than it began with.

    Parameters
    ----------
    session : Session
        The session.
    procedure, calibration, site, profile
        Files given now; None: the session's own.

    Raises
    ------
    InputError
        At least one differs; the message lists all that differ.
    """
    plan, differ = session.plan, []
    active = calibration or plan.certificate.path
    now = read_calibration_file(active) if active.exists() or plan.certificate.sha256 else None
    if now is None:
        pass  # there was none, and there is none yet
    elif now.model.serial_number != plan.unit:
        differ.append(f"unit: expected {plan.unit!r}, got {now.model.serial_number!r} ({active})")
    elif now.sha256 not in (plan.certificate.sha256, session.files.get(RESULT)):
        differ.append(
            f"certificate: expected the one that the session began with ({_began(plan)}), got another of the "
            f"same unit ({active}, {now.sha256[:12]})"
        )
    given = [
        ("procedure", procedure, plan.procedure),
        ("site", site, plan.site),
        ("profile", profile and EmbeddedFile.of(profile, profiles.content(profile)), plan.profile),
    ]
    differ += [
        f"{name}: expected {began.name} unchanged, got {file.name} with other contents"
        for name, file, began in given
        if file and file.sha256 != began.sha256
    ]
    if differ:
        raise InputError(
            "\n  ".join(
                [
                    f"{session.folder}: cannot be resumed:",
                    *differ,
                    "use the files that the session began with, or begin another session",
                ]
            )
        )


def _began(plan: Plan) -> str:
    return "none" if plan.certificate.sha256 is None else plan.certificate.sha256[:12]


def steps_message(session: Session) -> Message:
    """Return the accepted steps of a session."""
    accepted = tuple(session.accepted)
    return message("steps", ids=accepted) if accepted else message("none")


def require_temperature(session: Session, degc: Mapping[str, float | None]) -> None:
    """Refuse to resume a session at another temperature than that of the accepted runs.

    Parameters
    ----------
    session : Session
        The session.
    degc : mapping
        Temperature now by channel, degrees Celsius; None if unknown.

    Raises
    ------
    InputError
        One differs by more than `RESUME_KELVIN`.
    """
    for name, now in degc.items():
        accepted = [a for a in session.accepted.values() if isinstance(a, AcceptedStep)]
        known = [t for a in accepted if (t := a.temperature_degc.get(name)) is not None]
        if now is None or not known:
            continue
        mean = float(np.mean(known))
        if abs(now - mean) > RESUME_KELVIN:
            raise InputError(
                f"{session.folder}: cannot be resumed now: {name}: expected {mean:.1f} degC within "
                f"{RESUME_KELVIN:g} K, as in the accepted runs, got {now:.1f}; wait until the unit has that "
                "temperature, or begin another session"
            )


def resume(
    session: Session, console: Console, redo: Sequence[str], language: str, ask: Callable[[], bool] | None
) -> None:
    """Report the progress of a session, ask whether to resume it, and withdraw the steps to be done again.

    Parameters
    ----------
    session : Session
        The session.
    console : Console
        Terminal of the operator.
    redo : sequence of str
        Steps to be done again.
    language : str
        Language of the operator.
    ask : callable or None
        Waits for the operator's answer; None: the session is resumed at once.

    Raises
    ------
    InputError
        The operator declines, or a step does not exist.
    """
    plan, lines = session.plan, [session.dropped] if session.dropped else []
    state = message("resume_state", folder=str(session.folder), unit=plan.unit, steps=steps_message(session))
    port = message("resume_port", port=plan.port, certificate=str(plan.certificate.path))
    lines += [text(state, language), text(port, language)]
    console.print("\n".join(lines), markup=False, soft_wrap=True)
    if ask is not None:
        console.print(text(message("resume"), language), markup=False)
        if not ask():
            raise InputError(
                f"{session.folder}: not resumed and not changed; name another folder to begin anew"
            )
    session.redo(redo)
    left = session.record_leftovers()
    session.append(Resumed(left))
    for name in left:
        for step_id, why in uncovered_steps(session, name):
            lost = message("rest_lost", step=step_id, why=why)
            console.print(text(lost, language), markup=False, soft_wrap=True)
            session.append(Redone(step_id, session.next_attempt(step_id), -1))
