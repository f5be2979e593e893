"""Command `imudrv sim`."""

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Final

from imudrv import profiles
from imudrv.calibration import write_calibration
from imudrv.cli.arguments import add_profile, message_stream
from imudrv.errors import InputError
from imudrv.files.outputs import require_other
from imudrv.files.tables import table, writing
from imudrv.service.printer import Printer
from imudrv.sim import scenario as scenarios
from imudrv.sim.capture import record
from imudrv.sim.live import play
from imudrv.sim.truth import true_calibration
from imudrv.terminal import progress, say
from imudrv.url import speed_of
from imudrv.wording import counted

EXAMPLE: Final = "rocking --profile imu50-rs422 --port pty --link /tmp/imu50"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    text = f"{', '.join(scenarios.shipped())}, or a scenario file (keys: tools/guides/simulation.md)"
    parser.add_argument("scenario", help=text)
    add_profile(parser, required=True)
    target = parser.add_mutually_exclusive_group(required=True)
    text = "capture to write; - for standard output"
    target.add_argument("-o", "--output", type=Path, metavar="CAPTURE", help=text)
    text = "send live on pty, serial://PATH, can://INTERFACE/CHANNEL or tcp://[HOST]:PORT"
    target.add_argument("--port", metavar="URL", help=text)
    text = "FILE.npz: true motion, sample by sample; FILE.yaml: calibration of the true unit"
    parser.add_argument("--truth", type=Path, metavar="FILE", help=text)
    parser.add_argument("--speed", metavar="X", help="speed of a live run: 1, 10, ... or max (default: 1)")
    parser.add_argument("--link", metavar="NAME", help="stable name for the pty of a live run")


def run(arguments: argparse.Namespace) -> None:
    """Simulate a unit, to a capture or live."""
    if arguments.port is not None:
        _play(arguments)
    else:
        _record(arguments)


def _record(arguments: argparse.Namespace) -> None:
    if arguments.speed or arguments.link:
        raise InputError("--speed, --link: expected with --port; a capture has no speed")
    layout = profiles.load(arguments.profile).layout()
    scenario = scenarios.load(arguments.scenario)
    samples = scenarios.samples(scenario, layout.interval)
    of_motion = arguments.truth is not None and arguments.truth.suffix == ".npz"
    if arguments.truth is not None and arguments.truth.suffix not in (".npz", ".yaml"):
        raise InputError(f"--truth {arguments.truth}: expected a name ending in .npz or .yaml")
    for output in filter(None, (arguments.output, arguments.truth)):
        require_other(output, arguments.profile, *scenarios.files(arguments.scenario))
    with ExitStack() as stack:
        capture = stack.enter_context(writing(arguments.output))
        advance = stack.enter_context(progress("simulate", samples))
        rows = stack.enter_context(table(arguments.truth, (".npz",), {})) if of_motion else None
        for data, truth in record(scenario, layout):
            capture.write(data)
            if rows is not None:
                rows.write({name: truth[name] for name in truth.dtype.names or ()})
            advance(len(truth))
    if arguments.truth is not None and not of_motion:
        write_calibration(arguments.truth, true_calibration(scenario, layout))
    say(
        f"{arguments.output}: {counted(samples, 'sample')} of {layout.name}, seed {scenario.seed}",
        message_stream(arguments.output),
    )


def _play(arguments: argparse.Namespace) -> None:
    if arguments.truth is not None:
        raise InputError("--truth: expected with -o; a live run writes no file")
    profile = profiles.load(arguments.profile)
    scenario = scenarios.load(arguments.scenario)
    speed = speed_of(arguments.speed or "1")
    with Printer(sys.stdout) as printer:
        printer.say(str(play(scenario, profile, arguments.port, speed, printer.say, arguments.link)))
    if printer.failure:
        raise InputError(printer.failure)
