"""The command `imudrv`: each module is the command of its name; `arguments` and `capture` are shared.

A module is imported when its command is called, see `imudrv.terminal.run_program`.
"""

from collections.abc import Sequence
from typing import Final

from imudrv.terminal import run_program

COMMANDS: Final = {
    "demo": "Demonstrate service, bench procedure, certificate and verification on a simulated unit.",
    "doctor": "Diagnose why no data arrive from a unit, and say what to do.",
    "run": "Run the live service: data of a unit in, compensated increments out.",
    "receive": "Count the samples that running services send, by unit.",
    "monitor": "Show a running service on the terminal.",
    "status": "Print the health of a running service; exit code 0 ok, 3 warning, 4 failure.",
    "decode": "Decode a capture to pulse increments.",
    "compensate": "Compensate a capture: increments in body axes.",
    "plot": "Draw a first look at a capture or recording: pulses, rates, losses, temperatures.",
    "export": "Convert a recording to another format.",
    "view": "Show samples in Foxglove or Lichtblick, live or from a recording.",
    "pack": "Compress and index a recording, with samples that plotting programs read.",
    "sim": "Simulate a unit: to a capture, or live on a port.",
    "profiles": "List the shipped profiles, print one, or begin one from a DBC file.",
    "files": "Write the files for C programs, udev and systemd to a folder.",
    "check": "Check a calibration, site, profile, scenario or settings file.",
    "warm": "Compile all kernels ahead of the first start.",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run `imudrv` with some arguments, those of the process if None; return the exit code."""
    return run_program(__name__, "Driver of a 50-type ring-laser-gyro IMU.", COMMANDS, argv)
