"""Command `calib validate`."""

import argparse
from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Final

from calib.api import validate
from calib.certificate import lever_arms_of
from calib.cli.arguments import add_channel, add_workers, check_output
from calib.fleet.spread import spread
from calib.reports.html import as_html
from calib.reports.text import print_document
from calib.reports.validation import document
from calib.validation.simulate import TRIALS, campaign, dither_trials, skew_trials
from calib.validation.trial import RATE_FILTER
from calib.validation.verdict import Validation, evaluate
from imudrv.calibration import Calibration, read_calibration
from imudrv.cli.arguments import add_profile
from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.files.inputs import total_size
from imudrv.imu.rate_filter import NAMES, RateFilterName
from imudrv.nav.alignment import ALIGNMENT_S
from imudrv.terminal import NOT_GOOD, OK, console, progress
from imudrv.wording import counted

_MORE: Final = {"skew": skew_trials, "dither": dither_trials}
EXAMPLE: Final = "--simulate rocking --seeds 20 --report validation.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add = parser.add_argument
    text = "rest, motion, rest: wire bytes, CAN logs, or recordings (.mcap)"
    add("recordings", type=Path, nargs="*", metavar="RECORDING", help=text)
    text = "simulate units, with lever arms from a simulated procedure"
    add("--simulate", choices=(*TRIALS, "all"), help=text)
    add("--seeds", type=int, default=1, metavar="N", help="number of simulated units (default: 1)")
    add_workers(parser)
    add_profile(parser)
    add_channel(parser)
    add("--calibration", type=Path, metavar="C.yaml", help="calibration of the unit, with lever arms")
    add("--site", type=Path, metavar="S.yaml", help="site of the recordings: latitude, longitude, height")
    text = "length of the alignment in recordings (default: %(default)g s)"
    add("--align", type=float, default=ALIGNMENT_S, metavar="S", help=text)
    text = "angular rate for the size effect (default: %(default)s)"
    add("--rate-filter", choices=NAMES, default=RATE_FILTER, help=text)
    text = "time by which accelerometer samples of the recordings end later than those of gyros; is corrected"
    add("--skew-ms", type=float, default=0.0, metavar="MS", help=text)
    add("--report", type=Path, metavar="R.html", help="report with figures, one file")


def run(arguments: argparse.Namespace) -> int:
    """Evaluate compensation on recordings, or on simulated units."""
    if (arguments.simulate is None) == (not arguments.recordings):
        raise InputError("validate: expected either recordings or --simulate")
    if arguments.report is not None:
        inputs = (*arguments.recordings, arguments.profile, arguments.calibration, arguments.site)
        check_output(arguments.report, *inputs)
    if arguments.simulate is not None:
        validations = _simulated(arguments)
        drawn = sum(one.trial.name.endswith("unit 1") for one in validations)
        report = document("a simulated unit", validations, drawn)
        required = [one for one in validations if "unit" in one.trial.name]
    else:
        calibration, required = _navigated(arguments)
        report = document(f"unit {calibration.serial_number}", required, len(required))
    if arguments.report is not None:
        with atomic_write(arguments.report) as file:
            file.write(as_html(report).encode())
    print_document(report)
    return OK if all(one.good for one in required) else NOT_GOOD


def _simulated(arguments: argparse.Namespace) -> list[Validation]:
    which, seeds = arguments.simulate, arguments.seeds
    if seeds < 1:
        raise InputError(f"--seeds: expected 1 or more, got {seeds}")
    names = tuple(TRIALS) if which == "all" else (which,)
    function = partial(_validations, names=names, rate_filter=arguments.rate_filter)
    work = [*range(1, seeds + 1), *(_MORE if which == "all" else ())]
    found: list[Validation] = []
    screen = console(stderr=True)
    with screen.status("simulate") if screen.is_terminal else nullcontext() as status:
        for part in spread(function, work, arguments.workers, arguments.scheduler):
            found += part
            if status:
                status.update(f"simulate: {counted(len(found), 'trial')} done")
    return found


def _validations(work: int | str, names: Sequence[str], rate_filter: RateFilterName) -> list[Validation]:
    """Return the trials of a unit, by its seed, or those of a kind of `_MORE`."""
    if isinstance(work, str):
        return [evaluate(trial) for trial in _MORE[work](1)]
    return [evaluate(trial) for trial in campaign(names, [work], rate_filter)]


def _navigated(arguments: argparse.Namespace) -> tuple[Calibration, list[Validation]]:
    if arguments.calibration is None or arguments.site is None:
        raise InputError("validate: expected --calibration and --site with recordings")
    calibration = read_calibration(arguments.calibration)
    lever_arms_of(calibration, str(arguments.calibration))
    found = []
    for path in arguments.recordings:
        with progress(path.name, total_size([path])) as advance:
            validation = validate(
                path,
                calibration=calibration,
                site=arguments.site,
                profile=arguments.profile,
                align_s=arguments.align,
                rate_filter=arguments.rate_filter,
                skew_s=arguments.skew_ms * 1e-3,
                channel=arguments.channel,
                advance=advance,
            )
        found.append(validation)
    return calibration, found
