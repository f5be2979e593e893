"""Command `calib align`."""

import argparse
from pathlib import Path
from typing import Final

from calib.alignment import align
from calib.cli.arguments import add_channel
from calib.reports.alignment import document
from calib.reports.text import print_document
from imudrv.cli.arguments import add_profile
from imudrv.errors import InputError
from imudrv.terminal import OK, progress

EXAMPLE: Final = "z-up.raw --profile imu50-rs422 --calibration unit.yaml --site site.yaml"

MOVED: Final = 3
"""Exit code: the unit was not at rest."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add = parser.add_argument
    text = "wire bytes, CAN log, or recording (.mcap), which contains its profile and calibration"
    add("capture", type=Path, metavar="CAPTURE", help=text)
    add_profile(parser)
    add_channel(parser)
    text = "calibration of the unit; default: the one in the recording"
    add("--calibration", type=Path, metavar="C.yaml", help=text)
    text = "site of the capture: latitude, longitude, height, gravity where it was measured"
    add("--site", type=Path, required=True, metavar="S.yaml", help=text)
    text = "begin of the rest, from the beginning of the capture (default: the longest rest)"
    add("--from", dest="begin_s", type=float, metavar="S", help=text)
    add("--to", dest="end_s", type=float, metavar="S", help="its end")


def run(arguments: argparse.Namespace) -> int:
    """Print level and heading of a rest, and its readings against the site."""
    begin_s, end_s = arguments.begin_s, arguments.end_s
    if (begin_s is None) != (end_s is None):
        raise InputError("align: expected --from and --to together, got one of them")
    passes = 2 if begin_s is None else 1
    size = arguments.capture.stat().st_size if arguments.capture.exists() else 0
    with progress("align", passes * size) as advance:
        result = align(
            arguments.capture,
            site=arguments.site,
            calibration=arguments.calibration,
            profile=arguments.profile,
            window_s=None if begin_s is None else (begin_s, end_s),
            channel=arguments.channel,
            advance=advance,
        )
    print_document(document(result))
    return MOVED if result.aligned.motion else OK
