"""Messages for faults of a settings file: where, what was expected, what was found."""

import difflib
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Final, Literal, TypeAlias, get_args, get_origin

from pydantic import ValidationError

from imudrv.files.model import Model

MAX_FAULTS: Final = 50
"""Largest number of faults in one message."""

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
    "enum": "{expected}",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a mapping (key: value)",
    "model_type": "a mapping (key: value)",
    "dataclass_type": "a mapping (key: value)",
    "datetime_type": _TIME,
    "datetime_parsing": _TIME,
    "datetime_from_date_parsing": _TIME,
    "timezone_aware": f"{_TIME}, with its zone",
}

_NUMBER: Final = r"[-+]?(0x[0-9A-Fa-f]{1,16}|[0-9]{1,20}(\.[0-9]{1,20})?)"

_Place: TypeAlias = tuple[str | int, ...]


def header_faults(document: object, model: type[Model]) -> Iterator[str]:
    """Yield the faults of `format`, `version` and `kind`.

    They are compared by type too: pydantic takes true and 1.0 for 1.
    """
    for name in ("format", "version", "kind"):
        field = model.model_fields.get(name)
        if field is None or get_origin(field.annotation) is not Literal:
            continue
        if not isinstance(document, Mapping) or name not in document:
            continue
        allowed, came = get_args(field.annotation), document[name]
        if not any(type(came) is type(value) and came == value for value in allowed):
            advice = model.advice_for_value(name, came)
            rest = shown_value(came) + (f"; {advice}" if advice else "")
            yield f"{name}: expected {' or '.join(map(str, allowed))}, got {rest}"


def validation_faults(error: ValidationError, document: object, model: type[Model]) -> list[str]:
    """Return the errors of pydantic as sentences, one for each place."""
    found: dict[tuple[str, str], list[str]] = {}  # what was expected, by place and what came
    for place, e in _located(error.errors(include_url=False), document):
        where, name, came, values = _path(place), e["type"], e["input"], e.get("ctx", {})
        keys = ".".join(step for step in place if isinstance(step, str))
        if name == "extra_forbidden":
            known = _keys(model, place[:-1])
            advice = model.advice_for_key(keys) or _nearest(str(place[-1]), known)
            advice = advice or f"known are {', '.join(sorted(known))}"
            found[where, f"unknown key; {advice}"] = []
        elif name == "unexpected_keyword_argument":  # of a dataclass
            found[where, "unknown key; remove it"] = []
        elif name == "missing" and isinstance(place[-1], int):
            # One error for each absent item of a tuple, in order: the last one gives the length.
            found[_path(place[:-1]), str(len(came))] = [f"{place[-1] + 1} {_plural(came)}"]
        elif name == "missing":
            found[where, "missing; add it"] = []
        elif name == "too_short" and len(came) >= values["min_length"]:
            continue  # pydantic counts valid items only; the others have errors of their own
        elif name in ("too_short", "too_long"):
            limit = "at least {min_length}" if name == "too_short" else "at most {max_length}"
            found[where, str(len(came))] = [f"{limit.format(**values)} {_plural(came)}"]
        elif name == "value_error":
            found |= {(where, fault): [] for fault in str(values["error"]).splitlines()}
        elif name == "json_invalid":  # half a character; the rest cannot be wrong here
            found["", "expected Unicode text, got bytes that are none; is the locale UTF-8?"] = []
        elif name in _EXPECTED:
            advice = model.advice_for_value(keys, came) or _advice(name, came, values)
            rest = shown_value(came) + (f"; {advice}" if advice else "")
            found.setdefault((where, rest), []).append(_EXPECTED[name].format(**values))
        else:
            found[where, f"{e['msg']}, got {shown_value(came)}"] = []
    return [
        (f"{where}: " if where else "")
        + (f"expected {' or '.join(dict.fromkeys(expected))}, got {rest}" if expected else rest)
        for (where, rest), expected in found.items()
    ]


def _located(errors: Sequence[Any], document: object) -> Iterator[tuple[_Place, Any]]:
    """Yield each error with its place in the document; for a union only those of the best alternatives."""
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
    """Return the place of an error, and the first alternative of a union on the way to it."""
    place: list[str | int] = []
    branch = None
    here: Any = document
    for i, step in enumerate(error["loc"]):
        if _has_step(here, step):
            place.append(step)
            here = here[step]
        elif error["type"] == "missing" and i == len(error["loc"]) - 1:
            place.append(step)
        elif branch is None:
            branch = tuple(place), step
    return tuple(place), branch


def _has_step(here: object, step: str | int) -> bool:
    if isinstance(here, Mapping):
        return step in here
    return isinstance(here, list | tuple) and step in range(len(here))


def _keys(annotation: Any, place: _Place) -> set[str]:
    """Return the keys that a model has at a place."""
    if isinstance(annotation, type) and issubclass(annotation, Model):
        fields = annotation.model_fields
        if not place:
            return set(fields)
        field = fields.get(str(place[0]))
        return _keys(field.annotation, place[1:]) if field else set()
    inside = place[1:] if get_origin(annotation) in (tuple, list, dict) else place
    return set().union(*(_keys(argument, inside) for argument in get_args(annotation)))


def _advice(expected: str, came: object, values: Mapping[str, Any]) -> str:
    """Return what to do with the quotes of a value, or the known value that is like this one."""
    if expected == "string_type" and isinstance(came, int | float):
        return "put it in quotes"
    if expected in ("int_type", "float_type") and isinstance(came, str) and re.fullmatch(_NUMBER, came):
        return "leave out the quotes"
    if expected in ("literal_error", "enum") and isinstance(came, str):
        return _nearest(came, re.findall(r"'([^']*)'", values["expected"]))
    return ""


def _nearest(name: str, known: Iterable[str]) -> str:
    """Return a hint at the known name that is like this one, if one is."""
    near = difflib.get_close_matches(name[:100], list(known), 1)
    return f"did you mean {near[0]}?" if near else ""


def _path(place: _Place) -> str:
    steps = (f"[{step}]" if isinstance(step, int) else f".{quoted_name(step)}" for step in place)
    return "".join(steps).removeprefix(".")


def quoted_name(key: str) -> str:
    """Return a key as messages show it."""
    return key if re.fullmatch(r"[\w-]{1,60}", key) else _short(key)


def _short(value: object) -> str:
    """Return a value in less than a line, without control characters."""
    text = repr(value[:60] if isinstance(value, str) else value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def shown_value(value: object) -> str:
    """Return a value as messages show it, shortened."""
    if value is None:
        return "nothing"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f"text {_short(value)}"
    if isinstance(value, Mapping):
        return "a mapping"
    return f"a list of {len(value)}" if isinstance(value, list | tuple) else _short(value)


def _plural(items: Sequence[object]) -> str:
    if all(isinstance(item, int | float) for item in items):
        return "numbers"
    return "rows" if all(isinstance(item, list | tuple) for item in items) else "values"


def bounded(faults: list[str]) -> list[str]:
    """Return at most `MAX_FAULTS` faults, then the number of the others."""
    rest = len(faults) - MAX_FAULTS
    return [*faults[:MAX_FAULTS], f"and {rest} more"] if rest > 0 else faults
