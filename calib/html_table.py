"""A small HTML table, for results in a notebook."""

from collections.abc import Iterable, Sequence
from html import escape


def html_table(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table as HTML; all text is escaped.

    Parameters
    ----------
    caption : str
        Text above the table.
    head : sequence of str
        Column names.
    rows : iterable of sequence of str
        Cells, one for each column.

    Returns
    -------
    str
    """
    header = "".join(f"<th>{escape(name)}</th>" for name in head)
    body = "".join(f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><caption>{escape(caption)}</caption><tr>{header}</tr>{body}</table>"
