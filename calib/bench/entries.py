"""Entries of the journal: one dataclass per event, and their JSON form.

Events of the procedure's engine are journaled as they are, an accepted step with its recording.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, Literal, Self, TypeAlias, get_args

from pydantic import TypeAdapter, ValidationError

from calib.messages import verbatim
from calib.procedure.events import (
    Aborted,
    Accepted,
    Checked,
    Entered,
    Finished,
    Redone,
    Rejected,
    Restarted,
    Skipped,
    Turned,
)
from imudrv.errors import InputError
from imudrv.units import MM


@dataclass(frozen=True)
class EmbeddedFile:
    """A text file that the plan contains.

    Attributes
    ----------
    name : str
        Name or path as the user gave it.
    text : str
        Content.
    sha256 : str
        SHA-256 of the content, hexadecimal.
    """

    name: str
    text: str
    sha256: str

    @classmethod
    def of(cls, name: str | Path, content: bytes) -> Self:
        """Return a file with the hash of its content."""
        return cls(str(name), content.decode(), sha256(content).hexdigest())


@dataclass(frozen=True)
class CertificateFile:
    """The unit's active certificate: its path, and its SHA-256 when the session began."""

    path: Path
    sha256: str


@dataclass(frozen=True)
class Plan:
    """First entry of every journal.

    Attributes
    ----------
    format, version
        Of the journal.
    software : str
        Version that began the session.
    unit : str
        Serial number.
    port : str
        Port where the unit was connected.
    certificate : CertificateFile
        The unit's active certificate.
    procedure, site, profile : EmbeddedFile
        What is done, where, and the wire format of the unit.
    """

    format: Literal["imu50-session"]
    version: Literal[1]
    software: str
    unit: str
    port: str
    certificate: CertificateFile
    procedure: EmbeddedFile
    site: EmbeddedFile
    profile: EmbeddedFile


@dataclass(frozen=True)
class FileRecorded:
    """A complete file of the session; `left` if it belongs to an attempt that a kill or power cut ended."""

    name: str
    bytes: int
    sha256_of_file: str
    left: bool = False


@dataclass(frozen=True, kw_only=True)
class AcceptedStep(Accepted):
    """An accepted attempt whose files are recorded; temperatures in degrees Celsius by channel."""

    recording: str
    temperature_degc: Mapping[str, float | None]


@dataclass(frozen=True)
class ServiceMessage:
    """A message of the driver service."""

    text: str


@dataclass(frozen=True)
class UnitDetected:
    """First data from the unit in this process; `restarted` if its counter is behind the journal's."""

    counter: int
    restarted: bool
    temperature_degc: Mapping[str, float | None]


@dataclass(frozen=True)
class Decision:
    """The operator has accepted or rejected the result."""

    accepted: bool


@dataclass(frozen=True)
class ResidualVelocity:
    """Horizontal velocity after a rotation, m/s.

    Attributes
    ----------
    without, compensated : float
        Without and with size-effect compensation.
    """

    without: float
    compensated: float

    def __str__(self) -> str:
        """Return a phrase for the operator."""
        return (
            f"residual velocity after half a turn: {self.without / MM:.1f} mm/s without size-effect "
            f"compensation, {self.compensated / MM:.1f} mm/s with it"
        )


@dataclass(frozen=True)
class SessionEnded:
    """The session is complete; the velocity is None if the verification was skipped."""

    velocity_left_m_s: ResidualVelocity | None


@dataclass(frozen=True)
class Resumed:
    """The session was opened again; `left` names the files of an interrupted attempt."""

    left: tuple[str, ...]


@dataclass(frozen=True)
class LineDropped:
    """A partial last line was dropped from the journal."""

    bytes: int
    sha256_of_dropped: str


Counted: TypeAlias = (
    Entered | Checked | Restarted | Turned | Rejected | Skipped | Redone | Finished | Aborted | UnitDetected
)
"""Entries with the counter of the newest sample."""


Entry: TypeAlias = (
    Counted
    | Plan
    | FileRecorded
    | AcceptedStep
    | ServiceMessage
    | Decision
    | SessionEnded
    | Resumed
    | LineDropped
)


_SPECIAL_NAMES: Final[Mapping[type[Entry], str]] = {
    FileRecorded: "file",
    AcceptedStep: "accepted",
    ServiceMessage: "service",
    UnitDetected: "heard",
    SessionEnded: "end",
    LineDropped: "dropped",
}
"""Event names that are not the lower-case class name."""


_NAMES: Final = {kind: _SPECIAL_NAMES.get(kind, kind.__name__.lower()) for kind in get_args(Entry)}


_KINDS: Final = {name: kind for kind, name in _NAMES.items()}


def to_json(entry: Entry) -> dict[str, Any]:
    """Return an entry as a JSON object; its `event` names the dataclass."""
    event = _NAMES[type(entry)]
    return {"event": event, **_adapter(event).dump_python(entry, mode="json")}


def from_json(line: Mapping[str, Any]) -> Entry:
    """Return the entry of a JSON object; keys that its dataclass does not have are ignored.

    Parameters
    ----------
    line : mapping
        As `to_json` or an older version made it.

    Returns
    -------
    Entry

    Raises
    ------
    InputError
        The event is unknown, or a field is missing or invalid.
    """
    event = line.get("event")
    if event not in _KINDS:
        raise InputError(f"unknown event {event!r}; a newer version may have written it")
    if "reason" in line:  # in older journals a restart has one, and reasons are texts
        line = {**line, "reasons": [line["reason"]]}
    if "reasons" in line:
        reasons = [asdict(verbatim(r)) if isinstance(r, str) else r for r in line["reasons"]]
        line = {**line, "reasons": reasons}
    try:
        entry: Entry = _adapter(event).validate_python(line)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise InputError(f"event {event!r}: field {where}: {first['msg']}") from None
    return entry


@cache
def _adapter(event: str) -> TypeAdapter[Any]:
    return TypeAdapter(_KINDS[event])
