"""Convert an IMU log of the PSINS toolbox (text, six integer increments a row) to wire bytes at 100 Hz.

tools/run python tools/psins_to_wire.py lasergyro.imu -o lasergyro.raw
tools/run imudrv decode lasergyro.raw --profile tools/psins-100hz.yaml -o lasergyro.npz
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.records import PULSES, Records
from imudrv.terminal import guarded
from imudrv.wire.encode import StreamEncoder

PROFILE = Path(__file__).with_name("psins-100hz.yaml")
_INITIAL_ROWS = 3
_CHUNK = 1 << 14


def read(path: Path) -> Records:
    """Read the increments of a log.

    Parameters
    ----------
    path : Path
        The log: ``%`` comments, three rows of initial values and scale factors, then the increments.

    Returns
    -------
    ndarray of PULSES
        Numbered from 0.

    Raises
    ------
    InputError
        The file cannot be read, or has another format.
    """
    try:
        lines = [
            line for line in path.read_text("ascii").splitlines() if line.strip() and not line.startswith("%")
        ]
        rows = np.loadtxt(lines[_INITIAL_ROWS:], np.int64, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: expected a PSINS log of six integers a row, cannot read it: {error}"
        ) from error
    if rows.ndim != 2 or rows.shape[1] != 6:
        raise InputError(f"{path}: expected six integers a row, got an array of shape {rows.shape}")
    pulses = np.zeros(len(rows), PULSES)
    pulses["counter"] = np.arange(len(rows))
    pulses["gyro"] = rows[:, :3]
    pulses["accelerometer"] = rows[:, 3:]
    return pulses


def convert(source: Path, output: Path) -> None:
    """Convert a log to wire bytes."""
    encoder = StreamEncoder(profiles.load(str(PROFILE)).layout())
    pulses = read(source)
    with output.open("wb") as file:
        for at in range(0, len(pulses), _CHUNK):
            file.write(encoder.encode(pulses[at : at + _CHUNK]).tobytes())
    print(f"{output}: {len(pulses)} samples")


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source", type=Path)
    parser.add_argument("-o", "--output", type=Path, required=True)
    arguments = parser.parse_args()
    return guarded(lambda: convert(arguments.source, arguments.output))


if __name__ == "__main__":
    sys.exit(main())
