"""A document: one content, as text for a terminal and as one HTML file with its figures inside."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias


@dataclass(frozen=True)
class Paragraph:
    """Running text."""

    text: str


@dataclass(frozen=True)
class KeyValues:
    """What and how much."""

    rows: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Table:
    """Rows under a head; the first column is text, the others numbers."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Figure:
    """A figure, drawn where it is shown."""

    title: str
    draw: Callable[[], bytes]


Block: TypeAlias = Paragraph | KeyValues | Table | Figure


@dataclass(frozen=True)
class Section:
    """A part of the report with its heading."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Document:
    """Sections under a title."""

    title: str
    subtitle: str
    sections: tuple[Section, ...]


def sanitise(text: str) -> str:
    """Text of a file with nothing in it that could steer a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


MARKS: Final = {"good": "bold green", "note": "bold", "caution": "bold yellow", "bad": "bold red"}
