"""Accuracy of the noise coefficients over simulated records: error over its sigma, and what is observable.

tools/run python tools/noise_montecarlo.py --kinds QN
tools/run python tools/noise_montecarlo.py --kinds QNBK --records 24 --json
"""

import argparse
import json
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from calib.noise.estimates import EstimatesCovariance
from calib.noise.fit import Fit, fit, usable
from calib.noise.model import KINDS, B, K, N, Q, R
from calib.noise.pyramid import KEEP, Pyramid
from imudrv.units import ARCSEC, DEG_PER_H, DEG_PER_SQRT_H

Array = NDArray[np.float64]

INTERVAL_S: Final = 0.01
TRUE: Final = np.array(
    [
        0.1 * ARCSEC,
        0.002 * DEG_PER_SQRT_H,
        0.05 * DEG_PER_H,
        0.8 * DEG_PER_H / 60.0,
        10.0 * DEG_PER_H / 3600.0,
    ]
)
"""Coefficients, SI; each is observable beside the others in 1.5 h, its square 3.8 of its sigmas or more.

The fit reports a square from 2 sigma on. Of a coefficient near that limit only the high estimates are
reported, so that the z-score of those is far from 0 whatever their sigma.
"""


def record(kinds: str, samples: int, rng: np.random.Generator) -> Array:
    """Return angle increments with some kinds of noise."""
    true = np.where([kind in kinds for kind in KINDS], TRUE, 0.0)
    t_s = np.arange(samples) * INTERVAL_S
    rate = true[R] * t_s + np.cumsum(true[K] * INTERVAL_S**0.5 * rng.normal(size=samples))
    if true[B]:
        rate += true[B] * flicker(samples, rng)
    angle = np.cumsum(true[N] * INTERVAL_S**0.5 * rng.normal(size=samples) + rate * INTERVAL_S)
    angle += true[Q] * rng.normal(size=samples)
    increments: Array = np.diff(angle, prepend=0.0)
    return increments


def flicker(samples: int, rng: np.random.Generator) -> Array:
    """Return noise of the two-sided density 1 / (2 pi f), from twice its length."""
    frequency = np.fft.rfftfreq(2 * samples, INTERVAL_S)
    omega = 2.0 * np.sin(np.pi * frequency[1:] * INTERVAL_S) / INTERVAL_S
    root = np.concatenate([[0.0], np.sqrt(1.0 / (omega * INTERVAL_S))])
    noise: Array = np.fft.irfft(np.fft.rfft(rng.normal(size=2 * samples)) * root)[:samples]
    return noise


def fitted(increments: Array) -> Fit:
    """Return the fit of one record."""
    pyramid = Pyramid(1)
    pyramid.feed(increments[:, None], np.full(len(increments), KEEP, np.int8))
    found = usable(pyramid.result())
    return fit(found, 0, INTERVAL_S, EstimatesCovariance(found, INTERVAL_S))


def main() -> None:
    """Fit the records and print their statistics."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--kinds", default="QN", help="kinds of noise in the records (default: %(default)s)")
    parser.add_argument("--records", type=int, default=24, help="default: %(default)s")
    parser.add_argument("--hours", type=float, default=1.5, help="length of a record (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="default: %(default)s")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args()
    if not set(options.kinds) <= set(KINDS) or options.records < 1 or options.hours < 0.1:
        parser.error(f"--kinds: expected letters of {KINDS}; --records: 1 or more; --hours: 0.1 or more")
    rng = np.random.default_rng(options.seed)
    samples = round(options.hours * 3600.0 / INTERVAL_S)
    fits = [fitted(record(options.kinds, samples, rng)) for _ in range(options.records)]
    rows = []
    for k, kind in enumerate(KINDS):
        true = TRUE[k] if kind in options.kinds else 0.0
        seen = [one for one in fits if np.isfinite(one.value[k])]
        z = np.array([(one.value[k] - true) / one.sigma[k] for one in seen])
        rows.append(
            {
                "kind": kind,
                "in_the_records": bool(true),
                "observable": len(seen),
                "z_rms": float(np.sqrt(np.mean(z**2))) if len(seen) else None,
                "sigma_percent": float(100.0 * np.mean([one.sigma[k] / true for one in seen]))
                if len(seen) and true
                else None,
                "above_the_limit": sum(one.below[k] < true for one in fits),
            }
        )
    reduced = float(np.mean([one.reduced_chi_square for one in fits]))
    if options.json:
        print(
            json.dumps({"records": options.records, "reduced_chi_square": reduced, "kinds": rows}, indent=1)
        )
        return
    table = Table(
        "kind", "in the records", "observable", "z rms", "sigma, %", "true value above the 95 % limit"
    )
    for row in rows:
        table.add_row(
            *(
                "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)
                for value in row.values()
            )
        )
    console = Console()
    console.print(f"{options.records} records of {options.hours:g} h; reduced chi-square {reduced:.2f}")
    console.print(table)


if __name__ == "__main__":
    main()
