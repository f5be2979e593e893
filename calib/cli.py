"""The command `calib`: arguments in, one function a command, plain words out."""

import argparse
import re
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from hashlib import sha256
from math import inf, nan
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias, get_args

import yaml
from pydantic import ConfigDict, JsonValue
from rich.console import Console

from calib import procedure as procedures
from calib.bench import run
from calib.certificate import (
    CHANGED,
    FOUND,
    arms_of,
    certificate,
    check_target,
    result_document,
    with_arms,
    write,
    write_json,
)
from calib.dither import dither_text
from calib.document import as_html, as_text, for_terminal
from calib.findings import Basis, find
from calib.gauge import GAUGES, Arms, Gauge, convert, from_kalibr, from_psins, to_kalibr, to_psins
from calib.identify import Extra
from calib.report import arms_text, report_for_terminal, report_html, report_text
from calib.session import verify
from calib.trials import TRIALS, askew, campaign, dithering
from calib.validate import RATE_FILTER, Judged, Setting, Trial, judge, navigate
from calib.validation_report import document
from imudrv import config, profiles
from imudrv.calibration import Calibration, read_calibration, read_calibration_file
from imudrv.captures import Capture
from imudrv.config import Model
from imudrv.console import BAD_INPUT, OK, CommandLine, progress
from imudrv.errors import InputError
from imudrv.imu.rate_filter import NAMES, rate_filter
from imudrv.nav.alignment import ALIGNMENT_S
from imudrv.outputs import file_to_write, require_other
from imudrv.recording import Recording
from imudrv.sinks.files import replacing
from imudrv.site import Site
from imudrv.units import MM, NS, NS_PER_S

Stated: TypeAlias = tuple[Literal["x", "y", "z"], list[float]]

EXTRAS: Final[tuple[Extra, ...]] = get_args(Extra)
PROGRAMS: Final = ("kalibr", "psins")
NOT_GOOD: Final = 3
"""Exit code: a verdict is bad."""


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
    return _commands().run(argv)


