"""Latency of the loop, from the read that completed a sample to its datagram on the socket."""

from typing import Final, NamedTuple

from imudrv.units import NS

_SUB_BITS: Final = 4  # each factor of two in 16 bins: a quantile is correct within 6 %


_BINS: Final = 64 << _SUB_BITS


class LatencyReport(NamedTuple):
    """Quantiles of the latency since the start, s, and the number of samples later than the deadline."""

    p50_s: float
    p99_s: float
    p999_s: float
    max_s: float
    late: int


class Latency:
    """Histogram of latencies; a call allocates no object that stays.

    Parameters
    ----------
    deadline_ns : int
        Latency above which a sample counts as late.
    """

    def __init__(self, deadline_ns: int) -> None:
        self._deadline_ns = deadline_ns
        self._counts = [0] * _BINS
        self._worst_ns = 0
        self._late = 0

    def add(self, latency_ns: int, samples: int) -> None:
        """Count samples of one latency."""
        ns = max(latency_ns, 0)
        shift = max(ns.bit_length() - _SUB_BITS - 1, 0)
        self._counts[(shift << _SUB_BITS) + (ns >> shift)] += samples
        self._worst_ns = max(self._worst_ns, ns)
        if ns > self._deadline_ns:
            self._late += samples

    @property
    def report(self) -> LatencyReport:
        """Quantiles so far; zeros before the first sample."""
        total = sum(self._counts)

        def quantile(share: float) -> float:
            passed = 0
            for i, count in enumerate(self._counts):
                passed += count
                if count and passed >= share * total:
                    return min(_upper_ns(i), self._worst_ns) * NS
            return 0.0

        return LatencyReport(quantile(0.5), quantile(0.99), quantile(0.999), self._worst_ns * NS, self._late)


def _upper_ns(i: int) -> int:
    """Return the largest latency of a bin."""
    shift = max((i >> _SUB_BITS) - 1, 0)
    return ((i - (shift << _SUB_BITS) + 1) << shift) - 1
