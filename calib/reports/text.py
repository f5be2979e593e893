"""Documents as plain text, and for a terminal."""

from collections.abc import Iterator, Sequence
from io import StringIO
from itertools import chain
from typing import Final

from rich import box
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table as RichTable
from rich.text import Text as RichText

from calib.reports.document import MARKS, Block, Document, Figure, KeyValues, Paragraph
from imudrv.terminal import console, printable

WIDTH: Final = 80
"""Columns of the text."""


def for_terminal(document: Document) -> RenderableType:
    """Return a document for a console, without its figures."""
    parts: list[RenderableType] = [
        _plain(document.title, style="bold"),
        _plain(document.subtitle),
        "",
    ]
    for section in document.sections:
        parts += [_plain(section.title.upper(), style="bold")]
        parts += chain.from_iterable(_shown(block) for block in section.blocks)
    return Group(*parts)


def print_document(document: Document) -> None:
    """Print a document: in colour and in full width on a terminal, elsewhere as plain text."""
    screen = console()
    if screen.is_terminal:
        screen.print(for_terminal(document))
    else:
        screen.file.write(as_text(document))


def as_text(document: Document) -> str:
    """Return a document as plain text of 80 columns, without its figures."""
    return _text(for_terminal(document))


def blocks_text(blocks: Sequence[Block]) -> str:
    """Return blocks alone as plain text."""
    return _text(Group(*chain.from_iterable(_shown(block) for block in blocks)))


def _text(shown: RenderableType) -> str:
    out = StringIO()
    Console(file=out, width=WIDTH, color_system=None).print(shown)
    return "".join(f"{line.rstrip()}\n" for line in out.getvalue().splitlines())


def _plain(text: str, style: str = "") -> RichText:
    return RichText(printable(text), style)


def _shown(block: Block) -> Iterator[RenderableType]:
    if isinstance(block, Figure):
        return
    if isinstance(block, Paragraph):
        yield Padding(_plain(block.text), (0, 0, 1, 2))
    elif isinstance(block, KeyValues):
        grid = RichTable.grid(padding=(0, 2, 0, 0))
        grid.add_column()
        grid.add_column(overflow="fold")
        for name, value in block.rows:
            grid.add_row(_plain(name, style=MARKS.get(name, "dim")), _plain(value))
        yield Padding(grid, (0, 0, 1, 2))
    else:
        table = RichTable(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0), show_edge=False)
        for k, name in enumerate(block.head):
            table.add_column(_plain(name), justify="right" if k else "left", overflow="fold")
        for row in block.rows:
            table.add_row(*map(_plain, row))
        yield Padding(_plain(block.title), (0, 0, 0, 2))
        yield Padding(table, (0, 0, 1, 2))
