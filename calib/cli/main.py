"""The command `calib`: arguments in, one function a command, plain words out."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from calib.cli.arguments import EXTRAS, PROGRAMS, extra_terms, one_or_three, positive
from calib.cli.arms import run_export, run_gauge, run_import
from calib.cli.bench import run_session, run_verify
from calib.cli.dither import run_dither
from calib.cli.identify import run_identify
from calib.cli.validate import run_validate
from calib.lever_arms.gauge import GAUGES
from calib.procedure import plan
from calib.validation.simulate import TRIALS
from calib.validation.trial import RATE_FILTER
from imudrv import profiles
from imudrv.imu.rate_filter import NAMES
from imudrv.nav.alignment import ALIGNMENT_S
from imudrv.terminal import CommandLine


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

    sub = add("identify", run_identify, "Captures of rotations to lever arms, certificate and report.")
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
        "--estimate", type=extra_terms, default=(), metavar="WHAT", help=f"more unknowns: {','.join(EXTRAS)}"
    )
    sub.add_argument(
        "-o", "--output", type=Path, required=True, metavar="NEW.yaml", help="the certificate to write"
    )
    sub.add_argument("--json", type=Path, metavar="R.json", help="the whole result, for programs")
    sub.add_argument("--report", type=Path, metavar="R.html", help="the report with figures, one file")

    sub = add("run", run_session, "Walk through the bench procedure with a unit, to its certificate.")
    sub.add_argument("--port", metavar="URL", help="where the unit is, as for imudrv run")
    sub.add_argument("--profile", metavar="P", help="what it sends, as for imudrv run")
    sub.add_argument(
        "--calibration", type=Path, metavar="C.yaml", help="its certificate; new once you accept"
    )
    sub.add_argument("--site", type=Path, metavar="S.yaml", help="where it stands")
    sub.add_argument("--procedure", metavar="P", help=f"{', '.join(plan.shipped())}, or a file")
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

    sub = add(
        "verify", run_verify, "Check a session's evidence, and find its result again from the recordings."
    )
    sub.add_argument("session", type=Path, metavar="DIR")

    sub = add(
        "validate",
        run_validate,
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

    sub = add(
        "gauge", run_gauge, "A certificate's lever arms in another gauge, exactly, with their covariance."
    )
    sub.add_argument("file", type=Path, help="the certificate")
    add_gauge(sub, "--to", required=True)
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="NEW.yaml")

    sub = add("export-arms", run_export, "A certificate's lever arms as another program writes them.")
    sub.add_argument("file", type=Path, help="the certificate")
    sub.add_argument("--to", choices=PROGRAMS, required=True, help="kalibr: YAML; psins: MATLAB")

    sub = add("import-arms", run_import, "Lever arms that another program found, into a certificate.")
    sub.add_argument(
        "file",
        type=Path,
        help="Kalibr's imu.yaml; of PSINS what clbtfile writes (cm), or lines clbt.rx = [...] (m)",
    )
    sub.add_argument("--from", dest="program", choices=PROGRAMS, required=True, help="who wrote it")
    sub.add_argument("--calibration", type=Path, required=True, metavar="C.yaml", help="the unit's")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="NEW.yaml")

    sub = add("dither", run_dither, "What dithering gyros do to accelerometers, and what rate filters pass.")
    sub.add_argument(
        "--amplitude-arcsec",
        type=one_or_three,
        required=True,
        metavar="A[,A,A]",
        help="of the blocks x, y, z, such as 150; 150,0,0 for one gyro",
    )
    sub.add_argument(
        "--frequency-hz", type=one_or_three, required=True, metavar="F[,F,F]", help="such as 400,405,393"
    )
    sub.add_argument("--certificate", type=Path, required=True, metavar="C.yaml", help="with lever arms")
    sub.add_argument("--rate-hz", type=positive, default=1000.0, metavar="HZ", help="default: 1000")
    sub.add_argument("--rate-filter", choices=NAMES, help="default: all of them")
    sub.add_argument(
        "--case-reaction",
        type=positive,
        default=0.01,
        metavar="PART",
        help="the case's angle over the block's; default: 0.01",
    )
    return line
