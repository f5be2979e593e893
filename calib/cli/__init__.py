"""The command `calib`: each module is the command of its name; `arguments` is shared.

A module is imported when its command is called, see `imudrv.terminal.run_program`.
"""

import os
from collections.abc import Sequence
from typing import Final

from imudrv.terminal import run_program

COMMANDS: Final = {
    "run": "Run the bench procedure with a unit: from the first pose to its new certificate.",
    "verify": (
        "Check a session or a certificate: files, signatures, and the result, computed again; "
        "exit code 2 damaged, 3 unfinished, 4 not signed by a trusted key."
    ),
    "key": "Make or show the key with which this bench signs its sessions and certificates.",
    "sensors": (
        "Calibrate the sensors of a unit from rests in several poses and the motions between them; exit "
        "code 3 if the verdict is bad."
    ),
    "fleet": "Index many sessions, and find units that drift and benches that are off.",
    "reidentify": (
        "Identify the sessions of a tree again and compare with what was certified; "
        "exit code 3 if one differs."
    ),
    "identify": "Identify lever arms from captures of rotations: certificate and report.",
    "noise": (
        "Compute the noise of a unit from a long rest: Allan deviations and their coefficients; "
        "exit code 3 if it was not at rest."
    ),
    "align": "Align a rest: level, heading, and its readings against the site; exit code 3 if it moved.",
    "validate": "Navigate the same pulses with and without compensation; exit code 3 if a verdict is bad.",
    "gauge": "Convert the lever arms of a certificate to another gauge, exactly, with their covariance.",
    "export-arms": "Print the lever arms of a certificate in the format of another program.",
    "import-arms": "Write lever arms of another program to a certificate.",
    "dither": "Predict what gyro dither adds to the accelerometers, and what each rate filter compensates.",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run `calib` with some arguments, those of the process if None; return the exit code."""
    # numpy comes later: threads make matrices of a few hundred rows slower, much so on a busy machine
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    return run_program(__name__, "Inner lever arms of a 50-type ring-laser-gyro IMU.", COMMANDS, argv)
