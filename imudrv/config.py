"""The YAML edge: every settings file of ours comes in and goes out here, checked whole.

A file is plain data: mappings, lists, text, numbers, true/false, null. Unquoted values follow the core schema
of YAML 1.2: ``1e-6`` is a number; ``0017``, ``1:30``, ``yes`` and a date are text. Anchors, aliases, tags and
keys given twice are refused.
"""

import difflib
import hashlib
import json
import math
import os
import re
import secrets
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from io import BufferedReader
from itertools import chain, count, takewhile
from pathlib import Path
from typing import Annotated, Any, Final, Generic, Literal, TypeAlias, TypeVar, get_args, get_origin

import yaml
from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, ValidationError

from imudrv.errors import FaultyFileError, InputError
from imudrv.outputs import file_to_write

MAX_BYTES: Final = 1 << 20
"""Largest settings file, bytes."""
MAX_DEPTH: Final = 32
"""Deepest nesting of lists and mappings."""
MAX_EVENTS: Final = 50_000
"""Most values, beginnings and ends of lists and mappings."""
MAX_FAULTS: Final = 50
"""Most faults that one message tells."""


class Model(BaseModel):
    """A section of a settings file; frozen.

    Unknown keys, NaN and infinity are refused, and text or true/false where a number is meant.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def _utc(time: datetime) -> datetime:
    if not 2000 <= time.year < 3000:
        raise ValueError(f"expected a date from the year 2000 on, got {time.isoformat()}")
    return time.astimezone(UTC)


UtcTime: TypeAlias = Annotated[AwareDatetime, AfterValidator(_utc)]
"""A time with its zone, kept in UTC."""
Vector3: TypeAlias = tuple[float, float, float]
Matrix3: TypeAlias = tuple[Vector3, Vector3, Vector3]
"""Three rows."""

M = TypeVar("M", bound=Model)


@dataclass(frozen=True)
class SettingsFile(Generic[M]):
    """A settings file as one read found it; whatever happens to the file, the three agree.

    Attributes
    ----------
    content : bytes
        The file as it is.
    sha256 : str
        SHA-256 of the content, 64 hexadecimal digits.
    model : Model
        The content, checked.
    """

    content: bytes
    sha256: str
    model: M


def read_file(path: str | os.PathLike[str], model: type[M]) -> SettingsFile[M]:
    """Read and check a settings file, and keep its content; see `read`.

    Parameters
    ----------
    path : path-like
        The file.
    model : subclass of Model
        What it should be.

    Returns
    -------
    SettingsFile
    """
    data = content(path)
    return SettingsFile(data, hashlib.sha256(data).hexdigest(), parse_text(data, model, os.fspath(path)))


def read(path: str | os.PathLike[str], model: type[M]) -> M:
    """Read and check a settings file.

    Parameters
    ----------
    path : path-like
        The file: YAML, UTF-8, at most `MAX_BYTES`.
    model : subclass of Model
        What it should be.

    Returns
    -------
    Model

    Raises
    ------
    InputError
        The file cannot be read.
    FaultyFileError
        It is no YAML, or not what the model says; all faults at once.
    """
    return read_file(path, model).model


def parse_text(text: bytes, model: type[M], name: str) -> M:
    """Read and check settings that are in memory already; see `read`.

    Parameters
    ----------
    text : bytes
        YAML, UTF-8.
    model : subclass of Model
        What it should be.
    name : str
        What messages call it.

    Returns
    -------
    Model
    """
    return parse(_load(text, name), model, name)


def parse(document: object, model: type[M], name: str) -> M:
    """Check data that is loaded already.

    Parameters
    ----------
    document : object
        Mappings, lists, text, numbers, dates.
    model : subclass of Model
        What it should be. A wrong `format` or `version` is told alone: the rest is then another file's.
    name : str
        What messages call it.

    Returns
    -------
    Model

    Raises
    ------
    FaultyFileError
        It is not what the model says; all faults at once.
    """
    if faults := list(_header_faults(document, model)):
        raise FaultyFileError(name, faults)
    try:
        # As JSON, because strict then takes a list for a tuple and text for a date, yet no text for a number.
        return model.model_validate_json(json.dumps(document, default=datetime.isoformat))
    except ValidationError as error:
        raise FaultyFileError(name, _bounded(_faults(error, document, model))) from None


def kind(path: str | os.PathLike[str]) -> str:
    """Tell what a settings file is: the value of its `format`; a site file may lack it.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    str
        For example ``imu50-calibration``.

    Raises
    ------
    InputError
        The file cannot be read, is no YAML, or does not say what it is.
    """
    name = os.fspath(path)
    document = _load(content(path), name)
    if not isinstance(document, dict):
        raise FaultyFileError(name, [f"expected a mapping (key: value), got {_shown(document)}"])
    if "format" not in document and "latitude_deg" in document:
        return "imu50-site"
    found = document.get("format")
    if not isinstance(found, str):
        came = _shown(found) if "format" in document else "no such key"
        raise FaultyFileError(
            name, [f"format: expected what the file is, such as imu50-calibration, got {came}"]
        )
    return found


def write(path: str | os.PathLike[str], document: Model | Mapping[str, object]) -> None:
    """Write a settings file so that at every moment the old or the new one is there, whole.

    The file that was there is kept beside it under its name and time, ``NAME.20261122T100000Z.yaml``, with
    ``.2``, ``.3`` ... behind the time where that is taken. A symbolic link is followed.

    Parameters
    ----------
    path : path-like
        The file.
    document : Model or mapping
        What it becomes: keys in the model's order, absent options left out, floats that come back exactly.

    Raises
    ------
    InputError
        It cannot be written, what is there is no settings file but too large, or see `file_to_write`.
    """
    path = Path(path)
    target = file_to_write(path)
    data = yaml.dump(
        _plain(document), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=math.inf
    ).encode()
    if len(data) > MAX_BYTES:
        raise InputError(
            f"{path}: expected at most {MAX_BYTES} bytes to write, got {len(data)}; shorten the contents"
        )
    _load(data, str(path))  # what is written can be read
    with _plain_words(path, "written", f"expected the folder {path.parent}, there is none; make it first"):
        if target.exists():
            _replace(_kept_name(target), content(target))
        _replace(target, data)


def content(path: str | os.PathLike[str]) -> bytes:
    """Read a settings file as it is.

    Parameters
    ----------
    path : path-like
        The file, at most `MAX_BYTES`.

    Returns
    -------
    bytes

    Raises
    ------
    InputError
        It cannot be read or is too large.
    """
    path = Path(path)
    with _reading(path), _open(path) as file:
        data = file.read(MAX_BYTES + 1)
    if len(data) > MAX_BYTES:
        raise InputError(
            f"{path}: expected a settings file of at most {MAX_BYTES} bytes, got more; is it another file?"
        )
    return data


def sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file of any size.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    str
        64 hexadecimal digits.

    Raises
    ------
    InputError
        The file cannot be read.
    """
    path = Path(path)
    with _reading(path), _open(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def change_mark(path: str | os.PathLike[str]) -> tuple[int, int, int]:
    """Time of modification (ns), size (bytes) and inode of a file: another mark, another content.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    tuple of int
        Zeros if there is no such file.
    """
    try:
        found = os.stat(path)
    except (OSError, ValueError):  # ValueError: a NUL in the path
        return 0, 0, 0
    return found.st_mtime_ns, found.st_size, found.st_ino


@contextmanager
def unchanged(path: str | os.PathLike[str]) -> Iterator[None]:
    """Watch a file that is read in several passes.

    Parameters
    ----------
    path : path-like
        The file.

    Raises
    ------
    InputError
        At the end: it was changed or replaced meanwhile.
    """
    before = change_mark(path)
    yield
    if change_mark(path) != before:
        raise InputError(
            f"{os.fspath(path)}: expected a file that stays as it is, it was changed while it was read; "
            "wait until it is complete, then try again"
        )


# Files


@contextmanager
def _plain_words(path: Path, done: str, missing: str) -> Iterator[None]:
    """Turn the system's errors about `path`, which should have been `done`, into ours."""
    try:
        yield
    except FileNotFoundError as error:
        raise InputError(f"{path}: {missing}") from error
    except PermissionError as error:
        raise InputError(
            f"{path}: cannot be {done}: permission denied; change the permissions or the user"
        ) from error
    except (OSError, ValueError) as error:  # ValueError: a NUL in the path
        raise InputError(f"{path}: cannot be {done}: {getattr(error, 'strerror', None) or error}") from error


def _reading(path: Path) -> AbstractContextManager[None]:
    return _plain_words(path, "read", "expected a file, there is none; check the path")


def _open(path: Path) -> BufferedReader:
    if not stat.S_ISREG(path.stat().st_mode):
        raise InputError(f"{path}: expected a file, got a {'folder' if path.is_dir() else 'device or pipe'}")
    return path.open("rb")


def _replace(path: Path, data: bytes) -> None:
    """Put `data` at `path` in one step that survives a loss of power."""
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _kept_name(path: Path) -> Path:
    """Find a free name for the file that is at `path`, by its time."""
    time = datetime.fromtimestamp(path.stat().st_mtime, UTC)
    stem = f"{path.stem}.{time:%Y%m%dT%H%M%SZ}"
    names = chain([stem], (f"{stem}.{n}" for n in count(2)))
    return next(kept for name in names if not os.path.lexists(kept := path.with_name(name + path.suffix)))


# YAML to plain data, from the parser's events: so depth, aliases and repeated keys are seen before they cost

_PARSER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_INT = re.compile(r"[-+]?(0|[1-9][0-9]{0,19})|0x[0-9a-fA-F]{1,16}")
_FLOAT = re.compile(r"[-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?")
_WORDS: Final[dict[str, bool | float | None]] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL"), None),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
    **dict.fromkeys((".nan", ".NaN", ".NAN"), math.nan),
    **{sign + word: float(sign + "inf") for sign in ("", "+", "-") for word in (".inf", ".Inf", ".INF")},
}


