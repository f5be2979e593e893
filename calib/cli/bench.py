"""Commands `calib run` and `calib verify`."""

import argparse

from rich.console import Console

from calib.bench.run import RunOptions, new_folder, run
from calib.bench.verify import verify
from imudrv.terminal import BAD_INPUT, OK


def run_session(arguments: argparse.Namespace) -> int:
    """Run or resume a session at the bench."""
    options = RunOptions(
        folder=arguments.session or new_folder(),
        port=arguments.port,
        profile=arguments.profile,
        calibration=arguments.calibration,
        site=arguments.site,
        procedure=arguments.procedure,
        hands_free=arguments.hands_free,
        rehearse=arguments.rehearse,
        speed=arguments.speed,
        redo=tuple(arguments.redo),
    )
    return run(options, Console())


def run_verify(arguments: argparse.Namespace) -> int:
    """Verify a session."""
    verified = verify(arguments.session)
    print(verified)
    return BAD_INPUT if verified.faults else OK
