"""Command `imudrv export`."""

import argparse
from pathlib import Path
from typing import Final

from imudrv.cli.arguments import add_output, message_stream
from imudrv.errors import InputError
from imudrv.recording.export import KINDS, export, export_datagrams
from imudrv.recording.reader import Recording
from imudrv.recording.ros2 import AXES, DEFAULT_CONVENTION, Convention
from imudrv.terminal import say

EXAMPLE: Final = "run.mcap --to npz -o run.npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = "a recording (.mcap), or datagrams (.i50n), which raw and candump cannot be made from"
    parser.add_argument("recording", type=Path, help=text)
    parser.add_argument("--to", choices=KINDS, required=True, help="output format")
    add_output(parser, "file to write; - for standard output with csv, raw, candump")
    text = f"of ros2: name of the frame (default: {DEFAULT_CONVENTION.frame_id})"
    parser.add_argument("--frame-id", metavar="NAME", help=text)
    text = "of ros2: X forward, Y left, Z up (flu, REP 103, default), or the unit's: X right, Y front, Z up"
    parser.add_argument("--axes", choices=list(AXES), help=text)


def run(arguments: argparse.Namespace) -> None:
    """Write a recording in another format."""
    named = {name: value for name in ("frame_id", "axes") if (value := getattr(arguments, name)) is not None}
    if named and arguments.to != "ros2":
        option = next(iter(named)).replace("_", "-")
        raise InputError(f"--{option}: expected --to ros2, got --to {arguments.to}; leave the option out")
    source, target = arguments.recording, arguments.output
    if source.suffix.lower() == ".i50n":
        done = export_datagrams(source, arguments.to, target, Convention(**named))
    else:
        done = export(Recording(source), arguments.to, target, Convention(**named))
    say(f"{source} -> {target}: {done}", message_stream(target))