class _UnusableError(Exception):
    """Reading on makes no sense."""


def _load(data: bytes, name: str) -> object:
    faults: list[str] = []
    try:
        document = _document(_events(data.decode("utf-8")), faults)
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        byte = data[error.start]
        faults.append(f"line {line}: expected UTF-8 text, got the byte 0x{byte:02x}; save the file as UTF-8")
    except _UnusableError as error:
        faults.append(str(error))
    except yaml.MarkedYAMLError as error:
        problem = " ".join(filter(None, (error.problem, error.context)))
        line_column = _line(error.problem_mark)
        faults.append(f"{line_column}: expected YAML, got: {problem}; check brackets, quotes and indentation")
    except yaml.reader.ReaderError as error:
        character = f"0x{error.character:02x}"
        faults.append(f"expected text, got the control character {character}; is it another file?")
    except (OverflowError, ValueError):  # of PyYAML without libyaml, which leaves such an escape to chr()
        faults.append("expected text, got an escape (\\U) that is no character; correct it")
    if faults:
        raise FaultyFileError(name, _bounded(faults))
    return document


def _events(text: str) -> Iterator[Any]:
    for n, event in enumerate(yaml.parse(text, Loader=_PARSER)):
        if n == MAX_EVENTS:
            raise _UnusableError(f"{_line(event.start_mark)}: expected at most {MAX_EVENTS} values, got more")
        yield event


