"""Many benches, measured: an index that finds what has changed, workers that identify again, and a table.

tools/run python tools/fleet.py                           # all of it
tools/run python tools/fleet.py --sessions 8              # fewer sessions for the workers
tools/run python tools/fleet.py --tree sessions           # your sessions, which are only read

The sessions of the fleet have certificates and no recordings: 25 units on five benches over two years, of
which one bench is off by 0.05 mm and one unit drifts by 0.02 mm a month. Those for the workers are copies of
one rehearsal, as links. Each check is printed; the exit code is 1 if one failed.
"""

import argparse
import logging
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final, NamedTuple, TypeVar

import numpy as np
from rich.console import Console
from rich.table import Table

from calib.bench.entries import Decision, EmbeddedFile, SessionEnded
from calib.bench.session import Session
from calib.bench.state import RESULT
from calib.certificate import PROVENANCE_IDENTIFIED, with_lever_arms
from calib.fleet import report
from calib.fleet.changes import MONTH_DAYS, Measurement, find_changes
from calib.fleet.index import measurements, opened, update
from calib.fleet.reidentify import Reidentified, reidentify_all, sessions
from calib.lever_arms.gauge import LeverArms
from imudrv.calibration import write_calibration
from imudrv.files import settings_file
from imudrv.sim.scenario import NOMINAL
from imudrv.site import Site
from imudrv.units import MM

SIGMA_MM: Final = 0.02
BENCHES: Final = tuple(f"bench {k}" for k in range(1, 6))
OFF_BENCH, DRIFTING_UNIT = "bench 4", "50-0007"
BEGUN: Final = datetime(2026, 1, 1, tzinfo=UTC)

PLANNED_BENCHES, PLANNED_YEARS, SESSIONS_A_YEAR = 50, 5, 1000
"""What is extrapolated to; four sessions a working day on each bench."""

_PROCEDURE: Final = b"""
format: imu50-procedure
version: 1
name: one
poses: [{id: z-up, up: +Z, east: +X, turn_deg: 180}]
"""
T = TypeVar("T")


def fleet(
    seed: int, sessions: int = 200, units: int = 25, off_mm: float = 0.0, drift_mm: float = 0.0
) -> list[Measurement]:
    """Draw the results of units on benches over two years.

    Parameters
    ----------
    seed : int
        Random seed.
    sessions, units : int
        Their numbers.
    off_mm : float
        By which `OFF_BENCH` is off in one axis.
    drift_mm : float
        By which `DRIFTING_UNIT` drifts in one axis a month.
    """
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(6, 6)) * 0.3 + np.eye(6)
    P = A @ A.T * SIGMA_MM**2
    levels = rng.normal(0.0, 20.0, (units, 6))
    found = []
    for n in range(sessions):
        unit, bench, t = f"50-{n % units:04}", BENCHES[rng.integers(len(BENCHES))], float(rng.uniform(0, 730))
        value = levels[n % units] + rng.multivariate_normal(np.zeros(6), P)
        value[1] += off_mm * (bench == OFF_BENCH)
        value[4] += drift_mm * (unit == DRIFTING_UNIT) * t / MONTH_DAYS
        found.append(Measurement(unit, bench, t, value, P))
    return found


def write_session(folder: Path, result: Measurement, operator: str = "Li") -> None:
    """Write a complete session with this result and without recordings; its papers are beside it."""
    papers = folder.parent
    papers.mkdir(parents=True, exist_ok=True)
    unit = NOMINAL.model_copy(update={"serial_number": result.unit})
    write_calibration(papers / "unit.yaml", unit)
    settings_file.write(papers / "site.yaml", Site(latitude_deg=28.2, longitude_deg=113.0, height_m=60.0))
    bench = f"{{format: imu50-bench, version: 1, bench: {result.bench}}}"
    session = Session.create(
        folder,
        procedure=EmbeddedFile.of("one.yaml", _PROCEDURE),
        calibration=papers / "unit.yaml",
        site=EmbeddedFile.of("site.yaml", (papers / "site.yaml").read_bytes()),
        profile="imu50-rs422",
        port="/dev/ttyUSB0",
        bench=EmbeddedFile.of("bench.yaml", bench.encode()),
        operator=operator,
    )
    covariance = np.zeros((9, 9))
    covariance[3:, 3:] = result.covariance * MM**2
    r_b = -np.concatenate([np.zeros(3), result.value]).reshape(3, 3) * MM  # x - y, x - z
    made = with_lever_arms(
        unit,
        LeverArms(r_b, covariance, "x"),
        PROVENANCE_IDENTIFIED,
        {},
        BEGUN + timedelta(days=result.t_days),
    )
    write_calibration(folder / RESULT, made)
    session.record_file(RESULT)
    session.append(Decision(True))
    session.end(SessionEnded(None))
    session.close()


