"""Command `calib export-arms`."""

import argparse
from pathlib import Path
from typing import Final

import yaml

from calib.certificate import lever_arms_of
from calib.cli.arguments import PROGRAMS
from calib.lever_arms.interchange import to_kalibr, to_psins
from imudrv.calibration import read_calibration

EXAMPLE: Final = "unit.yaml --to kalibr > imu.yaml"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("file", type=Path, help="certificate with lever arms")
    parser.add_argument("--to", choices=PROGRAMS, required=True, help="kalibr: YAML; psins: MATLAB")


def run(arguments: argparse.Namespace) -> None:
    """Print lever arms in the format of another program."""
    arms = lever_arms_of(read_calibration(arguments.file), str(arguments.file))
    if arguments.to == "kalibr":
        print("# lever arms of the accelerometers, m, origin at that of x")
        print(yaml.safe_dump({"imu0": to_kalibr(arms)}, sort_keys=False, default_flow_style=None), end="")
        return
    print(f"% lever arms of the accelerometers, m, gauge {arms.gauge}")
    for name, r in to_psins(arms).items():
        print(f"clbt.{name} = [{'; '.join(map(str, r))}];")
