"""Entries of the journal: one dataclass per event; their JSON form is checked as a settings file is.

Events of the procedure's engine are journaled as they are, an accepted step with its recording.
"""

from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, TypeAlias, get_args, get_type_hints

from pydantic import AfterValidator, AwareDatetime, TypeAdapter, create_model
from pydantic import Field as Key

from calib.messages import Message, message, verbatim
from calib.procedure.events import (
    Aborted,
    Accepted,
    Checked,
    Entered,
    Event,
    Finished,
    Redone,
    Rejected,
    RestAccepted,
    Restarted,
    Rested,
    Skipped,
    Turned,
)
from imudrv.calibration import Base64Of32Bytes, Base64Of64Bytes, SerialNumber
from imudrv.errors import FaultyFileError
from imudrv.files import settings_file
from imudrv.files.faults import shown_value
from imudrv.files.model import Model
from imudrv.units import MM

MAX_COUNTER: Final = 1 << 53
"""Largest counter: exact in every JSON reader, and 285 000 years at 1 kHz."""


def printable(text: str) -> str:
    """Return the text; raise `ValueError` if it is not printable."""
    if not text.isprintable():
        raise ValueError(f"expected printable text, got {text[:60]!r}")
    return text


def _file_name(text: str) -> str:
    if not text.isprintable() or "/" in text or text in ("", ".", ".."):
        raise ValueError(f"expected the name of a file in the session's folder, got {text[:60]!r}")
    return text


def _absolute(path: Path) -> Path:
    if not path.is_absolute() or not str(path).isprintable():
        raise ValueError(f"expected an absolute path of printable text, got {str(path)[:60]!r}")
    return path


Counter = Annotated[int, Key(ge=-1, le=MAX_COUNTER)]
"""Counter of a sample; -1: before the first."""
Count = Annotated[int, Key(ge=0, le=MAX_COUNTER)]
Digest = Annotated[str, Key(pattern=r"^[0-9a-f]{64}$")]
"""SHA-256, hexadecimal."""
Line = Annotated[str, Key(max_length=4096), AfterValidator(printable)]
"""Text that is printed in messages."""
Date = Annotated[str, Key(pattern=r"^(\d{4}-\d{2}-\d{2})?$")]
"""Such as 2026-11-26, or empty."""
FileName = Annotated[str, Key(max_length=255), AfterValidator(_file_name)]
"""Name of a file in the session's folder; no path."""
AbsolutePath = Annotated[Path, AfterValidator(_absolute)]


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

    name: Line
    text: str
    sha256: Digest

    @classmethod
    def of(cls, name: str | Path, content: bytes) -> Self:
        """Return a file with the hash of its content."""
        return cls(str(name), content.decode(), sha256(content).hexdigest())


@dataclass(frozen=True)
class CertificateFile:
    """The unit's active certificate: its path, and its SHA-256 when the session began, None without one."""

    path: AbsolutePath
    sha256: Digest | None


def _undamaged(file: EmbeddedFile) -> EmbeddedFile:
    found = sha256(file.text.encode()).hexdigest()
    if found != file.sha256:
        raise ValueError(f"expected text of the SHA-256 {file.sha256[:12]}..., got {found[:12]}...")
    return file


UndamagedFile = Annotated[EmbeddedFile, AfterValidator(_undamaged)]


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
    bench : EmbeddedFile or None
        Who calibrates, where and with what; None if there is no such file, and in older journals.
    operator : str
        Who conducts the session; empty if unknown.
    received : str
        Date on which the unit was received; empty if unknown.
    host : str
        Name of the computer; empty in older journals.
    """

    format: Literal["imu50-session"]
    version: Literal[1]
    software: Line
    unit: SerialNumber
    port: Line
    certificate: CertificateFile
    procedure: UndamagedFile
    site: UndamagedFile
    profile: UndamagedFile
    bench: UndamagedFile | None = None
    operator: Line = ""
    received: Date = ""
    host: Line = ""


@dataclass(frozen=True)
class FileRecorded:
    """A complete file of the session; `left` if it belongs to an attempt that a kill or power cut ended."""

    name: FileName
    bytes: Count
    sha256_of_file: Digest
    left: bool = False


@dataclass(frozen=True, kw_only=True)
class AcceptedStep(Accepted):
    """An accepted attempt whose files are recorded; temperatures in degrees Celsius by channel."""

    recording: FileName
    temperature_degc: Mapping[Line, float | None]

    def __post_init__(self) -> None:
        """Refuse counters in the wrong order, and more samples than they span."""
        first, last = self.first_counter, self.last_counter
        span = last - first + 1
        if span < 1:
            raise ValueError(f"last_counter: expected at least first_counter, {first}, got {last}")
        if self.samples is not None and self.samples > span:
            raise ValueError(f"samples: expected at most the {span} of the counters, got {self.samples}")


@dataclass(frozen=True, kw_only=True)
class AcceptedRest(RestAccepted):
    """An accepted rest; its recording goes on, and is closed and recorded later."""

    recording: FileName

    def __post_init__(self) -> None:
        """Refuse counters in the wrong order, and another number of samples than they span allows."""
        span = self.last_counter - self.first_counter + 1
        if span < 1:
            raise ValueError(f"last_counter: expected at least {self.first_counter}, got {self.last_counter}")
        if self.samples is None or self.samples > span:
            raise ValueError(f"samples: expected at most the {span} of the counters, got {self.samples}")


@dataclass(frozen=True)
class ServiceMessage:
    """A message of the driver service."""

    text: str


@dataclass(frozen=True)
class UnitDetected:
    """First data from the unit in this process; `restarted` if its counter is behind the journal's."""

    counter: Counter
    restarted: bool
    temperature_degc: Mapping[Line, float | None]


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

    @property
    def message(self) -> Message:
        """Phrase for the operator."""
        return message(
            "residual_velocity", without_mm_s=self.without / MM, compensated_mm_s=self.compensated / MM
        )


