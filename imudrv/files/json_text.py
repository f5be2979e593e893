"""JSON within bounds, from files that anybody may have written: plain data, each key once."""

import json
import re
from itertools import accumulate
from typing import Any, Final

from imudrv.errors import FaultyFileError
from imudrv.files.faults import quoted_name

MAX_DEPTH: Final = 32
"""Deepest nesting of lists and objects."""

_STRING: Final = re.compile(rb'"(?:[^"\\]|\\.)*"', re.DOTALL)


def load_json(data: bytes, name: str) -> Any:
    """Parse JSON within bounds; the caller limits its length.

    Parameters
    ----------
    data : bytes
        UTF-8.
    name : str
        Where it comes from, in messages.

    Returns
    -------
    object
        Objects, lists, text, numbers, true/false, None.

    Raises
    ------
    FaultyFileError
        It is no such JSON.
    """
    if _depth(data) > MAX_DEPTH:
        raise FaultyFileError(name, [f"expected at most {MAX_DEPTH} levels of nesting, got more"])
    try:
        document = json.loads(data.decode(), object_pairs_hook=_object)
        json.dumps(document, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise FaultyFileError(
            name, ["expected text, got an escape (\\ud800 to \\udfff) of half a character"]
        ) from None
    except ValueError as error:  # no UTF-8, no JSON, a key twice, thousands of digits
        raise FaultyFileError(name, [f"expected JSON: {error}"]) from None
    return document


def _depth(data: bytes) -> int:
    brackets = (byte for byte in _STRING.sub(b"", data) if byte in b"[]{}")
    return max(accumulate(1 if byte in b"[{" else -1 for byte in brackets), default=0)


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"expected each key once, got {quoted_name(twice)} again")
    return found
