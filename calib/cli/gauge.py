"""Command `calib gauge`."""

import argparse
from pathlib import Path
from typing import Any, Final

from calib.certificate import PROVENANCE_CONVERTED, lever_arms_of, with_lever_arms, write
from calib.cli.arguments import add_certificate_output, add_gauge, check_output, known_point, written_text
from calib.lever_arms.gauge import convert
from calib.reports.identification import arms_text
from calib.signing.keys import bench_key
from imudrv.calibration import read_calibration_file
from imudrv.terminal import say
from imudrv.units import MM

EXAMPLE: Final = "unit.yaml --to x -o unit-x.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, help="certificate with lever arms")
    add_gauge(parser, "--to", required=True)
    add_certificate_output(parser)


def run(arguments: argparse.Namespace) -> None:
    """Convert the gauge of a certificate."""
    check_output(arguments.output, arguments.file)
    key = bench_key()
    file = read_calibration_file(arguments.file)
    before = lever_arms_of(file.model, str(arguments.file))
    point = known_point(arguments.at)
    arms = convert(before, arguments.gauge, point)
    how: dict[str, Any] = {"from": before.gauge, "to": arms.gauge, "file_sha256": file.sha256}
    if point is not None:
        accelerometer, r_b = point
        how["stated_mm"] = {accelerometer: [value / MM for value in r_b]}
    write(arguments.output, with_lever_arms(file.model, arms, PROVENANCE_CONVERTED, how), key)
    print(arms_text(arms), end="")
    say(written_text(arguments.output, file.model, arms))