@dataclass(frozen=True)
class SessionEnded:
    """The session is complete; the velocity is None if the verification was skipped."""

    velocity_left_m_s: ResidualVelocity | None


@dataclass(frozen=True)
class Resumed:
    """The session was opened again; `left` names the files of an interrupted attempt."""

    left: tuple[FileName, ...]


@dataclass(frozen=True)
class LineDropped:
    """A partial last line was dropped from the journal."""

    bytes: Count
    sha256_of_dropped: Digest


@dataclass(frozen=True)
class Signed:
    """Signature of the journal up to the line before; see `calib.bench.journal`."""

    public_key: Base64Of32Bytes
    ed25519: Base64Of64Bytes


Counted: TypeAlias = (
    Entered
    | Checked
    | Restarted
    | Turned
    | Rested
    | Rejected
    | Skipped
    | Redone
    | Finished
    | Aborted
    | UnitDetected
)
"""Entries with the counter of the newest sample."""


Entry: TypeAlias = (
    Counted
    | Plan
    | FileRecorded
    | AcceptedStep
    | AcceptedRest
    | ServiceMessage
    | Decision
    | SessionEnded
    | Resumed
    | LineDropped
    | Signed
)


_SPECIAL_NAMES: Final[Mapping[type[Entry], str]] = {
    FileRecorded: "file",
    AcceptedStep: "accepted",
    AcceptedRest: "rest",
    ServiceMessage: "service",
    UnitDetected: "heard",
    SessionEnded: "end",
    LineDropped: "dropped",
}
"""Event names that are not the lower-case class name."""


_NAMES: Final = {kind: _SPECIAL_NAMES.get(kind, kind.__name__.lower()) for kind in get_args(Entry)}


_KINDS: Final = {name: kind for kind, name in _NAMES.items()}


_OF_ENGINE: Final[Mapping[str, Any]] = {
    "step_id": Annotated[str, Key(max_length=64), AfterValidator(printable)],
    "attempt": Annotated[int, Key(ge=0, le=1_000_000)],
    "counter": Counter,
    "first_counter": Count,
    "last_counter": Count,
    "samples": Annotated[int, Key(ge=1, le=MAX_COUNTER)] | None,
}
"""Limits of fields of the engine's events."""


class _Line(Model):
    """What every line of a journal has; see `calib.bench.journal`."""

    event: str
    at: AwareDatetime | None = None
    before: Digest | Literal[""] = ""
    sha256: Digest | None = None


def to_json(entry: Entry) -> dict[str, Any]:
    """Return an entry as a JSON object; its `event` names the dataclass."""
    event = _NAMES[type(entry)]
    return {"event": event, **_adapter(event).dump_python(entry, mode="json")}


def from_json(line: object, name: str = "journal") -> Entry:
    """Check the JSON object of a line and return its entry.

    Parameters
    ----------
    line : object
        As `to_json` or an older version made it, with or without the keys of the journal.
    name : str
        Name of the line in messages.

    Returns
    -------
    Entry

    Raises
    ------
    FaultyFileError
        The event is unknown, or keys are missing, unknown or invalid; all faults at once.
    """
    if not isinstance(line, dict):
        raise FaultyFileError(name, ["expected a JSON object"])
    event = line.get("event")
    if not isinstance(event, str) or event not in _KINDS:
        known = ", ".join(sorted(_KINDS))
        raise FaultyFileError(
            name,
            [f"event: expected one of {known}, got {shown_value(event)}; is it of a newer version?"],
        )
    if "reason" in line:  # in older journals a restart has one, and reasons are texts
        line = {"reasons": [line["reason"]], **{key: line[key] for key in line if key != "reason"}}
    if isinstance(reasons := line.get("reasons"), list):
        line = {**line, "reasons": [asdict(verbatim(r)) if isinstance(r, str) else r for r in reasons]}
    checked = settings_file.parse(line, _model(event), name)
    kind = _KINDS[event]
    try:
        entry: Entry = kind(**{field.name: getattr(checked, field.name) for field in fields(kind)})
    except ValueError as error:
        raise FaultyFileError(name, [str(error)]) from None
    return entry


@cache
def _adapter(event: str) -> TypeAdapter[Any]:
    return TypeAdapter(_KINDS[event])


@cache
def _model(event: str) -> type[Model]:
    """Return the model of a line with an event."""
    kind = _KINDS[event]
    types = get_type_hints(kind, include_extras=True)
    if issubclass(kind, Event):
        types.update(_OF_ENGINE)
    keys: dict[str, Any] = {
        field.name: (types[field.name], ... if field.default is MISSING else field.default)
        for field in fields(kind)
    }
    return create_model(kind.__name__, __base__=_Line, **keys)