class Index(NamedTuple):
    """What the index of sessions without recordings takes: bytes and s each, s a question by their number."""

    bytes: float
    new_s: float
    ask_s: dict[int, float]
    is_good: bool


class Workers(NamedTuple):
    """What sessions with recordings take: bytes, s to index, and s of a worker to identify again, each."""

    bytes: float
    verify_s: float
    identify_s: float
    is_good: bool


def main() -> int:
    """Run it; return the exit code."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--sessions", type=int, default=40, metavar="N", help="default: %(default)s")
    parser.add_argument("--tree", type=Path, help="identify these sessions again instead of a rehearsal's")
    options = parser.parse_args()
    if options.sessions < 4:
        parser.error("--sessions: expected 4 or more")
    with tempfile.TemporaryDirectory(prefix="fleet-") as name:
        folder = Path(name)
        index = _indexed(folder / "fleet")
        tree = options.tree or _copies(folder / "rehearsed", options.sessions)
        workers = _identified_again(tree)
    _print_table(index, workers)
    return 0 if index.is_good and workers.is_good else 1


def _copies(tree: Path, count: int) -> Path:
    """Rehearse one session and copy it by links."""
    tree.mkdir()
    command = [
        sys.executable,
        "-m",
        "calib",
        "run",
        "--rehearse",
        "--speed",
        "max",
        "--session",
        str(tree / "0"),
    ]
    _, s = _timed(lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL))
    print(f"one session rehearsed: {s:.0f} s", flush=True)
    for number in range(1, count):
        for file in (tree / "0").rglob("*"):
            copy = tree / str(number) / file.relative_to(tree / "0")
            copy.parent.mkdir(parents=True, exist_ok=True)
            if file.is_file():
                os.link(file, copy)
    return tree


def _identified_again(tree: Path) -> Workers:
    """Identify sessions again by one worker, by two, and by two of which one is killed."""
    folders = sessions([tree])
    with _workers(1) as cluster:
        list(reidentify_all(folders[:1], scheduler=cluster.scheduler_address))  # loads the kernels
        alone, one_s = _timed(lambda: list(reidentify_all(folders, scheduler=cluster.scheduler_address)))
    with _workers(2) as cluster:
        list(reidentify_all(folders[:2], scheduler=cluster.scheduler_address))
        both, two_s = _timed(lambda: list(reidentify_all(folders, scheduler=cluster.scheduler_address)))
        survived, death_s = _timed(lambda: list(_with_a_death(folders, cluster)))
    found = [[(one.r_mm, one.fault) for one in some] for some in (alone, both, survived)]
    serial = list(reidentify_all(folders[:1]))
    is_good = found[0] == found[1] == found[2] and (serial[0].r_mm, "") == found[0][0]
    _check(
        is_good,
        f"{len(folders)} sessions identified again: one worker {one_s:.1f} s, two {two_s:.1f} s "
        f"({one_s / two_s:.2f} times as fast), two of which one is killed {death_s:.1f} s; the same bits, "
        "and those of this process",
    )
    size = sum(file.stat().st_size for folder in folders for file in folder.rglob("*"))
    with tempfile.TemporaryDirectory() as name:
        _, verify_s = _timed(lambda: update(tree, Path(name) / "i.sqlite"))
    return Workers(size / len(folders), verify_s / len(folders), one_s / len(folders), is_good)


def _with_a_death(folders: list[Path], cluster: Any) -> Iterator[Reidentified]:
    done = reidentify_all(folders, scheduler=cluster.scheduler_address)
    yield next(done)
    import distributed

    with distributed.Client(cluster) as client:
        tasks = client.processing()
        busy = max(tasks, key=lambda worker: len(tasks[worker]))
        os.kill(client.run(os.getpid, workers=[busy])[busy], signal.SIGKILL)
    yield from done


@contextmanager
def _workers(count: int) -> Iterator[Any]:
    import distributed

    with distributed.LocalCluster(
        n_workers=count, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL
    ) as cluster:
        yield cluster


def _indexed(folder: Path) -> Index:
    """Index a fleet, at once and in two steps, and ask what has changed."""
    tree, later = folder / "sessions", folder / "later"
    for number, result in enumerate(fleet(1, off_mm=0.05, drift_mm=0.02)):
        write_session((later if number % 4 == 3 else tree / "first") / f"{number}", result)
    update(tree, folder / "i.sqlite")
    later.rename(tree / "later")
    update(tree, folder / "i.sqlite")
    done, new_s = _timed(lambda: update(tree, folder / "new.sqlite"))
    _, again_s = _timed(lambda: update(tree, folder / "new.sqlite"))
    with opened(folder / "i.sqlite") as old, opened(folder / "new.sqlite") as new:
        is_equal = _rows(old) == _rows(new)
        found = {(change.kind, change.name) for change in find_changes(measurements(new))}
        benches, benches_s = _timed(lambda: report.benches(new))
        drift, drift_s = _timed(lambda: report.drift(new, DRIFTING_UNIT))
    is_found = found == {("bench", OFF_BENCH), ("unit", DRIFTING_UNIT)}
    is_found &= not benches.is_good and not drift.is_good
    size = (folder / "new.sqlite").stat().st_size
    _check(
        is_equal,
        f"{done.new} sessions indexed in {new_s:.2f} s, again in {again_s:.2f} s, {size / 1e6:.2f} MB; "
        "an index that was brought up to date equals it",
    )
    names = ", ".join(" ".join(one) for one in sorted(found))
    _check(is_found, f"changed: {names}; asked in {benches_s:.2f} s (benches) and {drift_s:.2f} s (drift)")
    alarms = sum(bool(find_changes(fleet(seed))) for seed in range(100, 120))
    _check(alarms <= 2, f"20 fleets of 200 sessions in which nothing changes: {alarms} alarms, 0.2 expected")
    ask_s = {}
    for count in (200, 400, 800):
        drawn = fleet(1, count, count // 8)
        _, ask_s[count] = _timed(lambda drawn=drawn: find_changes(drawn))  # type: ignore[misc]
    return Index(size / done.new, new_s / done.new, ask_s, is_equal and is_found and alarms <= 2)


def _rows(database: Any) -> list[Any]:
    return [
        row
        for name in ("session", "quantity")
        for row in database.execute(f"SELECT * FROM {name} ORDER BY 1, 2, 3").fetchall()
    ]


def _print_table(index: Index, workers: Workers) -> None:
    """Print what was measured, and what it means for many benches."""
    total = PLANNED_BENCHES * PLANNED_YEARS * SESSIONS_A_YEAR
    (few, few_s), *_, (many, many_s) = index.ask_s.items()
    power = np.log(many_s / few_s) / np.log(many / few)
    rows = {
        "files": (f"{workers.bytes / 1e6:.0f} MB a session", f"{workers.bytes * total / 1e12:.1f} TB"),
        "index": (f"{index.bytes / 1e3:.1f} kB a session", f"{index.bytes * total / 1e9:.2f} GB"),
        "index from nothing, hashes of all files": (
            f"{workers.verify_s * 1e3:.0f} ms a session",
            f"{workers.verify_s * total / 3600:.1f} h",
        ),
        "the same without recordings": (
            f"{index.new_s * 1e3:.1f} ms a session",
            f"{index.new_s * total / 60:.0f} min",
        ),
        "what has changed": (
            ", ".join(f"{s:.2f} s of {count}" for count, s in index.ask_s.items()),
            f"as n^{power:.1f}: an hour at {many * (3600 / many_s) ** (1 / power):.0f} sessions",
        ),
        "identify again": (
            f"{workers.identify_s:.2f} s a session",
            f"{workers.identify_s * total / 3600:.0f} h of a worker",
        ),
    }
    table = Table("", "measured", f"{PLANNED_BENCHES} benches, {PLANNED_YEARS} years: {total} sessions")
    for name, cells in rows.items():
        table.add_row(name, *cells)
    Console(width=110).print(table)


def _timed(function: Callable[[], T]) -> tuple[T, float]:
    begin = time.monotonic()
    result = function()
    return result, time.monotonic() - begin


def _check(is_good: bool, text: str) -> None:
    print(f"{'ok    ' if is_good else 'FAILED'} {text}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
