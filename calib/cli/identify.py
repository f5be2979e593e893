"""Command `calib identify`."""

import argparse

from rich.console import Console

from calib.certificate import certificate, check_target, write
from calib.cli.arguments import Stated, check_output, known_point, written_text
from calib.identification import EstimationOptions, identify, prior_calibration
from calib.lever_arms.gauge import Gauge, LeverArms, convert
from calib.reports.identification import report_for_terminal, report_html, report_text
from calib.result_file import result_document, write_json
from imudrv.errors import InputError
from imudrv.files.atomic import atomic_write
from imudrv.terminal import progress


def run_identify(arguments: argparse.Namespace) -> None:
    """Run the command."""
    stated = known_point(arguments.at)
    inputs = (*arguments.captures, arguments.profile, arguments.calibration, arguments.site)
    for output in filter(None, (arguments.output, arguments.json, arguments.report)):
        check_output(output, *inputs)
    prior = prior_calibration(arguments.captures, arguments.calibration, arguments.unit)
    check_target(arguments.output, prior.calibration)
    nine = arguments.gauge == "given" and stated is None
    size = sum(path.stat().st_size for path in arguments.captures if path.exists())
    with progress("identify", 2 * size) as advance:  # each capture is read twice
        result = identify(
            arguments.captures,
            site=arguments.site,
            calibration=prior,
            profile=arguments.profile,
            options=EstimationOptions(arguments.method, arguments.pivot, nine, tuple(arguments.estimate)),
            channel=arguments.channel,
            advance=advance,
        )
    arms = _wanted(result.arms, arguments.gauge, stated)
    shown = (arms, convert(arms, "x" if arms.gauge == "centroid" else "centroid"))
    written = []
    try:  # files first: whoever reads the text may leave
        if arguments.json is not None:
            write_json(arguments.json, result_document(result, arms))
            written.append(f"{arguments.json}: the result")
        if arguments.report is not None:
            with atomic_write(arguments.report) as file:
                file.write(report_html(result, shown).encode())
            written.append(f"{arguments.report}: the report")
        write(arguments.output, certificate(result, arms))
        written.append(written_text(arguments.output, prior.calibration, arms))
    finally:
        console = Console(highlight=False)
        if console.is_terminal:
            console.print(report_for_terminal(result, shown))
        else:
            print(report_text(result, shown), end="")
        print(*written, sep="\n")


def _wanted(arms: LeverArms, gauge: Gauge | None, stated: Stated | None) -> LeverArms:
    """Return the arms in the requested gauge, by default in that of the estimate."""
    if stated is None and gauge in (None, arms.gauge):
        return arms
    if gauge is None:
        raise InputError("--at: expected with --gauge given")
    return convert(arms, gauge, stated)
