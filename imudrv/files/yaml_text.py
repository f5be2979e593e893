"""YAML within bounds: plain data in, plain data out, nothing executed.

Unquoted values follow the core schema of YAML 1.2: ``1e-6`` is a number; ``0017``, ``1:30``, ``yes`` and a
date are text. Anchors, aliases, tags and duplicate keys are refused.
"""

import math
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import takewhile
from typing import Any, Final

import yaml

from imudrv.errors import FaultyFileError
from imudrv.files.faults import bounded, quoted_name

MAX_DEPTH: Final = 32
"""Deepest nesting of lists and mappings."""
MAX_EVENTS: Final = 50_000
"""Largest number of values, and beginnings and ends of lists and mappings."""

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
    """A fault after which the rest cannot be read."""


def load_yaml(data: bytes, name: str) -> object:
    """Parse YAML within bounds.

    Parameters
    ----------
    data : bytes
        UTF-8.
    name : str
        Name of the file in messages.

    Returns
    -------
    object
        Mappings, lists, text, numbers, true/false, None.

    Raises
    ------
    FaultyFileError
        It is no such YAML; all faults at once.
    """
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
        raise FaultyFileError(name, bounded(faults))
    return document


def _events(text: str) -> Iterator[Any]:
    for n, event in enumerate(yaml.parse(text, Loader=_PARSER)):
        if n == MAX_EVENTS:
            raise _UnusableError(f"{_line(event.start_mark)}: expected at most {MAX_EVENTS} values, got more")
        yield event


def _document(events: Iterator[Any], faults: list[str]) -> object:
    next(events)  # stream start
    if isinstance(next(events), yaml.StreamEndEvent):
        return None
    document = _value(next(events), events, 0, faults)
    next(events)  # document end
    if not isinstance(rest := next(events), yaml.StreamEndEvent):
        faults.append(f"{_line(rest.start_mark)}: expected one document, got a second one; remove it")
    return document


def _value(event: Any, events: Iterator[Any], depth: int, faults: list[str]) -> object:
    """Return the value that begins with `event`."""
    line = _line(event.start_mark)
    if event.anchor is not None:
        faults.append(f"{line}: expected a value, got an anchor (&) or alias (*); write the value out")
    if isinstance(event, yaml.AliasEvent):
        return None
    if event.tag is not None:
        faults.append(f"{line}: expected a value, got a tag (!); remove it, put text in quotes")
    if isinstance(event, yaml.ScalarEvent):
        return scalar(event.value) if event.implicit[0] else event.value
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
            faults.append(f"{line}: expected each key once, got {quoted_name(key.value)} again; keep one")
        mapping[key.value] = _value(next(events), events, depth + 1, faults)
    return mapping


def _until(end: type, events: Iterator[Any]) -> Iterator[Any]:
    return takewhile(lambda event: not isinstance(event, end), events)


def scalar(text: str) -> bool | float | str | None:
    """Return an unquoted value; integers of more than 20 digits become floats."""
    if text in _WORDS:
        return _WORDS[text]
    if _INT.fullmatch(text):
        return int(text, 16 if "x" in text else 10)
    return float(text) if _FLOAT.fullmatch(text) else text


def _line(mark: Any) -> str:
    return f"line {mark.line + 1}, column {mark.column + 1}"


def dump_yaml(document: object) -> bytes:
    """Write plain data as YAML that `load_yaml` reads back.

    Parameters
    ----------
    document : object
        Mappings, lists, text, numbers, dates, true/false, None.

    Returns
    -------
    bytes
        UTF-8; mappings in their order, floats exact, lists of plain values in one row.
    """
    text = yaml.dump(document, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=math.inf)
    return text.encode()


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        return True


def _represent_list(dumper: _Dumper, items: list[object]) -> yaml.Node:
    row = not any(isinstance(item, list | dict) for item in items)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", items, flow_style=row)


def _represent_time(dumper: _Dumper, time: datetime) -> yaml.Node:
    text = time.astimezone(UTC).isoformat().replace("+00:00", "Z")
    return dumper.represent_scalar("tag:yaml.org,2002:timestamp", text)


def _represent_text(dumper: _Dumper, text: str) -> yaml.Node:
    # Quoted and escaped, because the emitter loses line breaks that only Unicode knows.
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=None if text.isprintable() else '"')


_Dumper.add_representer(str, _represent_text)
_Dumper.add_representer(list, _represent_list)
_Dumper.add_representer(datetime, _represent_time)
# Text that only YAML 1.2 takes for a number (1e5) needs its quotes too.
_Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(f"({_FLOAT.pattern})$"), list("-+.0123456789")
)
