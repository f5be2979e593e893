"""Command `imudrv decode`."""

import argparse
from typing import Final

from imudrv.cli.arguments import add_output
from imudrv.cli.capture import add_capture, open_capture, print_losses
from imudrv.files.outputs import require_other
from imudrv.files.tables import pulse_columns, table
from imudrv.terminal import progress

EXAMPLE: Final = "z-up.raw --profile imu50-rs422 -o pulses.npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add_capture(parser)
    add_output(parser, "NAME.csv or NAME.npz; - for csv on standard output")


def run(arguments: argparse.Namespace) -> int:
    """Write the pulse increments of a capture as a table."""
    require_other(arguments.output, arguments.capture, arguments.profile)
    capture = open_capture(arguments)
    parts = {"temperature_degc": capture.layout.temperature_names}
    with (
        table(arguments.output, (".csv", ".npz"), parts) as rows,
        progress("decode", capture.size or None) as advance,
    ):
        for pulses in capture.pulses(advance):
            rows.write(pulse_columns(pulses, capture.layout))
    return print_losses(capture, arguments.output)
