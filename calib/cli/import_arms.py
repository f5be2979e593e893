"""Command `calib import-arms`."""

import argparse
import re
from hashlib import sha256
from pathlib import Path
from typing import Final

from pydantic import ConfigDict, JsonValue

from calib.certificate import PROVENANCE_IDENTIFIED, with_lever_arms, write
from calib.cli.arguments import PROGRAMS, add_certificate_output, check_output, written_text
from calib.lever_arms.interchange import from_kalibr, from_psins
from calib.reports.identification import arms_text
from calib.signing.keys import bench_key
from imudrv.calibration import read_calibration
from imudrv.errors import InputError
from imudrv.files import atomic, settings_file
from imudrv.files.model import Model
from imudrv.terminal import say

EXAMPLE: Final = "imu.yaml --from kalibr --calibration unit.yaml -o new.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = "imu.yaml of Kalibr; for PSINS the file of clbtfile (cm), or lines clbt.rx = [...] (m)"
    parser.add_argument("file", type=Path, help=text)
    text = "program that wrote the file"
    parser.add_argument("--from", dest="program", choices=PROGRAMS, required=True, help=text)
    text = "calibration of the unit"
    parser.add_argument("--calibration", type=Path, required=True, metavar="C.yaml", help=text)
    add_certificate_output(parser)


def run(arguments: argparse.Namespace) -> None:
    """Write lever arms of another program to a certificate."""
    check_output(arguments.output, arguments.file, arguments.calibration)
    key = bench_key()
    calibration = read_calibration(arguments.calibration)
    if arguments.program == "kalibr":
        file = settings_file.read_file(arguments.file, _Kalibr)
        arms, digest = from_kalibr(file.model.imu0), file.sha256
    else:
        content = atomic.content(arguments.file)
        arms, digest = from_psins(_clbt(content, arguments.file)), sha256(content).hexdigest()
    how = {"method": f"imported from {arguments.program}", "file_sha256": digest}
    write(arguments.output, with_lever_arms(calibration, arms, PROVENANCE_IDENTIFIED, how), key)
    print(arms_text(arms), end="")
    say(written_text(arguments.output, calibration, arms))


class _Kalibr(Model):
    """The part of an IMU file of Kalibr that is used."""

    model_config = ConfigDict(extra="ignore")

    imu0: dict[str, JsonValue]


def _clbt(content: bytes, path: Path) -> dict[str, list[float]]:
    """Return the rows of MATLAB text, m: `clbt.rx = [...]` is in m, `rx = [...]` of `clbtfile` in cm."""
    text = content.decode("utf-8", errors="replace")
    rows = {}
    for prefix, name, row in re.findall(r"^\s*(clbt\.)?(r[xyz])\s*=\s*\[([^\]]*)\]", text, re.MULTILINE):
        try:
            values = [float(value) for value in re.split(r"[\s;,]+", row.strip())]
        except ValueError:
            raise InputError(f"{path}: {name}: expected three numbers, got {row.strip()[:60]!r}") from None
        rows[name] = values if prefix else [value * 1e-2 for value in values]
    return rows
