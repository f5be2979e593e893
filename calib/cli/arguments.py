"""Types of command-line arguments."""

import argparse
from math import inf, nan
from pathlib import Path
from typing import Final, Literal, TypeAlias, get_args

from calib.estimation.result import Extra
from calib.lever_arms.gauge import LeverArms
from imudrv.calibration import Calibration
from imudrv.errors import InputError
from imudrv.files.outputs import file_to_write, require_other
from imudrv.units import MM


def check_output(path: Path, *inputs: str | Path | None) -> None:
    """Refuse an output before the work, instead of behind it."""
    file_to_write(path)
    require_other(path, *inputs)


Stated: TypeAlias = tuple[Literal["x", "y", "z"], list[float]]


EXTRAS: Final[tuple[Extra, ...]] = get_args(Extra)


PROGRAMS: Final = ("kalibr", "psins")


def written_text(path: Path, calibration: Calibration, arms: LeverArms) -> str:
    """Return the line that reports a written certificate."""
    return f"{path}: certificate of unit {calibration.serial_number}, gauge {arms.gauge}"


def one_or_three(text: str) -> tuple[float, ...]:
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


def positive(text: str) -> float:
    """Parse a positive number."""
    value = _not_negative(text)
    if value == 0.0:
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text!r}")
    return value


def extra_terms(text: str) -> tuple[Extra, ...]:
    """Parse the extra parameters to estimate."""
    names = tuple(text.split(","))
    if unknown := [name for name in names if name not in EXTRAS]:
        raise argparse.ArgumentTypeError(f"expected {' or '.join(EXTRAS)}, got {unknown[0]!r}")
    return tuple(name for name in EXTRAS if name in names)


def known_point(text: str | None) -> Stated | None:
    """Take `y=12.5,-3,40` apart."""
    if text is None:
        return None
    accelerometer, _, rest = text.partition("=")
    try:
        point = [float(value) * MM for value in rest.split(",")]
    except ValueError:
        point = []
    for name in ("x", "y", "z"):
        if accelerometer == name and len(point) == 3:
            return name, point
    raise InputError(
        f"--at: expected an accelerometer and three numbers in mm, such as y=12.5,-3,40, got {text!r}"
    )
