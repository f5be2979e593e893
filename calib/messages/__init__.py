"""Messages to the operator: keys with values; a catalogue for each language has the sentences.

A catalogue is a YAML file with one line for each key; its text is a Python format string with the values of
the message, whole numbers as `imudrv.wording.Count`. Text of `imudrv` (alignment, service, recordings) is the
message `verbatim`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias, Union

from imudrv.messages import LANGUAGES, joined, language
from imudrv.messages import catalogue as texts_of
from imudrv.wording import Count

__all__ = ["LANGUAGES", "Message", "Value", "catalogue", "english", "language", "message", "text", "verbatim"]

Value: TypeAlias = Union[str, int, float, "Message", tuple[str, ...], tuple["Message", ...]]
"""Number, name, message, or several names or messages."""


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

    def shown(value: Value) -> str | int | float:
        if isinstance(value, Message):
            return text(value, language)
        if isinstance(value, tuple):
            return joined((str(shown(part)) for part in value), language)
        return Count(value) if isinstance(value, int) else value

    return catalogue(language)[what.key].format(**{name: shown(value) for name, value in what.values.items()})


def catalogue(language: str) -> Mapping[str, str]:
    """Return the texts of one of `LANGUAGES` by key."""
    return texts_of(language, __name__)
