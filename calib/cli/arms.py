"""Commands `calib gauge`, `calib export-arms` and `calib import-arms`."""

import argparse
import re
from hashlib import sha256
from pathlib import Path
from typing import Any

import yaml
from pydantic import ConfigDict, JsonValue

from calib.certificate import (
    PROVENANCE_CONVERTED,
    PROVENANCE_IDENTIFIED,
    lever_arms_of,
    with_lever_arms,
    write,
)
from calib.cli.arguments import check_output, known_point, written_text
from calib.lever_arms.gauge import convert
from calib.lever_arms.interchange import from_kalibr, from_psins, to_kalibr, to_psins
from calib.reports.identification import arms_text
from imudrv.calibration import read_calibration, read_calibration_file
from imudrv.errors import InputError
from imudrv.files import atomic, settings_file
from imudrv.files.model import Model
from imudrv.units import MM


def run_gauge(arguments: argparse.Namespace) -> None:
    """Convert the gauge of a certificate."""
    check_output(arguments.output, arguments.file)
    file = read_calibration_file(arguments.file)
    before = lever_arms_of(file.model, str(arguments.file))
    stated = known_point(arguments.at)
    arms = convert(before, arguments.gauge, stated)
    how: dict[str, Any] = {
        "from": before.gauge,
        "to": arms.gauge,
        "file_sha256": file.sha256,
    }
    if stated is not None:
        how["stated_mm"] = {stated[0]: [value / MM for value in stated[1]]}
    write(arguments.output, with_lever_arms(file.model, arms, PROVENANCE_CONVERTED, how))
    print(arms_text(arms), end="")
    print(written_text(arguments.output, file.model, arms))


def run_export(arguments: argparse.Namespace) -> None:
    """Export lever arms."""
    arms = lever_arms_of(read_calibration(arguments.file), str(arguments.file))
    if arguments.to == "kalibr":
        print("# lever arms of the accelerometers, m, origin at that of x")
        print(yaml.safe_dump({"imu0": to_kalibr(arms)}, sort_keys=False, default_flow_style=None), end="")
        return
    print(f"% lever arms of the accelerometers, m, gauge {arms.gauge}")
    for name, r in to_psins(arms).items():
        print(f"clbt.{name} = [{'; '.join(map(str, r))}];")


def run_import(arguments: argparse.Namespace) -> None:
    """Import lever arms."""
    check_output(arguments.output, arguments.file, arguments.calibration)
    calibration = read_calibration(arguments.calibration)
    if arguments.program == "kalibr":
        file = settings_file.read_file(arguments.file, _Kalibr)
        arms, digest = from_kalibr(file.model.imu0), file.sha256
    else:
        content = atomic.content(arguments.file)
        arms, digest = from_psins(_clbt(content, arguments.file)), sha256(content).hexdigest()
    how = {"method": f"imported from {arguments.program}", "file_sha256": digest}
    write(arguments.output, with_lever_arms(calibration, arms, PROVENANCE_IDENTIFIED, how))
    print(arms_text(arms), end="")
    print(written_text(arguments.output, calibration, arms))


class _Kalibr(Model):
    """What matters of the IMU file that Kalibr writes."""

    model_config = ConfigDict(extra="ignore")

    imu0: dict[str, JsonValue]


def _clbt(content: bytes, path: Path) -> dict[str, list[float]]:
    """Rows of MATLAB text, m: `clbt.rx = [...]` of a program is in m, `rx = [...]` of `clbtfile` in cm."""
    text = content.decode("utf-8", errors="replace")
    rows = {}
    for prefix, name, row in re.findall(r"^\s*(clbt\.)?(r[xyz])\s*=\s*\[([^\]]*)\]", text, re.MULTILINE):
        try:
            values = [float(value) for value in re.split(r"[\s;,]+", row.strip())]
        except ValueError:
            raise InputError(f"{path}: {name}: expected three numbers, got {row.strip()[:60]!r}") from None
        rows[name] = values if prefix else [value * 1e-2 for value in values]
    return rows
