"""Command `calib noise`."""

import argparse
from math import inf
from pathlib import Path
from typing import Final

from calib.certificate import check_target, write
from calib.cli.arguments import add_channel, check_output
from calib.identification import prior_calibration
from calib.noise.analysis import analyse_noise
from calib.noise.documents import certificate, result_document
from calib.reports.noise import document, report_html
from calib.reports.text import print_document
from calib.result_file import write_json
from calib.signing.keys import bench_key
from imudrv.cli.arguments import add_profile
from imudrv.files.atomic import atomic_write
from imudrv.files.inputs import total_size
from imudrv.terminal import OK, progress, say

EXAMPLE: Final = "rest.raw --profile imu50-rs422 --calibration unit.yaml --report noise.html -o new.yaml"

NOT_AT_REST: Final = 3
"""Exit code: nothing but upper limits was found."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add = parser.add_argument
    text = "wire bytes, CAN logs, or recordings (.mcap), which contain their profile and calibration"
    add("captures", type=Path, nargs="+", metavar="CAPTURE", help=text)
    add_profile(parser)
    add_channel(parser)
    text = "calibration with the scale factors; default: the recordings' one, or the profile's nominal ones"
    add("--calibration", type=Path, metavar="C.yaml", help=text)
    text = "begin of what is used, from the beginning of the capture"
    add("--from", dest="begin_s", type=float, metavar="S", help=text)
    add("--to", dest="end_s", type=float, metavar="S", help="its end")
    add("--json", type=Path, metavar="N.json", help="the whole result as JSON")
    add("--report", type=Path, metavar="N.html", help="report with figures, one file")
    text = "certificate to write: that of the unit with its noise"
    add("-o", "--output", type=Path, metavar="NEW.yaml", help=text)


def run(arguments: argparse.Namespace) -> int:
    """Compute the noise of a unit from captures at rest."""
    captures, output = arguments.captures, arguments.output
    for path in filter(None, (output, arguments.json, arguments.report)):
        check_output(path, *captures, arguments.profile, arguments.calibration)
    window_s = None
    if arguments.begin_s is not None or arguments.end_s is not None:
        window_s = arguments.begin_s or 0.0, inf if arguments.end_s is None else arguments.end_s
    calibration = None
    if arguments.calibration is not None or output is not None:
        calibration = prior_calibration(captures, arguments.calibration)
    key = None
    if output is not None and calibration is not None:
        check_target(output, calibration.calibration)
        key = bench_key()
    with progress("noise", total_size(captures)) as advance:
        result = analyse_noise(
            captures,
            calibration=calibration,
            profile=arguments.profile,
            window_s=window_s,
            channel=arguments.channel,
            advance=advance,
        )
    written = []
    try:  # files first: the reader of the text may go away
        if arguments.json is not None:
            write_json(arguments.json, result_document(result))
            written.append(f"{arguments.json}: the result")
        if arguments.report is not None:
            with atomic_write(arguments.report) as file:
                file.write(report_html(result).encode())
            written.append(f"{arguments.report}: the report")
        if output is not None and result.is_bad:
            written.append(f"{output}: not written, as the verdict is bad")
        elif output is not None:
            new = certificate(result)
            write(output, new, key)
            written.append(f"{output}: certificate of unit {new.serial_number} with its noise")
    finally:
        print_document(document(result))
        say("\n".join(written))
    return NOT_AT_REST if result.is_bad else OK
