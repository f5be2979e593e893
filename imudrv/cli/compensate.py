"""Command `imudrv compensate`."""

import argparse
from pathlib import Path
from typing import Final

from imudrv.calibration import coefficients, read_calibration_file, require_unit
from imudrv.cli.arguments import add_output, message_stream
from imudrv.cli.capture import add_capture, open_capture, print_losses
from imudrv.errors import InputError
from imudrv.files.outputs import require_other
from imudrv.files.tables import increment_columns, table
from imudrv.imu.compensation import LEAVES_OUT_SKEW, Compensator
from imudrv.imu.rate_filter import NAMES
from imudrv.terminal import progress, say
from imudrv.wording import counted

EXAMPLE: Final = "z-up.raw --profile imu50-rs422 --calibration unit.yaml -o increments.npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_capture(parser)
    text = "calibration of the unit; default: the one in the recording"
    parser.add_argument("--calibration", type=Path, metavar="C.yaml", help=text)
    text = "serial number of the unit; the calibration of another unit is rejected"
    parser.add_argument("--unit", metavar="SERIAL", help=text)
    text = "angular rate for the size effect (default: causal)"
    parser.add_argument("--rate-filter", choices=NAMES, default="causal", help=text)
    add_output(parser, "NAME.csv, NAME.npz or NAME.i50n; - for csv on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Write the compensated increments of a capture as a table."""
    require_other(arguments.output, arguments.capture, arguments.profile, arguments.calibration)
    capture = open_capture(arguments)
    if arguments.calibration is not None:
        file = read_calibration_file(arguments.calibration, arguments.unit)
        calibration, origin = file.model, f"calibration {file.sha256[:12]}"
    elif capture.recording is not None and (recorded := capture.recording.calibration) is not None:
        require_unit(recorded, arguments.unit, str(arguments.capture))
        calibration, origin = recorded, "calibration of the recording"
    else:
        raise InputError("expected --calibration: only a recording of the service contains a calibration")
    compensator = Compensator(coefficients(calibration), capture.layout, arguments.rate_filter)
    with (
        table(arguments.output, (".csv", ".npz", ".i50n"), {}) as rows,
        progress("compensate", capture.size or None) as advance,
    ):
        for increments in capture.increments(compensator, advance):
            rows.write(increment_columns(increments))
    code = print_losses(capture, arguments.output)
    stream = message_stream(arguments.output)
    size_effect = "compensated"
    if not calibration.size_effect:
        size_effect = "not compensated: the calibration has no sensing points"
    elif not compensator.has_size_effect:
        size_effect = f"not compensated: {capture.layout.name} lacks axes"
    say(f"  unit {calibration.serial_number}, {origin}", stream)
    if compensator.leaves_out_skew:
        say(f"  {LEAVES_OUT_SKEW}", stream)
    delay = counted(compensator.lag, "sample")
    say(f"  size effect {size_effect}; rate filter {arguments.rate_filter}, delay {delay}", stream)
    return code
