"""Operator's console in a browser: one more screen on the engine's view, and one more keyboard."""

import json
import os
import re
import secrets
from collections.abc import Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Final

from calib.bench.keys import QUESTIONS, action_of
from calib.bench.kinds import SessionResult
from calib.bench.screen import PHASES, large_text, shown_last_try, shown_reasons, tone
from calib.bench.session import Session
from calib.bench.simulated_unit import is_rehearsal
from calib.bench.state import REPORTS, WEB_TOKEN
from calib.messages import LANGUAGES, Message, text
from calib.procedure.events import Action, View
from calib.procedure.plan import all_steps
from imudrv.messages import page_labels
from imudrv.web.server import PageServer

ADDRESS: Final = "127.0.0.1:8650"
"""Default address: this machine only."""

PERIOD_S: Final = 0.05
"""Interval of the frames, s."""

TOKEN_BYTES: Final = 16
TOKEN: Final = re.compile(r"[A-Za-z0-9_-]{22}")
"""Form of a token of so many bytes."""


class WebConsole:
    """The page of a session.

    Parameters
    ----------
    session : Session
        The session.
    address : str
        See `PageServer`.
    language : str
        Language at first.

    Attributes
    ----------
    url : str
        Address for the browser, with the token of the session, which stays the same when it is resumed.
    """

    def __init__(self, session: Session, address: str, language: str) -> None:
        self._session = session
        self._actions: SimpleQueue[dict[str, Any]] = SimpleQueue()
        self._server = PageServer(
            resources.files(__package__).joinpath("page"),
            address,
            _token(session.folder / WEB_TOKEN),
            self._actions.put,
            {name: partial(_report, session, name) for name in REPORTS.values()},
        )
        self.url = self._server.url
        procedure = session.procedure()
        steps = [
            {"id": step.id, "up": step.up, "wanted": step.C_bn.T.tolist()} for step in all_steps(procedure)
        ]
        self._keep(
            "hello",
            {
                "unit": session.plan.unit,
                "simulated": is_rehearsal(session.folder),
                "steps": steps,
                "language": language,
                "labels": page_labels("calib.messages"),
                "questions": {name: _texts(question) for name, question in QUESTIONS.items()},
            },
        )

    @property
    def viewers(self) -> int:
        """Number of connected pages."""
        return self._server.viewers

    def show(self, view: View) -> None:
        """Send a view as a frame, if somebody looks."""
        if self._server.viewers:
            self._server.publish(json.dumps(_frame(view)))

    def action(self, view: View) -> Action | None:
        """Return the next action of the pages that is possible in a view, and was meant for its step."""
        while (asked := self._next()) is not None:
            name = asked.get("action")
            if isinstance(name, str) and name in view.actions and asked.get("step") == view.step_id:
                return action_of(name, view)
        return None

    def answer(self) -> bool | None:
        """Return the answer to whether the result is accepted; None: not yet."""
        while (asked := self._next()) is not None:
            if isinstance(accepted := asked.get("accept"), bool):
                return accepted
        return None

    def ask(self, result: SessionResult) -> None:
        """Show the result, and ask whether it is accepted."""
        while self._next() is not None:
            pass  # what was pressed before the question is no answer to it
        verdicts = [(mark, _texts(why)) for mark, why in result.verdicts]
        self._keep("result", {**result.page, "verdicts": verdicts})

    def decided(self) -> None:
        """Take the question away."""
        self._keep("result", {})

    def end(self, outcome: Sequence[Message]) -> None:
        """Show how the session has ended."""
        self._keep("end", {"lines": [_texts(line) for line in outcome], "reports": self._session.reports})

    def close(self) -> None:
        """End the server."""
        self._server.close()

    def _next(self) -> dict[str, Any] | None:
        try:
            return self._actions.get_nowait()
        except Empty:
            return None

    def _keep(self, kind: str, content: dict[str, Any]) -> None:
        self._server.keep(kind, json.dumps({"kind": kind, **content}))


def _report(session: Session, name: str) -> bytes:
    """Return the content of a report; empty until it is written."""
    return (session.folder / name).read_bytes() if name in session.files else b""


def _texts(what: Message) -> dict[str, str]:
    return {language: text(what, language) for language in LANGUAGES}


def _frame(view: View) -> dict[str, Any]:
    """Return a view as the page takes it."""
    return {
        "kind": "view",
        "step": view.step_id,
        "phase": view.phase,
        "phase_name": _texts(PHASES[view.phase]),
        "tone": tone(view),
        "title": _texts(view.title),
        "big": {language: large_text(view, language) for language in LANGUAGES},
        "hints": [_texts(hint) for hint in view.hints],
        "reasons": [_texts(reason) for reason in shown_reasons(view)],
        "last_try": [_texts(reason) for reason in shown_last_try(view)],
        "accepted": view.accepted,
        "skipped": view.skipped,
        "attitude": view.C_nb,
        "force": view.force_m_s2,
        "angle": view.angle_deg,
        "want": view.want_deg,
        "rate": view.rate_deg_per_s,
        "stillness": view.stillness,
        "progress": view.progress,
        "sigmas": (view.level_sigma_deg, view.heading_sigma_deg),
        "actions": view.actions,
        "bells": view.bells,
    }


def _token(path: Path) -> str:
    """Return the token of a session, readable by its owner only."""
    if path.exists() and TOKEN.fullmatch(token := path.read_text(errors="replace").strip()):
        return token
    path.unlink(missing_ok=True)
    token = secrets.token_urlsafe(TOKEN_BYTES)
    with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
        file.write(f"{token}\n")
    return token
