"""Accuracy of the identified lever arms over simulated units: see `calib.validation.montecarlo`.

tools/run python tools/montecarlo.py --cases 200
tools/run python tools/montecarlo.py --budget slow --signs both --json
"""

import argparse
import json
from collections.abc import Iterable
from dataclasses import asdict, replace

from rich.console import Console
from rich.progress import track
from rich.table import Table

from calib.estimation.priors import Priors
from calib.validation.montecarlo import BUDGETS, run_cases


def main() -> None:
    """Run the cases and print their statistics."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--cases", type=int, default=200, help="number of units (default: %(default)s)")
    parser.add_argument("--budget", choices=BUDGETS, default="standard", help="default: %(default)s")
    parser.add_argument("--signs", choices=("one", "both"), default="one", help="three rotations or six")
    parser.add_argument(
        "--skew-sigma-ms",
        type=float,
        default=Priors().skew * 1e3,
        help="gyro-accelerometer skew of the units, 1 sigma, and its prior; 0: none (default: %(default)s)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the first case (default: %(default)s)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args()
    if options.cases < 1:
        parser.error("--cases: expected 1 or more")
    if not 0.0 <= options.skew_sigma_ms <= 2.0:
        parser.error("--skew-sigma-ms: expected 0 to 2")
    budget = BUDGETS[options.budget]
    budget = replace(budget, priors=replace(budget.priors, skew=options.skew_sigma_ms * 1e-3))
    seeds: Iterable[int] = range(options.seed, options.seed + options.cases)
    if not options.json:
        seeds = track(seeds, description="cases", transient=True)
    signs = (1,) if options.signs == "one" else (1, -1)
    found = run_cases(seeds, signs, budget)
    if options.json:
        rows = [asdict(row) for row in found]
        print(json.dumps({"budget": options.budget, "signs": options.signs, "methods": rows}, indent=1))
        return
    table = Table(
        "method", "mean rms", "worst", "scatter", "predicted", "ratio", "NEES (6)", "95 % band", "chi2/dof"
    )
    for s in found:
        table.add_row(
            s.method,
            *(f"{x:.4f}" for x in (s.mean_rms_mm, s.worst_rms_mm, s.scatter_mm, s.predicted_mm)),
            f"{s.ratio:.3f}",
            f"{s.nees:.2f}",
            f"{s.nees_band[0]:.2f} .. {s.nees_band[1]:.2f}",
            f"{s.chi_square_per_degree:.2f}",
        )
    console = Console()
    console.print(f"{options.cases} units, budget {options.budget}, {3 * len(signs)} rotations each; mm")
    console.print(table)


if __name__ == "__main__":
    main()
