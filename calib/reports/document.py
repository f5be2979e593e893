"""Content of a document, without its form: `text` and `html` render it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Final, TypeAlias

from calib.messages import LANGUAGES, Message, message, text


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


Say: TypeAlias = Callable[[Message], str]
"""Returns the text of a message in the language of a document."""

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


def translations(made: Callable[[Say], Document]) -> dict[str, Document]:
    """Return a document in each of `LANGUAGES`; its figures are drawn once for all."""
    documents = {language: made(partial(text, language=language)) for language in LANGUAGES}
    blocks = (block for section in documents[LANGUAGES[0]].sections for block in section.blocks)
    draw = [cache(block.draw) for block in blocks if isinstance(block, Figure)]
    return {language: _drawn_by(iter(draw), document) for language, document in documents.items()}


def _drawn_by(draw: Iterator[Callable[[], bytes]], document: Document) -> Document:
    sections = (
        replace(
            section,
            blocks=tuple(
                replace(block, draw=next(draw)) if isinstance(block, Figure) else block
                for block in section.blocks
            ),
        )
        for section in document.sections
    )
    return replace(document, sections=tuple(sections))


def sanitise(text: str) -> str:
    """Return text of a file without characters that could control a terminal."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


MARKS: Final = {"good": "bold green", "note": "bold", "caution": "bold yellow", "bad": "bold red"}
"""Marks of a verdict, and their style on a terminal."""

MARK_NAMES: Final = {
    "good": message("mark_good"),
    "note": message("mark_note"),
    "caution": message("mark_caution"),
    "bad": message("mark_bad"),
}
