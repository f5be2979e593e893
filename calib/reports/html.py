"""Documents as one HTML file."""

import re
from base64 import b64encode
from html import escape
from importlib import resources
from string import Template
from typing import Final

from calib.messages import message, text
from calib.reports.document import MARK_NAMES, Block, Document, Figure, KeyValues, Paragraph, Section

LONG: Final = 15
"""A table of more rows may be broken by a page's end."""

MOST_TOGETHER: Final = 5
"""A section of more paragraphs may be, too."""


def as_html(document: Document, number: str = "", watermark: str = "", language: str = "en") -> str:
    """Return a document as one HTML file, figures inside, nothing loaded from elsewhere.

    Parameters
    ----------
    document : Document
        Its text is escaped here.
    number : str
        Number on every printed page.
    watermark : str
        Word across every printed page.
    language : str
        Language of the document.

    Returns
    -------
    str
        The file.
    """
    body = "\n".join(_section(section, language) for section in document.sections)
    page = Template(resources.files(__package__).joinpath("page.html").read_text("utf-8"))
    counters = {"page": '" counter(page) "', "pages": '" counter(pages) "'}
    return page.substitute(
        language=language.replace("_", "-"),
        page_of=text(message("certificate_page", page=counters["page"], pages=counters["pages"]), language),
        title=escape(document.title),
        subtitle=escape(document.subtitle),
        number=re.sub("[^A-Za-z0-9._-]", "", number),
        watermark=f'<div class="watermark">{escape(watermark)}</div>' if watermark else "",
        body=body,
    )


def _section(section: Section, language: str) -> str:
    is_text = all(isinstance(block, Paragraph) for block in section.blocks)
    kind = ' class="short"' if is_text and len(section.blocks) <= MOST_TOGETHER else ""
    blocks = "".join(_marked_up(block, language) for block in section.blocks)
    return f"<section{kind}>\n<h2>{escape(section.title)}</h2>\n{blocks}</section>"


def _marked_up(block: Block, language: str) -> str:
    if isinstance(block, Paragraph):
        return f"<p>{escape(block.text)}</p>\n"
    if isinstance(block, Figure):
        image = b64encode(block.draw()).decode()
        return (
            f'<figure><img alt="{escape(block.title)}" src="data:image/svg+xml;base64,{image}">'
            f"<figcaption>{escape(block.title)}</figcaption></figure>\n"
        )
    if isinstance(block, KeyValues):
        rows = "".join(_pair(name, value, language) for name, value in block.rows)
        return f'<table class="pairs">\n{rows}</table>\n'
    head = "".join(f"<th>{escape(name)}</th>" for name in block.head)
    rows = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>\n" for row in block.rows)
    kind = "long" if len(block.rows) > LONG else "short"
    return (
        f'<h3>{escape(block.title)}</h3>\n<table class="{kind}">\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{rows}</tbody></table>\n"
    )


def _pair(name: str, value: str, language: str) -> str:
    mark = MARK_NAMES.get(name)
    kind, shown = ("name", name) if mark is None else (name, text(mark, language))
    return f'<tr><th class="{kind}">{escape(shown)}</th><td>{escape(value)}</td></tr>\n'