def _document(events: Iterator[Any], faults: list[str]) -> object:
    next(events)  # the stream begins
    if isinstance(next(events), yaml.StreamEndEvent):
        return None
    document = _value(next(events), events, 0, faults)
    next(events)  # the document ends
    if not isinstance(rest := next(events), yaml.StreamEndEvent):
        faults.append(f"{_line(rest.start_mark)}: expected one document, got a second one; take it out")
    return document


def _value(event: Any, events: Iterator[Any], depth: int, faults: list[str]) -> object:
    """Build the value that begins with `event`."""
    line = _line(event.start_mark)
    if event.anchor is not None:
        faults.append(f"{line}: expected a value, got an anchor (&) or alias (*); write the value out")
    if isinstance(event, yaml.AliasEvent):
        return None
    if event.tag is not None:
        faults.append(f"{line}: expected a value, got a tag (!); take it out, quote what is text")
    if isinstance(event, yaml.ScalarEvent):
        return _scalar(event.value) if event.implicit[0] else event.value
    if depth == MAX_DEPTH:
        raise _UnusableError(f"{line}: expected at most {MAX_DEPTH} levels of nesting, got more")
    if isinstance(event, yaml.SequenceStartEvent):
        return [_value(item, events, depth + 1, faults) for item in _until(yaml.SequenceEndEvent, events)]
    mapping: dict[str, object] = {}
    for key in _until(yaml.MappingEndEvent, events):
        if not isinstance(key, yaml.ScalarEvent):
            raise _UnusableError(f"{_line(key.start_mark)}: expected text as a key, got a list or mapping")
        if key.value in mapping:
            line = _line(key.start_mark)
            faults.append(f"{line}: expected each key once, got {_name(key.value)} again; keep one")
        mapping[key.value] = _value(next(events), events, depth + 1, faults)
    return mapping