def _commands() -> CommandLine:
    line = CommandLine("calib", "Inner lever arms of a 50-type ring-laser-gyro IMU.")
    add = line.add

    def add_gauge(sub: argparse.ArgumentParser, option: str, **more: Any) -> None:
        sub.add_argument(option, dest="gauge", choices=GAUGES, help="where the origin of b is put", **more)
        sub.add_argument(
            "--at",
            metavar="A=X,Y,Z",
            help="for given: where accelerometer A senses, mm, from a drawing; such as y=12.5,-3,40",
        )

    def add_channel(sub: argparse.ArgumentParser) -> None:
        sub.add_argument("--channel", metavar="NAME", help="CAN channel of candump logs, such as can0")

    sub = add("identify", _identify, "Captures of rotations to lever arms, certificate and report.")
    sub.add_argument(
        "captures",
        type=Path,
        nargs="+",
        metavar="CAPTURE",
        help="wire bytes, candump logs, recordings (.mcap)",
    )
    sub.add_argument(
        "--profile", metavar="P", help=f"{', '.join(profiles.shipped())}, or a file; recordings know theirs"
    )
    add_channel(sub)
    sub.add_argument(
        "--calibration", type=Path, metavar="C.yaml", help="the unit's; default: the recordings' own"
    )
    sub.add_argument("--site", type=Path, required=True, metavar="S.yaml", help="where the unit stood")
    sub.add_argument("--unit", metavar="SERIAL", help="serial number of the unit; another one's is refused")
    sub.add_argument("--method", choices=("joint", "plain"), default="joint", help="default: joint")
    add_gauge(sub, "--gauge")
    sub.add_argument(
        "--pivot",
        choices=("free", "fixed"),
        default="free",
        help="fixed: the origin of b is known to stay still, as on a turntable; all nine are then told",
    )
    sub.add_argument(
        "--estimate", type=_extras, default=(), metavar="WHAT", help=f"more unknowns: {','.join(EXTRAS)}"
    )
    sub.add_argument(
        "-o", "--output", type=Path, required=True, metavar="NEW.yaml", help="the certificate to write"
    )
    sub.add_argument("--json", type=Path, metavar="R.json", help="the whole result, for programs")
    sub.add_argument("--report", type=Path, metavar="R.html", help="the report with figures, one file")

    sub = add("run", _run, "Walk through the bench procedure with a unit, to its certificate.")
    sub.add_argument("--port", metavar="URL", help="where the unit is, as for imudrv run")
    sub.add_argument("--profile", metavar="P", help="what it sends, as for imudrv run")
    sub.add_argument(
        "--calibration", type=Path, metavar="C.yaml", help="its certificate; new once you accept"
    )
    sub.add_argument("--site", type=Path, metavar="S.yaml", help="where it stands")
    sub.add_argument("--procedure", metavar="P", help=f"{', '.join(procedures.shipped())}, or a file")
    sub.add_argument(
        "--session", type=Path, metavar="DIR", help="journal and evidence; one that is there is resumed"
    )
    sub.add_argument(
        "--redo",
        action="append",
        default=[],
        metavar="STEP",
        help="do this step of a session that is there again; may be repeated",
    )
    sub.add_argument("--hands-free", action="store_true", help="go on by the sensors alone")
    sub.add_argument("--rehearse", action="store_true", help="with a simulated unit and technician")
    sub.add_argument("--speed", default="1", metavar="X", help="of the rehearsal: 1, 10, ... or max")

    sub = add("verify", _verify, "Check a session's evidence, and find its result again from the recordings.")
    sub.add_argument("session", type=Path, metavar="DIR")

    sub = add(
        "validate",
        _validate,
        "Navigate the same pulses without and with compensation, and judge; exit code 3: a bad verdict.",
    )
    sub.add_argument(
        "recordings", type=Path, nargs="*", metavar="RECORDING", help="rest, motion, rest; as for identify"
    )
    sub.add_argument(
        "--simulate", choices=(*TRIALS, "all"), help="a simulated unit, its arms from a simulated procedure"
    )
    sub.add_argument("--seeds", type=int, default=1, metavar="N", help="simulated units (default: 1)")
    sub.add_argument("--profile", metavar="P", help="as for identify")
    add_channel(sub)
    sub.add_argument("--calibration", type=Path, metavar="C.yaml", help="the unit's, with lever arms")
    sub.add_argument("--site", type=Path, metavar="S.yaml", help="where the unit stood")
    sub.add_argument(
        "--align",
        type=float,
        default=ALIGNMENT_S,
        metavar="S",
        help="alignment on recordings (default: %(default)g s)",
    )
    sub.add_argument(
        "--rate-filter", choices=NAMES, default=RATE_FILTER, help="for the size effect (default: %(default)s)"
    )
    sub.add_argument(
        "--skew-ms",
        type=float,
        default=0.0,
        metavar="MS",
        help="by so much the accelerometers' sample of recordings ends later; is put right",
    )
    sub.add_argument("--report", type=Path, metavar="R.html", help="the report with figures, one file")

    sub = add("gauge", _gauge, "A certificate's lever arms in another gauge, exactly, with their covariance.")
    sub.add_argument("file", type=Path, help="the certificate")
    add_gauge(sub, "--to", required=True)
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="NEW.yaml")

    sub = add("export-arms", _export_arms, "A certificate's lever arms as another program writes them.")
    sub.add_argument("file", type=Path, help="the certificate")
    sub.add_argument("--to", choices=PROGRAMS, required=True, help="kalibr: YAML; psins: MATLAB")

    sub = add("import-arms", _import_arms, "Lever arms that another program found, into a certificate.")
    sub.add_argument(
        "file",
        type=Path,
        help="Kalibr's imu.yaml; of PSINS what clbtfile writes (cm), or lines clbt.rx = [...] (m)",
    )
    sub.add_argument("--from", dest="program", choices=PROGRAMS, required=True, help="who wrote it")
    sub.add_argument("--calibration", type=Path, required=True, metavar="C.yaml", help="the unit's")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="NEW.yaml")

    sub = add("dither", _dither, "What dithering gyros do to accelerometers, and what rate filters pass.")
    sub.add_argument(
        "--amplitude-arcsec",
        type=_one_or_three,
        required=True,
        metavar="A[,A,A]",
        help="of the blocks x, y, z, such as 150; 150,0,0 for one gyro",
    )
    sub.add_argument(
        "--frequency-hz", type=_one_or_three, required=True, metavar="F[,F,F]", help="such as 400,405,393"
    )
    sub.add_argument("--certificate", type=Path, required=True, metavar="C.yaml", help="with lever arms")
    sub.add_argument("--rate-hz", type=_positive, default=1000.0, metavar="HZ", help="default: 1000")
    sub.add_argument("--rate-filter", choices=NAMES, help="default: all of them")
    sub.add_argument(
        "--case-reaction",
        type=_positive,
        default=0.01,
        metavar="PART",
        help="the case's angle over the block's; default: 0.01",
    )
    return line


def _run(arguments: argparse.Namespace) -> int:
    return run(
        port=arguments.port,
        profile=arguments.profile,
        calibration=arguments.calibration,
        site=arguments.site,
        procedure=arguments.procedure,
        folder=arguments.session,
        hands_free=arguments.hands_free,
        rehearse=arguments.rehearse,
        speed=arguments.speed,
        redo=arguments.redo,
        console=Console(),
    )


def _verify(arguments: argparse.Namespace) -> int:
    faults, notes = verify(arguments.session)
    print("\n".join([*notes, *faults]))
    return BAD_INPUT if faults else OK


