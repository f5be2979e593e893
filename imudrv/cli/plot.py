"""Command `imudrv plot`."""

import argparse
from pathlib import Path
from typing import Final

from imudrv.calibration import read_calibration
from imudrv.cli.arguments import add_output
from imudrv.cli.capture import add_capture, open_capture, print_losses
from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.files.outputs import file_to_write, require_other
from imudrv.plot import Overview
from imudrv.terminal import progress

EXAMPLE: Final = "z-up.raw --calibration unit.yaml -o z-up.png"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_capture(parser)
    text = "for rates and specific force of a unit that sends pulses; default: the one in the recording"
    parser.add_argument("--calibration", type=Path, metavar="C.yaml", help=text)
    add_output(parser, "NAME.png or NAME.html")


def run(arguments: argparse.Namespace) -> int:
    """Draw pulses, rates, specific force, losses and temperatures of a capture."""
    output = arguments.output
    if output.suffix not in (".png", ".html"):
        raise InputError(f"-o {output}: expected a name ending in .png or .html")
    require_other(output, arguments.capture, arguments.profile, arguments.calibration)
    capture = open_capture(arguments)
    calibration = None if capture.recording is None else capture.recording.calibration
    if arguments.calibration is not None:
        calibration = read_calibration(arguments.calibration)
    with progress("plot", capture.size or None) as advance:
        overview = Overview(capture, calibration, advance)
    drawn = overview.png() if output.suffix == ".png" else overview.html().encode()
    with atomic_write(file_to_write(output)) as file:
        file.write(drawn)
    return print_losses(capture, output)