def _until(end: type, events: Iterator[Any]) -> Iterator[Any]:
    return takewhile(lambda event: not isinstance(event, end), events)


def _scalar(text: str) -> bool | float | str | None:
    """Read an unquoted value; whole numbers of more than 20 digits become floats."""
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text):
        return int(text, 16 if "x" in text else 10)
    return float(text) if _FLOAT.fullmatch(text) else text


def _line(mark: Any) -> str:
    return f"line {mark.line + 1}, column {mark.column + 1}"


# Plain data to YAML: mappings in blocks, a row of values on one line


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        return True


def _row_or_block(dumper: _Dumper, items: list[object]) -> yaml.Node:
    row = not any(isinstance(item, list | dict) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=row)


def _time(dumper: _Dumper, time: datetime) -> yaml.Node:
    text = time.astimezone(UTC).isoformat().replace("+00:00", "Z")
    return dumper.represent_scalar("tag:yaml.org,2002:timestamp", text)


def _text(dumper: _Dumper, text: str) -> yaml.Node:
    # Quoted and escaped, because the emitter loses breaks of line that only Unicode knows.
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=None if text.isprintable() else '"')


_Dumper.add_representer(str, _text)
_Dumper.add_representer(list, _row_or_block)
_Dumper.add_representer(datetime, _time)
# Text that only YAML 1.2 takes for a number (1e5) needs its quotes too.
_Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(f"({_FLOAT.pattern})$"), list("-+.0123456789")
)


def _plain(value: object) -> object:
    if isinstance(value, Model):
        fields = ((name, getattr(value, name)) for name in type(value).model_fields)
        return {name: _plain(field) for name, field in fields if field is not None}
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value


# Faults in words

_TIME: Final = "a time in the way of 2026-11-22T10:00:00Z"
_EXPECTED: Final = {
    "float_type": "a number",
    "finite_number": "a finite number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "string_type": "text",
    "string_too_short": "text of {min_length} characters or more",
    "string_too_long": "text of at most {max_length} characters",
    "string_pattern_mismatch": "text that matches {pattern}",
    "greater_than": "more than {gt}",
    "greater_than_equal": "at least {ge}",
    "less_than": "less than {lt}",
    "less_than_equal": "at most {le}",
    "literal_error": "{expected}",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a mapping (key: value)",
    "model_type": "a mapping (key: value)",
    "datetime_type": _TIME,
    "datetime_parsing": _TIME,
    "datetime_from_date_parsing": _TIME,
    "timezone_aware": f"{_TIME}, with its zone",
}
_Place: TypeAlias = tuple[str | int, ...]


def _header_faults(document: object, model: type[Model]) -> Iterator[str]:
    """Compare `format` and `version` by type too: pydantic takes true and 1.0 for 1."""
    for name in ("format", "version"):
        field = model.model_fields.get(name)
        if field is None or get_origin(field.annotation) is not Literal:
            continue
        if not isinstance(document, Mapping) or name not in document:
            continue
        allowed, came = get_args(field.annotation), document[name]
        if not any(type(came) is type(value) and came == value for value in allowed):
            yield f"{name}: expected {' or '.join(map(str, allowed))}, got {_shown(came)}"


