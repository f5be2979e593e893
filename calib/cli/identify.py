"""Command `calib identify`."""

import argparse
from pathlib import Path
from typing import Final, get_args

from calib.certificate import certificate, check_target, lever_arms_of, write
from calib.cli.arguments import (
    add_certificate_output,
    add_channel,
    add_gauge,
    check_output,
    known_point,
    written_text,
)
from calib.cli.result import add_result_files, write_result
from calib.estimation.priors import Priors
from calib.estimation.result import Extra
from calib.identification import EstimationOptions, identify, prior_calibration
from calib.lever_arms.gauge import Gauge, LeverArms, convert
from calib.reports.identification import report_html, terminal_document
from calib.reports.text import print_document
from calib.reports.truth import comparison
from calib.result_file import result_document
from calib.signing.keys import bench_key
from imudrv.calibration import read_calibration
from imudrv.cli.arguments import add_profile
from imudrv.errors import InputError
from imudrv.files.inputs import total_size
from imudrv.imu.rate_filter import NAMES
from imudrv.terminal import progress
from imudrv.units import PPM, UG, URAD

MAX_SIGMA: Final = 1e5
LEAST_SIGMA: Final = 0.01
"""Range of the standard uncertainty of a prior, in the unit of its option."""


EXAMPLE: Final = (
    "z-up.raw x-up.raw y-up.raw --profile imu50-rs422 --calibration unit.yaml --site site.yaml -o new.yaml"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    add = parser.add_argument
    text = "wire bytes, CAN logs, or recordings (.mcap), which contain their profile"
    add("captures", type=Path, nargs="+", metavar="CAPTURE", help=text)
    add_profile(parser)
    add_channel(parser)
    text = "calibration of the unit; default: the one in the recordings"
    add("--calibration", type=Path, metavar="C.yaml", help=text)
    text = "site of the captures: latitude, longitude, height"
    add("--site", type=Path, required=True, metavar="S.yaml", help=text)
    text = "serial number of the unit; the calibration of another unit is rejected"
    add("--unit", metavar="SERIAL", help=text)
    add("--method", choices=("joint", "plain"), default="joint", help="default: joint")
    add_gauge(parser, "--gauge")
    text = (
        "fixed: the origin of the body frame does not move, as on a turntable; determines all nine components"
    )
    add("--pivot", choices=("free", "fixed"), default="free", help=text)
    text = "estimate more parameters"
    add("--estimate", choices=get_args(Extra), help=text)
    text = "filter of the rates in H; auto: dither wherever the sample rate allows it (default)"
    add("--rate-filter", choices=("auto", *NAMES), default="auto", help=text)
    text = (
        "1 sigma of the gyro-accelerometer skew about that of the calibration; 0: known exactly; default: "
        "that of the calibration, or else 0.5"
    )
    add("--skew-sigma-ms", type=_sigma, metavar="MS", help=text)
    text = (
        "1 sigma of the biases, scale factors and misalignments of the calibration; default: those in the "
        "calibration, or else 100 ug, 50 ppm and 100 urad"
    )
    add("--prior-sigma", type=_sigma, nargs=3, metavar=("UG", "PPM", "URAD"), help=text)
    add_certificate_output(parser)
    add_result_files(parser)
    add("-v", "--verbose", action="store_true", help="print the whole report, not only the result")
    text = "true unit of a simulation: the result is compared with it at the end, and does not depend on it"
    add("--truth", type=Path, metavar="T.yaml", help=text)


def run(arguments: argparse.Namespace) -> None:
    """Identify the lever arms from captures."""
    point = known_point(arguments.at)
    inputs = (*arguments.captures, arguments.profile, arguments.calibration, arguments.site, arguments.truth)
    for output in filter(None, (arguments.output, arguments.json, arguments.report)):
        check_output(output, *inputs)
    prior = prior_calibration(arguments.captures, arguments.calibration, arguments.unit)
    check_target(arguments.output, prior.calibration)
    key = bench_key()
    options = EstimationOptions(
        arguments.method,
        arguments.pivot,
        nine=arguments.gauge == "given" and point is None,
        extra=(arguments.estimate,) if arguments.estimate else (),
        rate_filter=arguments.rate_filter,
        priors=_priors(arguments.prior_sigma),
        skew_sigma_s=None if arguments.skew_sigma_ms is None else arguments.skew_sigma_ms * 1e-3,
    )
    with progress("identify", total_size(arguments.captures * 2)) as advance:  # each is read twice
        result = identify(
            arguments.captures,
            site=arguments.site,
            calibration=prior,
            profile=arguments.profile,
            options=options,
            channel=arguments.channel,
            advance=advance,
        )
    arms = _in_gauge(result.arms, arguments.gauge, point)
    gauges = (arms, convert(arms, "x" if arms.gauge == "centroid" else "centroid"))

    def write_certificate() -> str:
        write(arguments.output, certificate(result, arms), key)
        return written_text(arguments.output, prior.calibration, arms)

    write_result(
        arguments,
        terminal_document(result, gauges, arguments.verbose),
        lambda: result_document(result, arms),
        lambda: report_html(result, gauges),
        write_certificate,
    )
    if arguments.truth is not None:
        true = lever_arms_of(read_calibration(arguments.truth), str(arguments.truth))
        print_document(comparison(arms, true, arguments.truth.name))


def _sigma(text: str) -> float:
    """Parse a standard uncertainty."""
    value = float(text)
    if not 0.0 <= value <= MAX_SIGMA:
        raise argparse.ArgumentTypeError(f"expected a number from 0 to {MAX_SIGMA:g}, got {text}")
    return value


def _priors(sigma: list[float] | None) -> Priors | None:
    """Return the priors of option --prior-sigma."""
    if sigma is None:
        return None
    if min(sigma) < LEAST_SIGMA:
        raise InputError(
            f"--prior-sigma: expected three numbers from {LEAST_SIGMA:g} up, got {min(sigma):g}; give the "
            "accuracy of the calibration"
        )
    bias_ug, scale_ppm, misalignment_urad = sigma
    return Priors(
        accelerometer_bias=bias_ug * UG,
        accelerometer_scale=scale_ppm * PPM,
        accelerometer_misalignment=misalignment_urad * URAD,
        gyro_misalignment=misalignment_urad * URAD,
    )


def _in_gauge(arms: LeverArms, gauge: Gauge | None, point: tuple[str, list[float]] | None) -> LeverArms:
    """Return the arms in the requested gauge, by default that of the estimate."""
    if point is None and gauge in (None, arms.gauge):
        return arms
    if gauge is None:
        raise InputError("--at: expected with --gauge given")
    return convert(arms, gauge, point)
