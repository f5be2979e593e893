"""Command `imudrv run`."""

import argparse
import sys
from pathlib import Path
from typing import Final

from imudrv.cli.arguments import add_profile
from imudrv.imu.rate_filter import NAMES
from imudrv.service import settings
from imudrv.service.loop import Service
from imudrv.service.printer import Printer
from imudrv.service.runtime import SignalFlags
from imudrv.service.settings import Settings
from imudrv.signals import SIGHUP
from imudrv.terminal import INTERRUPTED, OK

EXAMPLE: Final = (
    "--port /dev/ttyUSB0 --profile imu50-rs422 --calibration unit.yaml --out udp://localhost:5050"
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command; their names are those of `Settings`."""
    add = parser.add_argument
    add("settings", type=Path, nargs="?", help="settings file; options override it")
    add("--port", metavar="URL", help="port of the unit: /dev/ttyUSB0, can://..., replay://..., sim://...")
    add_profile(parser)
    add("--calibration", metavar="C.yaml", help="calibration file of the unit")
    add("--unit", metavar="SERIAL", help="serial number of the connected unit")
    text = "udp://HOST:PORT, tcp://[HOST]:PORT, serial://PATH, can://..., zenoh://KEY, file:NAME; repeatable"
    add("--out", dest="outputs", action="append", metavar="URL", help=text)
    add("--record", metavar="FILE.mcap", help="record everything; in a folder: one file for each run")
    text = "have the disk keep the recording at least this often (default: when the system does, 5 to 30 s)"
    add("--sync", dest="sync_s", type=float, metavar="S", help=text)
    text = "leave the recording as it was written, neither compressed nor indexed at the end of the run"
    add("--no-pack", dest="pack", action="store_false", default=None, help=text)
    add("--rate-filter", choices=NAMES, help="angular rate for the size effect (default: causal)")
    add("--status", metavar="PATH", help="socket that reports the status")
    add("--realtime", action="store_true", default=None, help="request SCHED_FIFO and locked memory")


def run(arguments: argparse.Namespace) -> int:
    """Run the service until a signal ends it."""
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