def _faults(error: ValidationError, document: object, model: type[Model]) -> list[str]:
    """Put what pydantic found into sentences, one for each place."""
    told: dict[tuple[str, str], list[str]] = {}
    for place, e in _located(error.errors(include_url=False), document):
        where, name, came, values = _path(place), e["type"], e["input"], e.get("ctx", {})
        if name == "extra_forbidden":
            told[where, _unknown_key(str(place[-1]), _keys(model, place[:-1]))] = []
        elif name == "missing" and isinstance(place[-1], int):
            # One error for each absent place of a tuple, in order: the last one tells the length.
            told[_path(place[:-1]), str(len(came))] = [f"{place[-1] + 1} {_things(came)}"]
        elif name == "missing":
            told[where, "missing; add it"] = []
        elif name == "too_short" and len(came) >= values["min_length"]:
            continue  # pydantic counts the good items only; the bad ones are told on their own
        elif name in ("too_short", "too_long"):
            limit = "at least {min_length}" if name == "too_short" else "at most {max_length}"
            told[where, str(len(came))] = [f"{limit.format(**values)} {_things(came)}"]
        elif name == "value_error":
            told[where, str(values["error"])] = []
        elif name in _EXPECTED:
            quotes = "; put it in quotes" if name == "string_type" and isinstance(came, int | float) else ""
            told.setdefault((where, _shown(came) + quotes), []).append(_EXPECTED[name].format(**values))
        else:
            told[where, f"{e['msg']}, got {_shown(came)}"] = []
    return [
        (f"{where}: " if where else "")
        + (f"expected {' or '.join(dict.fromkeys(expected))}, got {rest}" if expected else rest)
        for (where, rest), expected in told.items()
    ]


def _located(errors: Sequence[Any], document: object) -> Iterator[tuple[_Place, Any]]:
    """Yield each error with its place in the document; of a union only the alternatives that fit best."""
    found = [(*_place(e, document), e) for e in errors]
    misfit: dict[tuple[_Place, str | int], tuple[bool, int]] = {}
    for place, branch, e in found:
        if branch is not None:
            other_type, keys = misfit.get(branch, (False, 0))
            odd_key = e["type"] in ("missing", "extra_forbidden")
            misfit[branch] = other_type or place == branch[0], keys + odd_key
    best: dict[_Place, tuple[bool, int]] = {}
    for (union, _), score in misfit.items():
        best[union] = min(score, best.get(union, score))
    for place, branch, e in found:
        if branch is None or misfit[branch] == best[branch[0]]:
            yield place, e


def _place(error: Any, document: object) -> tuple[_Place, tuple[_Place, str | int] | None]:
    """Tell where an error is, and the first alternative of a union on the way (pydantic puts it in loc)."""
    place: list[str | int] = []
    branch = None
    here: Any = document
    for i, step in enumerate(error["loc"]):
        if _leads_on(here, step):
            place.append(step)
            here = here[step]
        elif error["type"] == "missing" and i == len(error["loc"]) - 1:
            place.append(step)
        elif branch is None:
            branch = tuple(place), step
    return tuple(place), branch


def _leads_on(here: object, step: str | int) -> bool:
    if isinstance(here, Mapping):
        return step in here
    return isinstance(here, list | tuple) and step in range(len(here))


def _keys(annotation: Any, place: _Place) -> set[str]:
    """Tell the keys that the model knows at a place."""
    if isinstance(annotation, type) and issubclass(annotation, Model):
        fields = annotation.model_fields
        if not place:
            return set(fields)
        field = fields.get(str(place[0]))
        return _keys(field.annotation, place[1:]) if field else set()
    inside = place[1:] if get_origin(annotation) in (tuple, list, dict) else place
    return set().union(*(_keys(argument, inside) for argument in get_args(annotation)))


def _unknown_key(name: str, known: set[str]) -> str:
    near = difflib.get_close_matches(name[:100], known, 1)
    return "unknown key; " + (f"did you mean {near[0]}?" if near else f"known are {', '.join(sorted(known))}")


def _path(place: _Place) -> str:
    steps = (f"[{step}]" if isinstance(step, int) else f".{_name(step)}" for step in place)
    return "".join(steps).removeprefix(".")


def _name(key: str) -> str:
    return key if re.fullmatch(r"[\w-]{1,60}", key) else _short(key)


def _short(value: object) -> str:
    """Represent a value in less than a line, with no control characters."""
    text = repr(value[:60] if isinstance(value, str) else value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _shown(value: object) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"text {_short(value)}"
    if isinstance(value, Mapping):
        return "a mapping"
    return f"a list of {len(value)}" if isinstance(value, list | tuple) else _short(value)


def _things(items: Sequence[object]) -> str:
    if all(isinstance(item, int | float) for item in items):
        return "numbers"
    return "rows" if all(isinstance(item, list | tuple) for item in items) else "values"


def _bounded(faults: list[str]) -> list[str]:
    rest = len(faults) - MAX_FAULTS
    return [*faults[:MAX_FAULTS], f"and {rest} more"] if rest > 0 else faults
