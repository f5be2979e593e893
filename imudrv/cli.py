"""The command `imudrv`: arguments in, one function a command, plain words out."""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from imudrv import config, profiles
from imudrv.calibration import Calibration, coefficients, read_calibration
from imudrv.captures import Capture
from imudrv.config import Model
from imudrv.console import guarded, progress
from imudrv.demo import demo
from imudrv.errors import InputError
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import NAMES, rate_filter
from imudrv.profiles import Profile
from imudrv.sim import scenario as scenarios
from imudrv.sim.capture import record
from imudrv.sim.scenario import Scenario
from imudrv.sinks.files import increment_columns, pulse_columns, replacing, table
from imudrv.site import Site


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; those of the process if absent.

    Returns
    -------
    int
        Exit code, see `imudrv.console`.
    """
    arguments = _parser().parse_args(argv)
    command: Callable[[argparse.Namespace], None] = arguments.command
    return guarded(lambda: command(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="imudrv", description="Driver of a 50-type ring-laser-gyro IMU.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, command: Callable[[argparse.Namespace], None], text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        sub.set_defaults(command=command)
        return sub

    def add_profile(sub: argparse.ArgumentParser) -> None:
        text = f"{', '.join(profiles.shipped())}, or a profile file"
        sub.add_argument("--profile", required=True, metavar="P", help=text)

    sub = add("decode", _decode, "Capture to pulse increments.")
    sub.add_argument("capture", type=Path, help="wire bytes; for a CAN profile a candump log")
    add_profile(sub)
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="NAME.csv or NAME.npz")

    sub = add("compensate", _compensate, "Capture to compensated increments in body axes.")
    sub.add_argument("capture", type=Path, help="wire bytes; for a CAN profile a candump log")
    add_profile(sub)
    sub.add_argument(
        "--calibration", type=Path, required=True, metavar="C.yaml", help="the unit's calibration file"
    )
    sub.add_argument(
        "--unit", metavar="SERIAL", help="serial number of the unit; another unit's calibration is refused"
    )
    sub.add_argument(
        "--rate-filter", choices=NAMES, default="causal", help="for the size effect (default: causal)"
    )
    sub.add_argument(
        "-o", "--output", type=Path, required=True, metavar="OUT", help="NAME.csv, NAME.npz or NAME.i50n"
    )

    sub = add("sim", _sim, "A simulated unit's output as a capture.")
    sub.add_argument("scenario", help=f"{', '.join(scenarios.shipped())}, or a scenario file")
    add_profile(sub)
    sub.add_argument(
        "-o", "--output", type=Path, required=True, metavar="CAPTURE", help="the capture to write"
    )
    sub.add_argument("--truth", type=Path, metavar="FILE.npz", help="what really happened, sample by sample")

    sub = add("check", _check, "Check a calibration, site, profile or scenario file.")
    sub.add_argument("file", type=Path, help="the file")

    add(
        "demo", lambda _: demo(print), "The bench procedure on a simulated unit, from wire bytes to velocity."
    )
    return parser


def _decode(arguments: argparse.Namespace) -> None:
    layout = profiles.load(arguments.profile).layout()
    capture = Capture(arguments.capture, layout)
    parts = {"temperature_degc": layout.temperature_names}
    with (
        table(arguments.output, (".csv", ".npz"), parts) as rows,
        progress("decode", capture.size) as advance,
    ):
        for pulses in capture.pulses(advance):
            rows.write(pulse_columns(pulses, layout))
    _report(capture, arguments.output)


def _compensate(arguments: argparse.Namespace) -> None:
    layout = profiles.load(arguments.profile).layout()
    calibration = read_calibration(arguments.calibration, arguments.unit)
    compensator = Compensator(
        coefficients(calibration), layout, rate_filter(arguments.rate_filter, layout.interval_ns)
    )
    capture = Capture(arguments.capture, layout)
    with (
        table(arguments.output, (".csv", ".npz", ".i50n"), {}) as rows,
        progress("compensate", capture.size) as advance,
    ):
        for increments in capture.increments(compensator, advance):
            rows.write(increment_columns(increments))
    _report(capture, arguments.output)
    size_effect = (
        "compensated" if calibration.size_effect else "not compensated: the calibration has no sensing points"
    )
    print(f"  unit {calibration.serial_number}, calibration {config.sha256(arguments.calibration)[:12]}")
    print(f"  size effect {size_effect}; rate filter {arguments.rate_filter}, {compensator.lag} samples late")


def _sim(arguments: argparse.Namespace) -> None:
    layout = profiles.load(arguments.profile).layout()
    scenario = scenarios.load(arguments.scenario)
    samples = scenarios.samples(scenario, layout.interval_ns)
    if arguments.truth is not None and arguments.truth.suffix != ".npz":
        raise InputError(f"--truth {arguments.truth}: expected a name ending in .npz")
    with replacing(arguments.output) as capture, progress("simulate", samples) as advance:
        if arguments.truth is None:
            for data, truth in record(scenario, layout):
                capture.write(data)
                advance(len(truth))
        else:
            with table(arguments.truth, (".npz",), {}) as rows:
                for data, truth in record(scenario, layout):
                    capture.write(data)
                    rows.write({name: truth[name] for name in truth.dtype.names or ()})
                    advance(len(truth))
    print(f"{arguments.output}: {samples} samples of {layout.name}, seed {scenario.seed}")


def _check(arguments: argparse.Namespace) -> None:
    kinds: dict[str, type[Model]] = {
        "imu50-calibration": Calibration,
        "imu50-site": Site,
        "imu50-profile": Profile,
        "imu50-scenario": Scenario,
    }
    kind = config.kind(arguments.file)
    if kind not in kinds:
        raise InputError(f"{arguments.file}: format: expected one of {', '.join(kinds)}, got {kind!r}")
    config.read(arguments.file, kinds[kind])
    print(f"{arguments.file}: a good {kind} file")


def _report(capture: Capture, output: Path) -> None:
    """The books of a capture, for people."""
    print(f"{capture.path}: {capture.layout.name}, {capture.size} bytes -> {output}")
    print(f"  {capture.accountant.account}")
    for reason, rejected in sorted(capture.decoder.rejected.items()):
        name = reason.name.lower().replace("_", " ")
        first = ", ".join(map(str, rejected.first))
        more = ", ..." if rejected.stretches > len(rejected.first) else ""
        print(f"  {name}: {rejected.stretches} x, {rejected.length} in all, at {first}{more}")
