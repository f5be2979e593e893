"""Feed the product with input that no unit, bus or user should send, and check that its properties hold.

    tools/run python -m tools.fuzz [--seconds N | --cases N] [--seed S] [--only TARGET] [--first I]

Targets: the decoders (stream, candump, can, datagram), those of random profiles (profiles), settings files
(yaml), the processing from a capture to compensated increments (chain), capture files (log), recordings
(recording), URLs of ports (url), journals of sessions (journal), and the status socket (status). Case I of a
target depends on the seed and I alone. The first failure is reduced, written to a file, and ends the run with
exit code 1; Ctrl-C ends it with the summary.
"""

import argparse
import contextlib
import itertools
import math
import os
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

from rich.console import Console
from rich.table import Table

from imudrv.terminal import INTERRUPTED, OK, OUR_FAULT

from .cases import TARGETS, Case, Target

LIMIT_S: Final = 300.0
"""Longest that a case may take: none needs a second, but machines stall."""


class TimeLimit(threading.Thread):
    """Ends the run when a case takes too long; a thread, because kernels cannot be interrupted."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.stopped = threading.Event()
        self.case: Case | None = None
        self.since = time.monotonic()

    def run(self) -> None:
        """Check once a second."""
        while not self.stopped.wait(1.0):
            if self.case and time.monotonic() - self.since > LIMIT_S:
                name, reproduction = self.case.target.name, self.case.reproduction()
                print(f"{name} takes more than {LIMIT_S:.0f} s\n{reproduction}", flush=True)
                os._exit(OUR_FAULT)


def run(cases: Iterable[Case], seconds: float, out: Console) -> int:
    """Run cases until one fails or time is up; return the exit code."""
    end, limit = time.monotonic() + seconds, TimeLimit()
    limit.start()
    with out.status("", refresh_per_second=4) as status, warnings.catch_warnings():
        warnings.simplefilter("error")  # users would see them
        try:
            for case in cases:
                limit.case, limit.since = case, time.monotonic()
                if limit.since > end:
                    break
                status.update(f"{case.target.name} {case.number:,}")
                case.run()
        except Exception as error:
            limit.stopped.set()
            out.print(*traceback.format_tb(error.__traceback__)[-3:], sep="", markup=False)
            out.print(f"{case.target.name} failed: {type(error).__name__}: {error}", markup=False)
            status.update("reducing the input; Ctrl-C stops this")
            size = len(case.data)
            with contextlib.suppress(KeyboardInterrupt):
                out.print(f"reduced from {size} bytes: {case.shrink(error)}", markup=False)
            out.print(case.reproduction(), markup=False)
            return OUR_FAULT
        finally:
            limit.stopped.set()
    return OK


def summary(targets: Sequence[Target]) -> Table:
    """Return a table of the input of each target."""
    table = Table("target", "cases", "MB")
    for t in targets:
        table.add_row(t.name, f"{t.cases:,}", f"{t.size / 1e6:.2f}")
    return table


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seconds", type=float, help="duration (default: 60 without --cases)")
    parser.add_argument("--cases", type=int, help="number of cases of each target")
    parser.add_argument("--seed", type=int, default=1, help="seed of the cases (default: %(default)s)")
    parser.add_argument("--first", type=int, default=0, help="first case (default: %(default)s)")
    parser.add_argument("--only", choices=[t.name for t in TARGETS], help="one target instead of all")
    options = parser.parse_args(argv)
    if min(options.seed, options.first, options.cases or 0, options.seconds or 0) < 0:
        parser.error("expected numbers of 0 or more")
    targets = [replace(t) for t in TARGETS if options.only in (None, t.name)]
    numbers = itertools.islice(itertools.count(options.first), options.cases)
    seconds = options.seconds or (60.0 if options.cases is None else math.inf)
    out = Console(highlight=False, soft_wrap=True)
    try:
        code = run((Case(t, options.seed, n) for n in numbers for t in targets), seconds, out)
    except KeyboardInterrupt:
        code = INTERRUPTED
    out.print(summary(targets), f"seed {options.seed}", sep="\n")
    return code


if __name__ == "__main__":
    sys.exit(main())
