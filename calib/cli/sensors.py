"""Command `calib sensors`."""

import argparse
from pathlib import Path
from typing import Final, get_args

from calib.certificate import check_unit_file, write
from calib.cli.arguments import add_certificate_output, add_channel, check_output
from calib.cli.result import add_result_files, write_result
from calib.procedure.plan import load as load_procedure
from calib.reports.sensors import document, report_html
from calib.sensors.calibrate import SensorsOptions, calibrate_sensors
from calib.sensors.certificate import certificate, result_document, why_none
from calib.sensors.parameters import Nonlinearity
from calib.signing.keys import bench_key
from imudrv.calibration import read_calibration
from imudrv.cli.arguments import add_profile
from imudrv.errors import InputError
from imudrv.files.inputs import total_size
from imudrv.terminal import OK, progress

EXAMPLE: Final = "session.raw --profile imu50-rs422 --site site.yaml --unit 50-0017 -o unit.yaml"

BAD: Final = 3
"""Exit code: the verdict is bad."""
WITHOUT: Final = ("quadratic", "skew")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add = parser.add_argument
    text = "wire bytes, CAN logs, or recordings (.mcap); each is a session of its own"
    add("captures", type=Path, nargs="+", metavar="CAPTURE", help=text)
    add_profile(parser)
    add_channel(parser)
    text = "site of the captures: latitude, longitude, height, gravity where it was measured"
    add("--site", type=Path, required=True, metavar="S.yaml", help=text)
    add("--unit", required=True, metavar="SERIAL", help="serial number of the unit")
    add_certificate_output(parser)
    text = "certificate to start from (default: the profile's nominal scale factors, aligned axes)"
    add("--start", type=Path, metavar="OLD.yaml", help=text)
    add("--procedure", metavar="NAME|FILE", help="what was planned: names the poses")
    text = "body axes along the gyros (default), or along the faces that the unit stood on"
    add("--frame", choices=("gyro", "faces"), default="gyro", help=text)
    text = "fixed: the origin of the body frame does not move, as on a turntable; determines all nine arms"
    add("--pivot", choices=("free", "fixed"), default="free", help=text)
    add("--temperature", action="store_true", help="also the slopes per kelvin")
    text = "parameters to leave out: quadratic, skew, or both with a comma between"
    add("--without", type=_without, default=(), metavar="WHAT", help=text)
    text = "what a change of scale with the input is taken for (default: quadratic)"
    add("--nonlinearity", choices=get_args(Nonlinearity), default="quadratic", help=text)
    add_result_files(parser)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate the sensors from captures of rests and motions."""
    inputs = (*arguments.captures, arguments.profile, arguments.start, arguments.site)
    for output in filter(None, (arguments.output, arguments.json, arguments.report)):
        check_output(output, *(one for one in inputs if one != arguments.start or output != arguments.output))
    check_unit_file(arguments.output, arguments.unit)
    key = bench_key()
    with progress("sensors", total_size(arguments.captures * 3)) as advance:  # each is read three times
        result = calibrate_sensors(
            arguments.captures,
            site=arguments.site,
            unit=arguments.unit,
            profile=arguments.profile,
            start=read_calibration(arguments.start) if arguments.start else None,
            procedure=load_procedure(arguments.procedure) if arguments.procedure else None,
            options=SensorsOptions(
                arguments.frame,
                arguments.pivot,
                arguments.temperature,
                arguments.without,
                arguments.nonlinearity,
            ),
            channel=arguments.channel,
            advance=advance,
        )

    def write_certificate() -> str:
        if refusal := why_none(result):
            return f"{arguments.output}: no certificate: {refusal}"
        write(arguments.output, certificate(result), key)
        return f"{arguments.output}: certificate of unit {arguments.unit}"

    write_result(
        arguments,
        document(result),
        lambda: result_document(result),
        lambda: report_html(result),
        write_certificate,
    )
    return BAD if result.mark == "bad" else OK


def _without(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if wrong := [name for name in names if name not in WITHOUT]:
        raise InputError(f"--without: expected {' or '.join(WITHOUT)}, got {', '.join(wrong)}")
    return names
