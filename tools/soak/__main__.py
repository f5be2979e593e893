"""Endurance tests of the live service with real processes, ptys, sockets, buses and full disks.

    tools/run python -m tools.soak all
    tools/run python -m tools.soak loopback [--seconds 60]     also loopback-can, loopback-canfd
    tools/run python -m tools.soak fast [--seconds 60]         20 kHz
    tools/run python -m tools.soak fastest [--seconds 5]       100 kHz
    tools/run python -m tools.soak outputs [--minutes 30]      all outputs at once
    tools/run python -m tools.soak zenoh [--seconds 60]        two subscribers, one of which stops
    tools/run python -m tools.soak faults [--seconds 20]       the same counts offline, live and recorded
    tools/run python -m tools.soak kill [--times 20]           recordings after kill -9
    tools/run python -m tools.soak unplug [--seconds 15]       and full disk, stuck and absent receivers
    tools/run python -m tools.soak hostile [--minutes 30]      clients, calibrations, recordings, sockets
    tools/run python -m tools.soak hours [--hours 10]          in virtual time

Run it in the folder of the project. Each test prints what is required and what was found; the exit code is 1
when a check failed. Counts and contents must be right on any machine; times, loads and sizes depend on it.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from .checks import Check, StepError
from .disruption import disruption
from .hostile import hostile
from .kill import kill
from .line_faults import line_faults
from .loopback import loopback
from .outputs import outputs
from .subscribers import subscribers
from .virtual_hours import virtual_hours


class SoakTest(NamedTuple):
    """A test, and the option that sets its size."""

    run: Callable[[Path, float], list[Check]]
    option: str
    default: float
    help: str


TESTS: Final = {
    "loopback": SoakTest(loopback, "--seconds", 60, "every sample, from a pty to UDP, at 1 kHz"),
    "loopback-can": SoakTest(partial(loopback, profile="imu50-can"), "--seconds", 60, "from a CAN bus"),
    "loopback-canfd": SoakTest(partial(loopback, profile="imu50-canfd"), "--seconds", 60, "from CAN FD"),
    "fast": SoakTest(partial(loopback, rate_hz=20_000), "--seconds", 60, "every sample at 20 kHz"),
    "fastest": SoakTest(partial(loopback, rate_hz=100_000), "--seconds", 5, "every sample at 100 kHz"),
    "outputs": SoakTest(outputs, "--minutes", 30, "UDP, eight TCP clients, serial and recording at once"),
    "zenoh": SoakTest(
        subscribers, "--seconds", 60, "two services, two subscribers, of which one stops for 3 s"
    ),
    "faults": SoakTest(line_faults, "--seconds", 20, "the same counts offline, live and recorded"),
    "kill": SoakTest(kill, "--times", 20, "recordings after kill -9"),
    "unplug": SoakTest(disruption, "--seconds", 15, "unplugged port, full disk, stuck and absent receivers"),
    "hostile": SoakTest(hostile, "--minutes", 30, "40 clients that do not read, calibrations, deleted files"),
    "hours": SoakTest(virtual_hours, "--hours", 10, "counts and memory over hours of virtual time"),
}


def run(name: str, size: float) -> bool:
    """Run a test in a temporary folder and print its checks; return whether all passed."""
    print(f"{name} {TESTS[name].option} {size:g}", flush=True)
    with tempfile.TemporaryDirectory(prefix="soak-") as folder:
        try:
            checks = TESTS[name].run(Path(folder), size)
        except StepError as error:
            checks = [Check("the test runs to its end", str(error), False)]
    print(*checks, sep="\n", flush=True)
    return all(check.passed for check in checks)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.soak", description=(__doc__ or "").split("\n")[0])
    commands = parser.add_subparsers(dest="name", required=True, metavar="TEST")
    commands.add_parser("all", help="all tests")
    for name, test in TESTS.items():
        command = commands.add_parser(name, help=test.help)
        command.add_argument(
            test.option, dest="size", type=float, default=test.default, help="default: %(default)s"
        )
    options = parser.parse_args(argv)
    if getattr(options, "size", 1) <= 0:
        parser.error("expected a number above 0")
    names = list(TESTS) if options.name == "all" else [options.name]
    passed = [run(name, getattr(options, "size", TESTS[name].default)) for name in names]
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main())
