"""The command `imudrv`: arguments in, one function a command, plain words out."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from signal import SIGHUP
from typing import TextIO

from rich.console import Console

from imudrv import profiles
from imudrv.calibration import Calibration, coefficients, read_calibration_file, require_unit
from imudrv.capture import Capture
from imudrv.demo import demo
from imudrv.doctor.examine import doctor
from imudrv.errors import InputError
from imudrv.files import settings_file
from imudrv.files.model import Model
from imudrv.files.outputs import is_standard_output, require_other
from imudrv.files.tables import increment_columns, pulse_columns, table, writing
from imudrv.imu.compensation import Compensator
from imudrv.imu.rate_filter import NAMES, rate_filter
from imudrv.profiles.schema import Profile
from imudrv.recording.export import KINDS, export
from imudrv.recording.pack import pack
from imudrv.recording.reader import Recording
from imudrv.service import settings
from imudrv.service.loop import Service
from imudrv.service.monitor import monitor
from imudrv.service.printer import Printer
from imudrv.service.runtime import SignalFlags
from imudrv.service.settings import Settings
from imudrv.service.status import EXIT_CODES
from imudrv.service.status_socket import ask
from imudrv.sim import scenario as scenarios
from imudrv.sim.capture import record
from imudrv.sim.live import play, speed_of
from imudrv.sim.scenario import Scenario
from imudrv.site import Site
from imudrv.terminal import BAD_INPUT, INTERRUPTED, OK, CommandLine, progress


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; those of the process if absent.

    Returns
    -------
    int
        Exit code, see `imudrv.terminal`.
    """
    return _commands().run(argv)


def _commands() -> CommandLine:
    line = CommandLine("imudrv", "Driver of a 50-type ring-laser-gyro IMU.")
    add = line.add

    def add_profile(sub: argparse.ArgumentParser, required: bool = False) -> None:
        text = f"{', '.join(profiles.shipped())}, or a profile file"
        sub.add_argument("--profile", required=required, metavar="P", help=text)

    def add_capture(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("capture", type=Path, help="wire bytes, a candump log, or a recording.mcap")
        add_profile(sub)
        sub.add_argument("--channel", metavar="NAME", help="CAN channel of a candump log, such as can0")

    sub = add("decode", _decode, "Capture to pulse increments.")
    add_capture(sub)
    sub.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="NAME.csv or NAME.npz; - is standard output, as csv",
    )

    sub = add("compensate", _compensate, "Capture to compensated increments in body axes.")
    add_capture(sub)
    sub.add_argument(
        "--calibration", type=Path, metavar="C.yaml", help="the unit's; default: the recording's own"
    )
    sub.add_argument(
        "--unit", metavar="SERIAL", help="serial number of the unit; another unit's calibration is refused"
    )
    sub.add_argument(
        "--rate-filter", choices=NAMES, default="causal", help="for the size effect (default: causal)"
    )
    sub.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="NAME.csv, NAME.npz or NAME.i50n; - is standard output, as csv",
    )

    sub = add("sim", _sim, "A simulated unit: into a capture, or live as hardware in the loop.")
    sub.add_argument("scenario", help=f"{', '.join(scenarios.shipped())}, or a scenario file")
    add_profile(sub, required=True)
    way = sub.add_mutually_exclusive_group(required=True)
    way.add_argument(
        "-o", "--output", type=Path, metavar="CAPTURE", help="the capture to write; - is standard output"
    )
    way.add_argument(
        "--port",
        metavar="URL",
        help="play live on pty, serial://PATH, can://INTERFACE/CHANNEL or tcp://[HOST]:PORT",
    )
    sub.add_argument("--truth", type=Path, metavar="FILE.npz", help="what really happened, sample by sample")
    sub.add_argument("--speed", metavar="X", help="of a live run: 1, 10, ... or max (default: 1)")
    sub.add_argument("--link", metavar="NAME", help="stable name for the pty of a live run")

    sub = add("run", _run, "The live service: unit in, navigation out.")
    sub.add_argument("settings", type=Path, nargs="?", help="settings file; options go before it")
    sub.add_argument(
        "--port", metavar="URL", help="where the unit is: /dev/ttyUSB0, can://..., replay://..., sim://..."
    )
    sub.add_argument("--profile", metavar="P", help="wire format, as for decode")
    sub.add_argument("--calibration", metavar="C.yaml", help="the unit's calibration file")
    sub.add_argument("--unit", metavar="SERIAL", help="serial number of the unit that is connected")
    sub.add_argument(
        "--out",
        dest="outputs",
        action="append",
        metavar="URL",
        help="udp://HOST:PORT, tcp://[HOST]:PORT, serial://PATH, can://..., file:NAME; again for more",
    )
    sub.add_argument("--record", metavar="FILE.mcap", help="record everything; a folder: a file for each run")
    sub.add_argument("--rate-filter", choices=NAMES, help="for the size effect (default: causal)")
    sub.add_argument("--status", metavar="PATH", help="socket that tells the status")
    sub.add_argument(
        "--realtime", action="store_true", default=None, help="ask for SCHED_FIFO and locked memory"
    )

    sub = add("monitor", _monitor, "A running service, live on the terminal.")
    sub.add_argument("--status", type=Path, metavar="PATH", help="the service's socket")

    sub = add("status", _status, "A running service's health; exit code 0 ok, 3 warning, 4 failure.")
    sub.add_argument("--status", type=Path, metavar="PATH", help="the service's socket")
    sub.add_argument("--json", action="store_true", help="the whole status, for scripts")

    sub = add("doctor", _doctor, "Find out why a unit is not heard, and what to do.")
    sub.add_argument("--port", metavar="URL", required=True, help="as for run")
    sub.add_argument("--profile", metavar="P", help="what the unit should send")

    sub = add("pack", _pack, "Rewrite a recording compressed.")
    sub.add_argument("recording", type=Path)
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="PACKED.mcap")

    sub = add("export", _export, "A recording in another format.")
    sub.add_argument("recording", type=Path)
    sub.add_argument("--to", choices=KINDS, required=True, help="the format")
    sub.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="OUT",
        help="- is standard output, for csv, raw, candump",
    )

    sub = add("check", _check, "Check a calibration, site, profile, scenario or settings file.")
    sub.add_argument("file", type=Path, help="the file")

    add(
        "demo",
        lambda _: demo(_say),
        "The whole story on a simulated unit: bench procedure, certificate, proof.",
    )
    return line


