"""Content of a document, without its form: `text` and `html` render it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias


@dataclass(frozen=True)
class Paragraph:
    """Running text."""

    text: str


@dataclass(frozen=True)
class KeyValues:
    """Names with their values."""

    rows: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Table:
    """Rows below a header; the first column is text, the others are numbers."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Figure:
    """A figure; drawn only if it is shown."""

    title: str
    draw: Callable[[], bytes]


Block: TypeAlias = Paragraph | KeyValues | Table | Figure


@dataclass(frozen=True)
class Section:
    """Blocks below a heading."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Document:
    """Sections below a title."""

    title: str
    subtitle: str
    sections: tuple[Section, ...]


def sanitise(text: str) -> str:
    """Return text of a file without characters that could control a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


MARKS: Final = {"good": "bold green", "note": "bold", "caution": "bold yellow", "bad": "bold red"}
