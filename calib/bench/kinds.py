"""What a session computes, by the kind of its procedure."""

from typing import Any, Protocol

from calib.bench.rest_results import analyse_session, calibrate_session
from calib.bench.result import identify_session
from calib.bench.state import SessionState
from calib.messages import Message
from imudrv.calibration import Calibration


class SessionResult(Protocol):
    """Result of the accepted steps of a session."""

    @property
    def certificate(self) -> Calibration | None:
        """The unit's new certificate; None: there is none."""

    @property
    def verdicts(self) -> tuple[tuple[str, Message], ...]:
        """Marks and reasons."""

    def text(self, language: str) -> str:
        """Return what the operator needs for the decision."""

    @property
    def page(self) -> dict[str, Any]:
        """The same for the page: a ``table`` of texts, and what is drawn."""


def compute(session: SessionState) -> SessionResult:
    """Return the result of the accepted steps of a session, from its recordings."""
    kind = session.procedure().kind
    if kind == "arms":
        return identify_session(session)
    return calibrate_session(session) if kind == "sensors" else analyse_session(session)
