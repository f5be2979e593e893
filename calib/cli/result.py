"""Files and printed report of a command that computes a result."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from calib.reports.document import Document
from calib.reports.text import print_document
from calib.result_file import write_json
from imudrv.files.atomic import atomic_write
from imudrv.terminal import say


def add_result_files(parser: argparse.ArgumentParser, letter: str = "R") -> None:
    """Add ``--json`` and ``--report``; the letter names their files in the help."""
    add = parser.add_argument
    add("--json", type=Path, metavar=f"{letter}.json", help="the whole result as JSON")
    add("--report", type=Path, metavar=f"{letter}.html", help="report with figures, one file")


def write_result(
    arguments: argparse.Namespace,
    report: Document,
    as_json: Callable[[], dict[str, Any]],
    as_html: Callable[[], str],
    write_certificate: Callable[[], str | None],
) -> None:
    """Write the files of a result, then print the report and a line for each file.

    Files first: the reader of the text may go away. The report is printed also when a file cannot be written.

    Parameters
    ----------
    arguments : Namespace
        With those of `add_result_files`.
    report : Document
        What is printed.
    as_json, as_html : callable
        Contents of the two files, where they are wanted.
    write_certificate : callable
        Writes the certificate; returns the line about it, None if none is wanted.
    """
    written = []
    try:
        if arguments.json is not None:
            write_json(arguments.json, as_json())
            written.append(f"{arguments.json}: the result")
        if arguments.report is not None:
            with atomic_write(arguments.report) as file:
                file.write(as_html().encode())
            written.append(f"{arguments.report}: the report")
        if line := write_certificate():
            written.append(line)
    finally:
        print_document(report)
        say("\n".join(written))