def _decode(arguments: argparse.Namespace) -> None:
    require_other(arguments.output, arguments.capture, arguments.profile)
    capture = _capture(arguments)
    parts = {"temperature_degc": capture.layout.temperature_names}
    with (
        table(arguments.output, (".csv", ".npz"), parts) as rows,
        progress("decode", capture.size) as advance,
    ):
        for pulses in capture.pulses(advance):
            rows.write(pulse_columns(pulses, capture.layout))
    _report(capture, arguments.output)


def _compensate(arguments: argparse.Namespace) -> None:
    require_other(arguments.output, arguments.capture, arguments.profile, arguments.calibration)
    capture = _capture(arguments)
    if arguments.calibration is not None:
        file = read_calibration_file(arguments.calibration, arguments.unit)
        calibration, origin = file.model, f"calibration {file.sha256[:12]}"
    elif capture.recording is not None and (recorded := capture.recording.calibration) is not None:
        require_unit(recorded, arguments.unit, str(arguments.capture))
        calibration, origin = recorded, "calibration of the recording"
    else:
        raise InputError("expected --calibration, for only a recording of the service has one in it")
    layout = capture.layout
    compensator = Compensator(
        coefficients(calibration), layout, rate_filter(arguments.rate_filter, layout.interval_ns)
    )
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
    words = _words(arguments.output)
    print(f"  unit {calibration.serial_number}, {origin}", file=words)
    print(
        f"  size effect {size_effect}; rate filter {arguments.rate_filter}, {compensator.lag} samples late",
        file=words,
    )


def _capture(arguments: argparse.Namespace) -> Capture:
    profile = profiles.load(arguments.profile) if arguments.profile else None
    return Capture(arguments.capture, profile, arguments.channel)


