"""Accuracy of the identified lever arms over simulated units: see `calib.validation.montecarlo`.

tools/run python tools/montecarlo.py --cases 200 --skew-sigma-ms 0
tools/run python tools/montecarlo.py --budget coarse-pulses --signs both --cases 20
tools/run python tools/montecarlo.py --budget ten-turns --cases 10 --skew-sigma-ms 0 --bound
tools/run python tools/montecarlo.py --search 100 --workers 2

Seeds below 1000 were used to tune the estimate; reports begin at 1000.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from calib.cli.arguments import add_workers
from calib.detection.acceptance import RotationLimits
from calib.estimation.joint import estimate_joint
from calib.estimation.priors import Priors
from calib.estimation.result import LeverArmEstimate
from calib.fleet.spread import spread
from calib.identification import CaptureSummary, IdentificationResult, PriorCalibration
from calib.messages import english
from calib.reports.verdict import verdict
from calib.validation.bound import sigma_over_bound
from calib.validation.montecarlo import (
    BUDGETS,
    SITE,
    Budget,
    captures,
    drawn,
    nominal,
    statistics,
    true_arms,
    worst_sigma,
)
from imudrv.arrays import Array
from imudrv.errors import InputError

FIRST_SEED = 1000


class Outcome(NamedTuple):
    """Result of one case."""

    level: str  # of the verdict, or `refused`
    reason: str
    estimate: LeverArmEstimate | None
    truth: Array
    over_bound: float = 0.0  # sigma over that of the Cramer-Rao bound, where it is wanted

    @property
    def usable(self) -> bool:
        """Whether a certificate is made."""
        return self.level not in ("bad", "refused")

    @property
    def worst_sigma(self) -> float:
        """Largest error of a difference, in its standard uncertainty."""
        return 0.0 if self.estimate is None else worst_sigma(self.estimate, self.truth)


def outcome(seed: int, budget: Budget, *, bound: bool = False) -> Outcome:
    """Identify a unit; and compare its covariance with the bound."""
    truth = true_arms(seed, budget)
    try:
        found = captures(seed, budget)
        runs = [run for capture in found for run in capture.runs]
        estimate = estimate_joint(runs, budget.priors)
    except InputError as error:
        return Outcome("refused", str(error), None, truth)
    sources = tuple(CaptureSummary("case", "case", "", budget.profile, "", (), capture) for capture in found)
    known = PriorCalibration(nominal(budget), "nominal", "")
    overall, *marks = verdict(
        IdentificationResult(estimate, known, SITE, RotationLimits(), budget.priors, sources)
    )
    worst = next(mark for mark in marks if mark.level == overall.level)
    over_bound = sigma_over_bound(estimate, runs, budget.priors) if bound else 0.0
    return Outcome(overall.level, english(worst.text), estimate, truth, over_bound)


def drawn_outcome(seed: int) -> Outcome:
    """Identify a unit in conditions drawn at random."""
    return outcome(seed, drawn(seed))


def main() -> None:
    """Run the cases and print their statistics."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--cases", type=int, default=200, help="number of units (default: %(default)s)")
    parser.add_argument("--budget", choices=BUDGETS, default="standard", help="default: %(default)s")
    parser.add_argument("--signs", choices=("one", "both"), help="three rotations or six")
    parser.add_argument(
        "--skew-sigma-ms",
        type=float,
        default=Priors().skew * 1e3,
        help="gyro-accelerometer skew of the units, 1 sigma, and its prior; 0: none (default: %(default)s)",
    )
    text = "seed of the first case (default: %(default)s; tuned on seeds below)"
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help=text)
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    text = "also compare the stated covariance with the Cramer-Rao bound of the same noise and priors"
    parser.add_argument("--bound", action="store_true", help=text)
    text = "instead: N cases with conditions drawn at random, and the worst errors among them"
    parser.add_argument("--search", type=int, metavar="N", help=text)
    add_workers(parser)
    options = parser.parse_args()
    if options.cases < 1 or (options.search is not None and options.search < 1):
        parser.error("--cases, --search: expected 1 or more")
    if not 0.0 <= options.skew_sigma_ms <= 2.0:
        parser.error("--skew-sigma-ms: expected 0 to 2")
    seeds = range(options.seed, options.seed + (options.search or options.cases))

    def outcomes(function: Callable[[int], Outcome]) -> list[Outcome]:
        found: Iterable[Outcome] = spread(function, seeds, options.workers, options.scheduler)
        if not options.json:
            found = track(found, description="cases", total=len(seeds), transient=True)
        return list(found)

    if options.search:
        _print_search(list(zip(seeds, outcomes(drawn_outcome), strict=True)))
        return
    budget = BUDGETS[options.budget]
    budget = replace(budget, priors=replace(budget.priors, skew=options.skew_sigma_ms * 1e-3))
    if options.signs:
        budget = replace(budget, signs=(1,) if options.signs == "one" else (1, -1))
    _print_statistics(options, budget, outcomes(partial(outcome, budget=budget, bound=options.bound)))


def _print_statistics(options: Any, budget: Budget, found: list[Outcome]) -> None:
    """Print the statistics of the usable results, and the verdicts of all."""
    usable = [(one.estimate, one.truth) for one in found if one.estimate is not None and one.usable]
    levels = dict(Counter(one.level for one in found))
    row = asdict(statistics("joint", usable)) if usable else {}
    if options.bound and usable:
        row["sigma_over_bound"] = float(np.mean([one.over_bound for one in found if one.usable]))
    if options.json:
        print(
            json.dumps({"budget": options.budget, "signs": budget.signs, "verdicts": levels, **row}, indent=1)
        )
        return
    table = Table("of usable results", "value", title=f"{len(found)} units, budget {options.budget}")
    table.add_row("rotations", str(3 * len(budget.signs) * budget.turns))
    for name, value in row.items():
        text = f"{value:.4g}" if isinstance(value, float) else str(value)
        table.add_row(
            name.replace("_", " "), f"{value[0]:.2f} .. {value[1]:.2f}" if name == "nees_band" else text
        )
    table.add_row("verdicts", ", ".join(f"{n} {level}" for level, n in levels.items()))
    console = Console()
    console.print(table)
    for level in levels:
        if level != "good":
            console.print(f"{level}: {next(one.reason for one in found if one.level == level)}")


def _print_search(found: list[tuple[int, Outcome]]) -> None:
    """Print how many results of each verdict there are, and the worst of each."""
    table = Table("verdict", "cases", "worst error, sigma", "seed", "beyond 4 sigma")
    for level in ("good", "note", "caution", "bad", "refused"):
        cases = [(one.worst_sigma, seed) for seed, one in found if one.level == level]
        if cases:
            worst, seed = max(cases)
            beyond = [str(seed) for sigma, seed in cases if sigma > 4.0]
            table.add_row(level, str(len(cases)), f"{worst:.2f}", str(seed), ", ".join(beyond))
    Console().print(table)


if __name__ == "__main__":
    main()
