"""Command `imudrv check`."""

import argparse
from collections.abc import Iterator
from math import ceil
from pathlib import Path
from typing import Final

from imudrv.bench import Bench
from imudrv.calibration import Calibration
from imudrv.errors import FaultyFileError, InputError
from imudrv.files import settings_file
from imudrv.files.model import Model
from imudrv.profiles.line_load import line_load
from imudrv.profiles.schema import CanLine, Profile
from imudrv.profiles.summary import line, summary
from imudrv.service.settings import Settings
from imudrv.sim.scenario import Scenario
from imudrv.site import Site
from imudrv.terminal import say

EXAMPLE: Final = "unit.yaml"

_KINDS: Final[dict[str, type[Model]]] = {
    "imu50-calibration": Calibration,
    "imu50-site": Site,
    "imu50-profile": Profile,
    "imu50-scenario": Scenario,
    "imu50-service": Settings,
    "imu50-bench": Bench,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, help="the file")


def run(arguments: argparse.Namespace) -> None:
    """Check a file of any kind."""
    kind = settings_file.kind(arguments.file)
    if kind not in _KINDS:
        raise InputError(f"{arguments.file}: format: expected one of {', '.join(_KINDS)}, got {kind!r}")
    model = settings_file.read(arguments.file, _KINDS[kind])
    if isinstance(model, Profile) and (faults := list(_line_faults(model))):
        raise FaultyFileError(str(arguments.file), faults)
    say(f"{arguments.file}: valid {kind} file")
    if isinstance(model, Profile):
        for subject, description in (("line", _line(model)), *summary(model)):
            say(f"  {subject + ':':15}{description}")


def _line_faults(profile: Profile) -> Iterator[str]:
    """Yield why the line cannot carry the samples; a capture is decoded all the same."""
    load = line_load(profile)
    if load <= 1.0:
        return
    if isinstance(profile.line, CanLine):
        # With bit stuffing at its worst; of CAN FD both rates grow in proportion.
        key, speed, unit = "bitrate", profile.line.bitrate, "bit/s"
    else:
        key, speed, unit = "baudrate", profile.line.baudrate, "baud"
    needed = ceil(round(load * speed, 3))
    yield (
        f"line.{key}: expected at least {needed} {unit} for {profile.rate_hz:g} samples/s, got {speed}, of "
        f"which they take {100 * load:.0f} %; set a faster line or a lower rate, as in the unit"
    )


def _line(profile: Profile) -> str:
    return f"{profile.transport}, {line(profile)}, {100 * line_load(profile):.1f} % of it used"
