"""Command `calib identify`."""

import argparse
from hashlib import sha256
from pathlib import Path

from rich.console import Console

from calib.certificate import certificate, check_target, write
from calib.cli.arguments import Stated, check_output, known_point, written_text
from calib.identification import PriorCalibration, identify_captures
from calib.lever_arms.gauge import Gauge, LeverArms, convert
from calib.reports.identification import report_for_terminal, report_html, report_text
from calib.result_file import result_document, write_json
from imudrv import profiles
from imudrv.calibration import Calibration, read_calibration_file
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.files.atomic import atomic_write
from imudrv.recording.reader import Recording
from imudrv.site import Site
from imudrv.terminal import progress


def run_identify(arguments: argparse.Namespace) -> None:
    """Identify the lever arms from captures."""
    stated = known_point(arguments.at)
    inputs = (*arguments.captures, arguments.profile, arguments.calibration, arguments.site)
    for output in filter(None, (arguments.output, arguments.json, arguments.report)):
        check_output(output, *inputs)
    basis = _basis(arguments)
    check_target(arguments.output, basis.calibration)
    site = settings_file.read(arguments.site, Site)
    profile = profiles.load(arguments.profile) if arguments.profile else None
    size = sum(path.stat().st_size for path in arguments.captures if path.exists())
    with progress("identify", 2 * size) as advance:  # each capture is read twice
        findings = identify_captures(
            arguments.captures,
            profile,
            basis,
            site,
            method=arguments.method,
            pivot=arguments.pivot,
            nine=arguments.gauge == "given" and stated is None,
            extra=arguments.estimate,
            channel=arguments.channel,
            advance=advance,
        )
    arms = _wanted(findings.arms, arguments.gauge, stated)
    told = (arms, convert(arms, "x" if arms.gauge == "centroid" else "centroid"))
    written = []
    try:  # files first: whoever reads the text may leave
        if arguments.json is not None:
            write_json(arguments.json, result_document(findings, arms))
            written.append(f"{arguments.json}: the result")
        if arguments.report is not None:
            with atomic_write(arguments.report) as file:
                file.write(report_html(findings, told).encode())
            written.append(f"{arguments.report}: the report")
        write(arguments.output, certificate(findings, arms))
        written.append(written_text(arguments.output, basis.calibration, arms))
    finally:
        console = Console(highlight=False)
        if console.is_terminal:
            console.print(report_for_terminal(findings, told))
        else:
            print(report_text(findings, told), end="")
        print(*written, sep="\n")


def _wanted(arms: LeverArms, gauge: Gauge | None, stated: Stated | None) -> LeverArms:
    """The arms in the gauge asked for; nobody asked: in that of the estimate."""
    if stated is None and gauge in (None, arms.gauge):
        return arms
    if gauge is None:
        raise InputError("--at: expected with --gauge given")
    return convert(arms, gauge, stated)


def _basis(arguments: argparse.Namespace) -> PriorCalibration:
    """The calibration given, or the one that the recordings agree on."""
    if arguments.calibration is not None:
        file = read_calibration_file(arguments.calibration, arguments.unit)
        return PriorCalibration(file.model, arguments.calibration.name, file.sha256)
    texts: dict[str, str] = {}
    for path in arguments.captures:
        text = Recording(path).calibration_text if path.suffix == ".mcap" else None
        if text is None:
            raise InputError(f"{path}: expected --calibration, for there is none in it")
        texts.setdefault(text, str(path))
    if len(texts) > 1:
        raise InputError(
            f"expected recordings made with one calibration, got others in {' and '.join(texts.values())}; "
            "say which with --calibration"
        )
    ((text, path),) = texts.items()
    calibration = settings_file.parse_text(text.encode(), Calibration, f"{path}: calibration")
    if arguments.unit not in (None, calibration.serial_number):
        raise InputError(
            f"{path}: expected a recording of unit {arguments.unit!r}, "
            f"got one of {calibration.serial_number!r}"
        )
    return PriorCalibration(
        calibration, f"calibration in {Path(path).name}", sha256(text.encode()).hexdigest()
    )
