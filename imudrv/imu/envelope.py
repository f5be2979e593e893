"""Lower envelope: the line under all points of a window that comes closest to them on average.

It is the edge of the lower convex hull of the points that spans their mean x; x and y are times in ns. Of
each quarter of a second of x only the lowest point is kept, and the line changes only at the ends of these
bins, that is at fixed x, however the points are cut into pieces. While there are fewer bins than `MIN_BINS`
the line is level, through the lowest point.
"""

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from imudrv.kernels import kernel
from imudrv.units import NS_PER_S

BIN_NS: Final = NS_PER_S // 4
MIN_BINS: Final = 40
"""Bins with points that a line needs: 10 s."""
MAX_SKEW: Final = 500e-6
"""Largest slope of a line; no clock is that far off."""
MAX_CLEARANCE_NS: Final = 20_000_000
"""Largest distance from a line to the lowest point of the last `MIN_BINS` bins."""

_NO_POINT: Final = 2**62

ENVELOPE: Final = np.dtype(
    [
        ("first", np.int64),  # the points in use
        ("stop", np.int64),
        ("bin_end", np.int64),  # x at the end of the open bin
        ("low_x", np.int64),  # lowest point of the open bin
        ("low_y", np.int64),
        ("fitted", np.bool_),  # the line is an edge of the hull
        ("x0", np.float64),  # see `Line`
        ("y0", np.float64),
        ("skew", np.float64),
        ("clearance", np.float64),  # from a fitted line to the lowest point of the last `MIN_BINS` bins
    ],
    align=True,
)
"""State of an envelope between calls."""


class Line(NamedTuple):
    """Line `y = y0 + skew (x - x0)`."""

    x0: float
    y0: float
    skew: float


def room_for_points(window_ns: int) -> NDArray[np.int64]:
    """Make room for the points of a window.

    Parameters
    ----------
    window_ns : int
        Length of the window.

    Returns
    -------
    ndarray of int64, shape (3, n)
        x and y of the lowest point of each bin, and space for the hull. Twice as long as the window, so that
        points are seldom moved to the front.
    """
    return np.zeros((3, 2 * (window_ns // BIN_NS + 2)), np.int64)


@kernel
def line_of(e: np.void) -> Line:
    """Return the line."""
    return Line(e["x0"], e["y0"], e["skew"])


@kernel
def height(line: Line, x: int) -> float:
    """Return y of the line at x."""
    return line.y0 + line.skew * (x - line.x0)


@kernel
def above(line: Line, x: int, y: float) -> float:
    """Return how far a point is above the line."""
    return y - line.y0 - line.skew * (x - line.x0)


@kernel
def begin(e: np.void) -> None:
    """Start an envelope at x = 0, without points, with the line y = 0."""
    e["first"] = e["stop"] = 0
    e["bin_end"], e["low_y"] = BIN_NS, _NO_POINT
    e["fitted"] = False
    e["x0"] = e["y0"] = e["skew"] = 0.0


@kernel
def add_point(e: np.void, x: int, y: int) -> float:
    """Add a point of the open bin; return by how much a level line falls with it."""
    if y < e["low_y"]:
        e["low_x"], e["low_y"] = x, y
    if e["fitted"] or y >= e["y0"]:
        return 0.0
    fall = e["y0"] - y
    e["y0"] = y
    return float(fall)


@kernel
def close_bin(e: np.void, points: NDArray[np.int64], x: int, window_ns: int) -> bool:
    """Keep the lowest point of the open bin, which ends before x, and find the line of the window up to x.

    Returns False where a line that was fitted does not hold any more, no line fits `MIN_BINS` bins, or
    nothing is left of the window.
    """
    first, stop = e["first"], e["stop"]
    if stop == points.shape[1]:
        for k in range(first, stop):
            points[0, k - first], points[1, k - first] = points[0, k], points[1, k]
        first, stop = 0, stop - first
    points[0, stop], points[1, stop] = e["low_x"], e["low_y"]
    stop += 1
    while first < stop and points[0, first] < x - window_ns:
        first += 1
    if first == stop:
        return False
    e["first"], e["stop"] = first, stop
    e["bin_end"], e["low_y"] = x - x % BIN_NS + BIN_NS, _NO_POINT
    good = stop - first >= MIN_BINS
    if good:
        line = _middle_edge(points, first, stop)
        clearance = np.inf
        for k in range(stop - MIN_BINS, stop):
            clearance = min(clearance, above(line, points[0, k], points[1, k]))
        good = abs(line.skew) <= MAX_SKEW and clearance <= MAX_CLEARANCE_NS
        e["clearance"] = clearance
    if not good:
        if e["fitted"] or stop - first >= MIN_BINS:
            return False
        line = Line(0.0, float(points[1, first:stop].min()), 0.0)
    e["x0"], e["y0"], e["skew"] = line
    e["fitted"] = good
    return True


@kernel
def _middle_edge(points: NDArray[np.int64], first: int, stop: int) -> Line:
    """Edge of the lower convex hull that spans the mean x (Andrew, 1979)."""
    x, y, hull = points[0], points[1], points[2]
    top = 0
    total = 0.0
    for k in range(first, stop):
        total += x[k] - x[first]
        while top >= 2:
            a, b = hull[top - 2], hull[top - 1]
            if float(x[b] - x[a]) * (y[k] - y[a]) > float(x[k] - x[a]) * (y[b] - y[a]):
                break
            top -= 1
        hull[top] = k
        top += 1
    middle = x[first] + total / (stop - first)
    j = 1
    while x[hull[j]] < middle:
        j += 1
    a, b = hull[j - 1], hull[j]
    return Line(float(x[a]), float(y[a]), (y[b] - y[a]) / float(x[b] - x[a]))
