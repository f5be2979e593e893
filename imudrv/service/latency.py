"""Latency of the loop, from the read that completed a sample to its datagram on the socket."""

from typing import Final, NamedTuple, Self

import numpy as np

from imudrv.kernels import kernel
from imudrv.records import Records
from imudrv.units import NS

_SUB_BITS: Final = 4  # each factor of two in 16 bins: a quantile is correct within 6 %
_BINS: Final = 64 << _SUB_BITS

LATENCY: Final = np.dtype(
    [
        ("deadline_ns", np.int64),
        ("worst_ns", np.int64),
        ("late", np.int64),  # samples above the deadline
        ("counts", np.int64, _BINS),
    ],
    align=True,
)
"""State of `count_latency`."""


class LatencyReport(NamedTuple):
    """Latency since the start.

    Attributes
    ----------
    p50_s, p99_s, p999_s, max_s : float
        Quantiles, s.
    late : int
        Number of samples later than the deadline.
    histogram : tuple of (int, int)
        Largest latency of each bin that is not empty, ns, and the number of samples in it.
    """

    p50_s: float
    p99_s: float
    p999_s: float
    max_s: float
    late: int
    histogram: tuple[tuple[int, int], ...] = ()


class Latency:
    """Histogram of latencies.

    Parameters
    ----------
    deadline_ns : int
        Latency above which a sample counts as late.

    Attributes
    ----------
    state : ndarray of LATENCY, shape (1,)
        For `count_latency`.
    """

    def __init__(self, deadline_ns: int) -> None:
        self.state = np.zeros(1, LATENCY)
        self.state["deadline_ns"] = deadline_ns

    def copy(self) -> Self:
        """Return a copy that does not change any more."""
        other = type(self)(0)
        other.state[:] = self.state
        return other

    @property
    def report(self) -> LatencyReport:
        """Latency so far; zeros before the first sample."""
        s = self.state[0]
        counts, worst_ns = s["counts"], int(s["worst_ns"])
        passed, used = np.cumsum(counts), np.flatnonzero(counts)
        histogram = tuple(zip(map(_upper_ns, used.tolist()), counts[used].tolist(), strict=True))

        def quantile(share: float) -> float:
            if not passed[-1]:
                return 0.0
            return min(_upper_ns(int(np.searchsorted(passed, share * passed[-1]))), worst_ns) * NS

        quantiles = quantile(0.5), quantile(0.99), quantile(0.999), worst_ns * NS
        return LatencyReport(*quantiles, int(s["late"]), histogram)


@kernel
def count_latency(latency_ns: int, samples: int, state: Records) -> None:
    """Count samples of one latency.

    Parameters
    ----------
    latency_ns, samples : int
        The latency, and the number of samples that had it.
    state : ndarray of LATENCY
        `Latency.state`.
    """
    s = state[0]
    ns, shift = max(latency_ns, 0), 0
    while ns >> shift >= 2 << _SUB_BITS:
        shift += 1
    s["counts"][(shift << _SUB_BITS) + (ns >> shift)] += samples
    s["worst_ns"] = max(s["worst_ns"], ns)
    if ns > s["deadline_ns"]:
        s["late"] += samples


def _upper_ns(i: int) -> int:
    """Return the largest latency of a bin."""
    shift = max((i >> _SUB_BITS) - 1, 0)
    return ((i - (shift << _SUB_BITS) + 1) << shift) - 1
