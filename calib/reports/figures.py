"""Figures of the report, as SVG: the same input gives the same bytes."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from calib.estimation.result import RunResult, TurnResult
from calib.estimation.runs import Run
from calib.noise.analysis import ChannelNoise
from calib.noise.model import KINDS, variance_terms
from imudrv.arrays import Array
from imudrv.units import MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN: Final = 7.0


POINTS: Final = 2000
"""Minimum number of points of a long curve."""


COLOURS: Final = ("#1f5fa8", "#b8561a", "#3b7a4b")


_GREY: Final = "#8a8f98"


_STYLE: Final[dict[Any, Any]] = {
    "svg.hashsalt": "imu50",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _GREY,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e5e8",
    "grid.linewidth": 0.6,
    "xtick.color": "#44484f",
    "ytick.color": "#44484f",
    "lines.linewidth": 1.0,
    "legend.frameon": False,
}


@contextmanager
def drawing(height_in: float) -> Iterator[tuple["Figure", BytesIO]]:
    """Give an empty figure, and write it as SVG to the stream once it is drawn."""
    from matplotlib import rc_context  # slow to import; not needed for text
    from matplotlib.figure import Figure

    with rc_context(_STYLE):
        figure, svg = Figure(figsize=(WIDTH_IN, height_in), layout="constrained"), BytesIO()
        yield figure, svg
        if (layout := figure.get_layout_engine()) is not None:
            layout.execute(figure)  # here, because saving a figure with a layout draws it twice
            figure.set_layout_engine("none")
        figure.savefig(svg, format="svg", metadata={"Date": None})


def sensing_points(r_b: Array, C_ba: Array) -> bytes:
    """Draw sensing points and sensing directions of the accelerometers in three views.

    Parameters
    ----------
    r_b : ndarray, shape (3, 3)
        Row i: sensing point of accelerometer i, m, body axes.
    C_ba : ndarray, shape (3, 3)
        Accelerometer axes to body; the sensing directions are the rows of its inverse.

    Returns
    -------
    bytes
        SVG.
    """
    points, directions = r_b / MM, np.linalg.inv(C_ba)
    arrows = 0.3 * (float(np.ptp(points, axis=0).max()) or 1.0) * directions
    shown = np.concatenate([points, points + arrows, np.zeros((1, 3))])
    middle = (shown.min(axis=0) + shown.max(axis=0)) / 2.0
    half = 0.6 * float(np.ptp(shown, axis=0).max())
    with drawing(2.7) as (figure, svg):
        # axes to the right and up on the paper, and the direction towards the viewer
        views = (
            ("from above", 0, 1, [0, 0, 1]),
            ("from behind", 0, 2, [0, -1, 0]),
            ("from the right", 1, 2, [1, 0, 0]),
        )
        for axes, (title, h, v, viewer) in zip(figure.subplots(1, 3), views, strict=True):
            axes.set_title(title)
            axes.plot(0.0, 0.0, "+", color=_GREY, markersize=9)
            for name, point, arrow, colour in zip("xyz", points, arrows, COLOURS, strict=True):
                at, tip = point[[h, v]], (point + arrow)[[h, v]]
                axes.plot(*at, "o", color=colour, markersize=5)
                if np.hypot(arrow[h], arrow[v]) > 0.5 * np.linalg.norm(arrow):
                    axes.annotate("", tip, at, arrowprops={"arrowstyle": "->", "color": colour})
                else:
                    axes.plot(*at, "o", color=colour, markersize=11, fillstyle="none")
                    if arrow @ viewer < 0.0:
                        axes.plot(*at, "x", color=colour, markersize=8)
                axes.annotate(name, at, (-7, -10), textcoords="offset points", color=colour, weight="bold")
            axes.set(
                xlim=(middle[h] - half, middle[h] + half),
                ylim=(middle[v] - half, middle[v] + half),
                xlabel=f"{'XYZ'[h]} (mm)",
                ylabel=f"{'XYZ'[v]} (mm)",
                aspect="equal",
            )
    return svg.getvalue()


def velocities(run: Run, result: RunResult) -> bytes:
    """Draw the velocity of a run at rest with the estimate, and the residuals.

    Parameters
    ----------
    run : Run
        The run, for the times of its turns.
    result : RunResult
        Estimate for that run.

    Returns
    -------
    bytes
        SVG.
    """
    rests = [(float(run.t_s[at][0]), float(run.t_s[at][-1])) for at in run.arrests]
    with drawing(2.2) as (figure, svg):
        left, right = figure.subplots(1, 2)
        for k, name in enumerate(("east", "north")):
            v, fitted = result.v_n[:, k] / MM, result.fitted_n[:, k] / MM
            left.plot(result.t_s, v, ".", color=COLOURS[k], markersize=3, label=name)
            for begin, end in rests:
                part = (result.t_s >= begin) & (result.t_s <= end)
                left.plot(result.t_s[part], fitted[part], color=COLOURS[k], alpha=0.6)
            right.plot(result.t_s, v - fitted, ".", color=COLOURS[k], markersize=3)
        left.set(title="velocity at rest (points), estimate (lines)", ylabel="mm/s")
        right.set(title="residuals", ylabel="mm/s")
        for axes in (left, right):
            for (_, begin), (end, _) in pairwise(rests):
                axes.axvspan(begin, end, color="#eef0f3", linewidth=0)
            axes.set_xlabel("time from the start of navigation (s)")
        left.legend(loc="best", fontsize=7)
    return svg.getvalue()


def before_after(turns: Sequence[TurnResult]) -> bytes:
    """Draw the horizontal velocity after each rotation, measured and without the size effect.

    Parameters
    ----------
    turns : sequence of TurnResult
        The turns; numbered from 1.

    Returns
    -------
    bytes
        SVG.
    """
    with drawing(0.7 + 0.32 * len(turns)) as (figure, svg):
        axes: Axes = figure.subplots()
        at = np.arange(len(turns))
        for k, (name, values) in enumerate(
            (
                ("as measured", [turn.V_n for turn in turns]),
                ("without the size effect", [turn.compensated_n for turn in turns]),
            )
        ):
            speed = [np.hypot(v[0], v[1]) / MM for v in values]
            bars = axes.barh(at + 0.2 * (2 * k - 1), speed, 0.34, color=(_GREY, COLOURS[0])[k], label=name)
            axes.bar_label(bars, fmt="%.1f", padding=3, fontsize=7)
        axes.set(xlabel="horizontal velocity after the rotation (mm/s)")
        axes.margins(x=0.12)  # room for the longest bar's label
        axes.set_yticks(at, [f"turn {k + 1}" for k in at])
        axes.invert_yaxis()
        axes.grid(visible=False, axis="y")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7)
    return svg.getvalue()


def navigations(
    t_s: Array, normal_n: Array, compensated_n: Array, moved_s: tuple[float, float] | None
) -> bytes:
    """Draw the velocity error over time without and with size-effect compensation.

    Parameters
    ----------
    t_s : ndarray, shape (n,)
        Time from the end of the alignment, s.
    normal_n, compensated_n : ndarray, shape (n, 3)
        Velocity: east, north, up, m/s.
    moved_s : tuple of 2 float, or None
        Start and end of the motion, s.

    Returns
    -------
    bytes
        SVG.
    """
    step = max(1, len(t_s) // POINTS)
    with drawing(4.2) as (figure, svg):
        panels = figure.subplots(3, 1, sharex=True)
        for k, (axes, name) in enumerate(zip(panels, ("east", "north", "up"), strict=True)):
            if moved_s is not None:
                axes.axvspan(*moved_s, color="#eef0f3", linewidth=0)
            axes.plot(t_s[::step], normal_n[::step, k], color=COLOURS[1], label="Normal")
            axes.plot(t_s[::step], compensated_n[::step, k], color=COLOURS[0], label="Compensation")
            axes.set_ylabel(f"{name} (m/s)")
        panels[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, fontsize=7)
        panels[-1].set_xlabel("time from the end of the alignment (s)")
    return svg.getvalue()


def directions(sigma: Array, rank: int, limit_m: float) -> bytes:
    """Draw the uncertainty of each principal direction of the nine components.

    Parameters
    ----------
    sigma : ndarray, shape (9,)
        Standard uncertainties, m, ascending.
    rank : int
        Number of observable directions.
    limit_m : float
        Largest uncertainty of an observable direction, m.

    Returns
    -------
    bytes
        SVG.
    """
    with drawing(1.9) as (figure, svg):
        axes: Axes = figure.subplots()
        at = np.arange(1, len(sigma) + 1)
        axes.axhline(limit_m / MM, color=COLOURS[1], linestyle="--", label="limit")
        axes.semilogy(at[:rank], sigma[:rank] / MM, "o", color=COLOURS[0], label="observable")
        axes.semilogy(at[rank:], sigma[rank:] / MM, "o", color=_GREY, fillstyle="none", label="unobservable")
        axes.set(xlabel="principal direction of (r_x, r_y, r_z)", ylabel="sigma (mm)")
        axes.set_xticks(at)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7)
    return svg.getvalue()


def allan_deviations(tau_s: Array, channels: Sequence[ChannelNoise], unit: str, si: float) -> bytes:
    """Draw the Allan deviation of sensors with its 68 % band, the fitted model and the five parts of it.

    Parameters
    ----------
    tau_s : ndarray, shape (n,)
        Averaging times.
    channels : sequence of ChannelNoise
        The sensors.
    unit : str
        Unit of the deviation.
    si : float
        That unit, rad/s or m/s^2.

    Returns
    -------
    bytes
        SVG.
    """
    with drawing(2.6) as (figure, svg):
        panels = figure.subplots(1, len(channels), sharey=True)
        for axes, channel, colour in zip(panels, channels, COLOURS, strict=True):
            fit, deviation = channel.fit, channel.deviation / si
            axes.loglog(tau_s, deviation, ".", color=_GREY, markersize=2)
            at = np.searchsorted(tau_s, fit.tau_s)
            band = fit.deviation_sigma / si
            low = np.maximum(deviation[at] - band, 0.1 * deviation[at])
            axes.fill_between(fit.tau_s, low, deviation[at] + band, color=colour, alpha=0.25, linewidth=0)
            axes.loglog(fit.tau_s, deviation[at], ".", color=colour, markersize=3)
            bottom, top = 0.5 * deviation.min(), 2.0 * deviation.max()
            if fit.is_accepted:
                terms = variance_terms(fit.tau_s) * fit.squares
                axes.loglog(fit.tau_s, np.sqrt(terms.sum(axis=1)) / si, color=colour)
                for kind, term in zip(KINDS, terms.T, strict=True):
                    if term.max() > 0.0:
                        axes.loglog(fit.tau_s, np.sqrt(term) / si, ":", color=_GREY, linewidth=0.7)
                        k = int(np.argmax(term))
                        axes.annotate(kind, (fit.tau_s[k], np.sqrt(term[k]) / si), fontsize=7)
            axes.set(title=channel.name, xlabel="averaging time (s)", ylim=(bottom, top))
        panels[0].set_ylabel(f"Allan deviation ({unit})")
    return svg.getvalue()