def _sim(arguments: argparse.Namespace) -> None:
    if arguments.port is not None:
        _play(arguments)
        return
    if arguments.speed or arguments.link:
        raise InputError("--speed, --link: expected with --port; a capture has no speed")
    layout = profiles.load(arguments.profile).layout()
    scenario = scenarios.load(arguments.scenario)
    samples = scenarios.samples(scenario, layout.interval_ns)
    if arguments.truth is not None and arguments.truth.suffix != ".npz":
        raise InputError(f"--truth {arguments.truth}: expected a name ending in .npz")
    for output in filter(None, (arguments.output, arguments.truth)):
        require_other(output, arguments.profile, *scenarios.files(arguments.scenario))
    with writing(arguments.output) as capture, progress("simulate", samples) as advance:
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
    print(
        f"{arguments.output}: {samples} samples of {layout.name}, seed {scenario.seed}",
        file=_words(arguments.output),
    )


def _play(arguments: argparse.Namespace) -> None:
    if arguments.truth is not None:
        raise InputError("--truth: expected with -o; a live run has no file beside it")
    profile = profiles.load(arguments.profile)
    scenario = scenarios.load(arguments.scenario)
    speed = speed_of(arguments.speed or "1")
    with Printer(sys.stdout) as printer:
        printer.say(str(play(scenario, profile, arguments.port, speed, printer.say, arguments.link)))
    if printer.failure:
        raise InputError(printer.failure)


def _run(arguments: argparse.Namespace) -> int:
    signals = SignalFlags()
    names = set(Settings.model_fields) - {"format", "version"}
    given = {name: getattr(arguments, name) for name in names}
    with signals.caught(SIGHUP), Printer(sys.stdout) as printer, Printer(sys.stderr) as warnings:
        Service(
            settings.load(arguments.settings, given),
            printer.say,
            warn=warnings.say,
            signals=signals,
            notices=lambda: [*printer.notices(), *warnings.notices()],
        ).run()
    return INTERRUPTED if signals.hung_up else OK


def _monitor(arguments: argparse.Namespace) -> None:
    monitor(arguments.status or settings.default_status_path(), Console())


def _status(arguments: argparse.Namespace) -> int:
    status = ask(arguments.status or settings.default_status_path())
    if arguments.json:
        print(json.dumps(status, indent=1))
    else:
        print("\n".join([status["health"], *status["reasons"]]))
    return EXIT_CODES[status["health"]]


def _doctor(arguments: argparse.Namespace) -> int:
    return OK if doctor(arguments.port, arguments.profile, print) else BAD_INPUT


def _pack(arguments: argparse.Namespace) -> None:
    require_other(arguments.output, arguments.recording)
    pack(arguments.recording, arguments.output)
    before, after = arguments.recording.stat().st_size, arguments.output.stat().st_size
    print(f"{arguments.output}: {after} bytes, was {before}")


def _export(arguments: argparse.Namespace) -> None:
    export(Recording(arguments.recording), arguments.to, arguments.output)
    print(f"{arguments.recording} -> {arguments.output}", file=_words(arguments.output))


def _say(text: str) -> None:
    print(text, flush=True)


def _check(arguments: argparse.Namespace) -> None:
    kinds: dict[str, type[Model]] = {
        "imu50-calibration": Calibration,
        "imu50-site": Site,
        "imu50-profile": Profile,
        "imu50-scenario": Scenario,
        "imu50-service": Settings,
    }
    kind = settings_file.kind(arguments.file)
    if kind not in kinds:
        raise InputError(f"{arguments.file}: format: expected one of {', '.join(kinds)}, got {kind!r}")
    settings_file.read(arguments.file, kinds[kind])
    print(f"{arguments.file}: a good {kind} file")


def _report(capture: Capture, output: Path) -> None:
    """Print the loss summary of a capture."""
    words = _words(output)
    print(f"{capture.path}: {capture.layout.name}, {capture.size} bytes -> {output}", file=words)
    print(f"  {capture.tracker.counts}", file=words)
    for reason, rejected in sorted(capture.rejected.items()):
        name = reason.name.lower().replace("_", " ")
        first = ", ".join(map(str, rejected.first))
        more = ", ..." if rejected.runs > len(rejected.first) else ""
        print(f"  {name}: {rejected.runs} x, {rejected.length} in all, at {first}{more}", file=words)
    for channel, messages in list(capture.channels.items())[1:]:
        print(f"  left out: {messages} messages of channel {channel}", file=words)


def _words(output: Path) -> TextIO:
    """Where the words about an output go: not among its bytes."""
    return sys.stderr if is_standard_output(output) else sys.stdout
