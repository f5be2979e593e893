"""Command `imudrv check`."""

import argparse
from pathlib import Path
from typing import Final

from imudrv.calibration import Calibration
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.files.model import Model
from imudrv.profiles.schema import Profile
from imudrv.service.settings import Settings
from imudrv.sim.scenario import Scenario
from imudrv.site import Site

EXAMPLE: Final = "unit.yaml"

_KINDS: Final[dict[str, type[Model]]] = {
    "imu50-calibration": Calibration,
    "imu50-site": Site,
    "imu50-profile": Profile,
    "imu50-scenario": Scenario,
    "imu50-service": Settings,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, help="the file")


def run(arguments: argparse.Namespace) -> None:
    """Check a file of any kind."""
    kind = settings_file.kind(arguments.file)
    if kind not in _KINDS:
        raise InputError(f"{arguments.file}: format: expected one of {', '.join(_KINDS)}, got {kind!r}")
    settings_file.read(arguments.file, _KINDS[kind])
    print(f"{arguments.file}: valid {kind} file")
