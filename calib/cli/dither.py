"""Command `calib dither`."""

import argparse
from math import inf, nan
from pathlib import Path
from typing import Final

from calib.dither.text import dither_text
from imudrv.calibration import read_calibration
from imudrv.errors import InputError
from imudrv.imu.rate_filter import NAMES, rate_filter
from imudrv.units import NS, NS_PER_S

EXAMPLE: Final = "--amplitude-arcsec 150 --frequency-hz 400,405,393 --certificate unit.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add = parser.add_argument
    text = "dither amplitude of the gyros x, y, z, such as 150; 150,0,0 for the x gyro alone"
    add("--amplitude-arcsec", type=_one_or_three, required=True, metavar="A[,A,A]", help=text)
    text = "dither frequency of the gyros x, y, z, such as 400,405,393"
    add("--frequency-hz", type=_one_or_three, required=True, metavar="F[,F,F]", help=text)
    text = "certificate with lever arms"
    add("--certificate", type=Path, required=True, metavar="C.yaml", help=text)
    add("--rate-hz", type=_positive, default=1000.0, metavar="HZ", help="sample rate (default: 1000)")
    add("--rate-filter", choices=NAMES, help="one rate filter (default: all of them)")
    text = "angle of the case divided by that of the gyro block (default: 0.01)"
    add("--case-reaction", type=_positive, default=0.01, metavar="RATIO", help=text)


def _one_or_three(text: str) -> tuple[float, ...]:
    """Parse one or three numbers, none negative."""
    values = tuple(_not_negative(part) for part in text.split(","))
    if len(values) not in (1, 3):
        raise argparse.ArgumentTypeError(f"expected one number or three, got {text!r}")
    return values * 3 if len(values) == 1 else values


def _not_negative(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = nan
    if not 0.0 <= value < inf:
        raise argparse.ArgumentTypeError(f"expected a number, not negative, got {text!r}")
    return value


def _positive(text: str) -> float:
    """Parse a positive number."""
    value = _not_negative(text)
    if value == 0.0:
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text!r}")
    return value


def run(arguments: argparse.Namespace) -> None:
    """Print the effect of dither on the accelerometers of a unit."""
    if not 1.0 <= arguments.rate_hz <= 100_000.0:
        raise InputError(f"--rate-hz: expected 1 to 100000, got {arguments.rate_hz:g}")
    interval_ns = round(NS_PER_S / arguments.rate_hz)
    names = NAMES if arguments.rate_filter is None else (arguments.rate_filter,)
    text = dither_text(
        read_calibration(arguments.certificate),
        arguments.amplitude_arcsec,
        arguments.frequency_hz,
        [rate_filter(name, interval_ns) for name in names],
        interval_ns * NS,
        arguments.case_reaction,
    )
    print(text, end="")
