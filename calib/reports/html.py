"""Documents as one HTML file."""

from base64 import b64encode
from html import escape
from typing import Final

from calib.reports.document import MARKS, Block, Document, Figure, KeyValues, Paragraph

LONG: Final = 15
"""A table of more rows may be broken by a page's end."""


def as_html(document: Document) -> str:
    """Tell a document as one HTML file, figures inside, nothing loaded from elsewhere.

    Parameters
    ----------
    document : Document
        Its text is escaped here.

    Returns
    -------
    str
        The file.
    """
    body = "\n".join(
        f"<section>\n<h2>{escape(section.title)}</h2>\n{''.join(map(_marked_up, section.blocks))}</section>"
        for section in document.sections
    )
    return _PAGE.format(
        style=_STYLE, title=escape(document.title), subtitle=escape(document.subtitle), body=body
    )


def _marked_up(block: Block) -> str:
    if isinstance(block, Paragraph):
        return f"<p>{escape(block.text)}</p>\n"
    if isinstance(block, Figure):
        image = b64encode(block.draw()).decode()
        return (
            f'<figure><img alt="{escape(block.title)}" src="data:image/svg+xml;base64,{image}">'
            f"<figcaption>{escape(block.title)}</figcaption></figure>\n"
        )
    if isinstance(block, KeyValues):
        rows = "".join(
            f'<tr><th class="{name if name in MARKS else "name"}">{escape(name)}</th>'
            f"<td>{escape(value)}</td></tr>\n"
            for name, value in block.rows
        )
        return f'<table class="pairs">\n{rows}</table>\n'
    head = "".join(f"<th>{escape(name)}</th>" for name in block.head)
    rows = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>\n" for row in block.rows)
    kind = "long" if len(block.rows) > LONG else "short"
    return (
        f'<h3>{escape(block.title)}</h3>\n<table class="{kind}">\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{rows}</tbody></table>\n"
    )


_STYLE: Final = """
:root { color-scheme: light; }
body { font: 15px/1.5 "Helvetica Neue", Arial, "Liberation Sans", sans-serif; color: #22262b;
       background: #fff; max-width: 54rem; margin: 2.5rem auto; padding: 0 1.5rem; }
header { border-bottom: 2px solid #1f5fa8; margin-bottom: 1.5rem; }
h1 { font-size: 1.6rem; font-weight: 600; margin: 0; }
header p { color: #5b6068; margin: 0.2rem 0 0.8rem; }
h2 { font-size: 1.1rem; font-weight: 600; margin: 2rem 0 0.6rem; border-bottom: 1px solid #d9dce0; }
table { border-collapse: collapse; margin: 0.2rem 0 1.2rem; font-size: 0.87rem;
        font-variant-numeric: tabular-nums; }
.pairs, .short, tr { break-inside: avoid; }
h3 { font-size: 0.87rem; font-weight: 600; margin: 1rem 0 0.2rem; break-after: avoid; }
th, td { padding: 0.15rem 0.75rem; text-align: right; vertical-align: top; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
thead th { border-bottom: 1px solid #8a8f98; font-weight: 500; }
thead + tbody tr:nth-child(even) { background: #f6f7f9; }
.pairs td { text-align: left; overflow-wrap: anywhere; }
.pairs th { text-align: left; font-weight: 500; min-width: 6rem; color: #5b6068; }
.pairs .good { color: #2c6e3f; } .pairs .caution { color: #9a5b00; } .pairs .bad { color: #b3261e; }
.pairs .good, .pairs .note, .pairs .caution, .pairs .bad { font-weight: 700; text-transform: uppercase; }
figure { margin: 0.8rem 0 1.4rem; break-inside: avoid; }
figure img { width: 100%; height: auto; }
figcaption { font-size: 0.85rem; color: #5b6068; }
@media print {
  body { font-size: 10pt; max-width: none; margin: 0; padding: 0; }
  h2 { break-after: avoid; }
  @page { margin: 18mm; }
}
"""


_PAGE: Final = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy"
      content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<header><h1>{title}</h1><p>{subtitle}</p></header>
{body}
</body>
</html>
"""
