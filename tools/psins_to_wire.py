"""Convert an IMU log of the PSINS toolbox to wire bytes at 100 Hz.

Text, six integer increments a row; or, as `.bin`, seven float32 a row: angles, velocities, time.

tools/run python tools/psins_to_wire.py lasergyro.imu -o lasergyro.raw
tools/run imudrv decode lasergyro.raw --profile tools/psins-100hz.yaml -o lasergyro.npz
tools/run python tools/psins_to_wire.py imusysclbt.bin -o table.raw
tools/run calib sensors table.raw --profile tools/psins-float-100hz.yaml --pivot fixed ...
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from imudrv import profiles
from imudrv.errors import InputError
from imudrv.records import PULSES, Records, samples_type
from imudrv.terminal import guarded
from imudrv.wire.encode import StreamEncoder

PROFILE = Path(__file__).with_name("psins-100hz.yaml")
FLOAT_PROFILE = Path(__file__).with_name("psins-float-100hz.yaml")
_COLUMNS = 7
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


def read_binary(path: Path) -> Records:
    """Read the increments of a binary log: rows of seven float32, little-endian.

    Parameters
    ----------
    path : Path
        The log.

    Returns
    -------
    ndarray of `imudrv.records.samples_type`
        Increments in rad and m/s, numbered from 0.

    Raises
    ------
    InputError
        The file cannot be read, or holds no whole number of rows.
    """
    try:
        numbers = np.fromfile(path, "<f4")
    except OSError as error:
        raise InputError(f"{path}: expected a binary PSINS log, cannot read it: {error}") from error
    if not len(numbers) or len(numbers) % _COLUMNS:
        raise InputError(f"{path}: expected rows of {_COLUMNS} float32, got {len(numbers)} numbers")
    rows = numbers.reshape(-1, _COLUMNS)
    samples = np.zeros(len(rows), samples_type(gyro_pulses=False, accelerometer_pulses=False))
    samples["counter"] = np.arange(len(rows))
    samples["gyro"] = rows[:, :3]
    samples["accelerometer"] = rows[:, 3:6]
    return samples


def convert(source: Path, output: Path) -> None:
    """Convert a log to wire bytes."""
    is_binary = source.suffix == ".bin"
    encoder = StreamEncoder(profiles.load(str(FLOAT_PROFILE if is_binary else PROFILE)).layout())
    pulses = read_binary(source) if is_binary else read(source)
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
