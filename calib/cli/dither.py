"""Command `calib dither`."""

import argparse

from calib.dither.text import dither_text
from imudrv.calibration import read_calibration
from imudrv.errors import InputError
from imudrv.imu.rate_filter import NAMES, rate_filter
from imudrv.units import NS, NS_PER_S


def run_dither(arguments: argparse.Namespace) -> None:
    """Print the effect of dither."""
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
