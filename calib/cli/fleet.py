"""Command `calib fleet`."""

import argparse
from pathlib import Path
from typing import Final

from calib.fleet import report
from calib.fleet.index import opened, update
from imudrv.files.outputs import require_other
from imudrv.terminal import BAD_INPUT, NOT_GOOD, OK, say

EXAMPLE: Final = "index sessions"

_INDEX: Final = Path("fleet.sqlite")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    text = "bring the index of a tree of sessions up to date, or make it; exit code 2 if a session is damaged"
    index = actions.add_parser("index", help=text, description=text)
    index.add_argument("tree", type=Path, metavar="TREE", help="folder with sessions, at any depth")
    text = "results of a unit over time, and whether it has changed; exit code 3 if so"
    drift = actions.add_parser("drift", help=text, description=text)
    drift.add_argument("--unit", required=True, metavar="SERIAL", help="serial number")
    drift.add_argument("--plot", type=Path, metavar="FILE.png", help="plot of the lever arms to write")
    text = "whether a bench is off by more than its sigma; exit code 3 if one is"
    benches = actions.add_parser("benches", help=text, description=text)
    text = "write all results as one table"
    export = actions.add_parser("export", help=text, description=text)
    export.add_argument("--to", choices=("parquet",), required=True, help="format")
    export.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="file to write")
    for action in (index, drift, benches, export):
        action.add_argument(
            "--index", type=Path, default=_INDEX, metavar="FILE", help=f"the index (default: {_INDEX})"
        )


def run(arguments: argparse.Namespace) -> int:
    """Carry out the action."""
    if arguments.action == "index":
        done = update(arguments.tree, arguments.index)
        say(f"{arguments.index}: {done.new} read, {done.unchanged} unchanged, {done.removed} removed")
        for fault in done.faults:
            say(f"not used: {fault}")
        return BAD_INPUT if any("damaged" in fault for fault in done.faults) else OK
    with opened(arguments.index) as database:
        if arguments.action == "export":
            require_other(arguments.output, arguments.index)
            report.export(database, arguments.output, arguments.to)
            return OK
        if arguments.action == "drift":
            shown = report.drift(database, arguments.unit)
            if arguments.plot is not None:
                report.plot(database, arguments.unit, arguments.plot)
        else:
            shown = report.benches(database)
    say(shown.text)
    return OK if shown.is_good else NOT_GOOD
