"""Command `calib noise`."""

import argparse
from math import inf
from pathlib import Path
from typing import Final

from calib.certificate import check_target, write
from calib.cli.arguments import add_channel, check_output
from calib.cli.result import add_result_files, write_result
from calib.identification import prior_calibration
from calib.noise.analysis import analyse_noise
from calib.noise.documents import certificate, result_document
from calib.reports.noise import document, report_html
from calib.signing.keys import bench_key
from imudrv.cli.arguments import add_profile
from imudrv.files.inputs import total_size
from imudrv.terminal import OK, progress

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
    add_result_files(parser, "N")
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

    def write_certificate() -> str | None:
        if output is None:
            return None
        if result.is_bad:
            return f"{output}: not written, as the verdict is bad"
        new = certificate(result)
        write(output, new, key)
        return f"{output}: certificate of unit {new.serial_number} with its noise"

    write_result(
        arguments,
        document(result),
        lambda: result_document(result),
        lambda: report_html(result),
        write_certificate,
    )
    return NOT_AT_REST if result.is_bad else OK
