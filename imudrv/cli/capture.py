"""The capture that `decode` and `compensate` read, and the summary of its losses."""

import argparse
import sys
from pathlib import Path

from imudrv.capture import Capture
from imudrv.cli.arguments import add_profile, message_stream
from imudrv.terminal import BAD_INPUT, OK, say
from imudrv.wire.layout import Layout, SequenceKind
from imudrv.wording import counted


def add_capture(parser: argparse.ArgumentParser) -> None:
    """Add the arguments that `open_capture` takes."""
    text = "wire bytes, a CAN log (candump, .asc, .blf, .trc, ..), also .gz or .zst; or a recording (.mcap)"
    parser.add_argument("capture", type=Path, help=text)
    add_profile(parser)
    parser.add_argument("--channel", metavar="NAME", help="channel of a CAN log, such as can0")


def open_capture(arguments: argparse.Namespace) -> Capture:
    """Open the capture that the arguments name."""
    return Capture(arguments.capture, arguments.profile, arguments.channel)


def print_losses(capture: Capture, output: Path) -> int:
    """Print what was read, and which samples and bytes were lost or rejected; return the exit code."""
    stream = message_stream(output)
    file = capture.file
    what = f" of {file.description}" if file.is_converted or file.archive else ""
    say(f"{capture.path}: {capture.layout.name}, {capture.size} bytes{what} -> {output}", stream)
    if capture.is_profile_found:
        say(f"  profile {capture.layout.name}: found, for it fits best of the shipped ones", stream)
    counts = capture.tracker.counts
    say(f"  {counts}", stream)
    if counts.unknown_gaps:
        say(f"  {_unknown_gaps(counts.unknown_gaps, capture.layout)}", stream)
    for reason, rejected in sorted(capture.rejected.items()):
        name = reason.name.lower().replace("_", " ")
        first = ", ".join(map(str, rejected.first))
        more = ", ..." if rejected.runs > len(rejected.first) else ""
        where = "" if file.is_converted else f", at {first}{more}"
        say(f"  {name}: {rejected.runs} x, {rejected.length} in all{where}", stream)
    for channel, messages in list(capture.channels.items())[1:]:
        say(f"  ignored: {counted(messages, 'message')} of channel {channel}", stream)
    for hint in capture.hints:
        say(f"  hint: {hint}", stream)
    if fault := capture.sequence_fault:
        say(f"error: {capture.path}: {fault}", sys.stderr)
        return BAD_INPUT
    return OK


def _unknown_gaps(count: int, layout: Layout) -> str:
    """Say how long the gaps may be whose length neither a counter nor a time of arrival gives."""
    gaps = f"{counted(count, 'gap')} of unknown length"
    if layout.sequence.kind is SequenceKind.NONE:
        return f"{gaps}: the unit sends no counter, and the capture has no times of arrival"
    return (
        f"{gaps}, counted with the smallest: or {float(layout.samples_a_round):g} samples more, "
        "any number of times, for the capture has no times of arrival"
    )
