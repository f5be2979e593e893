"""Missing samples from the times of arrival, where the unit's own numbers do not give them.

A sample can arrive late, never early. Of samples that one read delivered the last one is the freshest. How
late it is, against the least of the last arrivals, is jitter as long as it varies, and missing samples when
it stays: then it is a multiple of a *period*, one sample interval for a unit without a counter, and the time
in which a narrow counter goes round.
"""

from typing import Final

import numpy as np

from imudrv.kernels import kernel

KEPT: Final = 32
"""Arrivals that determine the jitter; while there are fewer, one sample interval counts as jitter."""

ARRIVALS: Final = np.dtype(
    [
        ("t_ns", np.int64),  # of the newest
        ("least_ns", np.int64),  # least arrival less elapsed time
        ("count", np.int64),  # in use of
        ("late_ns", np.int64, KEPT),  # how late each of the latest arrivals was
        ("slot", np.int64),
    ],
    align=True,
)
"""State of the kernels between calls."""


@kernel
def missing_periods(a: np.void, t_ns: int, elapsed_ns: int, period_ns: float, interval_ns: int) -> int:
    """Take note of an arrival; return how many periods are missing before it.

    Parameters
    ----------
    a : void of ARRIVALS
        State.
    t_ns : int
        Time of arrival.
    elapsed_ns : int
        Time by the samples up to the last one that arrived, if none is missing.
    period_ns : float
        Time of which a multiple may be missing.
    interval_ns : int
        Sample interval.

    Returns
    -------
    int
    """
    late = t_ns - elapsed_ns - a["least_ns"]
    first = a["t_ns"] == 0
    a["t_ns"] = t_ns
    if first or late < -period_ns / 2:
        a["least_ns"] += late
        a["count"] = a["slot"] = 0
        return 0
    jitter = interval_ns if a["count"] < KEPT else 0
    for k in range(a["count"]):
        jitter = max(jitter, a["late_ns"][k])
    missing = 0
    # Jitter near one sample interval looks like a missing sample: only what stays then counts.
    is_clear = jitter < period_ns / 4 or period_ns > 2 * interval_ns
    if is_clear and late - jitter > period_ns / 2:
        missing = max(1, int(np.rint((late - jitter / 2) / period_ns)))
        # No sample is early: one that is late by less than a period follows a pause.
        missing = min(missing, int((late + jitter + interval_ns) / period_ns))
        late -= int(missing * period_ns)
    a["late_ns"][a["slot"]] = late
    a["slot"] = (a["slot"] + 1) % KEPT
    a["count"] = min(a["count"] + 1, KEPT)
    if a["slot"] == 0 or late < 0:
        missing += _settle(a, period_ns)
    return missing


@kernel
def _settle(a: np.void, period_ns: float) -> int:
    """Measure from the least late of the latest arrivals; return the periods that all of them are late."""
    least = a["late_ns"][0]
    for k in range(1, a["count"]):
        least = min(least, a["late_ns"][k])
    missing = max(0, int(np.rint(least / period_ns)))
    a["least_ns"] += least - int(missing * period_ns)
    for k in range(a["count"]):
        a["late_ns"][k] -= least
    return missing
