"""Command `calib validate`."""

import argparse
from collections.abc import Iterator
from contextlib import nullcontext
from typing import Final

from rich.console import Console

from calib.api import validate
from calib.certificate import lever_arms_of
from calib.cli.arguments import check_output
from calib.reports.html import as_html
from calib.reports.text import as_text, for_terminal
from calib.reports.validation import document
from calib.validation.simulate import TRIALS, campaign, dither_trials, skew_trials
from calib.validation.trial import Trial
from calib.validation.verdict import TrialMetrics, evaluate
from imudrv.calibration import Calibration, read_calibration
from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.terminal import OK, progress

NOT_GOOD: Final = 3
"""Exit code: a verdict is bad."""


def run_validate(arguments: argparse.Namespace) -> int:
    """Judge recordings, or simulated units."""
    if (arguments.simulate is None) == (not arguments.recordings):
        raise InputError("validate: expected either recordings or --simulate")
    if arguments.report is not None:
        inputs = (*arguments.recordings, arguments.profile, arguments.calibration, arguments.site)
        check_output(arguments.report, *inputs)
    if arguments.simulate is not None:
        trials = [(trial, evaluate(trial)) for trial in _simulated(arguments)]
        shown = sum(trial.name.endswith("unit 1") for trial, _ in trials)
        told = document("a simulated unit", trials, shown)
        required = [judged for trial, judged in trials if "unit" in trial.name]
    else:
        calibration, trials = _navigated(arguments)
        told = document(f"unit {calibration.serial_number}", trials, len(trials))
        required = [judged for _, judged in trials]
    if arguments.report is not None:
        with atomic_write(arguments.report) as file:
            file.write(as_html(told).encode())
    console = Console(highlight=False)
    if console.is_terminal:
        console.print(for_terminal(told))
    else:
        print(as_text(told), end="")
    return OK if all(judged.good for judged in required) else NOT_GOOD


def _simulated(arguments: argparse.Namespace) -> Iterator[Trial]:
    which, seeds, name = arguments.simulate, arguments.seeds, arguments.rate_filter
    if seeds < 1:
        raise InputError(f"--seeds: expected 1 or more, got {seeds}")
    console = Console(stderr=True)
    names = tuple(TRIALS) if which == "all" else (which,)
    with console.status("simulate") if console.is_terminal else nullcontext() as status:
        yield from campaign(names, range(1, seeds + 1), name, status.update if status else lambda _: None)
        if which == "all":
            yield from skew_trials(1)
            yield from dither_trials(1)


def _navigated(arguments: argparse.Namespace) -> tuple[Calibration, list[tuple[Trial, TrialMetrics]]]:
    if arguments.calibration is None or arguments.site is None:
        raise InputError("validate: expected --calibration and --site with recordings")
    calibration = read_calibration(arguments.calibration)
    lever_arms_of(calibration, str(arguments.calibration))
    found = []
    for path in arguments.recordings:
        with progress(path.name, path.stat().st_size if path.exists() else 0) as advance:
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
        found.append((validation.trial, validation.metrics))
    return calibration, found
