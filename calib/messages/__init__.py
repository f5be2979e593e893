"""Messages to the operator: keys with values; a catalogue for each language has the sentences.

A catalogue is a YAML file with one line for each key; its text is a Python format string with the values of
the message. Text of `imudrv` (alignment, service, recordings) is the message `verbatim`.
"""

import locale
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Final, TypeAlias, Union

import yaml

Value: TypeAlias = Union[str, int, float, "Message", tuple[str, ...], tuple["Message", ...]]
"""Number, name, message, or several names or messages."""

LANGUAGES: Final = ("en", "zh_CN")
"""Languages with a catalogue; the first one is the default."""


@dataclass(frozen=True)
class Message:
    """A message to the operator.

    Attributes
    ----------
    key : str
        In the catalogue.
    values : mapping of str to Value
        For the placeholders of the text.
    """

    key: str
    values: Mapping[str, Value]


def message(key: str, /, **values: Value) -> Message:
    """Return a message."""
    return Message(key, values)


def verbatim(text: str) -> Message:
    """Return a text that is in no catalogue as a message."""
    return message("verbatim", text=text)


def english(what: Message) -> str:
    """Return the English text of a message."""
    return text(what, "en")


def text(what: Message, language: str) -> str:
    """Return the text of a message in one of `LANGUAGES`."""
    return _render(what, catalogue(language))


def language(name: str | None = None) -> str:
    """Return the one of `LANGUAGES` that is nearest to a language.

    Parameters
    ----------
    name : str, optional
        Such as ``zh_CN``, ``zh-Hans`` or ``en_GB.UTF-8``. Default: the language of the system.

    Returns
    -------
    str
        ``en`` for an unknown language.
    """
    name = (name or _system_language()).replace("-", "_").lower()
    return next((known for known in LANGUAGES if name[:2] == known[:2]), LANGUAGES[0])


def _system_language() -> str:
    names = (os.environ.get(variable) for variable in ("LC_ALL", "LC_MESSAGES", "LANG"))
    name = next(filter(None, names), None) or locale.getlocale()[0] or ""
    return name.replace("Chinese", "zh")  # as Windows calls it


@cache
def catalogue(language: str) -> Mapping[str, str]:
    """Return the texts of one of `LANGUAGES` by key."""
    content = resources.files(__name__).joinpath(f"{language}.yaml").read_bytes()
    texts: dict[str, str] = yaml.safe_load(content)
    return texts


def _render(what: Message, texts: Mapping[str, str]) -> str:
    def shown(value: Value) -> str | int | float:
        if isinstance(value, Message):
            return _render(value, texts)
        if isinstance(value, tuple):
            return texts["separator"].join(str(shown(part)) for part in value)
        return value

    return texts[what.key].format(**{name: shown(value) for name, value in what.values.items()})