def _identify(arguments: argparse.Namespace) -> None:
    stated = _stated(arguments.at)
    inputs = (*arguments.captures, arguments.profile, arguments.calibration, arguments.site)
    for output in filter(None, (arguments.output, arguments.json, arguments.report)):
        _check_output(output, *inputs)
    basis = _basis(arguments)
    check_target(arguments.output, basis.calibration)
    site = config.read(arguments.site, Site)
    profile = profiles.load(arguments.profile) if arguments.profile else None
    size = sum(path.stat().st_size for path in arguments.captures if path.exists())
    with progress("identify", 2 * size) as advance:  # each capture is read twice
        findings = find(
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
            with replacing(arguments.report) as file:
                file.write(report_html(findings, told).encode())
            written.append(f"{arguments.report}: the report")
        write(arguments.output, certificate(findings, arms))
        written.append(_written(arguments.output, basis.calibration, arms))
    finally:
        console = Console(highlight=False)
        if console.is_terminal:
            console.print(report_for_terminal(findings, told))
        else:
            print(report_text(findings, told), end="")
        print(*written, sep="\n")


def _validate(arguments: argparse.Namespace) -> int:
    """Judge recordings, or simulated units."""
    if (arguments.simulate is None) == (not arguments.recordings):
        raise InputError("validate: expected either recordings or --simulate")
    if arguments.report is not None:
        inputs = (*arguments.recordings, arguments.profile, arguments.calibration, arguments.site)
        _check_output(arguments.report, *inputs)
    if arguments.simulate is not None:
        trials = [(trial, judge(trial)) for trial in _simulated(arguments)]
        shown = sum(trial.name.endswith("unit 1") for trial, _ in trials)
        told = document("a simulated unit", trials, shown)
        required = [judged for trial, judged in trials if "unit" in trial.name]
    else:
        calibration, trials = _navigated(arguments)
        told = document(f"unit {calibration.serial_number}", trials, len(trials))
        required = [judged for _, judged in trials]
    if arguments.report is not None:
        with replacing(arguments.report) as file:
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
            yield from askew(1)
            yield from dithering(1)


def _navigated(arguments: argparse.Namespace) -> tuple[Calibration, list[tuple[Trial, Judged]]]:
    if arguments.calibration is None or arguments.site is None:
        raise InputError("validate: expected --calibration and --site with recordings")
    calibration = read_calibration(arguments.calibration)
    arms_of(calibration, str(arguments.calibration))
    site = config.read(arguments.site, Site)
    profile = profiles.load(arguments.profile) if arguments.profile else None
    found = []
    for path in arguments.recordings:
        capture = Capture(path, profile, arguments.channel)
        setting = Setting(
            capture.layout,
            calibration,
            site,
            arguments.align,
            arguments.rate_filter,
            arguments.skew_ms * 1e-3,
        )
        with progress(path.name, capture.size) as advance:
            trial = navigate(path.name, capture.pulses(advance), setting)
        found.append((trial, judge(trial)))
    return calibration, found


def _check_output(path: Path, *inputs: str | Path | None) -> None:
    """Refuse an output before the work, instead of behind it."""
    file_to_write(path)
    require_other(path, *inputs)


def _written(path: Path, calibration: Calibration, arms: Arms) -> str:
    return f"{path}: certificate of unit {calibration.serial_number}, gauge {arms.gauge}"


def _wanted(arms: Arms, gauge: Gauge | None, stated: Stated | None) -> Arms:
    """The arms in the gauge asked for; nobody asked: in that of the estimate."""
    if stated is None and gauge in (None, arms.gauge):
        return arms
    if gauge is None:
        raise InputError("--at: expected with --gauge given")
    return convert(arms, gauge, stated)


def _basis(arguments: argparse.Namespace) -> Basis:
    """The calibration given, or the one that the recordings agree on."""
    if arguments.calibration is not None:
        file = read_calibration_file(arguments.calibration, arguments.unit)
        return Basis(file.model, arguments.calibration.name, file.sha256)
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
    calibration = config.parse_text(text.encode(), Calibration, f"{path}: calibration")
    if arguments.unit not in (None, calibration.serial_number):
        raise InputError(
            f"{path}: expected a recording of unit {arguments.unit!r}, "
            f"got one of {calibration.serial_number!r}"
        )
    return Basis(calibration, f"calibration in {Path(path).name}", sha256(text.encode()).hexdigest())


def _gauge(arguments: argparse.Namespace) -> None:
    _check_output(arguments.output, arguments.file)
    file = read_calibration_file(arguments.file)
    before = arms_of(file.model, str(arguments.file))
    stated = _stated(arguments.at)
    arms = convert(before, arguments.gauge, stated)
    how: dict[str, Any] = {
        "from": before.gauge,
        "to": arms.gauge,
        "file_sha256": file.sha256,
    }
    if stated is not None:
        how["stated_mm"] = {stated[0]: [value / MM for value in stated[1]]}
    write(arguments.output, with_arms(file.model, arms, CHANGED, how))
    print(arms_text(arms), end="")
    print(_written(arguments.output, file.model, arms))


def _export_arms(arguments: argparse.Namespace) -> None:
    arms = arms_of(read_calibration(arguments.file), str(arguments.file))
    if arguments.to == "kalibr":
        print("# lever arms of the accelerometers, m, origin at that of x")
        print(yaml.safe_dump({"imu0": to_kalibr(arms)}, sort_keys=False, default_flow_style=None), end="")
        return
    print(f"% lever arms of the accelerometers, m, gauge {arms.gauge}")
    for name, r in to_psins(arms).items():
        print(f"clbt.{name} = [{'; '.join(map(str, r))}];")


def _import_arms(arguments: argparse.Namespace) -> None:
    _check_output(arguments.output, arguments.file, arguments.calibration)
    calibration = read_calibration(arguments.calibration)
    if arguments.program == "kalibr":
        file = config.read_file(arguments.file, _Kalibr)
        arms, digest = from_kalibr(file.model.imu0), file.sha256
    else:
        content = config.content(arguments.file)
        arms, digest = from_psins(_clbt(content, arguments.file)), sha256(content).hexdigest()
    how = {"method": f"imported from {arguments.program}", "file_sha256": digest}
    write(arguments.output, with_arms(calibration, arms, FOUND, how))
    print(arms_text(arms), end="")
    print(_written(arguments.output, calibration, arms))


def _dither(arguments: argparse.Namespace) -> None:
    if not 1.0 <= arguments.rate_hz <= 100_000.0:
        raise InputError(f"--rate-hz: expected 1 to 100000, got {arguments.rate_hz:g}")
    interval_ns = round(NS_PER_S / arguments.rate_hz)
    names = NAMES if arguments.rate_filter is None else (arguments.rate_filter,)
    text = dither_text(
        read_calibration(arguments.certificate),
        arguments.amplitude_arcsec,
        arguments.frequency_hz,
        [rate_filter(name, interval_ns) for name in names],
        interval_ns * NS,
        arguments.case_reaction,
    )
    print(text, end="")


def _one_or_three(text: str) -> tuple[float, ...]:
    values = tuple(_not_negative(part) for part in text.split(","))
    if len(values) not in (1, 3):
        raise argparse.ArgumentTypeError(f"expected one number or three, got {text!r}")
    return values * 3 if len(values) == 1 else values


def _not_negative(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = nan
    if not 0.0 <= value < inf:
        raise argparse.ArgumentTypeError(f"expected a number, not negative, got {text!r}")
    return value


def _positive(text: str) -> float:
    value = _not_negative(text)
    if value == 0.0:
        raise argparse.ArgumentTypeError(f"expected a positive number, got {text!r}")
    return value


class _Kalibr(Model):
    """What matters of the IMU file that Kalibr writes."""

    model_config = ConfigDict(extra="ignore")

    imu0: dict[str, JsonValue]


def _clbt(content: bytes, path: Path) -> dict[str, list[float]]:
    """Rows of MATLAB text, m: `clbt.rx = [...]` of a program is in m, `rx = [...]` of `clbtfile` in cm."""
    text = content.decode("utf-8", errors="replace")
    rows = {}
    for prefix, name, row in re.findall(r"^\s*(clbt\.)?(r[xyz])\s*=\s*\[([^\]]*)\]", text, re.MULTILINE):
        try:
            values = [float(value) for value in re.split(r"[\s;,]+", row.strip())]
        except ValueError:
            raise InputError(f"{path}: {name}: expected three numbers, got {row.strip()[:60]!r}") from None
        rows[name] = values if prefix else [value * 1e-2 for value in values]
    return rows


def _extras(text: str) -> tuple[Extra, ...]:
    names = tuple(text.split(","))
    if unknown := [name for name in names if name not in EXTRAS]:
        raise argparse.ArgumentTypeError(f"expected {' or '.join(EXTRAS)}, got {unknown[0]!r}")
    return tuple(name for name in EXTRAS if name in names)


def _stated(text: str | None) -> Stated | None:
    """Take `y=12.5,-3,40` apart."""
    if text is None:
        return None
    accelerometer, _, rest = text.partition("=")
    try:
        point = [float(value) * MM for value in rest.split(",")]
    except ValueError:
        point = []
    for name in ("x", "y", "z"):
        if accelerometer == name and len(point) == 3:
            return name, point
    raise InputError(
        f"--at: expected an accelerometer and three numbers in mm, such as y=12.5,-3,40, got {text!r}"
    )
