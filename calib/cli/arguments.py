"""Arguments that several commands have."""

import argparse
from pathlib import Path
from typing import Any, Final

from calib.lever_arms.gauge import GAUGES, LeverArms
from imudrv.calibration import Calibration
from imudrv.errors import InputError
from imudrv.files.outputs import file_to_write, require_other
from imudrv.units import MM

PROGRAMS: Final = ("kalibr", "psins")
"""Programs that lever arms are exchanged with."""


def add_gauge(parser: argparse.ArgumentParser, option: str, **more: Any) -> None:
    """Add the gauge under the name of an option, and ``--at``, see `known_point`."""
    text = "origin of the body frame"
    parser.add_argument(option, dest="gauge", choices=GAUGES, help=text, **more)
    text = "for gauge given: known sensing point of accelerometer A, mm, such as y=12.5,-3,40"
    parser.add_argument("--at", metavar="A=X,Y,Z", help=text)


def add_channel(parser: argparse.ArgumentParser) -> None:
    """Add ``--channel``."""
    parser.add_argument("--channel", metavar="NAME", help="channel of CAN logs, such as can0")


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Add ``--workers`` and ``--scheduler``, of which one may be given, see `calib.fleet.spread`."""
    where = parser.add_mutually_exclusive_group()
    text = "processes on this computer (default: 1; more need pip install imu50[dask])"
    where.add_argument("--workers", type=int, default=1, metavar="N", help=text)
    text = "Dask scheduler whose workers do it, such as tcp://host:8786; with the same software and paths"
    where.add_argument("--scheduler", metavar="URL", help=text)


def add_certificate_output(parser: argparse.ArgumentParser) -> None:
    """Add ``-o``, required."""
    text = "certificate to write"
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="NEW.yaml", help=text)


def known_point(text: str | None) -> tuple[str, list[float]] | None:
    """Parse an accelerometer and its sensing point, mm, such as ``y=12.5,-3,40``; return it in m."""
    if text is None:
        return None
    accelerometer, _, rest = text.partition("=")
    try:
        point = [float(value) * MM for value in rest.split(",")]
    except ValueError:
        point = []
    if accelerometer not in ("x", "y", "z") or len(point) != 3:
        raise InputError(
            f"--at: expected an accelerometer and three numbers in mm, such as y=12.5,-3,40, got {text!r}"
        )
    return accelerometer, point


def check_output(path: Path, *inputs: str | Path | None) -> None:
    """Refuse an unusable output before the work, not after it."""
    file_to_write(path)
    require_other(path, *inputs)


def written_text(path: Path, calibration: Calibration, arms: LeverArms) -> str:
    """Return the line that reports a written certificate."""
    return f"{path}: certificate of unit {calibration.serial_number}, gauge {arms.gauge}"
